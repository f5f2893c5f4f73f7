"""The distance between two clouds of points, by what they look like along lines (sliced Wasserstein distance).

Along a line the best way to carry one cloud to another is known: both in order (Rabin et al. 2011; Bonneel et al.
2015). The mean over lines is a distance of the clouds, zero only for equal ones, whatever their shape.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def random_directions(dimensions: int, count: int, generator: torch.Generator) -> Float[Tensor, "D K"]:
    """Unit vectors, evenly spread over the sphere, one a column; on the generator's device."""
    drawn = torch.randn(dimensions, count, generator=generator, device=generator.device)
    return F.normalize(drawn, dim=0)


def sliced_distance(
    points: Float[Tensor, "N D"], target: Float[Tensor, "M D"], directions: Float[Tensor, "D K"]
) -> Float[Tensor, ""]:
    """The squared 2-Wasserstein distance of two clouds along lines: D times its mean over unit `directions`.

    Clouds that are alike but for a shift Δ are |Δ|² apart on average over all directions, as they are by the full
    distance; others are closer by this one than by that. Differentiable in `points`. A cloud of more points than the
    other is read off at as many places of its order as the other has. A `ValueError` where there are no points.

    Example:
        >>> axes = torch.eye(3)
        >>> sliced_distance(torch.rand(50, 3), torch.rand(50, 3) + 2.0, axes) > 9.0
        tensor(True)
    """
    if not (len(points) and len(target)):
        raise ValueError(f"There are {len(points)} points and {len(target)} to compare them with; both need some.")
    ordered, wanted = ((cloud @ directions).sort(dim=0).values for cloud in (points, target))
    count = min(len(ordered), len(wanted))
    difference = quantiles(ordered, count) - quantiles(wanted, count)
    return points.shape[-1] * difference.square().mean()


def quantiles(ordered: Float[Tensor, "N K"], count: int) -> Float[Tensor, "count K"]:
    """Values at the middles of `count` equal parts of each column's order, with lines between the values."""
    if len(ordered) == count:
        return ordered
    places = (torch.arange(count, device=ordered.device) + 0.5) * (len(ordered) / count) - 0.5
    places = places.clamp(0, len(ordered) - 1)
    below = places.floor().long()
    above = (below + 1).clamp(max=len(ordered) - 1)
    return torch.lerp(ordered[below], ordered[above], (places - below).to(ordered)[:, None])
