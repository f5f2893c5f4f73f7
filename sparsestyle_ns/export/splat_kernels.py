"""Gaussians on a picture, and the way back: the inner loops of `gaussians.py`, where the formulas are.

A Gaussian is a row of `PARAMETERS` numbers: mean (3), logarithms of its scales (3), quaternion (4: w, x, y, z), logit
of its opacity (1) and colour (3). On a picture it is an ellipse, a row of `VALUES` numbers: centre (2), Σ'⁻¹ (3: xx,
xy, yy), opacity (1), colour (3) and Σ'yy, whose root says how many rows it reaches. Each is drawn whole, nearest first,
over the pixels that it reaches, with the light that is left there.
"""

from typing import NamedTuple

import numpy as np

from sparsestyle_ns.utils.numba_kernels import kernel

PARAMETERS, VALUES = 14, 10
REACH = 8.0**0.5
"""An ellipse ends at so many standard deviations, as in most viewers."""
MAX_ALPHA, MIN_ALPHA = 0.99, 1.0 / 255.0
"""Opacities in a pixel are at most the first; with less than the second, nothing is drawn (Kerbl et al.)."""
NEAREST = 0.01
"""Gaussians whose centre is nearer to the camera's plane than this, in world units, aren't drawn."""
OUT_OF_SIGHT = np.float32(np.inf)

_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_SIXTEENTH, _THIRD, _QUARTER = np.float32(1 / 16), np.float32(1 / 3), np.float32(1 / 4)
_NEAREST, _CUT = np.float32(NEAREST), np.float32(REACH * REACH)
_MAX_ALPHA, _MIN_ALPHA = np.float32(MAX_ALPHA), np.float32(MIN_ALPHA)
_DARK = np.float32(1e-4)  # where less light than this is left, nothing is drawn any more
_TINY = np.float32(1e-12)


class Eye(NamedTuple):
    """A pinhole camera: its pose (right, up, back, position as columns), and focal lengths and centre in pixels."""

    pose: np.ndarray
    focal_x: np.float32
    focal_y: np.float32
    center_x: np.float32
    center_y: np.float32
    width: int
    height: int
    blur: np.float32
    sharpened: bool
    foot: np.float32
    """These three as in `gaussians.Drawing`."""


@kernel
def _local(eye, row):
    """A mean in the camera's coordinates: right, up, back."""
    pose = eye.pose
    a, b, c = row[0] - pose[0, 3], row[1] - pose[1, 3], row[2] - pose[2, 3]
    return (
        pose[0, 0] * a + pose[1, 0] * b + pose[2, 0] * c,
        pose[0, 1] * a + pose[1, 1] * b + pose[2, 1] * c,
        pose[0, 2] * a + pose[1, 2] * b + pose[2, 2] * c,
    )


@kernel
def _rotation(row):
    """The rotation of a quaternion, row by row, and the quaternion's length."""
    length = np.sqrt(row[6] * row[6] + row[7] * row[7] + row[8] * row[8] + row[9] * row[9])
    w, x, y, z = row[6] / length, row[7] / length, row[8] / length, row[9] / length
    first = (_ONE - _TWO * (y * y + z * z), _TWO * (x * y - w * z), _TWO * (x * z + w * y))
    second = (_TWO * (x * y + w * z), _ONE - _TWO * (x * x + z * z), _TWO * (y * z - w * x))
    third = (_TWO * (x * z - w * y), _TWO * (y * z + w * x), _ONE - _TWO * (x * x + y * y))
    return first, second, third, length


@kernel
def _axes(eye, row, x, y, z):
    """A Gaussian's three half axes on the picture, in pixels: J W R S, two rows of three."""
    pose = eye.pose
    across, down = -eye.focal_x / z, eye.focal_y / z
    aside, below = across * x / z, down * y / z
    r0, r1, r2, _ = _rotation(row)
    j0, j1, j2 = (
        across * pose[0, 0] - aside * pose[0, 2],
        across * pose[1, 0] - aside * pose[1, 2],
        across * pose[2, 0] - aside * pose[2, 2],
    )
    k0, k1, k2 = (
        down * pose[0, 1] - below * pose[0, 2],
        down * pose[1, 1] - below * pose[1, 2],
        down * pose[2, 1] - below * pose[2, 2],
    )
    s0, s1, s2 = np.exp(row[3]), np.exp(row[4]), np.exp(row[5])
    first = (
        s0 * (j0 * r0[0] + j1 * r1[0] + j2 * r2[0]),
        s1 * (j0 * r0[1] + j1 * r1[1] + j2 * r2[1]),
        s2 * (j0 * r0[2] + j1 * r1[2] + j2 * r2[2]),
    )
    second = (
        s0 * (k0 * r0[0] + k1 * r1[0] + k2 * r2[0]),
        s1 * (k0 * r0[1] + k1 * r1[1] + k2 * r2[1]),
        s2 * (k0 * r0[2] + k1 * r1[2] + k2 * r2[2]),
    )
    return first, second, (j0, j1, j2), (k0, k1, k2), (s0, s1, s2)


@kernel
def _dot(first, second):
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


@kernel
def _kept_opacity(xx, xy, yy, blur):
    """By how much the blur would brighten an ellipse: √(|Σ' − blur| / |Σ'|), of Σ' without the blur."""
    before = max(xx * yy - xy * xy, _TINY)
    return np.sqrt(before / ((xx + blur) * (yy + blur) - xy * xy))


@kernel
def project(start, end, rows, eye, values, depths):
    """What a camera sees of the Gaussians from `start` to `end`.

    Args:
        values, depths: results, by Gaussian; the depth is `OUT_OF_SIGHT` of those that aren't in the picture.
    """
    for number in range(start, end):
        row, value = rows[number], values[number]
        depths[number] = OUT_OF_SIGHT
        x, y, z = _local(eye, row)
        if -z <= _NEAREST:
            continue
        column, line = eye.center_x - eye.focal_x * x / z, eye.center_y + eye.focal_y * y / z
        # A centre far beside the picture has a Jacobian that says nothing of what is in it.
        if abs(column - _HALF * eye.width) > eye.width or abs(line - _HALF * eye.height) > eye.height:
            continue
        first, second, _, _, _ = _axes(eye, row, x, y, z)
        xx, xy, yy = _dot(first, first), _dot(first, second), _dot(second, second)
        opacity = _ONE / (_ONE + np.exp(-row[10]))
        if eye.sharpened:
            opacity *= _kept_opacity(xx, xy, yy, eye.blur)
        xx, yy = xx + eye.blur, yy + eye.blur
        if opacity <= _MIN_ALPHA:
            continue
        reach_x, reach_y = np.sqrt(_CUT * xx), np.sqrt(_CUT * yy)
        if column < -reach_x or column > eye.width + reach_x or line < -reach_y or line > eye.height + reach_y:
            continue
        determinant = xx * yy - xy * xy
        value[0], value[1] = column, line
        value[2], value[3], value[4] = yy / determinant, -xy / determinant, xx / determinant
        value[5] = opacity
        value[6], value[7], value[8] = row[11], row[12], row[13]
        value[9] = yy
        depths[number] = -z


@kernel
def _reach(value):
    """Up to which q an ellipse is drawn: there it has the least opacity, or ends."""
    return min(_CUT, _TWO * np.log(value[5] / _MIN_ALPHA))


@kernel
def _lines(value, cut, start, end):
    """The rows of pixels, of those from `start` to `end`, whose centres an ellipse reaches."""
    reach = np.sqrt(cut * value[9])
    first = max(np.float32(start), np.ceil(value[1] - reach - _HALF))
    last = min(np.float32(end), np.floor(value[1] + reach - _HALF) + _ONE)
    return (int(first), int(last)) if first < last else (0, 0)


@kernel
def _columns(value, cut, down, width):
    """The columns that it reaches `down` pixels below its centre."""
    left = (cut - down * down / value[9]) / value[2]  # 1/Σ'yy is the Schur complement of Σ'⁻¹
    if left <= _ZERO:
        return 0, 0
    middle, reach = value[0] - value[3] / value[2] * down, np.sqrt(left)
    first = max(_ZERO, np.ceil(middle - reach - _HALF))
    last = min(np.float32(width), np.floor(middle + reach - _HALF) + _ONE)
    return (int(first), int(last)) if first < last else (0, 0)


@kernel
def _bell(q):
    """exp(−q/2) for q from 0 to 8, up to 2e-5 of it: a polynomial to the sixteenth power, quicker than exp."""
    t = -_HALF * _SIXTEENTH * q
    power = _ONE + t * (_ONE + _HALF * t * (_ONE + _THIRD * t * (_ONE + _QUARTER * t)))
    power *= power
    power *= power
    power *= power
    return power * power


@kernel
def _shape(q, foot):
    """The share of its opacity that an ellipse has at q: a bell, which is lowered so far that it ends at 0."""
    return (_bell(q) - foot) / (_ONE - foot)


@kernel
def lay(start, end, order, values, foot, rgb, light, last):
    """Draws ellipses on the rows of pixels from `start` to `end`.

    Args:
        order: numbers of the ellipses, the nearest first.
        foot: what is taken from all bells.
        rgb, light, last: results: colours, the light that is left, and the last place in `order` that drew in a pixel.
    """
    width = rgb.shape[1]
    for place in range(len(order)):
        value = values[order[place]]
        cut = _reach(value)
        first_line, last_line = _lines(value, cut, start, end)
        for line in range(first_line, last_line):
            down = np.float32(line) + _HALF - value[1]
            first, end_column = _columns(value, cut, down, width)
            for column in range(first, end_column):
                before = light[line, column]
                if before < _DARK:
                    continue
                across = np.float32(column) + _HALF - value[0]
                q = value[2] * across * across + (_TWO * value[3] * across + value[4] * down) * down
                weight = before * min(_MAX_ALPHA, value[5] * _shape(q, foot))
                rgb[line, column, 0] += weight * value[6]
                rgb[line, column, 1] += weight * value[7]
                rgb[line, column, 2] += weight * value[8]
                light[line, column] = before - weight
                last[line, column] = place


@kernel
def lay_backward(start, end, order, values, foot, last, rgb_grad, light, behind, grads):
    """The gradients of `lay`, back to front.

    Args:
        light: what `lay` left; it is given back to each ellipse in turn.
        behind: of each pixel, what all that lies behind the ellipse at hand adds to the loss; at first the background.
        grads: result, by ellipse: of the first nine of its values.
    """
    width = rgb_grad.shape[1]
    for place in range(len(order) - 1, -1, -1):
        value, grad = values[order[place]], grads[order[place]]
        cut = _reach(value)
        first_line, last_line = _lines(value, cut, start, end)
        for line in range(first_line, last_line):
            down = np.float32(line) + _HALF - value[1]
            first, end_column = _columns(value, cut, down, width)
            sum_q, sum_x, sum_xx, sum_o = _ZERO, _ZERO, _ZERO, _ZERO
            sum_r, sum_g, sum_b = _ZERO, _ZERO, _ZERO
            for column in range(first, end_column):
                if place > last[line, column]:
                    continue
                across = np.float32(column) + _HALF - value[0]
                q = value[2] * across * across + (_TWO * value[3] * across + value[4] * down) * down
                shape = _shape(q, foot)
                alpha = min(_MAX_ALPHA, value[5] * shape)
                passed = _ONE / (_ONE - alpha)
                before = light[line, column] * passed
                red, green, blue = rgb_grad[line, column, 0], rgb_grad[line, column, 1], rgb_grad[line, column, 2]
                shown = value[6] * red + value[7] * green + value[8] * blue
                weight = before * alpha
                sum_r += weight * red
                sum_g += weight * green
                sum_b += weight * blue
                alpha_grad = before * shown - behind[line, column] * passed
                behind[line, column] += weight * shown
                light[line, column] = before
                if alpha < _MAX_ALPHA:
                    sum_o += alpha_grad * shape
                    q_grad = -_HALF * value[5] * (shape + foot / (_ONE - foot)) * alpha_grad
                    sum_q += q_grad
                    sum_x += q_grad * across
                    sum_xx += q_grad * across * across
            grad[0] -= _TWO * (value[2] * sum_x + value[3] * down * sum_q)
            grad[1] -= _TWO * (value[3] * sum_x + value[4] * down * sum_q)
            grad[2] += sum_xx
            grad[3] += _TWO * sum_x * down
            grad[4] += sum_q * down * down
            grad[5] += sum_o
            grad[6] += sum_r
            grad[7] += sum_g
            grad[8] += sum_b


@kernel
def _spread_grads(value, grad):
    """∂L/∂Σ' = −Σ'⁻¹ ∂L/∂Σ'⁻¹ Σ'⁻¹, of matrices given as xx, xy (which stands twice in each) and yy."""
    a, b, c = value[2], value[3], value[4]
    xx, xy, yy = grad[2], grad[3], grad[4]
    return (
        -(a * a * xx + a * b * xy + b * b * yy),
        -(_TWO * a * b * xx + (a * c + b * b) * xy + _TWO * b * c * yy),
        -(b * b * xx + b * c * xy + c * c * yy),
    )


@kernel
def _sharp_grads(xx, xy, yy, blur, opacity_grad):
    """∂L/∂Σ' through an opacity that makes up for the blur, of Σ' without the blur."""
    before = xx * yy - xy * xy
    if before <= _TINY:
        return _ZERO, _ZERO, _ZERO
    blurred_x, blurred_y = xx + blur, yy + blur
    after = blurred_x * blurred_y - xy * xy
    return (
        _HALF * opacity_grad * (yy / before - blurred_y / after),
        opacity_grad * (xy / after - xy / before),
        _HALF * opacity_grad * (xx / before - blurred_x / after),
    )


@kernel
def _turn(row, length, rotation_grads, grad):
    """∂L/∂ of a quaternion of any length, from that of its rotation's nine entries, row by row."""
    w, x, y, z = row[6] / length, row[7] / length, row[8] / length, row[9] / length
    g0, g1, g2 = rotation_grads
    to_w = _TWO * (x * (g2[1] - g1[2]) + y * (g0[2] - g2[0]) + z * (g1[0] - g0[1]))
    to_x = _TWO * (y * (g0[1] + g1[0]) + z * (g0[2] + g2[0]) + w * (g2[1] - g1[2]) - _TWO * x * (g1[1] + g2[2]))
    to_y = _TWO * (x * (g0[1] + g1[0]) + z * (g1[2] + g2[1]) + w * (g0[2] - g2[0]) - _TWO * y * (g0[0] + g2[2]))
    to_z = _TWO * (x * (g0[2] + g2[0]) + y * (g1[2] + g2[1]) + w * (g1[0] - g0[1]) - _TWO * z * (g0[0] + g1[1]))
    along = w * to_w + x * to_x + y * to_y + z * to_z
    grad[6], grad[7] = (to_w - along * w) / length, (to_x - along * x) / length
    grad[8], grad[9] = (to_y - along * y) / length, (to_z - along * z) / length


@kernel
def project_backward(start, end, order, rows, eye, values, value_grads, grads):
    """The gradients of `project`, of the ellipses at the places from `start` to `end` of `order`.

    Args:
        grads: result, by Gaussian, of its parameters.
    """
    pose = eye.pose
    for place in range(start, end):
        number = order[place]
        row, value, grad, value_grad = rows[number], values[number], grads[number], value_grads[number]
        x, y, z = _local(eye, row)
        first, second, j, k, s = _axes(eye, row, x, y, z)
        xx_grad, xy_grad, yy_grad = _spread_grads(value, value_grad)
        opacity_grad = value_grad[5]
        if eye.sharpened:
            xx, xy, yy = _dot(first, first), _dot(first, second), _dot(second, second)
            more = _sharp_grads(xx, xy, yy, eye.blur, opacity_grad * value[5])
            xx_grad, xy_grad, yy_grad = xx_grad + more[0], xy_grad + more[1], yy_grad + more[2]
            opacity_grad *= _kept_opacity(xx, xy, yy, eye.blur)
        opacity = _ONE / (_ONE + np.exp(-row[10]))
        grad[10] = opacity_grad * opacity * (_ONE - opacity)
        grad[11], grad[12], grad[13] = value_grad[6], value_grad[7], value_grad[8]

        f0 = _TWO * xx_grad * first[0] + xy_grad * second[0]
        f1 = _TWO * xx_grad * first[1] + xy_grad * second[1]
        f2 = _TWO * xx_grad * first[2] + xy_grad * second[2]
        g0 = _TWO * yy_grad * second[0] + xy_grad * first[0]
        g1 = _TWO * yy_grad * second[1] + xy_grad * first[1]
        g2 = _TWO * yy_grad * second[2] + xy_grad * first[2]
        grad[3], grad[4] = f0 * first[0] + g0 * second[0], f1 * first[1] + g1 * second[1]
        grad[5] = f2 * first[2] + g2 * second[2]
        r0, r1, r2, length = _rotation(row)
        f0, f1, f2, g0, g1, g2 = f0 * s[0], f1 * s[1], f2 * s[2], g0 * s[0], g1 * s[1], g2 * s[2]
        rotation_grads = (
            (j[0] * f0 + k[0] * g0, j[0] * f1 + k[0] * g1, j[0] * f2 + k[0] * g2),
            (j[1] * f0 + k[1] * g0, j[1] * f1 + k[1] * g1, j[1] * f2 + k[1] * g2),
            (j[2] * f0 + k[2] * g0, j[2] * f1 + k[2] * g1, j[2] * f2 + k[2] * g2),
        )
        _turn(row, length, rotation_grads, grad)

        j_grad = (_dot(r0, (f0, f1, f2)), _dot(r1, (f0, f1, f2)), _dot(r2, (f0, f1, f2)))
        k_grad = (_dot(r0, (g0, g1, g2)), _dot(r1, (g0, g1, g2)), _dot(r2, (g0, g1, g2)))
        right, up = (pose[0, 0], pose[1, 0], pose[2, 0]), (pose[0, 1], pose[1, 1], pose[2, 1])
        back = (pose[0, 2], pose[1, 2], pose[2, 2])
        across, down = -eye.focal_x / z, eye.focal_y / z
        across_grad, aside_grad = _dot(j_grad, right) + value_grad[0] * x, -_dot(j_grad, back)
        down_grad, below_grad = _dot(k_grad, up) + value_grad[1] * y, -_dot(k_grad, back)
        x_grad = value_grad[0] * across + aside_grad * across / z
        y_grad = value_grad[1] * down + below_grad * down / z
        z_grad = -(across_grad * across + down_grad * down) / z
        z_grad -= _TWO * (aside_grad * across * x + below_grad * down * y) / (z * z)
        for axis in range(3):
            grad[axis] = x_grad * right[axis] + y_grad * up[axis] + z_grad * back[axis]
