"""One slow, obvious version of each equation, to compare the fast one with.

No function here shares code with the package; most are loops over Python numbers.
"""

import itertools
import math

import numpy as np
import scipy.linalg
import torch

# ---------------------------------------------------------------------------------------------------------------------
# losses
# ---------------------------------------------------------------------------------------------------------------------


def cosine(a, b):
    """Cosine of the angle between two vectors; 0 where one of them is zero."""
    lengths = math.sqrt(sum(x * x for x in a)) * math.sqrt(sum(x * x for x in b))
    return sum(x * y for x, y in zip(a, b, strict=True)) / lengths if lengths > 0 else 0.0


def nearest_neighbors(features, style_features):
    """For each feature the index of the first style feature with the largest cosine."""
    nearest = []
    for feature in features.tolist():
        cosines = [cosine(feature, style) for style in style_features.tolist()]
        nearest.append(cosines.index(max(cosines)))
    return nearest


def nnfm_loss(features, style_features):
    """(1/N) Σ_i min_j (1 − cos(f_i, s_j))."""
    distances = [min(1 - cosine(f, s) for s in style_features.tolist()) for f in features.tolist()]
    return sum(distances) / len(distances)


def semantic_loss(maps, target_maps):
    """1 − cos of the means of two feature maps [C][h][w] over their places."""
    means = [[sum(map(sum, channel)) / sum(map(len, channel)) for channel in each] for each in (maps, target_maps)]
    return 1 - cosine(*means)


def content_loss(features, target):
    """Σ (f − f*)² / Σ f*²."""
    pairs = list(zip(features.flatten().tolist(), target.flatten().tolist(), strict=True))
    return sum((f - t) ** 2 for f, t in pairs) / sum(t**2 for _, t in pairs)


# ---------------------------------------------------------------------------------------------------------------------
# color
# ---------------------------------------------------------------------------------------------------------------------


def color_moments(colors, weights):
    """Weighted mean and covariance, one colour at a time."""
    total = sum(weights.tolist())
    mean = sum(w * np.array(c) for c, w in zip(colors.tolist(), weights.tolist(), strict=True)) / total
    covariance = np.zeros((3, 3))
    for color, weight in zip(colors.tolist(), weights.tolist(), strict=True):
        difference = np.array(color) - mean
        covariance += weight * np.outer(difference, difference) / total
    return mean, covariance


def palette_transform(content_mean, content_covariance, style_mean, style_covariance):
    """A = Σ_s^½ Σ_c^−½ and b = μ_s − A μ_c by SciPy's general matrix square root; Σ_c must be invertible."""
    matrix = scipy.linalg.sqrtm(style_covariance) @ np.linalg.inv(scipy.linalg.sqrtm(content_covariance))
    return matrix, style_mean - matrix @ content_mean


def carried_in_order(points, target, rotation):
    """Each point's place along each axis of a rotation, taken by what the target has there; as many as points."""
    moved = np.zeros_like(points)
    for axis in rotation.T:
        places = sorted(range(len(points)), key=lambda index: points[index] @ axis)
        for index, wanted in zip(places, sorted(point @ axis for point in target), strict=True):
            moved[index] += wanted * axis
    return moved


def smooth_table(colors, offsets, side, smoothness, least):
    """`palette.smooth_table` as a least-squares problem written out, a row for each term; by [r, g, b] and channel."""
    rows, wanted, cells = [], [], side - 1
    for color, offset in zip(colors, offsets, strict=True):
        lower = np.minimum((color * cells).astype(int), cells - 1)
        for corner in itertools.product((0, 1), repeat=3):
            fraction = color * cells - lower
            pull = np.sqrt(np.prod(np.where(corner, fraction, 1 - fraction)) / len(colors))
            row = np.zeros((side,) * 3)
            row[tuple(lower + corner)] = pull
            rows.append(row.ravel())
            wanted.append(pull * offset)
    for axis in range(3):
        for place in itertools.product(range(side), repeat=3):
            if 0 < place[axis] < cells:
                row = np.zeros((side,) * 3)
                for step, factor in ((-1, 1), (0, -2), (1, 1)):
                    near = list(place)
                    near[axis] += step
                    row[tuple(near)] = factor
                rows.append(row.ravel() * np.sqrt(smoothness))
                wanted.append(np.zeros(3))
    rows += list(np.eye(side**3) * np.sqrt(least))
    wanted += [np.zeros(3)] * side**3
    found = np.linalg.lstsq(np.array(rows), np.array(wanted), rcond=None)[0]
    return found.reshape(side, side, side, 3)


# ---------------------------------------------------------------------------------------------------------------------
# evaluation
# ---------------------------------------------------------------------------------------------------------------------


def frechet_distance(first, second):
    """FID by SciPy's general matrix square root; both covariances must be regular."""
    means, covariances = [], []
    for sample in (first, second):
        means.append(sum(np.array(row) for row in sample.tolist()) / len(sample))
        differences = [np.array(row) - means[-1] for row in sample.tolist()]
        covariances.append(sum(np.outer(row, row) for row in differences) / (len(sample) - 1))
    root = scipy.linalg.sqrtm(covariances[0] @ covariances[1])
    return float(np.sum((means[0] - means[1]) ** 2) + np.trace(covariances[0] + covariances[1] - 2 * root).real)


# ---------------------------------------------------------------------------------------------------------------------
# schedule
# ---------------------------------------------------------------------------------------------------------------------


def content_weight(step, initial, decay, duration):
    """Eq. 6 for T > 0, by multiplying with the T-th root of α once an iteration."""
    weight = initial
    for _ in range(min(step, duration)):
        weight *= decay ** (1 / duration)
    return weight


# ---------------------------------------------------------------------------------------------------------------------
# rendering
# ---------------------------------------------------------------------------------------------------------------------


def weights(depths):
    """Weights of a ray's samples from their optical depths: what each takes of the light its predecessors left."""
    light, taken = 1.0, []
    for depth in depths:
        taken.append(light * (1 - math.exp(-depth)))
        light *= math.exp(-depth)
    return taken


def distortion(weights, edges):
    """Σ_ij w_i w_j |m_i − m_j| + ⅓ Σ w_i² (s_{i+1} − s_i), all pairs one by one."""
    middles = [(left + right) / 2 for left, right in itertools.pairwise(edges)]
    placed = list(zip(weights, middles, strict=True))
    between = sum(wi * wj * abs(mi - mj) for wi, mi in placed for wj, mj in placed)
    widths = [right - left for left, right in itertools.pairwise(edges)]
    return between + sum(w * w * width for w, width in zip(weights, widths, strict=True)) / 3


def inverse_cdf(edges, weights, quantile):
    """Where a histogram with these borders and masses has `quantile` of its mass to the left."""
    wanted = quantile * sum(weights)
    for left, right, weight in zip(edges[:-1], edges[1:], weights, strict=True):
        if weight > 0 and wanted <= weight:
            return left + wanted / weight * (right - left)
        wanted -= weight
    return edges[-1]


def contract(point):
    """x/2 where the largest coordinate |x| is below 1, else (1 − 1/(2|x|)) x/|x|: mip-NeRF 360's, halved."""
    norm = max(abs(coordinate) for coordinate in point)
    factor = 0.5 if norm < 1 else (1 - 0.5 / norm) / norm
    return [factor * coordinate for coordinate in point]


def ndc_points(points, focal_over_half_size, near=1.0):
    """Images of world points in NDC (NeRF, appendix C): (-(2f/w) x/z, -(2f/h) y/z, 1 + 2n/z), of a tensor of points.

    A point on or behind the camera plane has no image: its z is taken to be -1e-6 n.
    """
    x, y, z = points.unbind(-1)
    z = z.clamp(max=-1e-6 * near)
    scale_x, scale_y = focal_over_half_size
    return torch.stack([-scale_x * x / z, -scale_y * y / z, 1 + 2 * near / z], dim=-1)


def cell(position, resolution):
    """Cell indices of a point in [−1, 1]³; a point outside belongs to the nearest cell."""
    return tuple(min(max(math.floor((x + 1) / 2 * resolution), 0), resolution - 1) for x in position)


def pixel(depths, colors, s, background=(0.0, 0.0, 0.0)):
    """Colour over a background, Σw, and mean position Σws/Σw of one ray."""
    ray = weights(depths)
    opacity = sum(ray)
    color = [
        sum(w * c[channel] for w, c in zip(ray, colors, strict=True)) + (1 - opacity) * background[channel]
        for channel in range(3)
    ]
    return color, opacity, sum(w * x for w, x in zip(ray, s, strict=True)) / opacity if opacity > 0 else 1.0


# ---------------------------------------------------------------------------------------------------------------------
# encodings
# ---------------------------------------------------------------------------------------------------------------------


def positional_encoding(x, num_levels):
    """γ(x): x, then for each octave the sines of all coordinates and the cosines of all."""
    encoded = list(x)
    for octave in range(num_levels):
        encoded += [math.sin(2**octave * coordinate) for coordinate in x]
        encoded += [math.cos(2**octave * coordinate) for coordinate in x]
    return encoded


def tiny_cuda_encoding(position, params, num_levels, smallest, growth, features, table_size):
    """ψ(x) as tiny-cuda-nn's GridEncoding (type Hash, linear) has it; params is its flat table."""
    encoded, start = [], 0
    for level in range(num_levels):
        scale = smallest * growth**level - 1
        side = math.ceil(scale) + 1
        rows = min((side**3 + 7) // 8 * 8, table_size)
        sums = [0.0] * features
        for corner in range(8):
            weight, place, stride, hashed = 1.0, 0, 1, 0
            for axis, prime in enumerate((1, 2654435761, 805459861)):
                scaled = position[axis] * scale + 0.5
                step = corner >> axis & 1
                weight *= scaled - math.floor(scaled) if step else 1 - (scaled - math.floor(scaled))
                at = math.floor(scaled) + step
                place += at * stride
                stride *= side
                hashed ^= at * prime & 0xFFFFFFFF
            row = (hashed if stride > rows else place) % rows
            for number in range(features):
                sums[number] += weight * params[start + row * features + number]
        encoded += sums
        start += rows * features
    return encoded


def hash_encoding(position, table, resolutions, table_size):
    """ψ(x): on each level the eight corners' rows, each by the product of its nearness along the axes."""
    encoded = []
    for level, resolution in enumerate(resolutions):
        features = [0.0] * len(table[0])
        for corner in range(8):
            weight, row = 1.0, 0
            for axis, prime in enumerate((1, 2654435761, 805459861)):
                scaled = position[axis] * resolution
                step = corner >> axis & 1
                weight *= scaled - math.floor(scaled) if step else 1 - (scaled - math.floor(scaled))
                row ^= (math.floor(scaled) + step) * prime
            stored = table[level * table_size + row % table_size]
            features = [feature + weight * value for feature, value in zip(features, stored, strict=True)]
        encoded += features
    return encoded


def brightness_ssim(first, second):
    """SSIM (Wang et al. 2004, Eq. 13) of the brightness of pictures, pixel by pixel, with the window's inner part."""
    a, b = (picture.numpy() @ np.array([0.2989, 0.587, 0.114]) for picture in (first, second))
    values = []
    for y, x in itertools.product(*map(range, a.shape)):
        near = np.s_[max(0, y - 5) : y + 6, max(0, x - 5) : x + 6]
        rows, columns = (each[near] for each in np.mgrid[: a.shape[0], : a.shape[1]])
        weights = np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / (2 * 1.5**2))
        weights /= weights.sum()
        mean_a, mean_b = (weights * a[near]).sum(), (weights * b[near]).sum()
        variance_a, variance_b = (weights * a[near] ** 2).sum() - mean_a**2, (weights * b[near] ** 2).sum() - mean_b**2
        covariance = (weights * a[near] * b[near]).sum() - mean_a * mean_b
        likeness = (2 * mean_a * mean_b + 0.01**2) * (2 * covariance + 0.03**2)
        values.append(likeness / ((mean_a**2 + mean_b**2 + 0.01**2) * (variance_a + variance_b + 0.03**2)))
    return np.mean(values)
