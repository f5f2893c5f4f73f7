"""Pictures and feature maps as lists of vectors."""

from typing import Optional

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def feature_rows(features: Float[Tensor, "B C h w"]) -> Float[Tensor, "rows C"]:
    """A feature map's vectors, one a row."""
    return features.permute(0, 2, 3, 1).flatten(0, 2)


def covered_rows(
    features: Float[Tensor, "1 C h w"], accumulation: Optional[Float[Tensor, "H W"]]
) -> Float[Tensor, "rows C"]:
    """Those of a feature map's vectors that show the scene; all where no pixel does, or without `accumulation`."""
    rows = feature_rows(features)
    if accumulation is None:
        return rows
    covered = F.interpolate(accumulation[None, None].float(), size=features.shape[-2:], mode="area").flatten() > 0.5
    return rows[covered] if covered.any() else rows
