"""What a run was trained on, its photos and its painting, saved beside its config for later runs and viewers."""

import json
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Optional, Sequence

import numpy as np
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

from sparsestyle_ns.data.photos import photo_digests
from sparsestyle_ns.data.scene_info import scene_info
from sparsestyle_ns.effects.background import background_color
from sparsestyle_ns.effects.decisions import Decisions
from sparsestyle_ns.effects.registry import decided_on_photos
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole

RECORD_FILE = "scene.json"
THUMBNAIL_FILE = "style_thumbnail.jpg"
NAMES_TOLD = 8
"""Photos that a sentence names at most."""


@dataclass
class ViewsRecord:
    """Some photos of a scene: their names, poses as in `SceneRecord.cameras`, and digests of their files."""

    names: List[str]
    cameras: List[List[List[float]]]
    digests: List[Optional[str]]

    def difference(self, other: "ViewsRecord") -> Optional[str]:
        """In words, what is different about the photos that were there before (`other`); None where nothing is."""
        if self.names != other.names:
            return f"the photos were {in_words(other.names)}, and are {in_words(self.names)} now"
        for name, mine, theirs in zip(self.names, self.digests, other.digests, strict=True):
            if mine != theirs and None not in (mine, theirs):  # without the file, nothing can be said of it
                return f"{name} is another picture by now"
        if not _close(self.cameras, other.cameras):
            return "the cameras stand elsewhere: another scene, or other settings of the dataparser"
        return None


def in_words(names: Sequence[str]) -> str:
    """Names of photos in a line, the first of them where there are many."""
    told = ", ".join(names[:NAMES_TOLD]) or "none"
    return told if len(names) <= NAMES_TOLD else f"{told} and {len(names) - NAMES_TOLD} more"


def _close(first: Any, second: Any) -> bool:
    mine, theirs = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    return mine.shape == theirs.shape and np.allclose(mine, theirs, atol=1e-4)


@dataclass
class SceneRecord:
    """The photos of a run. What runs of earlier versions didn't record is None."""

    data: str
    """Folder or file of the scene, absolute, or relative to the run's folder."""
    view_ids: List[int]
    view_names: List[str]
    scene_box: List[List[float]]
    """Its corners."""
    cameras: List[List[List[float]]]
    """Camera-to-world matrix, [3][4], of each training view, after the dataparser's scaling."""
    background_color: Optional[List[float]]
    effects: Dict[str, bool]
    """Which of the effects that are decided on photos are on."""
    digests: Optional[List[Optional[str]]] = None
    """By which the files of the training views are known again (`photo_digests`)."""
    held_out: Optional[ViewsRecord] = None
    """The photos that the run is measured on."""
    painting: Optional[str] = None
    """By which the style image's file is known again."""
    folder: Optional[str] = None
    """The run's own folder, absolute, as it was then."""

    def save(self, folder: Path, final: Optional[Path] = None) -> None:
        """Writes `scene.json` into a run's folder, and into it where that is, or will be if `final` says so."""
        record = replace(self, folder=str((final or folder).resolve()))
        write_whole(folder / RECORD_FILE, json.dumps(asdict(record), indent=1) + "\n")

    @classmethod
    def load(cls, folder: Path) -> "SceneRecord":
        """Reads `scene.json` of a run's folder; InputError where it can't be read."""
        path = folder / RECORD_FILE
        try:
            return cls.from_content(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise InputError(f"{path} is missing or damaged; is {folder} the folder of a finished run?") from error

    @classmethod
    def from_content(cls, content: Dict[str, Any]) -> "SceneRecord":
        """The inverse of `dataclasses.asdict`; ValueError or TypeError where it isn't that."""
        held_out = content.get("held_out")
        record = cls(**{**content, "held_out": None if held_out is None else ViewsRecord(**held_out)})
        count = len(record.view_ids)
        if not isinstance(record.data, str) or np.asarray(record.cameras, dtype=np.float64).shape != (count, 3, 4):
            raise ValueError("it names no folder, or its cameras aren't those of its views")
        if np.asarray(record.scene_box, dtype=np.float64).shape != (2, 3) or len(record.view_names) != count:
            raise ValueError("its box or its photos can't be those of a scene")
        return record

    def found(self, path: Path, folder: Path) -> Path:
        """Where a file or folder is that the run used, whose own folder is `folder` now: it may have moved with it."""
        if self.folder is not None and Path(self.folder) != folder:
            moved = Path(os.path.normpath(folder / os.path.relpath(path, self.folder)))
            if moved.exists():
                return moved
        return path

    def find_data(self, folder: Path) -> Path:
        """Where the scene of the run in a folder is now; InputError where it is gone and hasn't moved with the run."""
        data = self.found(Path(os.path.normpath(folder / self.data)), folder)
        if not data.exists():
            raise InputError(
                f"The scene of the run {folder} isn't at {data} any more; put it back there, or write where it is now "
                f'behind "data" in {folder / RECORD_FILE}.'
            )
        return data

    def difference(self, other: "SceneRecord") -> Optional[str]:
        """In words, what keeps a field trained on `other` from fitting this scene; None where nothing does."""
        if not self._same_views(other):
            return self.photo_difference(other)
        for name, on in self.effects.items():
            theirs = other.effects.get(name, False)
            if on != theirs:
                word, flag = "on" if theirs else "off", f"--pipeline.effects.{name.replace('_', '-')}"
                return f"it was made with the effect {name} {word}, as by {flag} {word}"
        if self.background_color != other.background_color:
            return f"its background has the colour {other.background_color} in place of {self.background_color}"
        return self.photo_difference(other)

    def _same_views(self, other: "SceneRecord") -> bool:
        return self.view_ids == other.view_ids and self.view_names == other.view_names

    def photo_difference(self, other: "SceneRecord") -> Optional[str]:
        """The same of the photos and their poses alone."""
        if not self._same_views(other):
            return f"it was trained on views {other.view_ids} ({in_words(other.view_names)})"
        if not _close(self.scene_box, other.scene_box):
            return "its cameras stand elsewhere: another scene, or other settings of the dataparser"
        unknown: List[Optional[str]] = [None] * len(self.view_ids)
        before, now = (
            ViewsRecord(record.view_names, record.cameras, record.digests or unknown) for record in (other, self)
        )
        return now.difference(before)

    def held_out_difference(self, other: "SceneRecord") -> Optional[str]:
        """In words, what is different about the photos that a run (`other`) is measured on; None where nothing is."""
        if self.held_out is None or other.held_out is None:
            return None
        found = self.held_out.difference(other.held_out)
        return None if found is None else f"of the held-out photos, {found}"


class ExpectedScene(NamedTuple):
    """What a scene has to be, since something that is there was made of it."""

    record: SceneRecord
    what: str
    """That something, in words."""
    advice: str
    """What to do where the scene is another one."""
    measured: bool = True
    """Whether its held-out photos count, too."""

    def check(self, scene: SceneRecord) -> None:
        """Raises an InputError where a scene is another one."""
        difference = scene.photo_difference(self.record)
        if difference is None and self.measured:
            difference = scene.held_out_difference(self.record)
        if difference is not None:
            raise self.refusal(scene.data, difference)

    def refusal(self, data: str, reason: str) -> InputError:
        """An error that says why a scene isn't that one."""
        return InputError(f"{self.what} doesn't fit {data} as it is now ({reason}); {self.advice}.")


def record_scene(
    data: Path,
    outputs: DataparserOutputs,
    effects: Optional[Decisions] = None,
    held_out: Optional[DataparserOutputs] = None,
    with_photos: bool = True,
) -> SceneRecord:
    """The record of a run on a scene's training views, as `read_scene` gives them, and on its held-out ones.

    `with_photos` as of `record_views`; without effects only its photos mean something.
    """
    background, views = None if effects is None else background_color(effects), record_views(outputs, with_photos)
    return SceneRecord(
        data=str(data.resolve()),
        view_ids=list(scene_info(outputs).view_ids),
        view_names=views.names,
        scene_box=outputs.scene_box.aabb.tolist(),
        cameras=views.cameras,
        background_color=None if background is None else background.tolist(),
        effects={} if effects is None else decided_on_photos(effects),
        digests=views.digests,
        held_out=None if held_out is None else record_views(held_out, with_photos),
    )


def record_views(outputs: DataparserOutputs, with_photos: bool = True) -> ViewsRecord:
    """The record of some photos; without their files' digests unless `with_photos`."""
    names = [path.name for path in outputs.image_filenames]
    digests = photo_digests(outputs) if with_photos else [None] * len(names)
    return ViewsRecord(names, outputs.cameras.camera_to_worlds.tolist(), digests)


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
