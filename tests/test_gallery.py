"""The page is one file that needs nothing else, shows every picture, and never trusts a name."""

import base64
import io
import json
import re
import shutil
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from sparsestyle_ns.errors import InputError
from sparsestyle_ns.gallery import (
    Picture,
    RunPictures,
    View,
    collect_run,
    data_uri,
    depth_picture,
    page_html,
    read_video,
    write_page,
)

MP4 = b"\x00\x00\x00\x18ftypmp42 the rest of a film"


def make_pixels(seed, height=6, width=8):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def make_run(**changes):
    """A run with three photos and two views, the second of them without photo and depth."""
    run = {
        "name": "fern",
        "subtitle": "hier-style, 3 photos, 200 iterations",
        "photos": [Picture(make_pixels(i), f"image00{i}.png") for i in range(3)],
        "views": [
            View("held-out view 0", make_pixels(10), make_pixels(11), make_pixels(12), make_pixels(13)),
            View("held-out view 8", make_pixels(14), make_pixels(15)),
        ],
        "style": Picture(make_pixels(20), "night.jpg"),
        "figures": [("Coarse PSNR", "21.30 dB")],
        "settings": [("Method", "hier-style")],
    }
    return RunPictures(**{**run, **changes})


class Page(HTMLParser):
    """A page's attributes and text, with every element closed in its turn."""

    void = ("meta", "link", "img", "input", "br")

    def __init__(self, html):
        super().__init__()
        self.open, self.attributes, self.texts = [], [], []
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.attributes += [(tag, *pair) for pair in attrs]
        if tag not in self.void:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)

    def values(self, name):
        return [value for _, key, value in self.attributes if key == name]


def test_page_loads_nothing_from_elsewhere():
    html = page_html([make_run(video=MP4)], "Stylised scenes")
    assert "http:" not in html
    assert "https:" not in html
    assert "@import" not in html
    page = Page(html)
    assert all(source.startswith("data:") for source in page.values("src"))
    assert all(link.startswith(("data:", "#")) for link in page.values("href"))
    assert "default-src 'none'" in " ".join(page.values("content"))


def test_page_holds_every_picture_and_the_film():
    run = make_run(video=MP4)
    sources = set(Page(page_html([run], "Stylised scenes")).values("src"))
    pictures = [photo.pixels for photo in run.photos] + [run.style.pixels]
    for view in run.views:
        pictures += [view.stylised, view.coarse, *(p for p in (view.photo, view.depth) if p is not None)]
    expected = {data_uri(pixels) for pixels in pictures}
    assert sources == expected | {"data:video/mp4;base64," + base64.b64encode(MP4).decode()}


def test_every_picture_is_described_and_keeps_its_place_while_loading():
    page = Page(page_html([make_run()], "Stylised scenes"))
    images = page.values("alt")
    assert all(images)
    assert len(images) == page.values("width").count("8") == page.values("height").count("6")


def test_small_picture_survives_unchanged():
    pixels = make_pixels(3)
    kind, content = data_uri(pixels).split(",")
    assert kind == "data:image/png;base64"
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(base64.b64decode(content)))), pixels)


def test_large_picture_is_a_jpeg():
    assert data_uri(make_pixels(4, 500, 500)).startswith("data:image/jpeg;base64,/9j/")


def test_slider_shows_coarse_and_stylised_render_of_first_view():
    run = make_run()
    html = page_html([run], "Stylised scenes")
    slider = html[html.index('<div class="compare">') :]
    first, second = re.findall(r'src="([^"]+)"', slider)[:2]
    assert first == data_uri(run.views[0].stylised)
    assert second == data_uri(run.views[0].coarse)


def test_names_are_text_never_markup():
    attack = '"><script>alert(1)</script>&'
    run = make_run(
        name=attack,
        subtitle=attack,
        photos=[Picture(make_pixels(0), attack)],
        views=[View(attack, make_pixels(1), make_pixels(2))],
        style=None,
        style_note=attack,
        figures=[(attack, attack)],
        settings=[(attack, attack)],
    )
    html = page_html([run, run], attack)
    assert html.count("<script>") == 1
    assert attack in Page(html).texts


def test_missing_style_image_is_noted():
    html = page_html([make_run(style=None, style_note="The style image, night.jpg, is no longer there.")], "Scenes")
    assert "The style image, night.jpg, is no longer there." in html


def test_page_without_film_or_figures_has_no_empty_places_for_them():
    html = page_html([make_run(figures=[])], "Scenes")
    assert "<video" not in html
    assert "Measured" not in html


def test_several_runs_get_a_contents_that_leads_to_them():
    page = Page(page_html([make_run(name="fern"), make_run(name="flower")], "Scenes"))
    links = [link[1:] for link in page.values("href") if link.startswith("#")]
    assert links == ["run-1", "run-2"]
    assert set(links) <= set(page.values("id"))


def test_write_page_makes_the_folder_and_leaves_only_the_page(tmp_path):
    target = tmp_path / "new" / "folder" / "index.html"
    assert write_page([make_run()], target, "Scenes") == target
    assert target.read_text(encoding="utf-8") == page_html([make_run()], "Scenes")
    assert [path.name for path in target.parent.iterdir()] == ["index.html"]


def test_failed_write_leaves_the_former_page(tmp_path, monkeypatch):
    target = tmp_path / "index.html"
    target.write_text("former")

    def fail(source, destination):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(InputError, match="No space left"):
        write_page([make_run()], target, "Scenes")
    assert target.read_text() == "former"
    assert list(tmp_path.iterdir()) == [target]


def test_page_can_not_take_a_folders_place(tmp_path):
    with pytest.raises(InputError, match=r"is a folder; name a file, such as .*index.html"):
        write_page([make_run()], tmp_path, "Scenes")


def test_folder_that_can_not_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match=r"can't be written to .*index.html"):
        write_page([make_run()], tmp_path / "file" / "index.html", "Scenes")


def test_read_video_takes_mp4_only(tmp_path):
    film, text = tmp_path / "film.mp4", tmp_path / "film.txt"
    film.write_bytes(MP4)
    text.write_text("no film")
    assert read_video(film) == MP4
    with pytest.raises(InputError, match="is no MP4 video"):
        read_video(text)
    with pytest.raises(InputError, match="can't be read"):
        read_video(tmp_path / "gone.mp4")


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
    run = collect_run(moved, num_views=2)
    assert [photo.caption for photo in run.photos] == json.loads((runs.style / "scene.json").read_text())["view_names"]
    assert len(run.photos) == 3
    assert [view.name for view in run.views] == ["Held-out view image000.png", "Held-out view image008.png"]
    assert run.style.caption == "painting.png"
    for view in run.views:
        for pixels in (view.photo, view.coarse, view.stylised, view.depth):
            assert pixels.shape == (24, 32, 3)
            assert pixels.dtype == np.uint8
    assert dict(run.settings)["Iterations"] == "3 of 3"
    assert dict(run.figures)["Mean of"] == "2 views"
    assert run.subtitle == "hier-style, 3 photos, 3 iterations"
    assert Page(page_html([run], "A run")).values("src")


def test_collect_run_shows_a_run_whose_painting_is_gone(runs, tmp_path):
    moved = tmp_path / "outputs" / "scene" / "hier-style" / "run"
    shutil.copytree(runs.style, moved)
    config = moved / "config.yml"
    config.write_text(config.read_text().replace("- painting.png", "- gone.png"))
    run = collect_run(config, num_views=1)
    assert run.style is None
    assert "gone.png, is no longer there" in run.style_note


def test_collect_run_says_that_a_run_has_no_checkpoint(runs, tmp_path):
    moved = tmp_path / "outputs" / "scene" / "hier-style" / "run"
    shutil.copytree(runs.style, moved, ignore=shutil.ignore_patterns("*.ckpt"))
    with pytest.raises(InputError, match="has no checkpoint yet"):
        collect_run(moved)
