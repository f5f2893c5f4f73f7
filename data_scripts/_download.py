"""What `fetch_llff.py` and `fetch_blender.py` share: one scene out of a zip archive, all of it or nothing."""

import contextlib
import http.client
import shutil
import stat
import urllib.error
import urllib.request
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Callable, Iterator, Optional, Sequence

import tyro
from _command_line import ScriptError, exit_status, print_made
from _new_folder import new_folder
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

EXAMPLE_DATA_URL = "http://cseweb.ucsd.edu/~viscomp/projects/LF/papers/ECCV20/nerf/nerf_example_data.zip"
"""The NeRF authors' example data: nerf_llff_data/fern and nerf_synthetic/lego."""

CHUNK_BYTES = 1 << 20


@dataclass(frozen=True)
class FetchOptions:
    """The options that every fetching script has."""

    output: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUTPUT")]
    """Folder that will hold the scene's folder."""
    scene: str = "fern"
    """Name of the scene's folder, in the archive as in OUTPUT."""
    url: Annotated[str, tyro.conf.arg(help_behavior_hint="(default: the NeRF authors' example data)")] = (
        EXAMPLE_DATA_URL
    )
    """Zip archive: http://, https://, file:// or a path."""
    timeout: float = 30.0
    """Seconds without an answer before giving up."""
    force: bool = False
    """Replace a scene that is there already."""

    def __post_init__(self) -> None:
        if not self.timeout > 0:
            raise ValueError(f"--timeout is {self.timeout}, but has to be above 0")


def run(options: FetchOptions, marker: str, dataparser: str, finish: Optional[Callable[[Path], None]] = None) -> int:
    """A fetching script's work.

    Args:
        options: What the command line says.
        marker: Name of a file that tells the scene's folder in the archive from others of its name.
        dataparser: The one that reads the scene.
        finish: What to do with the unpacked folder before it is moved to its place.

    Returns:
        Exit status: 0, or 1 after saying on stderr, in one sentence, why there is no scene.
    """

    def work() -> None:
        folder = fetch_scene(options, marker, finish)
        print_made(folder, ["ns-train", "coarse-fewshot", "--data", folder, dataparser])

    return exit_status(work)


def fetch_scene(options: FetchOptions, marker: str, finish: Optional[Callable[[Path], None]] = None) -> Path:
    """Fetches one scene; returns its folder. For the arguments see `run`.

    Raises:
        ScriptError: There is no such archive or scene, or it cannot be written; OUTPUT is as before.
    """
    if options.scene in ("", ".", "..") or "/" in options.scene or "\\" in options.scene:
        raise ScriptError(f"{options.scene!r} is not the name of a scene; give the name of one folder, such as fern.")
    target = options.output / options.scene
    with new_folder(target, options.force) as folder:
        archive = folder.with_name("archive.zip")
        download(options.url, archive, options.timeout)
        unpack_scene(archive, options.scene, marker, folder)
        if finish is not None:
            finish(folder)
    return target


def download(url: str, target: Path, timeout: float) -> None:
    """Downloads `url` to the file `target`.

    Args:
        url: Address, http, https or file; or a path on this machine.
        target: File to write; its folder has to exist.
        timeout: Seconds without an answer after which to give up.

    Raises:
        ScriptError: The source cannot be read to its end.
        OSError: `target` cannot be written.
    """
    address = url if "://" in url or url.startswith("file:") else Path(url).absolute().as_uri()
    if address.partition(":")[0].lower() not in ("http", "https", "file"):
        raise ScriptError(f"{url} is no address that can be fetched; --url takes http://, https://, file:// or a path.")
    with _reading(address, timeout):
        request = urllib.request.Request(address, headers={"User-Agent": "sparsestyle-data-script"})
        response = urllib.request.urlopen(request, timeout=timeout)
    length = response.headers.get("Content-Length", "")
    expected, received = int(length) if length.isdigit() else None, 0
    read = _reading(address, timeout)(response.read)
    with response, open(target, "wb") as file, show_progress("Downloading", expected) as advance:
        while chunk := read(CHUNK_BYTES):
            file.write(chunk)
            received += len(chunk)
            advance(len(chunk))
    if expected is not None and received != expected:
        raise ScriptError(f"{url} broke off after {received:,} of {expected:,} bytes; try again.")


@contextlib.contextmanager
def _reading(address: str, timeout: float) -> Iterator[None]:
    """Turns what goes wrong while an address is read into a `ScriptError`."""
    try:
        yield
    except urllib.error.HTTPError as error:
        raise ScriptError(f"The server answered {error.code} ({error.reason}) for {address}; check --url.") from error
    except (OSError, http.client.HTTPException, ValueError) as error:
        reason = getattr(error, "reason", None) or error
        if isinstance(reason, TimeoutError):
            message = f"{address} gave no answer for {timeout:g} seconds; check the network or raise --timeout."
        else:
            message = f"Cannot read {address} ({reason}); check the network and --url."
        raise ScriptError(message) from error


def unpack_scene(archive: Path, scene: str, marker: str, target: Path) -> None:
    """Unpacks one scene's folder from a zip archive.

    Args:
        archive: The zip file.
        scene: Name of the folder to unpack, wherever in the archive it is.
        marker: Name of a file that this folder holds directly.
        target: Empty folder to write its contents to.

    Raises:
        ScriptError: The file is no sound zip archive, holds no such scene, or names paths outside of itself.
        OSError: `target` cannot be written.
    """
    try:
        with zipfile.ZipFile(archive) as opened:
            members = [member for member in opened.infolist() if not member.is_dir()]
            for member in members:
                _refuse_if_unsafe(member)
            root = _folder_of_scene(members, scene, marker)
            wanted = [member for member in members if PurePosixPath(member.filename).is_relative_to(root)]
            with show_progress(f"Unpacking {scene}", sum(member.file_size for member in wanted)) as advance:
                for member in wanted:
                    path = target / PurePosixPath(member.filename).relative_to(root)
                    path.parent.mkdir(parents=True, exist_ok=True)
                    with opened.open(member) as source, open(path, "wb") as file:
                        shutil.copyfileobj(source, file, CHUNK_BYTES)
                    advance(member.file_size)
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise ScriptError(f"What was downloaded is not a sound zip archive ({error}); check --url.") from error
    except RuntimeError as error:
        raise ScriptError(f"The zip archive cannot be unpacked here: {error}; choose another --url.") from error


@contextlib.contextmanager
def show_progress(what: str, total: Optional[float]) -> Iterator[Callable[[float], None]]:
    """A bar on stderr while the context lasts, where stderr is a terminal.

    Args:
        what: What is done, in a word or two.
        total: Bytes to come; None if unknown.

    Yields:
        A function to call with each further number of bytes.
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(what, total=total)
        yield lambda more: progress.advance(task, more)


def _refuse_if_unsafe(member: zipfile.ZipInfo) -> None:
    """Raises `ScriptError` if the member would be written outside of the folder that it is unpacked to."""
    path = PureWindowsPath(member.filename)  # takes slashes and backslashes for separators alike
    is_link = stat.S_ISLNK(member.external_attr >> 16)
    if is_link or path.drive or path.root or ".." in path.parts:
        raise ScriptError(f"The zip archive holds the unsafe path {member.filename!r}; nothing was unpacked from it.")


def _folder_of_scene(members: Sequence[zipfile.ZipInfo], scene: str, marker: str) -> PurePosixPath:
    paths = [PurePosixPath(member.filename) for member in members]
    folders = [path.parent for path in paths if path.name == marker and "__MACOSX" not in path.parts]
    matching = [folder for folder in folders if folder.name == scene]
    if not matching:
        names = ", ".join(sorted({folder.name for folder in folders if folder.name})) or "none"
        raise ScriptError(
            f"The archive holds no folder {scene}/ with a {marker} in it; the scenes that it does hold: {names}."
        )
    return min(matching, key=lambda folder: len(folder.parts))
