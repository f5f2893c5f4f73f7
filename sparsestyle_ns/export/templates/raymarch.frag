#version 300 es
// One ray a pixel through the voxels of a stylised scene, with the steps of the exact render. core/spaces.py and
// rendering/render.py do the same in Python, rendering/mixing.py what lies between the fields, export/voxel_grid.py all
// of it with these voxels. With OF_TILES, instead, how far all rays of a tile of pixels surely meet nothing.
precision highp float;
precision highp int;
precision highp sampler3D;

#define NDC 0
#define BOX 1
#define CONTRACTED 2
// renderer.js defines SPACE, UNBOUNDED, STYLES (how many are seen), HAS_COARSE, OF_TILES and TILE (a tile's side in
// pixels), because a processor that stands in for a graphics card goes through both sides of every `if`.

const float ENOUGH = 0.02;  // light behind which a ray ends; what is left of it gets the last colour
const float ENDLESS = 1e9;      // length of an unbounded ray's last step
const float MIN_FORWARD = 1e-6;
const float MAX_DISTANCE = 1e4;
const float LEAST_STRIDE = 0.25;  // of a step: with less, the rays of a tile have come to something
const float CONTRACTION = 2.0 / 3.0;  // the most by which it stretches a small length of its unit, in the maximum norm

uniform sampler3D u_style, u_other, u_coarse;  // rgb: colour, a: code of the density; z is the first axis
uniform sampler3D u_clearance;                 // how many cells away the nearest is that holds anything, of 255
uniform sampler2D u_free;                      // what the tiles have found: a share of the way, of 65535, in two bytes
uniform float u_strength, u_density_share, u_blend;
uniform float u_divider;                       // left of it, in pixels, is the coarse field
uniform int u_num_steps;
uniform float u_all_steps;                     // as many as voxels were chosen for
uniform vec2 u_style_texels, u_coarse_texels;  // from shares of the cube's sides to a texture's: factor and offset
uniform vec3 u_minimum, u_maximum;       // NDC, box: what becomes the cube
uniform vec2 u_focal_over_half_size;     // NDC
uniform vec2 u_depths;                   // NDC: t' of the nearest and of the farthest thing
uniform float u_near;                    // in world units; contracted: in multiples of u_unit
uniform float u_unit;                    // contracted: the length in the world that isn't bent
uniform float u_density_unit, u_least_density; // in bits: what light is halved by; less than the latter is rounding
uniform vec2 u_density_bits;             // of a code: factor and offset
uniform vec3 u_background;
uniform mat4 u_pose;                     // camera to world
uniform vec2 u_focal, u_center, u_size;  // in pixels; the centre from the top left

out vec4 color;

// A segment in field coordinates, start + s extent, or for a contracted space the ray in its unit.
vec3 start, extent;

float largest(vec3 values) {
    return max(values.x, max(values.y, values.z));
}

#if SPACE == NDC
bool enter(vec3 origin, vec3 direction) {
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

#elif SPACE == BOX
// Distances from a camera between which the whole box lies, and those between which a ray is in it.
vec2 around(vec3 origin) {
    float away = distance(origin, 0.5 * (u_minimum + u_maximum)), reach = 0.5 * distance(u_minimum, u_maximum);
    return max(vec2(away - reach, away + reach), u_near);
}

vec2 within;

bool enter(vec3 origin, vec3 direction) {
#if OF_TILES
    within = around(origin);
#else
    vec3 safe = mix(direction, vec3(1e-30), lessThan(abs(direction), vec3(1e-30)));
    vec3 first = (u_minimum - origin) / safe, second = (u_maximum - origin) / safe;
    vec3 low = min(first, second), high = max(first, second);
    within = vec2(max(largest(low), u_near), min(high.x, min(high.y, high.z)));
#endif
    float scale = 2.0 / largest(u_maximum - u_minimum);
    start = (origin + within.x * direction - 0.5 * (u_minimum + u_maximum)) * scale;
    extent = (within.y - within.x) * direction * scale;
    return within.y > within.x;
}

#else
bool enter(vec3 origin, vec3 direction) {
    start = origin / u_unit;
    extent = direction;
    return true;
}
#endif

#if SPACE == CONTRACTED
float spacing(float distance) {
    return distance < 1.0 ? 0.5 * distance : 1.0 - 0.5 / distance;
}

float distance_at(float s) {
    float spaced = mix(spacing(u_near), spacing(MAX_DISTANCE), s);
    return spaced < 0.5 ? 2.0 * spaced : 0.5 / max(1.0 - spaced, 0.5 / MAX_DISTANCE);
}

vec3 point(float s) {
    float distance = distance_at(s);
    vec3 position = start + distance * extent;
    float norm = largest(abs(position));
    return position * (norm < 1.0 ? 0.5 : (1.0 - 0.5 / norm) / norm);
}
#else
vec3 point(float s) {
    return start + s * extent;
}
#endif

float density_of(float code) {
    float density = u_density_unit * (exp2(u_density_bits.x * code + u_density_bits.y) - 1.0);
    return density > u_least_density ? density : 0.0;
}

// Colour and density of a field, at a share of the cube's sides.
vec4 field(sampler3D voxels, vec2 texels, vec3 share) {
    vec4 value = textureLod(voxels, share * texels.x + texels.y, 0.0);
    return vec4(value.rgb, density_of(value.a));
}

vec4 mixture(vec3 share, float strength, float density_share) {
#if STYLES == 0
    return field(u_coarse, u_coarse_texels, share);
#else
    vec4 value = field(u_style, u_style_texels, share);
#if STYLES == 2
    value = mix(value, field(u_other, u_style_texels, share), u_blend);
#endif
#if HAS_COARSE
    value = mix(field(u_coarse, u_coarse_texels, share), value, vec4(vec3(strength), density_share));
#endif
    return value;
#endif
}

vec3 direction_of(vec2 pixel) {
    vec3 seen = vec3((pixel.x - u_center.x) / u_focal.x, (u_center.y - pixel.y) / u_focal.y, -1.0);
    return normalize(mat3(u_pose) * seen);
}

// How many cells away from a share of the cube's sides the nearest is that holds anything. A texture's nearest texel is
// quicker to find, where there is no graphics card, than one of a number.
float clearance(vec3 share) {
    return floor(255.0 * textureLod(u_clearance, share, 0.0).r + 0.5);
}

#if OF_TILES
// How far in field coordinates the rays of a tile are from the one in its middle at most, at a share s of the way.
float spread_start, spread_extent;

float spread(float s) {
#if SPACE == CONTRACTED
    float distance = distance_at(s), apart = distance * spread_extent;
    float norm = largest(abs(start + distance * extent)) - apart;
    return apart * min(CONTRACTION, 2.0 / max(norm, 1e-6));
#else
    return spread_start + s * spread_extent;
#endif
}

// The share of the way, in the middle of a tile, after which its rays may meet something.
float free_way(float step) {
    float cell = 2.0 / float(textureSize(u_clearance, 0).x), s = 0.0;
    while (s < 1.0) {
        vec3 position = point(s), nearest = clamp(position, -1.0, 1.0);
        float radius = max(0.999 * (clearance((0.5 * nearest + 0.5).zyx) - 1.0) * cell, largest(abs(position - nearest)));
#if SPACE == CONTRACTED
        bool is_free = largest(abs(point(s + step) - position)) + spread(s + step) < radius;
        float stride = is_free ? step : 0.0;
#else
        float stride = (radius - spread(s)) / (largest(abs(extent)) + spread_extent);
#endif
        if (stride < LEAST_STRIDE * step) break;
        s += stride;
    }
    return min(s, 1.0);
}

void main() {
    float side = float(TILE);
    vec2 low = side * floor(gl_FragCoord.xy);
    vec3 origin = u_pose[3].xyz, starts[5], extents[5];
    bool is_seen = true;
    for (int i = 0; i < 5; i++) {
        vec2 at = i == 4 ? vec2(0.5) : vec2(i & 1, i >> 1);
        is_seen = enter(origin, direction_of(vec2(low.x + side * at.x, u_size.y - low.y - side * at.y))) && is_seen;
        starts[i] = start;
        extents[i] = extent;
    }
    spread_start = spread_extent = 0.0;
    for (int i = 0; i < 4; i++) {
        spread_start = max(spread_start, largest(abs(starts[i] - start)));
        spread_extent = max(spread_extent, largest(abs(extents[i] - extent)));
    }
    float way = floor(65535.0 * (is_seen ? free_way(1.0 / float(u_num_steps)) : 0.0));
    color = vec4(floor(way / 256.0) / 255.0, mod(way, 256.0) / 255.0, 0.0, 1.0);
}

#else
// The step before which the rays of this pixel's tile meet nothing.
float first_step() {
    vec2 bytes = floor(255.0 * texelFetch(u_free, ivec2(gl_FragCoord.xy) / TILE, 0).rg + 0.5);
    float way = dot(bytes, vec2(256.0, 1.0)) / 65535.0;
#if SPACE == BOX
    vec2 all = around(u_pose[3].xyz);
    way = (mix(all.x, all.y, way) - within.x) / (within.y - within.x);
#endif
    return floor(float(u_num_steps) * clamp(way, 0.0, 1.0));
}

void main() {
    vec2 pixel = vec2(gl_FragCoord.x, u_size.y - gl_FragCoord.y);
    bool before = pixel.x < u_divider;
    float strength = before ? 0.0 : u_strength, density_share = before ? 0.0 : u_density_share;
    vec3 sum = vec3(0.0);
    float light = 1.0;
    if (enter(u_pose[3].xyz, direction_of(pixel))) {
        float num_steps = float(u_num_steps), step = 1.0 / num_steps, length_ = length(extent) * step;
        float end = UNBOUNDED ? num_steps - 1.0 : num_steps;  // the last step of an unbounded ray always counts
        // Which has its middle where it is with all steps: voxels before that may not be there.
        float last = UNBOUNDED ? num_steps - 0.5 - 0.5 * num_steps / u_all_steps : end;
        // The middle of a step is a share of the cube's sides in the textures' order, which hold nothing beyond 0 and 1.
#if SPACE == CONTRACTED
#define MIDDLE (0.5 * point(((i == end ? last : i) + 0.5) * step) + 0.5).zyx
        float steps_a_cell = 0.0;  // how a contraction bends them, nobody knows
#else
#define MIDDLE first + (i == end ? last : i) * further
        vec3 further = 0.5 * step * extent.zyx, first = 0.5 * start.zyx + 0.5 + 0.5 * further;
        // Steps that surely lead out of no more than one cell.
        float steps_a_cell = 1.998 / (float(textureSize(u_clearance, 0).x) * length_ + 1e-6);
#endif
        bool inside = false;
        for (float i = min(first_step(), end); i <= num_steps - 1.0; i += 1.0) {
            vec3 share = MIDDLE;
            while (!inside && i < end) {
                float clear = clearance(share);
                if (clear == 0.0) break;
                i = min(i + 1.0 + floor((clear - 1.0) * steps_a_cell), end);
                share = MIDDLE;
            }
            vec4 value = mixture(share, strength, density_share);
            inside = value.a > 0.0;
#if SPACE == CONTRACTED
            length_ = distance(point(i * step), point((i + 1.0) * step));
#endif
            float passed = light * exp2(-value.a * (UNBOUNDED && i == end ? ENDLESS : length_));
            passed = passed < ENOUGH ? 0.0 : passed;
            sum += (light - passed) * value.rgb;
            light = passed;
            if (light == 0.0) break;
        }
    }
    color = vec4(sum + light * u_background, 1.0);
}
#endif
