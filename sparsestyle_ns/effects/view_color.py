"""Colour that depends on the view direction: the coarse field's colour head sees it, as in Eq. 1."""

import numpy as np

from sparsestyle_ns.effects.base import Measurement
from sparsestyle_ns.effects.exposure import DARK, fit_gains, not_measurable
from sparsestyle_ns.effects.scene import Scene

MIN_VIEWS = 6
"""Photos below which shine can't be told from shape (docs/method.md)."""
NOISE = 0.05
"""Difference of matched colours, of a range of 1, that noise and inexact matches explain."""
MIN_SHARE = 0.08
"""Share of matched points that differ by more, from which on colour depends on the view."""


def measure_view_color(scene: Scene) -> Measurement:
    """The share of matched points whose colours differ by more than `NOISE`, exposure taken off."""
    matches, unknown = scene.matches, not_measurable(scene)
    if unknown:
        return Measurement(False, unknown, None, MIN_SHARE)
    _, unexplained = fit_gains(matches)
    # A log ratio r of two colours with the mean m is a difference of about r m.
    differences = np.abs(unexplained) * (matches.colors.mean(axis=0) + DARK)
    share = float((differences.mean(axis=-1) > NOISE).mean())
    words, on = f"of {len(matches)} matched points change colour with the view", share >= MIN_SHARE
    num_views = len(scene.cameras)
    if on and num_views < MIN_VIEWS:
        words += f", but {num_views} photos are too few to tell shine from shape; {MIN_VIEWS} are needed"
        on = False
    return Measurement(on, words, share, MIN_SHARE)
