"""The styles of a scene that a viewer can show: fields, their paintings, and what made them."""

import base64
import io
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Dict, List, Optional, Tuple

from jaxtyping import Float
from PIL import Image
from torch import Tensor, nn

from sparsestyle_ns.runs.checkpoints import load_checkpoint, newest_checkpoint
from sparsestyle_ns.style.painting import decode_style_image, read_bytes
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole

THUMBNAIL_SIDE = 200
"""Longer side of a painting's thumbnail, in pixels."""
THUMBNAIL_NAME = "style_thumbnail.jpg"
"""Its file in a run's folder."""

Facts = List[Tuple[str, str]]
"""What made a style: pairs of what it is called and what it is."""


@dataclass(frozen=True)
class StyleImage:
    """A painting, as read from a file or sent by a browser.

    Attributes:
        name: of its file, without folders.
        data: what is in the file.
        pixels: RGB in [0, 1].
    """

    name: str
    data: bytes
    pixels: Float[Tensor, "3 H W"]

    @classmethod
    def read(cls, path: Path) -> "StyleImage":
        """Reads a file.

        Raises:
            InputError: it can't be read as an image.
        """
        path = path.expanduser()
        if path.exists() and not (path.is_file() or path.is_dir()):  # a device may never end
            raise InputError(f"The style image {path} is no file: give a JPEG, PNG or WebP file.")
        data = read_bytes(path)
        return cls(path.name, data, decode_style_image(data, path))

    @classmethod
    def received(cls, name: str, data: bytes) -> "StyleImage":
        """Takes what a browser sent over as the file `name`.

        Raises:
            InputError: it can't be read as an image.
        """
        name = Path(name.replace("\\", "/")).name or "upload"
        return cls(name, data, decode_style_image(data, name))

    def thumbnail(self) -> bytes:
        """A small JPEG."""
        picture = Image.fromarray((255 * self.pixels).round().byte().permute(1, 2, 0).numpy())
        picture.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
        file = io.BytesIO()
        picture.save(file, format="JPEG", quality=85)
        return file.getvalue()


def save_thumbnail(folder: Path, image: StyleImage) -> None:
    """Keeps a painting's thumbnail in a run's folder, so that the run can be told apart without the painting."""
    write_whole(folder / THUMBNAIL_NAME, image.thumbnail())


def find_thumbnail(folder: Path, style_image: Optional[Path]) -> Optional[bytes]:
    """The thumbnail of a run's painting: the run's own, else made from the painting; None where neither is there."""
    kept = folder / THUMBNAIL_NAME
    try:
        return kept.read_bytes() if kept.is_file() or style_image is None else StyleImage.read(style_image).thumbnail()
    except (OSError, InputError):
        return None


@dataclass(eq=False)
class Style:
    """One style of the scene.

    Attributes:
        name: what the panel calls it.
        field: gives σ_f and c_f.
        facts: what made it.
        thumbnail: a small JPEG of its painting.
    """

    name: str
    field: nn.Module
    facts: Facts = field(default_factory=list)
    thumbnail: Optional[bytes] = None

    def markdown(self) -> str:
        """The thumbnail, and what made the style."""
        picture = []
        if self.thumbnail is not None:
            picture = [f"![painting](data:image/jpeg;base64,{base64.b64encode(self.thumbnail).decode()})"]
        return "\n\n".join([*picture, *(f"**{name}** {plain(value)}" for name, value in self.facts)])


def plain(text: str) -> str:
    """Text that Markdown shows as it is, and that may be broken behind slashes and underscores.

    viser's Markdown takes JSX; a panel with a path in it that doesn't fit would have to be scrolled sideways.
    """
    escaped = re.sub(r"([\\`*_{}\[\]<>()#+!|~$&])", r"\\\1", " ".join(text.split()))
    return re.sub(r"(/|\\_)", r"\1<wbr />", escaped)


def style_facts(painting: Optional[str], run: str, notes: Dict[str, Any]) -> Facts:
    """What made a style.

    Args:
        painting: its file's name.
        run: the run's folder, or why there is none.
        notes: of its checkpoint, or of its trainer.
    """
    facts = [("Painting", painting or "not known"), ("Run", run)]
    if "step" in notes:
        facts.append(("Iterations", str(notes["step"] + 1)))
    if "backbone" in notes:
        facts.append(("Features", "{name}, {source}".format(**notes["backbone"])))
    if "coarse_run" in notes:
        facts.append(("Coarse run", notes["coarse_run"]))
    return facts


def checkpoint_notes(folder: Path) -> Dict[str, Any]:
    """What the newest checkpoint in a folder says beside the state; nothing where there is none or it can't be read."""
    newest = newest_checkpoint(folder)
    if newest is None:
        return {}
    try:
        state = load_checkpoint(newest)
    except InputError:
        return {}
    return {name: state[name] for name in ("step", "backbone", "coarse_run") if name in state}
