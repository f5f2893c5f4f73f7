"""One slow, obvious version of each equation, to compare the fast one with.

No function here shares code with the package; most are loops over Python numbers.
"""

import math

import numpy as np
import scipy.linalg

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


# ---------------------------------------------------------------------------------------------------------------------
# schedule
# ---------------------------------------------------------------------------------------------------------------------


def content_weight(step, initial, decay, duration):
    """Eq. 6 for T > 0, by multiplying with the T-th root of α once an iteration."""
    weight = initial
    for _ in range(min(step, duration)):
        weight *= decay ** (1 / duration)
    return weight
