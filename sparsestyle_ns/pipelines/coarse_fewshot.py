"""The pipeline of `coarse-fewshot`: batches of rays of a few photos, and views that nobody photographed."""

from dataclasses import dataclass, field
from typing import Any, Dict, List, Optional, Tuple, Type

import torch
import torch.nn.functional as F
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.models.base_model import ModelConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sparsestyle_ns.core.camera_paths import unseen_places
from sparsestyle_ns.effects.pose_refinement import miss_in_pixels
from sparsestyle_ns.effects.registry import decide_again
from sparsestyle_ns.losses.coarse import pooled_features, semantic_loss
from sparsestyle_ns.losses.stylization import fit_side
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModel, CoarseFewShotModelConfig
from sparsestyle_ns.pipelines.datamanager import bundle_rays
from sparsestyle_ns.pipelines.scene_pipeline import CheckedPipeline, CheckedPipelineConfig
from sparsestyle_ns.style.backbone import Backbone
from sparsestyle_ns.utils.errors import InputError

NUM_PLACES = 240
"""Places that a view is drawn from, at least."""


@dataclass
class CoarseFewShotPipelineConfig(CheckedPipelineConfig):
    """Settings of stage 1."""

    _target: Type = field(default_factory=lambda: CoarseFewShotPipeline)
    model: ModelConfig = field(default_factory=CoarseFewShotModelConfig)
    """The coarse field and how it is trained."""
    reprojection_weight: float = 1e-2
    """Weight of the distance, in pixels, by which rays to matched points miss each other, where cameras are refined."""
    semantic_weight: float = 0.0
    """Weight of the semantic loss (DietNeRF's, with VGG-16 for CLIP; 0.1 there): views between the photos must look
    like one of them to the feature network. 0 is off, and needs no network."""
    semantic_every: int = 10
    """Iterations from one semantic loss to the next."""
    semantic_side: int = 64
    """Longer side, in pixels, of the views rendered for it; all their rays are in memory at once."""


class UnseenViews:
    """The semantic loss of views drawn at random from `unseen_places`, each against a photo drawn at random.

    DietNeRF (Jain et al. 2021) embeds pictures by CLIP, which knows things; here VGG-16's third block knows their
    textures and parts. No module: a checkpoint doesn't hold the network.

    Args:
        cameras: of the photos, two or more.
        photos: what they saw, in [0, 1], on the network's device.
        side: longer side, in pixels, at which views are rendered, and the network sees them and the photos.
    """

    def __init__(self, backbone: Backbone, cameras: Cameras, photos: List[Float[Tensor, "H W 3"]], side: int) -> None:
        self.backbone, self.side = backbone, side
        places = unseen_places(cameras, NUM_PLACES)
        longest = max(int(places.width[0]), int(places.height[0]))
        places.rescale_output_resolution(side / longest, scale_rounding_mode="ceil")
        self.places = places.to(photos[0].device)
        with torch.no_grad():
            self.photos = torch.cat([self.embedding(photo) for photo in photos])

    def embedding(self, picture: Float[Tensor, "H W 3"]) -> Float[Tensor, "1 C"]:
        """What the network says that a picture shows."""
        image = fit_side(picture.permute(2, 0, 1)[None], self.side, self.backbone.smallest_side)
        return pooled_features(self.backbone(image))

    def loss(self, model: CoarseFewShotModel, generator: torch.Generator) -> Float[Tensor, ""]:
        """The loss of one view, rendered as training rays are, at the exposure of the photo that it is held against.

        View and photo are drawn by `generator`, on the CPU.
        """
        place = int(torch.randint(len(self.places), (), generator=generator))
        photo = int(torch.randint(len(self.photos), (), generator=generator))
        rays = self.places[place : place + 1].generate_rays(camera_indices=0, keep_shape=True)
        origins = rays.origins.reshape(-1, 3)
        photos = torch.full_like(origins[:, 0], photo, dtype=torch.long)
        view = model(bundle_rays(origins, rays.directions.reshape(-1, 3), photos, {}))["rgb"]
        return semantic_loss(self.embedding(view.view(rays.origins.shape)), self.photos[photo : photo + 1])


class CoarseFewShotPipeline(CheckedPipeline):
    """Stage 1. nerfstudio's own steps on our data manager and model."""

    config: CoarseFewShotPipelineConfig
    model: CoarseFewShotModel
    unseen: Optional[UnseenViews] = None
    """Views for the semantic loss, in training and where it is on."""

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> List[TrainingCallback]:
        """Adds the decision about empty space to nerfstudio's callbacks, and prepares the semantic loss.

        InputError where there can be none with these settings, photos or weights.
        """
        weight, every = self.config.semantic_weight, self.config.semantic_every
        if not 0.0 <= weight < float("inf"):
            raise InputError(f"--pipeline.semantic-weight is {weight}; give a number from 0 on.")
        if every < 1:
            raise InputError(f"--pipeline.semantic-every is {every}; give 1 or more.")
        if weight > 0:
            self.unseen = self._unseen_views()
        callbacks = super().get_training_callbacks(training_callback_attributes)
        if self.effects["empty_space"].choice == "auto":
            where = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
            callbacks.append(TrainingCallback(where_to_run=where, func=self.decide_empty_space))
        return callbacks

    def _unseen_views(self) -> UnseenViews:
        """The views between the photos, with the feature network, which is announced."""
        cameras, pixels = self.datamanager.train_dataset.cameras, self.datamanager.pixels
        if len(cameras) < 2:
            raise InputError("--pipeline.semantic-weight needs views between photos, and there is one; train on more.")
        backbone, side = self.config.load_backbone(self.device), self.config.semantic_side
        if side < backbone.smallest_side:
            raise InputError(f"--pipeline.semantic-side is {side}; give {backbone.smallest_side} or more pixels.")
        self.announce(backbone)
        photos = [pixels.colors[pixels.rows(view)].view(*size, 3) for view, size in enumerate(pixels.sizes)]
        return UnseenViews(backbone, cameras, photos, side)

    def get_train_loss_dict(self, step: int) -> Tuple[Dict[str, Any], Dict[str, Tensor], Dict[str, Any]]:
        """Outputs, losses and metrics of a batch and, every `semantic_every` iterations, the loss of an unseen view."""
        outputs, losses, metrics = super().get_train_loss_dict(step)
        refinement = self.model.refinement
        if refinement is not None and refinement.learns and self.datamanager.matched is not None:
            losses["reprojection_loss"] = self.config.reprojection_weight * self._reprojection_loss()
        if self.unseen is not None and step % self.config.semantic_every == 0:
            # Which view and which photo depends on the data manager's seed and the step alone.
            generator = torch.Generator().manual_seed(self.datamanager.config.seed * 1_000_003 + step)
            losses["semantic_loss"] = self.config.semantic_weight * self.unseen.loss(self.model, generator)
        return outputs, losses, metrics

    def _reprojection_loss(self) -> Float[Tensor, ""]:
        """How far photos' rays to matched points miss each other, in pixels of the size at which these were matched.

        Errors over a pixel count by their size, smaller ones by their square (Huber).
        """
        manager = self.datamanager
        points = torch.arange(len(manager.matched) // 2, device=self.device)
        pixels = miss_in_pixels(*manager.matched_pairs(points), manager.train_dataset.given_cameras)
        return F.huber_loss(pixels, torch.zeros_like(pixels))

    def decide_empty_space(self, step: int) -> None:
        """After every tenth of the iterations from three quarters on, measures whether skipping empty space pays."""
        # Before, the field is still half the fog that it starts as, and a measurement would say so.
        done, total = step + 1, self.model.num_iterations
        if done % max(1, total // 10) or not 3 * total <= 4 * done < 4 * total:
            return
        scene = self.datamanager.scene
        scene.coarse_density = lambda points: self.model.field.density_and_feature(points.to(self.device))[0]
        before = self.effects.on("empty_space")
        self.effects = decide_again(self.effects, "empty_space", scene)
        if self.effects.on("empty_space") != before:
            self.model.build_grid(self.effects)
            decision = self.effects["empty_space"]
            word, why = "on" if decision.on else "off", f"{decision.measured:.0%} {decision.reason}"
            CONSOLE.print(f"Empty-space skipping is {word} from iteration {done} on: {why}.")
