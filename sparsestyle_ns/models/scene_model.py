"""What the models of both stages have in common: they are built for what was decided about a scene."""

from typing import Any, Optional

from nerfstudio.data.scene_box import SceneBox
from nerfstudio.models.base_model import Model, ModelConfig

from sparsestyle_ns.data.scene_info import NDC
from sparsestyle_ns.effects.background import background_color
from sparsestyle_ns.effects.base import Decisions
from sparsestyle_ns.effects.exposure import build_exposure
from sparsestyle_ns.effects.layouts import build_space


class SceneModel(Model):
    """A model of a scene, with its space, its background colour and its photos' exposures.

    Args:
        scene_box: the dataparser's; in NDC if there is `ndc`, else in the world.
        ndc: the dataparser's map to NDC, without which space isn't laid out so.
        kwargs: for nerfstudio's model, among them the `device` that it will be moved to.
    """

    def __init__(
        self,
        config: ModelConfig,
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
        self.register_buffer("background", background_color(self.effects), persistent=False)
