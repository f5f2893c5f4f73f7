"""Files that a command writes: whether they can be written is known before the work, and they appear whole or not."""

import tempfile
from pathlib import Path

from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole


def prepare_output(output_path: Path, what: str, example: str) -> None:
    """Makes the folder that a file is to be written to.

    Args:
        output_path: the file.
        what: what it is, for the sentence that says why it can't be written.
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
    """Writes a file, which appears under its name only when it is whole; a failure leaves the one that was there.

    Args:
        output_path: the file; folders on the way to it are made.
        content: all of it.
        what, example: see `prepare_output`.

    Returns:
        The file's absolute path.

    Raises:
        InputError: it can't be written there.
    """
    prepare_output(output_path, what, example)
    unfinished = output_path.with_name(output_path.name + ".unfinished")
    try:
        return write_whole(output_path, content, unfinished).resolve()
    except OSError as error:
        raise _not_writable(output_path, what, error) from error
    finally:
        unfinished.unlink(missing_ok=True)


def _not_writable(output_path: Path, what: str, error: OSError) -> InputError:
    return InputError(
        f"{what} can't be written to {output_path} ({error.strerror}); name another file with --output-path."
    )
