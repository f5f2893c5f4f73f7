"""What the colours of matched points tell: photos' exposure and white balance, and colour that depends on the view."""

from typing import Optional, Tuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from sparsestyle_ns.data.matches import PointMatches, why_unmatched
from sparsestyle_ns.effects.decisions import Decisions, Measurement
from sparsestyle_ns.effects.scene import Scene

MIN_STOPS = 0.1
"""Gain of a photo's channel against the mean of all photos, in stops, from which on photos differ."""
MIN_MATCHES = 20
"""Matched points of every photo below which its gain can't be measured."""
DARK = 0.02
"""Added to colours before their ratio is taken, so that black doesn't count as infinitely dark."""
ROBUST = 0.02
"""Log ratio below which differences count by their square, above by their size."""
MIN_VIEWS = 6
"""Photos below which shine can't be told from shape (docs/method.md)."""
NOISE = 0.05
"""Difference of matched colours, of a range of 1, that noise and inexact matches explain."""
MIN_SHARE = 0.08
"""Share of matched points that differ by more, from which on colour depends on the view."""


def fit_gains(matches: PointMatches) -> Tuple[Float[np.ndarray, "views 3"], Float[np.ndarray, "matches 3"]]:
    """Each photo's log gain, and what of the colours' log ratios it doesn't explain.

    The gains minimise the sum of absolute differences (iteratively reweighted least squares), with a mean of zero over
    the photos in each channel.
    """
    ratios = np.log((matches.colors[1] + DARK) / (matches.colors[0] + DARK))
    rows = np.arange(len(matches))
    design = np.zeros((len(matches) + 1, matches.num_views))
    design[rows, matches.views[1]] += 1.0
    design[rows, matches.views[0]] -= 1.0
    design[-1] = 1.0
    gains = np.zeros((matches.num_views, 3))
    for channel in range(3):
        weights = np.ones(len(design))
        target = np.append(ratios[:, channel], 0.0)
        for _ in range(15):
            gains[:, channel] = np.linalg.lstsq(design * weights[:, None], target * weights, rcond=None)[0]
            error = np.abs(target - design @ gains[:, channel])
            weights[:-1] = 1.0 / np.sqrt(np.maximum(error[:-1], ROBUST))
    return gains, ratios - design[:-1] @ gains


def not_measurable(scene: Scene) -> Optional[str]:
    """Why photos' colours can't be compared by matched points, in words; None where they can."""
    fewest = scene.sure_matches.fewest_in_a_view()
    if fewest >= MIN_MATCHES:
        return None
    reason = why_unmatched(scene.cameras) or f"a photo has {fewest} matched points, fewer than {MIN_MATCHES}"
    return f"not measurable: {reason}"


class ExposureCorrection(nn.Module):
    """A gain for each photo and channel, exp(g) with the mean of g over the photos at 0.

    That gauge makes the scene's own colours those of the mean exposure, which is what views without a photo show.
    """

    def __init__(self, num_photos: int) -> None:
        super().__init__()
        self.log_gain = nn.Parameter(torch.zeros(num_photos, 3))

    def gains(self) -> Float[Tensor, "photos 3"]:
        """The photos' gains; their geometric mean is 1."""
        return torch.exp(self.log_gain - self.log_gain.mean(dim=0))

    def forward(
        self, rgb: Float[Tensor, "rays 3"], behind: Float[Tensor, "rays 3"], photos: Int[Tensor, "rays"]
    ) -> Float[Tensor, "rays 3"]:
        """What photos show of a scene's colours: their light times the photo's gain, and the part `behind` as it is."""
        return (rgb - behind) * self.gains()[photos] + behind

    def undone(
        self, colors: Float[Tensor, "pixels 3"], behind: Float[Tensor, "pixels 3"], photo: int
    ) -> Float[Tensor, "pixels 3"]:
        """A photo's colours at the mean exposure, cut to [0, 1]: the inverse of `forward` for one photo."""
        return ((colors - behind) / self.gains()[photo] + behind).clamp(0.0, 1.0)


def build_exposure(effects: Decisions, num_photos: int) -> Optional[ExposureCorrection]:
    """The photos' gains, to be learned with the field; None where the effect is off."""
    return ExposureCorrection(num_photos) if effects.on("exposure") else None


def measure_exposure(scene: Scene) -> Measurement:
    """The largest gain of a photo against the mean, in stops, from matched points."""
    unknown = not_measurable(scene)
    if unknown:
        return Measurement(False, unknown, None, MIN_STOPS)
    gains, _ = fit_gains(scene.sure_matches)
    stops = float(np.abs(gains).max() / np.log(2.0))
    words = f"stops at most between a photo and the mean, by {len(scene.sure_matches)} matched points"
    return Measurement(stops >= MIN_STOPS, words, stops, MIN_STOPS)


def measure_view_color(scene: Scene) -> Measurement:
    """The share of matched points whose colours differ by more than `NOISE`, exposure taken off.

    On, the coarse field's colour head sees the view direction, as in Eq. 1.
    """
    matches, unknown = scene.sure_matches, not_measurable(scene)
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
