#version 300 es
// One ray a pixel through the voxels of a stylised scene, with the steps of the exact render. core/spaces.py and
// rendering/render.py do the same in Python, export/voxel_grid.py with these voxels.
precision highp float;
precision highp int;
precision highp sampler3D;

const int NDC = 0, BOX = 1, CONTRACTED = 2;
const float MAX_OPTICAL_DEPTH = 80.0;
const float MIN_FORWARD = 1e-6;
const float MAX_DISTANCE = 1e4;

uniform sampler3D u_voxels;     // rgb: colour, a: code of the density; z is the first axis
uniform sampler3D u_occupancy;  // 1 in cells that hold anything
uniform int u_space, u_num_steps;
uniform bool u_unbounded;
uniform vec3 u_minimum, u_maximum;       // NDC, box: what becomes the cube
uniform vec2 u_focal_over_half_size;     // NDC
uniform vec2 u_depths;                   // NDC: t' of the nearest and of the farthest thing
uniform float u_near;                    // in world units; contracted: in multiples of u_unit
uniform float u_unit;                    // contracted: the length in the world that isn't bent
uniform float u_density_unit, u_density_step, u_rounding;
uniform vec3 u_background;
uniform mat4 u_pose;                     // camera to world
uniform vec2 u_focal, u_center, u_size;  // in pixels; the centre from the top left

out vec4 color;

// A segment in field coordinates, start + s extent, or for a contracted space the ray in its unit.
vec3 start, extent;

bool enter_ndc(vec3 origin, vec3 direction) {
    if (direction.z >= -MIN_FORWARD) return false;
    vec2 slope = direction.xy / direction.z;
    vec2 crossing = origin.xy - (u_near + origin.z) * slope;
    vec3 on_near_plane = vec3(u_focal_over_half_size * crossing / u_near, -1.0);
    vec3 at_infinity = vec3(-u_focal_over_half_size * slope, 1.0);
    vec3 line = at_infinity - on_near_plane, scale = 2.0 / (u_maximum - u_minimum);
    // A camera that has flown past the nearest thing doesn't see what is behind it.
    float own = 1.0 + u_near / min(origin.z, -MIN_FORWARD * u_near);
    float first = clamp(own, u_depths.x, u_depths.y);
    start = (on_near_plane + first * line - u_minimum) * scale - 1.0;
    extent = (u_depths.y - first) * line * scale;
    return true;
}

bool enter_box(vec3 origin, vec3 direction) {
    vec3 safe = mix(direction, vec3(1e-30), lessThan(abs(direction), vec3(1e-30)));
    vec3 first = (u_minimum - origin) / safe, second = (u_maximum - origin) / safe;
    vec3 low = min(first, second), high = max(first, second);
    float near = max(max(low.x, max(low.y, low.z)), u_near);
    float far = min(high.x, min(high.y, high.z));
    vec3 size = u_maximum - u_minimum;
    float scale = 2.0 / max(size.x, max(size.y, size.z));
    start = (origin + near * direction - 0.5 * (u_minimum + u_maximum)) * scale;
    extent = (far - near) * direction * scale;
    return far > near;
}

bool enter(vec3 origin, vec3 direction) {
    if (u_space == NDC) return enter_ndc(origin, direction);
    if (u_space == BOX) return enter_box(origin, direction);
    start = origin / u_unit;
    extent = direction;
    return true;
}

float spacing(float distance) {
    return distance < 1.0 ? 0.5 * distance : 1.0 - 0.5 / distance;
}

vec3 point(float s) {
    if (u_space != CONTRACTED) return start + s * extent;
    float spaced = mix(spacing(u_near), spacing(MAX_DISTANCE), s);
    float distance = spaced < 0.5 ? 2.0 * spaced : 0.5 / max(1.0 - spaced, 0.5 / MAX_DISTANCE);
    vec3 position = start + distance * extent, size = abs(position);
    float norm = max(size.x, max(size.y, size.z));
    return position * (norm < 1.0 ? 0.5 : (1.0 - 0.5 / norm) / norm);
}

void main() {
    vec2 pixel = vec2(gl_FragCoord.x, u_size.y - gl_FragCoord.y);
    vec3 seen = vec3((pixel.x - u_center.x) / u_focal.x, (u_center.y - pixel.y) / u_focal.y, -1.0);
    vec3 direction = normalize(mat3(u_pose) * seen);
    vec3 sum = vec3(0.0);
    float light = 1.0;
    if (enter(u_pose[3].xyz, direction)) {
        float step = 1.0 / float(u_num_steps);
        ivec3 cells = textureSize(u_occupancy, 0);
        vec3 texels = vec3(textureSize(u_voxels, 0));
        for (int i = 0; i < u_num_steps; i++) {
            bool last = u_unbounded && i == u_num_steps - 1;
            vec3 share = clamp(0.5 * point((float(i) + 0.5) * step) + 0.5, 0.0, 1.0).zyx;
            ivec3 cell = min(ivec3(share * vec3(cells)), cells - 1);
            if (!last && texelFetch(u_occupancy, cell, 0).r < 0.5) continue;
            vec4 value = textureLod(u_voxels, (share * (texels - 1.0) + 0.5) / texels, 0.0);
            float code = 255.0 * value.a - 1.0;
            if (code <= u_rounding) continue;
            float density = u_density_unit * (exp(u_density_step * code) - 1.0);
            float length_ = distance(point(float(i) * step), point(float(i + 1) * step));
            float left = exp(-(last ? MAX_OPTICAL_DEPTH : min(density * length_, MAX_OPTICAL_DEPTH)));
            sum += light * (1.0 - left) * value.rgb;
            light *= left;
            if (light < 1e-4) break;
        }
    }
    color = vec4(sum + light * u_background, 1.0);
}
