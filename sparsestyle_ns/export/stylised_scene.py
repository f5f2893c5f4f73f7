"""A stylised run that is ready to be exported, and its exact renders."""

from dataclasses import dataclass
from pathlib import Path
from typing import Dict, List, Optional

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.evaluation.held_out import exact_outputs
from sparsestyle_ns.export.orbit import pinholes
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.utils.progress import track


@dataclass
class StylisedScene:
    """Scene and painting; the model in evaluation mode; the training views, undistorted, and their photos' names.

    `held_out` and `held_out_names` are of photos that weren't trained on; of a scene without any, there are none.
    """

    title: str
    model: HierStyleModel
    cameras: Cameras
    names: List[str]
    held_out: Cameras
    held_out_names: List[str]


def load_scene(config_path: Path) -> StylisedScene:
    """Loads a stylised run; `InputError` if it has no checkpoint."""
    config, pipeline, _ = load_run(config_path)
    dataset, others = pipeline.datamanager.train_dataset, pipeline.datamanager.eval_dataset
    painting = config.pipeline.style_image
    title = config.experiment_name if painting is None else f"{config.experiment_name} · {Path(painting).stem}"
    names = [path.name for path in dataset.image_filenames]
    unseen = [index for index, path in enumerate(others.image_filenames) if path not in dataset.image_filenames]
    return StylisedScene(
        title=title,
        model=pipeline.model.eval(),
        cameras=pinholes(dataset.cameras.to("cpu")),
        names=names,
        held_out=pinholes(others.cameras.to("cpu")[torch.tensor(unseen, dtype=torch.long)]),
        held_out_names=[others.image_filenames[index].name for index in unseen],
    )


def exact_pictures(scene: StylisedScene, longest: Optional[int] = None) -> List[Dict[str, Tensor]]:
    """Exact renders of the training views, on the CPU, made smaller as by `pinholes`."""
    pictures = []
    for index in track(range(len(scene.cameras)), "Exact renders"):
        camera = pinholes(scene.cameras[index : index + 1], longest).to(scene.model.device)
        pictures.append({key: value.cpu() for key, value in exact_outputs(scene.model, camera).items()})
    return pictures
