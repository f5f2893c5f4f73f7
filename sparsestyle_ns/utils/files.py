"""Files that are either the former ones or the new ones, whatever happens while they are written.

`write_whole` writes any file. For the one that a command was asked to make with --output-path there are
`prepare_output`, which finds out before the work whether it can be written, and `write_output`.
"""

import os
import tempfile
from pathlib import Path
from typing import BinaryIO, Callable, Optional, Union

from sparsestyle_ns.utils.errors import InputError


def write_whole(
    target: Path, content: Union[str, bytes, Callable[[BinaryIO], None]], temporary: Optional[Path] = None
) -> Path:
    """Writes a file that gets its name only when it is whole and on the disk; returns its path.

    A failure leaves the former file as it was, and a process that is killed meanwhile also the unfinished one under
    another name, which the next call overwrites. Folders on the way to it are made.

    Args:
        content: text, which is written in UTF-8, bytes, or a function that writes them into an open file.
        temporary: where the unfinished file stands, on the same disk; None: beside `target`, as NAME.unfinished.

    Raises:
        OSError: the file can't be written; the former one is still there.
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


def prepare_output(output_path: Path, what: str, example: str) -> None:
    """Makes the folder that a file is to be written to.

    Args:
        what: what the file is, for the sentence that says why it can't be written.
        example: a good name for such a file.

    Raises:
        InputError: the folder can't be made or written to, or the file's name is that of a folder.
    """
    if output_path.is_dir():
        raise InputError(f"--output-path {output_path} is a folder; name a file, such as {output_path / example}.")
    try:
        output_path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=output_path.parent):
            pass
    except OSError as error:
        raise _not_writable(output_path, what, error) from error


def write_output(output_path: Path, content: bytes, what: str, example: str) -> Path:
    """Writes a file as `write_whole` does, and returns its absolute path; arguments and errors of `prepare_output`."""
    prepare_output(output_path, what, example)
    try:
        return write_whole(output_path, content).resolve()
    except OSError as error:
        raise _not_writable(output_path, what, error) from error


def _not_writable(output_path: Path, what: str, error: OSError) -> InputError:
    return InputError(
        f"{what} can't be written to {output_path} ({error.strerror}); name another file with --output-path."
    )
