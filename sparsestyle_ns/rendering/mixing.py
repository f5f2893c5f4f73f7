"""What lies between the coarse field and a stylised one, and between two styles of the same scene.

σ_c and c_c are the coarse field's density and colour at a point, σ_f and c_f a stylised field's. A picture with
strength s, geometry strength g and blend b of two styles, 0 and 1, shows

    σ = (1 − s g) σ_c + s g [(1 − b) σ_f⁰ + b σ_f¹],      c = (1 − s) c_c + s [(1 − b) c_f⁰ + b c_f¹].

So strength 0 is the coarse field, strength and geometry strength 1 a stylised one, and geometry strength 0 a stylised
colour on the coarse geometry. It is σ_f − σ_c, and not σ' itself, that s g weighs: so σ can't be negative, and values
that were worked out for one picture serve every other strength.
"""

from typing import NamedTuple, Sequence

from jaxtyping import Float
from torch import Tensor


class Mix(NamedTuple):
    """How much of each field a picture shows: s, g and b of the formulas above, all in [0, 1]."""

    strength: float = 1.0
    geometry: float = 1.0
    blend: float = 0.0

    @property
    def density_share(self) -> float:
        """s g, the share of σ that is the style's."""
        return self.strength * self.geometry


STYLISED = Mix()
"""The stylised field as it is."""


class Appearance(NamedTuple):
    """σ and c of a field at points."""

    density: Float[Tensor, "points"]
    color: Float[Tensor, "points 3"]


def interpolate(first: Float[Tensor, "*batch"], second: Float[Tensor, "*batch"], share: float) -> Tensor:
    """(1 − share) first + share second; the very same tensor at a share of 0 or 1."""
    if share == 0.0:
        return first
    return second if share == 1.0 else (1.0 - share) * first + share * second


def mixed(coarse: Appearance, styles: Sequence[Appearance], mix: Mix) -> Appearance:
    """σ and c of a picture (see the formulas above), from those of the coarse field and of one or two styles."""
    density, color = styles[0]
    if len(styles) > 1:
        density = interpolate(density, styles[1].density, mix.blend)
        color = interpolate(color, styles[1].color, mix.blend)
    density = interpolate(coarse.density, density, mix.density_share)
    return Appearance(density, interpolate(coarse.color, color, mix.strength))
