"""What a run was trained on, its photos and its painting, saved beside its config for later runs and viewers."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Dict, List, Optional

import numpy as np
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

from sparsestyle_ns.data.scene_info import scene_info
from sparsestyle_ns.effects.background import background_color
from sparsestyle_ns.effects.decisions import Decisions
from sparsestyle_ns.effects.registry import decided_on_photos
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole

RECORD_FILE = "scene.json"
THUMBNAIL_FILE = "style_thumbnail.jpg"


@dataclass
class SceneRecord:
    """The photos of a run."""

    data: str
    """Folder or file of the scene, absolute."""
    view_ids: List[int]
    view_names: List[str]
    scene_box: List[List[float]]
    """Its corners."""
    cameras: List[List[List[float]]]
    """Camera-to-world matrix, [3][4], of each training view, after the dataparser's scaling."""
    background_color: Optional[List[float]]
    effects: Dict[str, bool]
    """Which of the effects that are decided on photos are on."""

    def save(self, folder: Path) -> None:
        """Writes `scene.json` into a run's folder."""
        write_whole(folder / RECORD_FILE, json.dumps(asdict(self), indent=1) + "\n")

    @classmethod
    def load(cls, folder: Path) -> "SceneRecord":
        """Reads `scene.json` of a run's folder; InputError where it can't be read."""
        path = folder / RECORD_FILE
        try:
            return cls(**json.loads(path.read_text()))
        except (OSError, ValueError, TypeError) as error:
            raise InputError(f"{path} is missing or damaged; is {folder} the folder of a finished run?") from error

    def difference(self, other: "SceneRecord") -> Optional[str]:
        """In words, what keeps a field trained on `other` from fitting this scene; None where nothing does."""
        if self.view_ids != other.view_ids or self.view_names != other.view_names:
            return f"it was trained on views {other.view_ids} ({', '.join(other.view_names)})"
        for name, on in self.effects.items():
            theirs = other.effects.get(name, False)
            if on != theirs:
                word, flag = "on" if theirs else "off", f"--pipeline.effects.{name.replace('_', '-')}"
                return f"it was made with the effect {name} {word}, as by {flag} {word}"
        if self.background_color != other.background_color:
            return f"its background has the colour {other.background_color} in place of {self.background_color}"
        mine, theirs = [*self.cameras, self.scene_box], [*other.cameras, other.scene_box]
        if any(not np.allclose(first, second, atol=1e-4) for first, second in zip(mine, theirs, strict=True)):
            return "its cameras stand elsewhere: another scene, or other settings of the dataparser"
        return None


def record_scene(data: Path, outputs: DataparserOutputs, effects: Decisions) -> SceneRecord:
    """The record of a run on a scene's training views, as `read_scene` gives them."""
    background = background_color(effects)
    return SceneRecord(
        data=str(data.resolve()),
        view_ids=list(scene_info(outputs).view_ids),
        view_names=[path.name for path in outputs.image_filenames],
        scene_box=outputs.scene_box.aabb.tolist(),
        cameras=outputs.cameras.camera_to_worlds.tolist(),
        background_color=None if background is None else background.tolist(),
        effects=decided_on_photos(effects),
    )


def save_thumbnail(folder: Path, painting: Painting) -> None:
    """Keeps a painting's thumbnail in a run's folder, so that the run can be told apart without the painting."""
    write_whole(folder / THUMBNAIL_FILE, painting.thumbnail())


def find_thumbnail(folder: Path, style_image: Optional[Path]) -> Optional[bytes]:
    """The thumbnail of a run's painting: the run's own, else made from the painting; None where neither is there."""
    kept = folder / THUMBNAIL_FILE
    try:
        return kept.read_bytes() if kept.is_file() or style_image is None else Painting.read(style_image).thumbnail()
    except (OSError, InputError):
        return None
