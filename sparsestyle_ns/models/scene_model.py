"""What the models of both stages have in common: they are built for what was decided about a scene."""

from dataclasses import dataclass, field
from typing import Any, Dict, NamedTuple, Optional, Tuple

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.model_components import renderers
from nerfstudio.models.base_model import Model, ModelConfig
from torch import Tensor

from sparsestyle_ns.core.precision import Precision
from sparsestyle_ns.core.spaces import Segments
from sparsestyle_ns.data.scene_info import NDC
from sparsestyle_ns.effects.background import background_color
from sparsestyle_ns.effects.decisions import Decisions
from sparsestyle_ns.effects.layouts import build_space
from sparsestyle_ns.effects.matched_colors import build_exposure
from sparsestyle_ns.effects.pose_refinement import CameraRefinement
from sparsestyle_ns.fields.coarse import CoarseFieldConfig
from sparsestyle_ns.rendering.render import Background, straight_color
from sparsestyle_ns.utils.errors import InputError


@dataclass
class SceneModelConfig(ModelConfig):
    """Settings that both stages have."""

    enable_collider: bool = False
    """Unused: the space of the scene decides where rays start and end."""
    coarse_field: CoarseFieldConfig = field(default_factory=CoarseFieldConfig)
    """The coarse field; stage 2 takes it over from the coarse run."""
    precision: Precision = "auto"
    """Number format of matrix products: auto is bfloat16 where the device multiplies it, else float32; tf32 is for
    GPUs."""
    num_steps: int = 128
    """Even steps along a ray, 2 or more, on which a trained coarse field's weight is looked for, in a volume of its
    densities; those in empty cells are skipped."""
    eval_num_rays_per_chunk: int = 8192
    """Rays rendered at once outside of training."""


class Shown(NamedTuple):
    """What is to be seen along the rays of a picture."""

    segments: Segments
    unbounded: bool
    """Whether the last step goes on to infinity."""
    background: Background


class SceneModel(Model):
    """A model of a scene, with its space, its background colour, and its photos' exposures and refined cameras.

    `scene_box` is in NDC where there is `ndc`, the dataparser's map to it, else in the world; among `kwargs` are the
    `device` that the model will be moved to and, where cameras are refined, the `refinement`.
    """

    picture_names: Tuple[str, ...]
    """Of a picture's outputs."""

    def __init__(
        self,
        config: SceneModelConfig,
        scene_box: SceneBox,
        num_train_data: int,
        effects: Decisions,
        ndc: Optional[NDC] = None,
        **kwargs: Any,
    ) -> None:
        self.effects, self.ndc = effects, ndc  # nerfstudio's initialiser calls populate_modules
        super().__init__(config, scene_box, num_train_data, **kwargs)

    def populate_modules(self) -> None:
        """Builds the space, and what the scene's effects need in both stages."""
        super().populate_modules()
        self.space = build_space(self.effects, self.scene_box, self.ndc)
        self.exposure = build_exposure(self.effects, self.num_train_data)
        self.refinement: Optional[CameraRefinement] = self.kwargs.get("refinement")
        self.register_buffer("background", background_color(self.effects), persistent=False)
        if self.config.enable_collider:
            raise InputError(
                "--pipeline.model.enable-collider has no use here: the scene's space ends rays; leave it out."
            )
        if self.config.num_steps < 2:  # an unbounded space's last step is endless, and says nothing of where to look
            raise InputError(f"--pipeline.model.num-steps is {self.config.num_steps}; give 2 or more.")
        if self.config.eval_num_rays_per_chunk < 1:
            raise InputError(f"--eval-num-rays-per-chunk is {self.config.eval_num_rays_per_chunk}; give 1 or more.")

    def shown(self, rays: RayBundle) -> Shown:
        """What is to be seen along rays of a picture: all of the scene or, where a crop gives them ends, what lies
        between those, before the crop's background."""
        segments = self.space.segments(rays.origins, rays.directions)
        if rays.nears is None or rays.fars is None:
            return Shown(segments, self.space.unbounded, self.background)
        background, override = self.background, renderers.BACKGROUND_COLOR_OVERRIDE
        if override is not None:
            background = override.to(rays.origins)
        return Shown(segments.between(rays.nears, rays.fars), False, background)

    def get_rgba_image(self, outputs: Dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Colour without background, and the geometry's opacity, for `ns-export tsdf` and ns-render's rgba."""
        color = straight_color(outputs[output_name], outputs["accumulation"], self.background)
        return torch.cat([color, outputs["accumulation"]], dim=-1)
