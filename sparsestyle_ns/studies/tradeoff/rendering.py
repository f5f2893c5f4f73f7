"""Rendering: exact pictures, and baked ones of several resolutions, from cameras that fly from view to view."""

from typing import Callable, Dict, List

import torch
from nerfstudio.cameras.camera_paths import get_interpolated_camera_path
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.rendering.baked import BakedVolume, render_baked
from sparsestyle_ns.studies.tradeoff.axis import Axis, Values, in_turns
from sparsestyle_ns.studies.tradeoff.budget import Budget
from sparsestyle_ns.studies.tradeoff.plan import Plan
from sparsestyle_ns.studies.tradeoff.quadrature import difference, in_chunks
from sparsestyle_ns.studies.tradeoff.study import Study

RESOLUTIONS = (256, 128, 384, 64)
"""Cells along the cube's side, those that matter most first."""
FRAMES_BETWEEN_VIEWS = 10
"""As `ns-render interpolate` has them."""
EXACT = "exact"


class Rendering:
    """The axis, and the pictures of its flight."""

    def __init__(self, study: Study) -> None:
        self.study = study
        self.exact: Dict[int, Tensor] = {}
        self.volumes: Dict[int, BakedVolume] = {}

    def plans(self) -> List[Plan]:
        """One."""
        axis = Axis(
            *("rendering", "baking", "Exact and baked pictures", "--pipeline.model.bake-resolution", EXACT),
            *("view_seconds", "rmse", [("fps", "psnr")]),
        )
        return [Plan(axis, 7, self._measure)]

    def _measure(self, axis: Axis, budget: Budget) -> None:
        study, model = self.study, self.study.model_to_render()
        flight = self._flight()
        what = "the stylised scene" if study.is_stylised else "the coarse field (there is no painting)"
        height, width = study.size
        axis.own_error = study.own_error
        axis.note = (
            f"Pictures of {what}, {width} × {height}, on a flight between views, each from a camera not seen before; "
            "PSNR is against the exact picture. A baked volume's first picture takes longer: it fills the voxels "
            "(render_mode: baked)."
        )
        in_turns(axis, self._cases(model, flight, budget), budget, study.options.rounds, study.watch)

    def _flight(self) -> List[Cameras]:
        cameras = self.study.eval_dataset.cameras
        if len(cameras) < 2:
            cameras = self.study.manager.train_dataset.cameras
        if len(cameras) < 2:
            return [cameras[:1].to(self.study.device)]
        path = get_interpolated_camera_path(cameras[:2], FRAMES_BETWEEN_VIEWS, order_poses=False).to(self.study.device)
        return [path[index : index + 1] for index in range(len(path))]

    def _cases(
        self, model: HierStyleModel, flight: List[Cameras], budget: Budget
    ) -> Dict[object, Callable[[], Values]]:
        """Each draws the next frame with every call; frame 0 is for baking."""
        resolutions = sorted({*RESOLUTIONS, model.config.bake_resolution}, key=lambda cells: cells not in RESOLUTIONS)

        def frame(number: int) -> RayBundle:
            return flight[number % len(flight)].generate_rays(camera_indices=0, keep_shape=False).flatten()

        def draw(bundle: RayBundle, render: Callable[[RayBundle], Tensor]) -> Tensor:
            return in_chunks(bundle, model.config.num_steps, budget, render)

        def draw_exact(number: int) -> Tensor:
            return draw(frame(number), lambda part: model.get_outputs(part)[self.study.picture])

        def exact() -> Values:
            if not self.exact:
                draw_exact(0)
            number = len(self.exact) + 1
            seconds, self.exact[number] = self.study.timed(lambda: draw_exact(number))
            return {"view_seconds": seconds, "fps": 1.0 / seconds, **difference(self.exact[number], self.exact[number])}

        def baked(resolution: int) -> Callable[[], Values]:
            count = [0]

            def measure() -> Values:
                values: Values = {}
                if resolution not in self.volumes:
                    volume = model.bake(resolution)
                    seconds, _ = self.study.timed(lambda: draw(frame(0), lambda part: self._baked(model, volume, part)))
                    self.volumes[resolution] = volume
                    values["first_seconds"] = seconds
                count[0] += 1
                number = min(count[0], len(self.exact))
                volume = self.volumes[resolution]
                seconds, picture = self.study.timed(
                    lambda: draw(frame(number), lambda part: self._baked(model, volume, part))
                )
                values.update(view_seconds=seconds, fps=1.0 / seconds, memory_mb=volume.num_bytes / 1e6)
                return values | difference(picture, self.exact[number])

            return measure

        return {EXACT: exact, **{resolution: baked(resolution) for resolution in resolutions}}

    @torch.no_grad()
    def _baked(self, model: HierStyleModel, volume: BakedVolume, bundle: RayBundle) -> Tensor:
        segments = model.space.segments(bundle.origins, bundle.directions)
        fine, coarse = render_baked(volume, segments, model.marching, model.background)
        return fine.rgb if self.study.is_stylised else coarse.rgb
