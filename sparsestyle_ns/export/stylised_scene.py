"""A stylised run that is ready to be exported, and its exact renders."""

from dataclasses import dataclass
from pathlib import Path
from typing import Dict, List, Optional

from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.evaluation.held_out import exact_outputs
from sparsestyle_ns.export.orbit import pinholes
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.utils.progress import track


@dataclass
class StylisedScene:
    """Scene and painting; the model in evaluation mode; the training views, undistorted, and their photos' names."""

    title: str
    model: HierStyleModel
    cameras: Cameras
    names: List[str]


def load_scene(config_path: Path) -> StylisedScene:
    """Loads a stylised run; `InputError` if it has no checkpoint."""
    config, pipeline, _ = load_run(config_path)
    dataset = pipeline.datamanager.train_dataset
    painting = config.pipeline.style_image
    title = config.experiment_name if painting is None else f"{config.experiment_name} · {Path(painting).stem}"
    names = [path.name for path in dataset.image_filenames]
    return StylisedScene(title, pipeline.model.eval(), pinholes(dataset.cameras.to("cpu")), names)


def exact_pictures(scene: StylisedScene, longest: Optional[int] = None) -> List[Dict[str, Tensor]]:
    """Exact renders of the training views, on the CPU, made smaller as by `pinholes`."""
    pictures = []
    for index in track(range(len(scene.cameras)), "Exact renders"):
        camera = pinholes(scene.cameras[index : index + 1], longest).to(scene.model.device)
        pictures.append({key: value.cpu() for key, value in exact_outputs(scene.model, camera).items()})
    return pictures
