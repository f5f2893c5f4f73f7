"""What the models of both stages have in common: they are built for what was decided about a scene."""

from dataclasses import dataclass, field
from typing import Any, Optional

from nerfstudio.data.scene_box import SceneBox
from nerfstudio.models.base_model import Model, ModelConfig

from sparsestyle_ns.core.precision import Precision
from sparsestyle_ns.data.scene_info import NDC
from sparsestyle_ns.effects.background import background_color
from sparsestyle_ns.effects.decisions import Decisions
from sparsestyle_ns.effects.layouts import build_space
from sparsestyle_ns.effects.matched_colors import build_exposure
from sparsestyle_ns.effects.pose_refinement import CameraRefinement
from sparsestyle_ns.fields.coarse import CoarseFieldConfig


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
    eval_num_rays_per_chunk: int = 8192
    """Rays rendered at once outside of training."""


class SceneModel(Model):
    """A model of a scene, with its space, its background colour, and its photos' exposures and refined cameras.

    `scene_box` is in NDC where there is `ndc`, the dataparser's map to it, else in the world; among `kwargs` are the
    `device` that the model will be moved to and, where cameras are refined, the `refinement`.
    """

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
