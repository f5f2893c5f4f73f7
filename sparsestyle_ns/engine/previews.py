"""What a run looks like while it is trained: one held-out view, the same each time, beside its photo."""

from pathlib import Path
from typing import FrozenSet, Sequence

import torch
from jaxtyping import Float
from nerfstudio.utils import writer
from nerfstudio.utils.decorators import check_main_thread
from PIL import Image
from torch import Tensor

from sparsestyle_ns.data.photos import reduced
from sparsestyle_ns.evaluation.held_out import exact_outputs
from sparsestyle_ns.pipelines.scene_pipeline import CheckedPipeline
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.progress import say


def preview_steps(shares: Sequence[float], total: int) -> FrozenSet[int]:
    """After which iterations, of `total`, a preview is due, by shares of them; InputError for one not in (0, 1]."""
    for share in shares:
        if not 0.0 < share <= 1.0:
            raise InputError(f"--previews has {share:g}, which isn't a share of the iterations above 0 and up to 1.")
    return frozenset(max(1, round(share * total)) for share in shares)


def preview_path(run: Path, iterations: int) -> Path:
    """Where the preview after so many iterations is, in a run's folder."""
    return run / "previews" / f"after-{iterations:06d}.png"


@check_main_thread
def write_preview(pipeline: CheckedPipeline, run: Path, iterations: int, longest_side: int) -> None:
    """Puts a preview into the run's folder, and into tensorboard where that is on."""
    picture = render_preview(pipeline, longest_side)
    writer.put_image(name="Preview", image=picture, step=iterations)
    image = Image.fromarray(writer.to8b(picture).cpu().numpy())
    try:
        write_whole(preview_path(run, iterations), lambda file: image.save(file, "PNG"))
    except OSError as error:
        say(f"The preview after {iterations} iterations can't be saved ({error.strerror}); training goes on.")


@torch.no_grad()
def render_preview(pipeline: CheckedPipeline, longest_side: int) -> Float[Tensor, "H W 3"]:
    """The middle held-out view, side by side: photo, unstylised render where there is one, and render.

    Rendered exactly, at `longest_side` pixels at most; the state of training stays as it is.
    """
    model, dataset = pipeline.model, pipeline.datamanager.eval_dataset
    index = len(dataset) // 2
    camera = dataset.cameras[index : index + 1].to(model.device)
    photo = dataset[index]["image"][..., :3].to(model.device)
    scale = longest_side / max(photo.shape[:2])
    if scale < 1.0:
        camera.rescale_output_resolution(scale)
    size = int(camera.height), int(camera.width)
    photo = reduced(photo, size)
    pipeline.eval()
    outputs = exact_outputs(model, camera)
    pipeline.train()
    renders = [outputs[name] for name in ("rgb_coarse", "rgb") if name in outputs]
    return torch.cat([photo, *renders], dim=1)
