"""Views that nobody photographed, and what photos of the same scene say of them (DietNeRF, Jain et al. 2021).

DietNeRF embeds pictures by CLIP, which knows what things are. Here it is VGG-16's third block, averaged over the
picture: it knows textures and parts of things, and the loss is DietNeRF's in form only.
"""

from typing import List

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sparsestyle_ns.core.camera_paths import unseen_places
from sparsestyle_ns.losses.coarse import pooled_features, semantic_loss
from sparsestyle_ns.losses.stylization import fit_side
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModel
from sparsestyle_ns.pipelines.datamanager import bundle_rays
from sparsestyle_ns.style.backbone import Backbone

NUM_PLACES = 240
"""Places that a view is drawn from, at least."""


class UnseenViews:
    """The semantic loss of views drawn at random from `unseen_places`, each against a photo drawn at random.

    Kept out of the pipeline's modules: a checkpoint doesn't hold the network.

    Args:
        backbone: the feature network.
        cameras: of the photos, two or more.
        photos: what they saw, in [0, 1], on the network's device.
        side: longer side, in pixels, at which views are rendered, and the network sees them and the photos.
    """

    def __init__(self, backbone: Backbone, cameras: Cameras, photos: List[Float[Tensor, "H W 3"]], side: int) -> None:
        self.backbone = backbone
        self.side = side
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
