"""Colour that depends on where it is seen from."""

from typing import Any, Dict, List

import numpy as np

from sparsestyle_ns.effects.base import Effect, Measurement
from sparsestyle_ns.effects.exposure import DARK, fit_gains, not_measurable
from sparsestyle_ns.effects.scene import Scene

MIN_VIEWS = 6
"""Photos below which shine can't be told from shape (README, Where we depart from the paper)."""
NOISE = 0.05
"""Difference of matched colours, of a range of 1, that noise and inexact matches explain."""
MIN_SHARE = 0.08
"""Share of matched points that differ by more, from which on colour depends on the view."""


class ViewColor(Effect):
    """The coarse field's colour head sees the view direction, as in Eq. 1."""

    name = "view_color"
    help = "View-dependent colour: the same point differs between photos beyond noise and exposure."

    def measure(self, scene: Scene) -> Measurement:
        """See `Effect.measure`; the share of matched points that differ by more than `NOISE`, exposure taken off."""
        matches, unknown = scene.matches, not_measurable(scene)
        if unknown:
            return Measurement(False, unknown, None, MIN_SHARE)
        _, unexplained = fit_gains(matches)
        # A log ratio r of two colours with the mean m is a difference of about r m.
        differences = np.abs(unexplained) * (0.5 * (matches.colors_first + matches.colors_second) + DARK)
        share = float((differences.mean(axis=-1) > NOISE).mean())
        words = f"of {len(matches)} matched points change colour with the view"
        if share >= MIN_SHARE and scene.num_views < MIN_VIEWS:
            words += f", but {scene.num_views} photos can't tell shine from shape; {MIN_VIEWS} can"
            return Measurement(False, words, share, MIN_SHARE)
        return Measurement(share >= MIN_SHARE, words, share, MIN_SHARE)

    def build(self, parameters: Dict[str, List[float]], **needs: Any) -> int:
        """See `Effect.build`; the octaves of the direction's encoding, as the model's settings have them."""
        return needs["direction_levels"]
