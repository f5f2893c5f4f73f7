"""What the page shows of a run is rendered, filmed and measured from its files, wherever they are now."""

import io
import json
import shutil

import imageio.v3 as iio
import numpy as np
import pytest
import torch
import yaml
from nerfstudio.cameras.cameras import Cameras
from PIL import Image

from sparsestyle_ns.core.camera_paths import measuring_path, meeting_point, showing_path
from sparsestyle_ns.evaluation.held_out import saved_report
from sparsestyle_ns.gallery.film import FRAMES_PER_SECOND, encode_mp4, make_film, read_film
from sparsestyle_ns.gallery.layout import gallery_page
from sparsestyle_ns.gallery.make_gallery import collect_run, depth_picture
from sparsestyle_ns.runs.checkpoints import newest_checkpoint
from sparsestyle_ns.utils.errors import InputError

MP4 = b"\x00\x00\x00\x18ftypmp42 the rest of a film"


def test_films_are_mp4_only(tmp_path):
    film, text = tmp_path / "film.mp4", tmp_path / "film.txt"
    film.write_bytes(MP4)
    text.write_text("no film")
    assert read_film(film).content == MP4
    with pytest.raises(InputError, match="is no MP4 video"):
        read_film(text)
    with pytest.raises(InputError, match="can't be read"):
        read_film(tmp_path / "gone.mp4")


def test_depth_picture_is_lighter_where_things_are_nearer():
    depth = np.geomspace(1.0, 100.0, 64).reshape(8, 8, 1)
    brightness = depth_picture(depth, np.ones_like(depth)).mean(-1).ravel()
    assert np.all(np.diff(brightness) <= 0)
    assert brightness[0] - brightness[-1] > 100


def test_depth_picture_of_nothing_is_grey():
    empty = depth_picture(np.full((4, 4, 1), 1e9), np.zeros((4, 4, 1)))
    np.testing.assert_array_equal(empty, np.full((4, 4, 3), 128))


def test_collect_run_shows_photos_and_held_out_views_wherever_the_run_is_now(runs, tmp_path, monkeypatch):
    moved = tmp_path / "elsewhere" / "hier-style" / "renamed"
    shutil.copytree(runs.style, moved)
    monkeypatch.chdir(tmp_path)
    run = collect_run(moved, num_views=2, frames=3)
    assert [photo.caption for photo in run.photos] == json.loads((runs.style / "scene.json").read_text())["view_names"]
    assert len(run.photos) == 3
    assert [view.name for view in run.views] == ["Held-out view image000.png", "Held-out view image008.png"]
    assert run.style.caption == "painting.png"
    for view in run.views:
        for pixels in (view.photo, view.coarse, view.stylised, view.depth):
            assert pixels.shape == (24, 32, 3)
            assert pixels.dtype == np.uint8
    assert dict(run.settings)["Iterations"] == "3 of 3"
    assert dict(run.settings)["Size it sees views at"] == "12 pixels in 2 iterations, then 48 pixels in 1 iterations"
    assert dict(run.settings)["Content weight λ"] == "2 to 0.02 in 1 iterations, then 0.6 to 0.02 in 1 iterations"
    assert run.subtitle == "hier-style, 3 photos, 3 iterations"
    assert run.style_name == "painting"
    assert [table.title for table in run.tables] == ["Mean of the views above, 2"]
    assert run.tables[0].columns[0] == "coarse PSNR dB ↑"
    assert frames_of(run.film.content).shape == (3, 24, 32, 3)
    assert "flight" in run.film.caption
    assert "<video" in gallery_page([run], "A run")


def test_a_run_on_reduced_photos_is_shown_with_the_photos_as_they_are(runs, tmp_path):
    moved = tmp_path / "outputs" / "scene" / "hier-style" / "run"
    shutil.copytree(runs.style, moved)
    config = (moved / "config.yml").read_text()
    assert "max_image_side: 504" in config
    (moved / "config.yml").write_text(config.replace("max_image_side: 504", "max_image_side: 16"))
    run = collect_run(moved, num_views=1, frames=0)
    assert dict(run.settings)["Photo size in training"] == "16 × 12 pixels"
    pictures = [photo.pixels for photo in run.photos]
    pictures += [getattr(run.views[0], name) for name in ("photo", "coarse", "stylised")]
    assert {pixels.shape for pixels in pictures} == {(24, 32, 3)}


def test_a_painting_is_shown_as_it_was_read(runs, tmp_path):
    """Transparent pixels over white, as in training."""
    moved = tmp_path / "outputs" / "scene" / "hier-style" / "run"
    shutil.copytree(runs.style, moved)
    painting = Image.new("RGBA", (16, 8), (255, 0, 0, 0))
    painting.putpixel((0, 0), (255, 255, 255, 255))
    painting.save(tmp_path / "clear.png")
    config = yaml.load((moved / "config.yml").read_text(), Loader=yaml.Loader)
    config.pipeline.style_image = tmp_path / "clear.png"
    (moved / "config.yml").write_text(yaml.dump(config))
    np.testing.assert_array_equal(collect_run(moved, num_views=1, frames=0).style.pixels, np.full((8, 16, 3), 255))


def test_collect_run_shows_a_run_whose_painting_is_gone(runs, tmp_path):
    moved = tmp_path / "outputs" / "scene" / "hier-style" / "run"
    shutil.copytree(runs.style, moved)
    config = moved / "config.yml"
    config.write_text(config.read_text().replace("- painting.png", "- gone.png"))
    run = collect_run(config, num_views=1, frames=0)
    assert run.style is None
    assert run.film is None
    assert run.style_name == "gone"
    assert "gone.png, is no longer there" in run.style_note


def test_collect_run_says_that_a_run_has_no_checkpoint(runs, tmp_path):
    moved = tmp_path / "outputs" / "scene" / "hier-style" / "run"
    shutil.copytree(runs.style, moved, ignore=shutil.ignore_patterns("*.ckpt"))
    with pytest.raises(InputError, match="has no checkpoint yet"):
        collect_run(moved)


def test_figures_come_from_the_report_of_the_newest_checkpoint_alone(runs, tmp_path):
    moved = tmp_path / "outputs" / "scene" / "hier-style" / "run"
    shutil.copytree(runs.style, moved)
    report = {"step": 2, "results": {"coarse_psnr": 12.34, "content_ssim": 0.5}, "views": [{}, {}]}
    (moved / "evaluation.json").write_text(json.dumps(report))
    tables = collect_run(moved, num_views=1, frames=0).tables
    assert tables[0].title == "Coarse field, 2 held-out views"
    assert tables[0].rows == [("coarse", ["12.34"])]
    (moved / "evaluation.json").write_text(json.dumps({**report, "step": 1}))
    assert collect_run(moved, num_views=1, frames=0).tables[0].title == "Mean of the views above, 1"
    (moved / "evaluation.json").write_text("[1, 2]")
    assert saved_report(moved, 2) is None


def test_a_run_without_a_report_is_measured_when_that_is_asked_for_and_keeps_it(runs, tmp_path):
    moved = tmp_path / "outputs" / "scene" / "hier-style" / "run"
    shutil.copytree(runs.style, moved)
    shown = collect_run(moved, num_views=1, frames=0, evaluate=True)
    assert [table.title.split(",")[0] for table in shown.tables][:3] == ["Coarse field", "Style", "Content"]
    kept = saved_report(moved, 2)
    assert len(kept.views) == 2
    assert json.loads((moved / "evaluation.json").read_text())["results"] == kept.means
    assert newest_checkpoint(moved / "nerfstudio_models").name == "step-000000002.ckpt"


def test_a_run_whose_folder_takes_no_report_is_measured_and_shown_all_the_same(runs, tmp_path, capsys):
    moved = tmp_path / "outputs" / "scene" / "hier-style" / "run"
    shutil.copytree(runs.style, moved)
    (moved / "evaluation.json").mkdir()
    shown = collect_run(moved, num_views=1, frames=0, evaluate=True)
    assert [table.title.split(",")[0] for table in shown.tables][:3] == ["Coarse field", "Style", "Content"]
    assert f"evaluation.json can't be saved in {moved} (Is a directory); its figures are" in capsys.readouterr().out


def frames_of(content):
    """The frames of a film."""
    return np.stack(list(iio.imiter(io.BytesIO(content), plugin="FFMPEG", extension=".mp4")))


def test_a_film_has_its_frames_and_its_speed():
    ramp = np.linspace(0, 255, 64).astype(np.uint8)
    pictures = [np.broadcast_to(np.roll(ramp, 4 * index)[None, :, None], (48, 64, 3)) for index in range(5)]
    film = encode_mp4(pictures)
    assert film[4:8] == b"ftyp"
    frames = frames_of(film)
    assert frames.shape == (5, 48, 64, 3)
    assert np.abs(frames.astype(int) - np.stack(pictures)).mean() < 6
    assert iio.immeta(film, plugin="FFMPEG", extension=".mp4")["fps"] == FRAMES_PER_SECOND


def look_at(*places):
    """Cameras at places that look at the origin, z up."""
    poses = []
    for place in map(torch.tensor, places):
        back = torch.nn.functional.normalize(place, dim=0)
        right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), back), dim=0)
        poses.append(torch.stack([right, torch.linalg.cross(back, right), back, place], dim=-1))
    return Cameras(torch.stack(poses), fx=50.0, fy=50.0, cx=32.0, cy=24.0, width=64, height=48)


def test_photos_from_all_around_give_one_even_turn_about_what_they_look_at():
    cameras = look_at((3.0, 0.0, 1.0), (0.0, 3.0, 1.0), (-3.0, 0.0, 1.0), (0.0, -3.0, 1.0))
    path = showing_path(cameras, 12)
    places = path.camera_to_worlds[:, :, 3]
    angles = torch.rad2deg(torch.atan2(places[:, 1], places[:, 0]))
    torch.testing.assert_close(torch.diff(angles) % 360, torch.full((11,), 30.0), atol=1e-3, rtol=0)
    torch.testing.assert_close(places.norm(dim=-1), torch.full((12,), 10.0**0.5))
    assert meeting_point(path.camera_to_worlds).norm() < 1e-4


def test_photos_that_look_one_way_give_a_flight_through_them_there_and_back():
    cameras = look_at((3.0, -1.0, 0.0), (3.0, 0.0, 0.5), (3.0, 1.0, 0.0))
    path = showing_path(cameras, 16)
    places = path.camera_to_worlds[:, :, 3]
    given = cameras.camera_to_worlds[:, :, 3]
    torch.testing.assert_close(places[0], given[0])
    torch.testing.assert_close(places[8], given[2])
    torch.testing.assert_close(places[1:8], places[9:].flip(0))
    assert (places[4] - given[1]).norm() < 0.05
    steps = places.diff(dim=0).norm(dim=-1)
    assert steps[0] < 0.5 * steps[3]  # slow where it turns
    assert len(measuring_path(cameras)) == 17  # which the showing path has nothing to do with


def test_one_photo_gives_no_film():
    assert make_film(None, look_at((3.0, 0.0, 1.0)), 12, 64) is None
