"""The small picture of its painting that a stylised run keeps."""

from pathlib import Path
from typing import Optional

from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole

FILE_NAME = "style_thumbnail.jpg"


def save_thumbnail(folder: Path, painting: Painting) -> None:
    """Keeps a painting's thumbnail in a run's folder, so that the run can be told apart without the painting."""
    write_whole(folder / FILE_NAME, painting.thumbnail())


def find_thumbnail(folder: Path, style_image: Optional[Path]) -> Optional[bytes]:
    """The thumbnail of a run's painting: the run's own, else made from the painting; None where neither is there."""
    kept = folder / FILE_NAME
    try:
        return kept.read_bytes() if kept.is_file() or style_image is None else Painting.read(style_image).thumbnail()
    except (OSError, InputError):
        return None
