"""Held-out cameras of a scene whose training cameras were estimated: where in its world they stand.

Poses that were estimated have a world of their own, in which a held-out photo's known pose is known only up to a
similarity, and not better than the training cameras. So, as NeRFmm (Wang et al. 2021) and Nope-NeRF (Bian et al. 2023)
do, the similarity that lays the known training cameras over the estimated ones places the held-out camera, and then its
pose alone is refined on its photo, the scene and the lens as they are. Any figure of such a view is of a pose that has
seen the photo.
"""

from typing import Union

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sparsestyle_ns.core.precision import autocast
from sparsestyle_ns.core.sampling import even_edges
from sparsestyle_ns.effects.pose_refinement import CameraRefinement
from sparsestyle_ns.losses.coarse import reconstruction_loss
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModel
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.rendering.render import render_coarse

NUM_SAMPLES = 32
"""Even, jittered samples a ray."""


@torch.enable_grad()
def aligned_to_photo(
    model: Union[CoarseFewShotModel, HierStyleModel],
    camera: Cameras,
    photo: Float[Tensor, "H W 3"],
    unit: float,
    steps: int = 80,
    rays: int = 256,
    learning_rate: float = 2e-3,
) -> Cameras:
    """One camera, with the pose near by from which the coarse field looks most like the photo.

    By Adam on the squared error of random pixels, at a learning rate that falls to a hundredth.

    Args:
        unit: of moves, in the world (`moving_unit`).
    """
    device = model.device
    camera, photo = camera.to(device), photo.to(device).reshape(-1, 3)
    refinement = CameraRefinement(camera.camera_to_worlds, unit).to(device)
    bundle = camera.generate_rays(camera_indices=0, keep_shape=True).flatten()
    generator = torch.Generator(device=device).manual_seed(0)
    learned = list(refinement.parameters())
    optimizer = torch.optim.Adam(learned, lr=learning_rate)
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = learning_rate * 0.01 ** (step / steps)
        pick = torch.randint(len(photo), (rays,), generator=generator, device=device)
        views = torch.zeros_like(pick)
        origins, directions = refinement(bundle.origins[pick], bundle.directions[pick], views)
        segments = model.space.segments(origins, directions)
        edges = even_edges(len(pick), NUM_SAMPLES, device, generator)
        with autocast(device, model.config.precision):
            rendered = render_coarse(model.field, segments, directions, edges, model.space.unbounded, model.background)
        loss = reconstruction_loss(rendered.rgb, photo[pick])
        for part, gradient in zip(learned, torch.autograd.grad(loss, learned), strict=True):
            part.grad = gradient
        optimizer.step()
    return refinement.cameras(camera)
