"""The most similar of a style's feature vectors, exactly, with a tenth of the work of comparing with all of them."""

import math
from typing import Optional, Tuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestyle_ns.core.precision import at_least_float32, without_autocast
from sparsestyle_ns.utils.device_sizes import sizes_for

SHORTEST = 1e-12
"""Vectors no longer than this have no direction."""
COARSE, FINE = 23, 127
"""Principal directions in which similarities are bounded, first of all pairs and then of those that are left."""
TABLE_SIZE, BASIS_SAMPLE = 1 << 23, 4096
"""Bounds kept at once, one a feature vector and block, and style vectors that give the principal directions."""


class StyleIndex:
    """A style's feature vectors, arranged so that the most similar one is found without comparing with all.

    Let a(x) be the coefficients of a unit vector x in k orthonormal directions, and p(x) = √(1 − |a(x)|²) the length
    of the rest. Then (Cauchy–Schwarz)

        cos(f, s) ≤ a(f) · a(s) + p(f) p(s) = (a(f), p(f)) · (a(s), p(s)),

    a product of k + 1 instead of C numbers. In the style's own principal directions it is tight: with k = 23 of the
    768 channels of VGG's third block about 3% of a painting's vectors can't be ruled out. Vectors are sorted into
    blocks of similar ones; a block is compared, in one product of whole vectors, with those features for which its
    largest bound reaches the best similarity so far. What is ruled out could not have won, so the answer is exact.

    `block_size`, the most vectors in a block, changes time, not the answer. A `ValueError` without style features.

    Example:
        >>> style = StyleIndex(torch.rand(1000, 768))
        >>> style.nearest(3 * style.directions_of(torch.tensor([7, 7, 421])))
        tensor([  7,   7, 421])
    """

    @torch.no_grad()
    @without_autocast
    def __init__(self, style_features: Float[Tensor, "M C"], block_size: Optional[int] = None) -> None:
        check_style(style_features)
        directions = unit_vectors(style_features)
        device = directions.device
        first = _first_equal(directions)
        distinct = first.unique()
        axes = _principal_axes(directions)
        self.bases = [axes[:, :count].contiguous() for count in (COARSE, FINE)]
        coarse, fine = (_outline(directions, basis) for basis in self.bases)
        self.rows = distinct[_similar_blocks(coarse[distinct], block_size or sizes_for(device).style_block)]
        self.blocks, self.coarse, self.fine = directions[self.rows], coarse[self.rows], fine[self.rows]
        places = torch.empty_like(first)
        places[self.rows.flatten()] = torch.arange(self.rows.numel(), device=device)
        self._places = places[first]

    def directions_of(self, rows: Int[Tensor, " N"]) -> Float[Tensor, "N C"]:
        """Style vectors in these rows, as `unit_vectors`."""
        return self.blocks.flatten(0, 1)[self._places[rows]]

    @torch.no_grad()
    @without_autocast
    def nearest(self, features: Float[Tensor, "N C"]) -> Int[Tensor, " N"]:
        """As `nearest_neighbors`; of style vectors with equal directions the first is given."""
        rows_at_once = max(1, TABLE_SIZE // len(self.blocks))
        return torch.cat([self._nearest(part) for part in unit_vectors(features).split(rows_at_once)])

    def _nearest(self, directions: Float[Tensor, "n C"]) -> Int[Tensor, " n"]:
        coarse, fine = (_outline(directions, basis) for basis in self.bases)
        best = directions.new_full((len(directions),), -torch.inf)
        compared = []

        def compare(blocks: Int[Tensor, " P"], rows: Int[Tensor, " P"]) -> None:
            """Compares feature vectors with all style vectors of a block, for pairs sorted by block."""
            values, places = _block_maxima(directions, self.blocks, blocks, rows)
            best.scatter_reduce_(0, rows, values, "amax")
            compared.append((rows, values, self.rows[blocks, places]))

        bounds = self._bounds(coarse)
        favorites = bounds.argmax(dim=0)
        by_block = favorites.argsort()
        compare(favorites[by_block], by_block)
        bounds.scatter_(0, favorites[None], -torch.inf)
        blocks, rows = (bounds >= best).nonzero(as_tuple=True)

        finer_bounds, _ = _block_maxima(fine, self.fine, blocks, rows)
        best_bounds = finer_bounds.new_full((len(directions),), -torch.inf)
        is_favorite = finer_bounds == best_bounds.scatter_reduce_(0, rows, finer_bounds, "amax")[rows]
        # A GPU is waited for wherever the number of pairs that are left must be known, seven times in a search.
        # Comparing all with all would wait for nothing, but do ten times the work.
        pairs = is_favorite.nonzero().squeeze(-1)
        compare(blocks[pairs], rows[pairs])
        pairs = (~is_favorite & (finer_bounds >= best[rows])).nonzero().squeeze(-1)
        compare(blocks[pairs], rows[pairs])

        rows, values, found = (torch.cat(parts) for parts in zip(*compared, strict=True))
        found = torch.where(values == best[rows], found, len(self._places) - 1)
        return rows.new_zeros(len(best)).scatter_reduce_(0, rows, found, "amin", include_self=False)

    def _bounds(self, outlines: Float[Tensor, "n k"]) -> Float[Tensor, "blocks n"]:
        """Bounds of the similarities between each feature vector and any style vector of each block."""
        num_blocks, block_size, _ = self.coarse.shape
        side = sizes_for(outlines.device).bounded_vectors
        blocks_at_once = max(1, side // block_size)
        bounds = outlines.new_empty(num_blocks, len(outlines))
        # Memory that is new for each product would cost as much time as the product.
        buffer = outlines.new_empty(blocks_at_once * block_size * side)
        for part, part_bounds in zip(outlines.split(side), bounds.split(side, dim=1), strict=True):
            for blocks, out in zip(self.coarse.split(blocks_at_once), part_bounds.split(blocks_at_once), strict=True):
                products = buffer[: len(blocks) * block_size * len(part)].view(len(blocks) * block_size, len(part))
                torch.mm(blocks.flatten(0, 1), part.T, out=products)
                torch.amax(products.view(len(blocks), block_size, len(part)), dim=1, out=out)
        return bounds


def check_style(style_features: Float[Tensor, "M C"]) -> None:
    """Raises a `ValueError` where there is no style feature."""
    if len(style_features) == 0:
        raise ValueError("there is no style feature to match: the style image gave none")


def unit_vectors(vectors: Float[Tensor, "N C"]) -> Float[Tensor, "N C"]:
    """Vectors of length 1, or of length 0 where there is no direction."""
    vectors = at_least_float32(vectors)
    length = torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)
    return torch.where(length > SHORTEST, vectors / length.clamp_min(SHORTEST), 0.0)


def _first_equal(rows: Float[Tensor, "M C"]) -> Int[Tensor, " M"]:
    """For each row the first row that is equal to it."""
    _, group = torch.unique(rows, dim=0, return_inverse=True)
    index = torch.arange(len(rows), device=rows.device)
    return torch.full_like(index, len(rows)).scatter_reduce_(0, group, index, "amin")[group]


def _principal_axes(directions: Float[Tensor, "M C"]) -> Float[Tensor, "C C"]:
    """Orthonormal columns, those first in which the vectors are longest, as a sample of them says."""
    sample = directions[:: -(-len(directions) // BASIS_SAMPLE)].double()
    _, axes = torch.linalg.eigh(sample.T @ sample)
    return axes.flip(1).to(directions.dtype)


def _outline(directions: Float[Tensor, "N C"], basis: Float[Tensor, "C k"]) -> Float[Tensor, "N k+1"]:
    """Coefficients of unit vectors in a basis, and the length of the rest; products of two bound the vectors' own.

    The length gets an allowance τ under the root, as √((p² + τ)(q² + τ)) ≥ p q + τ. It covers all rounding: with u the
    unit of it, 2 √k C u in p², as much in a(f) · a(s), and less than 8 C u in lengths, sum and similarity.
    """
    channels, count = basis.shape
    unit = torch.finfo(directions.dtype).eps / 2
    allowance = 4 * (math.sqrt(count) + 2) * (channels + 2) * unit
    coefficients = directions @ basis
    rest = (1 - coefficients.square().sum(dim=-1, keepdim=True)).clamp_min(0) + allowance
    return torch.cat([coefficients, rest.sqrt()], dim=-1)


def _similar_blocks(points: Float[Tensor, "M k"], block_size: int) -> Int[Tensor, "blocks size"]:
    """Rows of `points` in blocks of at most this many, similar ones together, each block's in ascending order.

    The leaves of a k-d tree; where points can't be shared out evenly, the last occurs more than once.
    """
    depth = (-(-len(points) // block_size) - 1).bit_length()
    leaf_size = -(-len(points) // 2**depth)
    order = torch.arange(2**depth * leaf_size, device=points.device).clamp_max(len(points) - 1)
    for level in range(depth):
        nodes = order.view(2**level, -1)
        members = points[nodes]
        widest = members.var(dim=1).argmax(dim=-1)
        keys = members.gather(2, widest[:, None, None].expand(-1, members.shape[1], 1)).squeeze(2)
        order = nodes.gather(1, keys.argsort(dim=1))
    return order.view(2**depth, leaf_size).sort(dim=1).values


def _block_maxima(
    vectors: Float[Tensor, "n K"],
    style_blocks: Float[Tensor, "blocks size K"],
    blocks: Int[Tensor, " P"],
    rows: Int[Tensor, " P"],
) -> Tuple[Float[Tensor, " P"], Int[Tensor, " P"]]:
    """The largest product of a vector with those of a block, and its first place there, for pairs sorted by block."""
    ends = torch.searchsorted(blocks, torch.arange(len(style_blocks), device=blocks.device), right=True)
    counts = torch.diff(ends, prepend=ends.new_zeros(1)).tolist()
    maxima = [
        (vectors[members] @ block.T).max(dim=1) for block, members in zip(style_blocks, rows.split(counts), strict=True)
    ]
    values, places = zip(*maxima, strict=True)
    return torch.cat(values), torch.cat(places)
