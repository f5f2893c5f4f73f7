"""What `fetch_llff.py` and `fetch_blender.py` share: one scene out of a zip archive, all of it or nothing.

The archive is downloaded and unpacked in a temporary folder inside OUTPUT, so that only a finished scene, moved in one
step, ever stands where scenes are looked for. Whatever goes wrong becomes a `FetchError` of one sentence.
"""

import argparse
import contextlib
import http.client
import os
import shlex
import shutil
import stat
import sys
import tempfile
import urllib.error
import urllib.request
import zipfile
import zlib
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Callable, Iterator, Optional, Sequence

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

EXAMPLE_DATA_URL = "http://cseweb.ucsd.edu/~viscomp/projects/LF/papers/ECCV20/nerf/nerf_example_data.zip"
"""The NeRF authors' example data: nerf_llff_data/fern and nerf_synthetic/lego."""

CHUNK_BYTES = 1 << 20


class FetchError(Exception):
    """A scene could not be fetched. The message is one sentence: what went wrong, where, and what to do."""


def fetch_scene(
    url: str,
    output: Path,
    scene: str,
    marker: str,
    force: bool = False,
    timeout: float = 30.0,
    finish: Optional[Callable[[Path], None]] = None,
) -> Path:
    """Fetches one scene into `output / scene`.

    Args:
        url: Address of a zip archive, http, https or file; or the path of one on this machine.
        output: Folder that holds scenes; made if it is missing.
        scene: Name of the scene's folder, in the archive as in `output`.
        marker: Name of a file that tells a scene's folder in the archive from others of its name.
        force: Whether to replace a scene that is there already.
        timeout: Seconds without an answer after which to give up.
        finish: What to do with the unpacked folder before it is moved to its place.

    Returns:
        The scene's folder.

    Raises:
        FetchError: If there is no such archive or scene, or it cannot be written; `output / scene` is as before.
    """
    if scene in ("", ".", "..") or "/" in scene or "\\" in scene:
        raise FetchError(f"{scene!r} is not the name of a scene; give the name of one folder, such as fern.")
    target = output / scene
    if target.exists() and not force:
        raise FetchError(f"{target} exists already; add --force to replace it, or choose another OUTPUT.")
    try:
        output.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".fetch-", dir=output) as temporary:
            archive = Path(temporary) / "archive.zip"
            download(url, archive, timeout)
            unpacked = Path(temporary) / "scene"
            unpack_scene(archive, scene, marker, unpacked)
            if finish is not None:
                finish(unpacked)
            _put_in_place(unpacked, target, Path(temporary) / "replaced")
    except OSError as error:
        raise FetchError(f"Cannot write to {output}: {error.strerror or error}; choose another OUTPUT.") from error
    return target


def download(url: str, target: Path, timeout: float = 30.0) -> None:
    """Downloads `url` to the file `target`, which appears only once it is complete.

    Args:
        url: Address, http, https or file; or a path on this machine.
        target: File to write; its folder has to exist.
        timeout: Seconds without an answer after which to give up.

    Raises:
        FetchError: If the source cannot be read to its end.
        OSError: If `target` cannot be written.
    """
    address = url if "://" in url or url.startswith("file:") else Path(url).absolute().as_uri()
    if address.partition(":")[0].lower() not in ("http", "https", "file"):
        raise FetchError(f"{url} is no address that can be fetched; --url takes http://, https://, file:// or a path.")
    partial = target.with_name(target.name + ".part")
    with _open(address, timeout) as response:
        expected = _content_length(response)
        received = 0
        with open(partial, "wb") as file, show_progress("Downloading", expected) as advance:
            while chunk := _read(response, address, timeout):
                file.write(chunk)
                received += len(chunk)
                advance(len(chunk))
    if expected is not None and received != expected:
        raise FetchError(f"{url} broke off after {received:,} of {expected:,} bytes; try again.")
    os.replace(partial, target)


def unpack_scene(archive: Path, scene: str, marker: str, target: Path) -> None:
    """Unpacks one scene's folder from a zip archive.

    Args:
        archive: The zip file.
        scene: Name of the folder to unpack, wherever in the archive it is.
        marker: Name of a file that this folder holds directly.
        target: Folder to write the folder's contents to; made here.

    Raises:
        FetchError: If the file is no sound zip archive, holds no such scene, or names paths outside of itself.
        OSError: If `target` cannot be written.
    """
    try:
        with zipfile.ZipFile(archive) as opened:
            members = [member for member in opened.infolist() if not member.is_dir()]
            for member in members:
                _refuse_if_unsafe(member)
            root = _folder_of_scene(members, scene, marker)
            wanted = [member for member in members if PurePosixPath(member.filename).is_relative_to(root)]
            target.mkdir()
            with show_progress(f"Unpacking {scene}", sum(member.file_size for member in wanted)) as advance:
                for member in wanted:
                    path = target / PurePosixPath(member.filename).relative_to(root)
                    path.parent.mkdir(parents=True, exist_ok=True)
                    with opened.open(member) as source, open(path, "wb") as file:
                        shutil.copyfileobj(source, file, CHUNK_BYTES)
                    advance(member.file_size)
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise FetchError(f"What was downloaded is not a sound zip archive ({error}); check --url.") from error
    except RuntimeError as error:
        raise FetchError(f"The zip archive cannot be unpacked here: {error}; choose another --url.") from error


def add_common_arguments(parser: argparse.ArgumentParser, default_scene: str) -> None:
    """Adds the options that every fetching script has; `default_scene` is the one that the example data holds."""
    parser.add_argument("output", type=Path, help="folder that will hold the scene's folder")
    parser.add_argument("--scene", default=default_scene, help="name of the scene's folder in the archive")
    parser.add_argument("--url", default=EXAMPLE_DATA_URL, help="zip archive: http://, https://, file:// or a path")
    parser.add_argument("--timeout", type=float, default=30.0, help="seconds without an answer before giving up")
    parser.add_argument("--force", action="store_true", help="replace a scene that is there already")


def run(
    parser: argparse.ArgumentParser,
    marker: str,
    dataparser: str,
    arguments: Optional[Sequence[str]],
    finish_of: Callable[[argparse.Namespace], Optional[Callable[[Path], None]]] = lambda options: None,
) -> int:
    """A fetching script's whole command line.

    Args:
        parser: With `add_common_arguments` and the script's own.
        marker: See `fetch_scene`.
        dataparser: The one that reads the scene.
        arguments: None for the process's own.
        finish_of: From the options to what is done with an unpacked scene.

    Returns:
        Exit status: 0, or 1 after saying on stderr, in one sentence, why there is no scene.
    """
    options = parser.parse_args(arguments)
    if not options.timeout > 0:
        parser.error(f"--timeout is {options.timeout}, but has to be above 0")
    try:
        finish = finish_of(options)
        folder = fetch_scene(options.url, options.output, options.scene, marker, options.force, options.timeout, finish)
    except FetchError as error:
        print(f"Error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("Error: Interrupted; nothing was changed.", file=sys.stderr)
        return 1
    command = ["ns-train", "coarse-fewshot", "--data", str(folder), dataparser]
    print(f"Made {folder} – next: {shlex.join(command)}")
    return 0


@contextlib.contextmanager
def show_progress(what: str, total: Optional[float]) -> Iterator[Callable[[float], None]]:
    """A bar on stderr while the context lasts, if that is a terminal.

    Args:
        what: What is going on, in a word or two.
        total: Bytes to come; None if unknown.

    Yields:
        A function to call with each further number of bytes.
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(what, total=total)
        yield lambda more: progress.advance(task, more)


def _open(address: str, timeout: float) -> http.client.HTTPResponse:
    try:
        request = urllib.request.Request(address, headers={"User-Agent": "sparsestyle-data-script"})
        return urllib.request.urlopen(request, timeout=timeout)
    except urllib.error.HTTPError as error:
        raise FetchError(f"The server answered {error.code} ({error.reason}) for {address}; check --url.") from error
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise FetchError(_unreachable(address, error, timeout)) from error


def _read(response: http.client.HTTPResponse, address: str, timeout: float) -> bytes:
    try:
        return response.read(CHUNK_BYTES)
    except (OSError, http.client.HTTPException) as error:
        raise FetchError(_unreachable(address, error, timeout)) from error


def _unreachable(address: str, error: Exception, timeout: float) -> str:
    reason = getattr(error, "reason", None) or error
    if isinstance(reason, TimeoutError):
        return f"{address} gave no answer for {timeout:g} seconds; check the network or raise --timeout."
    return f"Cannot read {address} ({reason}); check the network and --url."


def _content_length(response: http.client.HTTPResponse) -> Optional[int]:
    length = response.headers.get("Content-Length", "")
    return int(length) if length.isdigit() else None


def _refuse_if_unsafe(member: zipfile.ZipInfo) -> None:
    """Raises `FetchError` if the member would be written outside of the folder that it is unpacked to."""
    path = PureWindowsPath(member.filename)  # takes slashes and backslashes for separators alike
    is_link = stat.S_ISLNK(member.external_attr >> 16)
    if is_link or path.drive or path.root or ".." in path.parts:
        raise FetchError(f"The zip archive holds the unsafe path {member.filename!r}; nothing was unpacked from it.")


def _folder_of_scene(members: Sequence[zipfile.ZipInfo], scene: str, marker: str) -> PurePosixPath:
    paths = [PurePosixPath(member.filename) for member in members]
    folders = [path.parent for path in paths if path.name == marker and "__MACOSX" not in path.parts]
    matching = [folder for folder in folders if folder.name == scene]
    if not matching:
        names = ", ".join(sorted({folder.name for folder in folders if folder.name})) or "none"
        raise FetchError(
            f"The archive holds no folder {scene}/ with a {marker} in it; the scenes that it does hold: {names}."
        )
    return min(matching, key=lambda folder: len(folder.parts))


def _put_in_place(folder: Path, target: Path, replaced: Path) -> None:
    """Moves `folder` to `target`, whose former contents, if any, end up in `replaced`."""
    if target.exists():
        os.replace(target, replaced)
    try:
        os.replace(folder, target)
    except OSError:
        if replaced.exists():
            os.replace(replaced, target)
        raise
