"""Settings of the optimiser."""

from dataclasses import dataclass
from typing import Tuple

from nerfstudio.engine.optimizers import AdamOptimizerConfig


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam in one pass over memory."""

    betas: Tuple[float, float] = (0.9, 0.999)
    """Decay of the running means of the gradient and its square."""
    fused: bool = True
    """Whether to use the fused implementation; the values are the same up to rounding."""
