"""Files: written whole or not at all, with names that are fit for any disk and told apart."""

import hashlib
import os
import re
import shutil
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path, PurePath
from typing import BinaryIO, Callable, Iterable, Iterator, List, Optional, Union

from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.interrupts import take_away_at_end

LONGEST, LONGEST_SUFFIX = 120, 16
"""UTF-8 bytes of a file's name, and characters of its suffix, at most: some file systems take 143 bytes."""


def write_whole(
    target: Path, content: Union[str, bytes, Callable[[BinaryIO], None]], temporary: Optional[Path] = None
) -> Path:
    """Writes a file that gets its name only when it is whole and on the disk; makes its folder; returns its path.

    `content` is text, bytes, or a function that writes them into an open file. The unfinished file stands at
    `temporary`, on the same disk, or beside the target. After an `OSError` the former file is still there.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    unfinished = temporary or target.with_name(target.name + ".unfinished")
    try:
        with open(unfinished, "wb") as file:
            if callable(content):
                content(file)
            else:
                file.write(content.encode("utf-8") if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, target)
    finally:
        unfinished.unlink(missing_ok=True)
    folder = os.open(target.parent, os.O_RDONLY)  # the new name is on the disk once its folder is
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
    return target


@contextmanager
def all_or_nothing(paths: List[Path]) -> Iterator[None]:
    """What is made at these paths, at which nothing is yet, goes away where the context doesn't come to its end."""
    folders = {part for path in paths for part in (path, *path.parents) if not part.exists()}
    unfinished = list(paths)

    def take_away() -> None:
        for path in unfinished:
            for part in path.iterdir() if path.is_dir() else [path]:
                with suppress(FileNotFoundError, NotADirectoryError):  # never made: a file may be in its folder's place
                    shutil.rmtree(part) if part.is_dir() else part.unlink()
        for folder in sorted(folders, key=lambda folder: len(folder.parts), reverse=True) if unfinished else ():
            with suppress(OSError):  # never made, or somebody else has put something there
                folder.rmdir()

    take_away_at_end(take_away)
    try:
        yield
        unfinished.clear()
    finally:
        take_away()


def digest(*contents: bytes) -> str:
    """Sixteen hexadecimal digits by which the contents of files are known again."""
    total = hashlib.sha256()
    for content in contents:
        total.update(content)
    return total.hexdigest()[:16]


def free_path(path: Path) -> Path:
    """A path at which nothing is yet: this, else with a number behind the name."""
    found, number = path, 2
    while found.exists():
        found, number = numbered(path, number), number + 1
    return found


def numbered(path: Path, number: int) -> Path:
    """A path beside another, with a number behind its name: also beside `.`, which has none."""
    if path.name in ("", ".."):
        path = path.resolve()
    return path.with_name(f"{path.stem}-{number}{path.suffix}")


def keep_former(path: Path, content: str) -> Optional[Path]:
    """Gives a file another name, says so and returns it, if its content isn't the one that takes its place."""
    if not path.is_file() or path.read_text(encoding="utf-8", errors="replace") == content:
        return None
    from sparsestyle_ns.utils.progress import say  # loads torch, for which checks of options have no time

    former = path.rename(free_path(path))
    say(f"What {path} said before is kept as {former}.")
    return former


def prepare_output(output_path: Path, what: str, example: str, force: bool = False) -> None:
    """Makes the folder of a file that a command is to write; an `InputError` where that file can't be written.

    So it is where there is such a file already, unless `force` says that it may be lost. The sentence calls the file
    `what`; `example` is a good name for it.
    """
    if output_path.is_dir():
        raise InputError(f"--output-path {output_path} is a folder; name a file, such as {output_path / example}.")
    if output_path.exists() and not force:
        raise InputError(
            f"--output-path {output_path} is there already; name another file, such as {free_path(output_path)}, or "
            "write over it with --force."
        )
    try:
        output_path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=output_path.parent):
            pass
    except OSError as error:
        raise not_writable(output_path, what, error.strerror) from error


def check_outside(output: Path, inputs: Path) -> None:
    """An `InputError` where a folder that `--output` names is a person's own folder of photos, or in it."""
    output, inputs = output.resolve(), inputs.resolve()
    if inputs.is_dir() and (output == inputs or inputs in output.parents):
        raise InputError(
            f"--output {output} is in the folder of the photos, which are only read; take "
            f"{free_path(inputs.with_name(f'{inputs.name}-scene'))} or another place outside of it."
        )


def check_writable(path: Path, what: str, flag: str = "--output-path") -> None:
    """An `InputError`, as of `prepare_output`, where a file or a folder can't be made; nothing is left of the trial."""
    around = next(folder for folder in path.absolute().parents if folder.exists())
    try:
        with tempfile.TemporaryFile(dir=around):
            pass
    except OSError as error:
        raise not_writable(path, what, error.strerror, flag) from error


def write_output(output_path: Path, content: Union[str, bytes], what: str, example: str) -> Path:
    """Writes a file as `write_whole` does, and returns its absolute path; arguments and errors of `prepare_output`.

    Whether it may be written was settled by that function, before the work began.
    """
    prepare_output(output_path, what, example, force=True)
    try:
        return write_whole(output_path, content).resolve()
    except OSError as error:
        raise not_writable(output_path, what, error.strerror) from error


def not_writable(output_path: Path, what: str, reason: Optional[str], flag: str = "--output-path") -> InputError:
    """An error that says why a command can't write to the place that a flag named."""
    return InputError(f"{what} can't be written to {output_path} ({reason}); name another place with {flag}.")


def free_name(name: str, taken: Iterable[str]) -> str:
    """A name that isn't taken: this, else with a number behind it."""
    taken, number = set(taken), 2
    found = name
    while found in taken:
        found, number = f"{name} {number}", number + 1
    return found


def safe_file_name(name: str, otherwise: str) -> str:
    """A name without folders in letters, digits, spaces and a few signs; `otherwise` where nothing of it is left."""
    # Neither hidden, nor "..", nor an end that some file systems drop.
    allowed = re.sub(r"[^\w .,()+-]", "_", name).strip(" .") or otherwise
    suffix = PurePath(allowed).suffix[:LONGEST_SUFFIX]
    room = LONGEST - len(suffix.encode())
    return PurePath(allowed).stem.encode()[:room].decode(errors="ignore") + suffix
