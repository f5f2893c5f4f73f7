"""The views that stage 2 stylises: their rays, frozen, and the pictures that they must stay like."""

import math
from dataclasses import dataclass, replace
from typing import Dict, List, Mapping, Optional, Sequence

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor, nn

from sparsestyle_ns.core.camera_paths import at_poses, poses_between
from sparsestyle_ns.data.photos import at_scale
from sparsestyle_ns.field_components.color_map import ColorMap
from sparsestyle_ns.losses.stylization import StyleTargets
from sparsestyle_ns.losses.stylization_loss import Content
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.pipelines.datamanager import FewShotDataManager, TrainingPixels
from sparsestyle_ns.rendering.frozen_view import FrozenView
from sparsestyle_ns.rendering.render import accumulation_of, seen_behind
from sparsestyle_ns.style.palette import PaletteTransfer, palette_of
from sparsestyle_ns.utils.device_sizes import bytes_to_keep
from sparsestyle_ns.utils.distributed import gather_rays, num_processes, shard_rays
from sparsestyle_ns.utils.progress import track


@dataclass
class ContentView:
    """A view that is stylised, and what it must stay like."""

    frozen: FrozenView
    """Its rays, ready to render."""
    picture: Float[Tensor, "H W 3"]
    """Its photo at the mean exposure, or its coarse render; for a painting, in its colours where the palette is
    transferred."""
    accumulation: Optional[Float[Tensor, "H W"]]
    """How opaque the coarse field is in each pixel; for a painting None where there is no background behind it."""
    features: Optional[Float[Tensor, "1 C h w"]] = None
    """The feature network's view of the picture, once a painting has asked for it."""
    seen_at: int = 0
    """The longer side, in pixels, at which it saw the picture."""

    @property
    def content(self) -> Content:
        """What it must stay like, once a painting has asked for it."""
        return Content(self.picture, self.features)


class SceneViews:
    """All views of a scene, with what depends on no painting: its training photos and, after them, views between these.

    Args:
        model: whose coarse field is final.
        scales: sizes at which there are all of the views, as shares of the photos'; the largest last.
        novel_views: how many views between the photos there are.
        samples_per_chunk: samples that are rendered at once, at most.
        cache_gigabytes: memory for what never changes; None: a quarter of what is free.
    """

    @torch.no_grad()
    def __init__(
        self,
        model: HierStyleModel,
        manager: FewShotDataManager,
        scales: Sequence[float],
        novel_views: int,
        samples_per_chunk: int,
        cache_gigabytes: Optional[float],
    ) -> None:
        self.model, self.samples_per_chunk, self._rays_of = model, samples_per_chunk, manager.refined_rays
        self.num_photos = len(manager.train_dataset)
        given = cache_gigabytes is not None
        self._bytes_left = cache_gigabytes * 2**30 if given else bytes_to_keep(model.device) / num_processes()
        self.by_scale: Dict[float, List[ContentView]] = {scale: [] for scale in scales}
        novel = cameras_between(manager.train_dataset.cameras, novel_views)
        work = [(scale, view) for scale in scales for view in (*range(self.num_photos), *novel)]
        pixels = {scale: manager.pixels_at(scale) for scale in scales}
        for scale, view in track(work, "Freezing views"):
            is_photo = isinstance(view, int)
            made = self._photo_view(pixels[scale], view) if is_photo else self._novel_view(at_scale(view, scale))
            self.by_scale[scale].append(made)

    @property
    def views(self) -> List[ContentView]:
        """Those of all sizes."""
        return [view for views in self.by_scale.values() for view in views]

    def _freeze(self, origins: Tensor, directions: Tensor) -> FrozenView:
        """The rays of a view that this process renders."""
        rays = shard_rays(origins), shard_rays(directions)
        frozen = self.model.freeze_view(*rays, self.samples_per_chunk, self._bytes_left)
        self._bytes_left -= frozen.kept_bytes
        return frozen

    def _photo_view(self, pixels: TrainingPixels, index: int) -> ContentView:
        (height, width), rows = pixels.sizes[index], pixels.rows(index)
        frozen = self._freeze(*self._rays_of(pixels.origins[rows], pixels.directions[rows], pixels.views[rows]))
        accumulation = gather_rays(frozen.render(accumulation_of), height * width)
        colors, exposure = pixels.colors[rows], self.model.exposure
        if exposure is not None:
            colors = exposure.undone(colors, seen_behind(accumulation, self.model.background), index)
        return ContentView(frozen, colors.view(height, width, 3), accumulation.view(height, width))

    def _novel_view(self, camera: Cameras) -> ContentView:
        bundle = camera.generate_rays(camera_indices=0, keep_shape=True).to(self.model.device)
        rays = bundle.flatten()
        with self.model.display.rendering("exact"):  # a viewer may restyle a run whose pictures are baked
            outputs = self.model.get_outputs_for_camera_ray_bundle(bundle)
        frozen = self._freeze(rays.origins, rays.directions)
        return ContentView(frozen, outputs["rgb_coarse"], outputs["accumulation_coarse"].squeeze(-1))

    @torch.no_grad()
    def for_painting(
        self, targets: Mapping[float, StyleTargets], transfer: Optional[PaletteTransfer]
    ) -> List[List[ContentView]]:
        """The views, by their size, with what they must stay like for a painting, given for each scale.

        Its palette is transferred, where it is, once for all sizes, from the painting at the largest.
        """
        palette = None if transfer is None else self._palette(targets[max(targets)].style_picture, transfer)
        return [
            [self._for_painting(view, each, palette) for view in self.by_scale[scale]]
            for scale, each in targets.items()
        ]

    def _for_painting(self, view: ContentView, targets: StyleTargets, palette: Optional[ColorMap]) -> ContentView:
        """A view in the painting's colours, with features; a background that is seen through the scene stays."""
        seen_through = self.model.background is not None
        if palette is not None:
            picture = palette(view.picture)
            if seen_through:
                picture = torch.lerp(view.picture, picture, view.accumulation[..., None].clamp(0.0, 1.0))
            view = replace(view, picture=picture, features=None)
        if view.features is None or view.seen_at != targets.feature_side:
            # Those of a view's own picture are the same for every painting, and kept for the next.
            view.features, view.seen_at = targets.features(view.picture), targets.feature_side
        # A copy: while one painting is trained, another may have the features made anew.
        return replace(view, accumulation=view.accumulation if seen_through else None)

    def _palette(self, style_picture: Float[Tensor, "3 h w"], transfer: PaletteTransfer) -> ColorMap:
        """The map of the photos' colours to the painting's."""
        photos = list(self.by_scale.values())[-1][: self.num_photos]
        colors = torch.cat([view.picture.reshape(-1, 3) for view in photos])
        weights = torch.cat([view.accumulation.reshape(-1) for view in photos])
        return palette_of(colors, weights, _colors_of(style_picture), transfer)

    @torch.no_grad()
    def last_palette(
        self,
        views: Sequence[ContentView],
        style: nn.Module,
        style_picture: Float[Tensor, "3 h w"],
        transfer: PaletteTransfer,
    ) -> ColorMap:
        """The map of a stylised field's colours, as these views show them, to the painting's."""
        colors = torch.cat([self.render(view, style).reshape(-1, 3) for view in views]).clamp(0.0, 1.0)
        whole = torch.ones_like(colors[:, 0])
        seen_through = views[0].accumulation is not None
        weights = torch.cat([view.accumulation.reshape(-1) for view in views]) if seen_through else whole
        return palette_of(colors, weights, _colors_of(style_picture), transfer)

    def render(self, view: ContentView, style: nn.Module, coarse_geometry: bool = False) -> Float[Tensor, "H W 3"]:
        """The stylised picture of a view, to whose rays each process contributes its share; differentiable."""
        own = view.frozen.render(lambda chunk: self.model.stylised(chunk, coarse_geometry, style).rgb)
        return gather_rays(own, view.picture[..., 0].numel()).view(view.picture.shape)

    def report(self) -> str:
        """In a line, what is kept in memory."""
        frozen = [view.frozen for view in self.views]
        kept, chunks = sum(view.kept_bytes for view in frozen), sum(view.num_chunks for view in frozen)
        whole = sum(view.is_kept for view in frozen)
        occupancy = self.model.occupancy
        occupied = "" if occupancy is None else f", {occupancy.share:.0%} of space occupied"
        note = "" if whole == len(frozen) else "; the rest is computed again in each iteration"
        return f"{len(frozen)} views in {chunks} chunks{occupied}; {whole} views kept in {kept / 2**20:.0f} MiB{note}."


def _colors_of(picture: Float[Tensor, "3 h w"]) -> Float[Tensor, "pixels 3"]:
    """Those of a reduced picture's pixels, in [0, 1]."""
    return picture.flatten(1).T.clamp(0.0, 1.0)


def cameras_between(cameras: Cameras, count: int) -> List[Cameras]:
    """`count` cameras half way, a third of the way … between neighbouring ones; none between fewer than two."""
    if count == 0 or len(cameras) < 2:
        return []
    gaps = len(cameras) - 1
    steps = math.ceil(count / gaps) + 1
    path = poses_between(cameras.camera_to_worlds.cpu(), gaps * steps + 1)
    between = [pose for place, pose in enumerate(path) if place % steps]
    return [at_poses(pose[None], cameras) for pose in between[:count]]
