"""A stylised run that is ready to be exported, and its exact renders."""

from dataclasses import dataclass
from pathlib import Path
from typing import Dict, List, Optional, Sequence

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor, nn

from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.evaluation.held_out import exact_outputs
from sparsestyle_ns.export.orbit import pinholes
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.progress import track


@dataclass
class StylisedScene:
    """What made a scene; the model in evaluation mode; the training views, undistorted, and their photos' names.

    Attributes:
        name: the scene's.
        painting: file name of the style image; None where it isn't known.
        method: nerfstudio's name of the method.
        iterations: of the style.
        held_out: of photos that weren't trained on, as `held_out_names`; of a scene without any, there are none.
    """

    name: str
    painting: Optional[str]
    method: str
    iterations: int
    model: HierStyleModel
    cameras: Cameras
    names: List[str]
    held_out: Cameras
    held_out_names: List[str]

    @property
    def style(self) -> str:
        """The painting's file name without its ending, if it is known."""
        return "" if self.painting is None else Path(self.painting).stem

    @property
    def title(self) -> str:
        """Scene and style."""
        return " · ".join(filter(None, (self.name, self.style)))


def load_scene(config_path: Path) -> StylisedScene:
    """Loads a stylised run; `InputError` if it has no checkpoint."""
    config, pipeline, step = load_run(config_path)
    dataset, others = pipeline.datamanager.train_dataset, pipeline.datamanager.eval_dataset
    painting = config.pipeline.style_image
    names = [path.name for path in dataset.image_filenames]
    unseen = [index for index, path in enumerate(others.image_filenames) if path not in dataset.image_filenames]
    return StylisedScene(
        name=config.experiment_name,
        painting=None if painting is None else Path(painting).name,
        method=config.method_name,
        iterations=step + 1,
        model=pipeline.model.eval(),
        cameras=pinholes(dataset.cameras.to("cpu")),
        names=names,
        held_out=pinholes(others.cameras.to("cpu")[torch.tensor(unseen, dtype=torch.long)]),
        held_out_names=[others.image_filenames[index].name for index in unseen],
    )


def load_scenes(config_paths: Sequence[Path]) -> List[StylisedScene]:
    """Loads stylised runs; `InputError` if one has no checkpoint, or they don't share views and coarse field."""
    first, *others = scenes = [load_scene(path) for path in config_paths]
    for scene, path in zip(others, config_paths[1:], strict=True):
        if not (have_one_scene(first, scene) and have_one_coarse_field(first.model, scene.model)):
            raise InputError(
                f"{config_paths[0].parent} and {path.parent} can't be blended: they are styles of different scenes or "
                "coarse runs; stylise one coarse run twice (--coarse-run)."
            )
    return scenes


def have_one_scene(first: StylisedScene, second: StylisedScene) -> bool:
    """Whether two scenes have the same training views."""
    views = (scene.cameras.camera_to_worlds for scene in (first, second))
    return first.names == second.names and torch.equal(*views)


def have_one_coarse_field(first: HierStyleModel, second: HierStyleModel) -> bool:
    """Whether the frozen parts of two models, between which pictures can be mixed, are the same."""
    if first.config.num_steps != second.config.num_steps or type(first.space) is not type(second.space):
        return False
    mine, theirs = (
        [value.cpu() for part in frozen_parts(model) for value in part.state_dict().values()]
        for model in (first, second)
    )
    return len(mine) == len(theirs) and all(map(torch.equal, mine, theirs))


def frozen_parts(model: HierStyleModel) -> List[nn.Module]:
    """What stylising doesn't change."""
    return [part for part in (model.field, model.space, model.occupancy) if part is not None]


def exact_pictures(scene: StylisedScene, longest: Optional[int] = None) -> List[Dict[str, Tensor]]:
    """Exact renders of the training views, on the CPU, made smaller as by `pinholes`."""
    pictures = []
    for index in track(range(len(scene.cameras)), "Exact renders"):
        camera = pinholes(scene.cameras[index : index + 1], longest).to(scene.model.device)
        pictures.append({key: value.cpu() for key, value in exact_outputs(scene.model, camera).items()})
    return pictures
