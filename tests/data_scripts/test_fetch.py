"""Fetching scenes: a whole one, or one clear sentence and everything as before. A server on this machine stands in."""

import io
import json
import os
import shutil
import socket
import stat
import subprocess
import sys
import threading
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import _download
import fetch_blender
import fetch_llff
import imageio.v2 as imageio
import numpy as np
import pytest

FERN = {"poses_bounds.npy": b"poses", "images/image000.png": b"first", "images/image001.png": b"second"}


def make_zip(files):
    """{'path': bytes} -> bytes of a zip archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def make_png(pixels):
    buffer = io.BytesIO()
    imageio.imwrite(buffer, pixels, format="png")
    return buffer.getvalue()


def contents(folder):
    """{'relative path': bytes} of all files below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


LLFF_ZIP = make_zip(
    {f"nerf_llff_data/fern/{name}": content for name, content in FERN.items()}
    | {"nerf_synthetic/lego/transforms_train.json": b"{}", "__MACOSX/nerf_llff_data/fern/poses_bounds.npy": b"junk"}
)


class _Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        body = self.server.files.get(self.path)
        if self.path == "/silent.zip":
            self.server.released.wait(10)
        if body is None:
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body[: len(body) // 2] if self.path == "/truncated.zip" else body)

    def log_message(self, *arguments):
        pass


@pytest.fixture(autouse=True)
def _no_proxy(monkeypatch):
    monkeypatch.setenv("no_proxy", "*")


@pytest.fixture(scope="module")
def server():
    """Serves /good.zip and misbehaves elsewhere; yields the address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
    server.released = threading.Event()
    server.files = {"/good.zip": LLFF_ZIP, "/truncated.zip": LLFF_ZIP, "/page.html": b"<html>Not here.</html>"}
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.released.set()
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def fails(tmp_path, capsys):
    """Runs a fetch that has to fail, checks that it does so cleanly, and returns what it says."""

    def run(*arguments, main=fetch_llff.main, output=tmp_path / "data", status=1):
        before = contents(tmp_path)
        assert main([str(output), *arguments]) == status
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.startswith("Error: ")
        assert captured.err.count("\n") == 1
        assert "Traceback" not in captured.err
        assert contents(tmp_path) == before
        assert not output.is_dir() or not list(output.glob(".unfinished-*"))
        return captured.err

    return run


def write(path, content):
    path.write_bytes(content)
    return path.as_uri()


def test_a_scene_is_fetched_from_a_server_without_its_neighbours(server, tmp_path):
    assert fetch_llff.main([str(tmp_path / "data"), "--url", f"{server}/good.zip"]) == 0
    assert contents(tmp_path) == {f"data/fern/{name}": content for name, content in FERN.items()}
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["fern"]


def test_a_scene_is_fetched_from_a_file_address_or_a_path(tmp_path):
    address = write(tmp_path / "a zip.zip", LLFF_ZIP)
    for name, url in (("one", address), ("two", str(tmp_path / "a zip.zip"))):
        assert fetch_llff.main([str(tmp_path / name), "--url", url]) == 0
        assert contents(tmp_path / name / "fern") == FERN


def test_a_scene_is_found_at_any_depth_of_the_archive(tmp_path):
    for depth, prefix in enumerate(("", "a/", "a/b/c/")):
        url = write(tmp_path / f"{depth}.zip", make_zip({f"{prefix}fern/{name}": data for name, data in FERN.items()}))
        assert fetch_llff.main([str(tmp_path / str(depth)), "--url", url]) == 0
        assert contents(tmp_path / str(depth) / "fern") == FERN


def test_the_script_runs_on_its_own_and_exits_with_status_1_on_failure(tmp_path):
    script = Path(fetch_llff.__file__)
    command = [sys.executable, str(script), str(tmp_path / "data"), "--url", str(tmp_path / "missing.zip")]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert result.returncode == 1
    assert result.stderr.startswith("Error: Cannot read file://")
    assert result.stderr.count("\n") == 1


def test_an_existing_scene_is_kept_without_force_and_replaced_with_it(tmp_path, fails):
    url = write(tmp_path / "good.zip", LLFF_ZIP)
    (tmp_path / "data" / "fern").mkdir(parents=True)
    (tmp_path / "data" / "fern" / "mine.txt").write_text("mine")
    assert "--force" in fails("--url", url)
    assert fetch_llff.main([str(tmp_path / "data"), "--url", url, "--force"]) == 0
    assert contents(tmp_path / "data" / "fern") == FERN


def test_an_existing_scene_survives_a_failed_replacement(server, tmp_path, fails):
    (tmp_path / "data" / "fern").mkdir(parents=True)
    (tmp_path / "data" / "fern" / "mine.txt").write_text("mine")
    fails("--url", f"{server}/truncated.zip", "--force")
    assert contents(tmp_path / "data") == {"fern/mine.txt": b"mine"}


def test_the_old_scene_comes_back_if_the_new_one_cannot_be_moved_in(tmp_path, fails, monkeypatch):
    (tmp_path / "data" / "fern").mkdir(parents=True)
    (tmp_path / "data" / "fern" / "mine.txt").write_text("mine")
    replace = os.replace

    def refuse_new_scene(source, target):
        if Path(source).name == "new":
            raise PermissionError(13, "Permission denied")
        replace(source, target)

    monkeypatch.setattr(os, "replace", refuse_new_scene)
    assert "Permission denied" in fails("--url", write(tmp_path / "good.zip", LLFF_ZIP), "--force")


def test_a_missing_page_is_reported_with_its_status(server, fails):
    assert "404" in fails("--url", f"{server}/missing.zip")


def test_a_download_that_breaks_off_is_reported_with_its_size(server, fails):
    message = fails("--url", f"{server}/truncated.zip")
    assert f"{len(LLFF_ZIP) // 2:,} of {len(LLFF_ZIP):,} bytes" in message


def test_a_web_page_in_place_of_an_archive_is_reported(server, fails):
    assert "not a sound zip archive" in fails("--url", f"{server}/page.html")


def test_a_server_that_does_not_answer_is_given_up_on(server, fails):
    assert "no answer for 0.2 seconds" in fails("--url", f"{server}/silent.zip", "--timeout", "0.2")


def test_a_port_that_nobody_listens_on_is_reported(fails):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        assert "Cannot read" in fails("--url", f"http://127.0.0.1:{unused.getsockname()[1]}/a.zip")


def test_a_host_that_cannot_be_found_is_reported(fails, monkeypatch):
    def no_network(*arguments, **options):
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", no_network)
    message = fails()
    assert "Name or service not known" in message
    assert _download.EXAMPLE_DATA_URL in message


@pytest.mark.parametrize("url", ["ftp://127.0.0.1/a.zip", "magnet://a", "http://", "http://[broken/a.zip"])
def test_an_address_that_means_nothing_here_is_reported(url, fails):
    assert "--url" in fails("--url", url)


def test_a_file_damaged_inside_the_archive_is_reported(tmp_path, fails):
    files = {"fern/poses_bounds.npy": bytes(1000), "fern/images/a.png": bytes(range(256)) * 40}
    damaged = bytearray(make_zip(files))
    start = damaged.index(b"fern/images/a.png") + len("fern/images/a.png")
    damaged[start + 20 : start + 60] = bytes(40)
    assert "not a sound zip archive" in fails("--url", write(tmp_path / "damaged.zip", bytes(damaged)))


def test_an_archive_without_the_scene_is_reported_with_the_scenes_it_has(server, fails):
    message = fails("--url", f"{server}/good.zip", "--scene", "flower")
    assert "flower" in message
    assert "does hold: fern" in message


def test_a_folder_of_the_right_name_without_the_scenes_files_is_not_the_scene(server, fails):
    message = fails("--url", f"{server}/good.zip", "--scene", "lego")
    assert "poses_bounds.npy" in message


@pytest.mark.parametrize("name", ["fern/../../evil", "/evil", "..\\evil", "C:\\evil", "other/../../evil"])
def test_an_archive_with_paths_that_lead_outside_is_refused(name, tmp_path, fails):
    url = write(tmp_path / "evil.zip", make_zip({"fern/poses_bounds.npy": b"poses", name: b"evil"}))
    assert "unsafe path" in fails("--url", url)


def test_an_archive_with_symbolic_links_is_refused(tmp_path, fails):
    link = zipfile.ZipInfo("fern/images")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    url = write(tmp_path / "link.zip", make_zip({"fern/poses_bounds.npy": b"poses", link: b"/etc"}))
    assert "unsafe path" in fails("--url", url)


@pytest.mark.parametrize("scene", ["../fern", "..", "a/b", ""])
def test_a_scene_name_that_leads_elsewhere_is_refused(scene, tmp_path, fails):
    assert "not the name of a scene" in fails("--url", write(tmp_path / "good.zip", LLFF_ZIP), "--scene", scene)


def test_an_output_that_cannot_be_written_is_reported(tmp_path, fails):
    (tmp_path / "file").write_text("")
    url = write(tmp_path / "good.zip", LLFF_ZIP)
    assert "Cannot write" in fails("--url", url, output=tmp_path / "file" / "data")


def test_a_disk_that_fills_up_is_reported(tmp_path, fails, monkeypatch):
    def disk_full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shutil, "copyfileobj", disk_full)
    assert "No space left on device" in fails("--url", write(tmp_path / "good.zip", LLFF_ZIP))


def test_an_interruption_leaves_nothing_behind(tmp_path, fails, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(_download, "unpack_scene", interrupt)
    assert "Interrupted" in fails("--url", write(tmp_path / "good.zip", LLFF_ZIP), status=130)


def test_a_timeout_of_nothing_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        fetch_llff.main([str(tmp_path), "--timeout", "0"])
    assert "--timeout" in capsys.readouterr().err


@pytest.fixture
def lego(tmp_path):
    """Address of an archive with a synthetic scene of two 4 x 4 pictures, and the pictures."""
    pictures = np.random.default_rng(0).integers(0, 256, (2, 4, 4, 4), dtype=np.uint8)
    transforms = json.dumps({"camera_angle_x": 0.69, "frames": []}).encode()
    files = {"nerf_synthetic/lego/transforms_train.json": transforms}
    for i, picture in enumerate(pictures):
        files[f"nerf_synthetic/lego/train/r_{i}.png"] = make_png(picture)
    return write(tmp_path / "lego.zip", make_zip(files)), pictures


def test_a_blender_scene_is_fetched_as_it_is(lego, tmp_path):
    url, pictures = lego
    assert fetch_blender.main([str(tmp_path / "data"), "--url", url]) == 0
    for i, picture in enumerate(pictures):
        np.testing.assert_array_equal(imageio.imread(tmp_path / "data" / "lego" / "train" / f"r_{i}.png"), picture)


def test_half_resolution_halves_the_pictures_and_nothing_else(lego, tmp_path):
    url, pictures = lego
    assert fetch_blender.main([str(tmp_path / "data"), "--url", url, "--half-resolution"]) == 0
    folder = tmp_path / "data" / "lego"
    assert json.loads((folder / "transforms_train.json").read_text())["camera_angle_x"] == 0.69
    for i, picture in enumerate(pictures):
        halved = imageio.imread(folder / "train" / f"r_{i}.png")
        np.testing.assert_array_equal(halved, fetch_blender.halve_image(picture))
        assert halved.shape == (2, 2, 4)


def test_half_resolution_of_a_broken_picture_is_reported(tmp_path, fails):
    files = {"lego/transforms_train.json": b"{}", "lego/train/r_0.png": b"no picture"}
    url = write(tmp_path / "broken.zip", make_zip(files))
    assert "r_0.png" in fails("--url", url, "--half-resolution", main=fetch_blender.main)


def test_halving_averages_squares_of_four_pixels():
    picture = np.array([[10, 20, 200, 200], [30, 40, 100, 100]], np.uint8)[..., None].repeat(3, axis=-1)
    np.testing.assert_array_equal(fetch_blender.halve_image(picture)[0, :, 0], [25, 150])


def test_halving_and_laying_over_a_background_can_be_swapped():
    picture = np.random.default_rng(1).integers(0, 256, (8, 8, 4), dtype=np.uint8)
    picture[:4, :, 3] = 0

    def over_white(image):
        colours, alpha = np.split(image / 255, [3], axis=-1)
        return colours * alpha + 1 - alpha

    expected = over_white(picture).reshape(4, 2, 4, 2, 3).mean(axis=(1, 3))
    # Colours and alpha are each rounded to a byte.
    np.testing.assert_allclose(over_white(fetch_blender.halve_image(picture)), expected, atol=1.5 / 255)


@pytest.mark.parametrize("shape", [(3, 4, 3), (4, 3, 4), (4, 4), (4, 4, 2)])
def test_a_picture_that_has_no_half_is_refused(shape):
    with pytest.raises(ValueError, match="shape"):
        fetch_blender.halve_image(np.zeros(shape, np.uint8))
