"""The page is one file that needs nothing else, shows every picture, and never trusts a name."""

import base64
import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from sparsestyle_ns.evaluation.tables import Table
from sparsestyle_ns.gallery.layout import THUMBNAIL_SIDE, Film, Picture, RunPictures, View, gallery_page
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_output
from sparsestyle_ns.utils.page import data_uri

MP4 = b"\x00\x00\x00\x18ftypmp42 the rest of a film"


def make_pixels(seed, height=6, width=8):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def make_run(**changes):
    """A run with three photos and two views."""
    run = {
        "name": "fern",
        "subtitle": "hier-style, 3 photos, 200 iterations",
        "photos": [Picture(make_pixels(i), f"image00{i}.png") for i in range(3)],
        "views": [
            View("held-out view 0", *map(make_pixels, range(10, 14))),
            View("held-out view 8", *map(make_pixels, range(14, 18))),
        ],
        "style_name": "night",
        "style": Picture(make_pixels(20), "night.jpg"),
        "tables": [Table("Mean of the views above, 2", ["coarse PSNR dB ↑"], [("", ["21.30"])])],
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
    html = gallery_page([make_run(film=Film(MP4, "A turn"))], "Stylised scenes")
    assert "http:" not in html
    assert "https:" not in html
    assert "@import" not in html
    page = Page(html)
    assert all(source.startswith("data:") for source in page.values("src"))
    assert all(link.startswith(("data:", "#")) for link in page.values("href"))
    assert "default-src 'none'" in " ".join(page.values("content"))


def test_page_holds_every_picture_and_the_film():
    run = make_run(film=Film(MP4, "A turn"))
    sources = set(Page(gallery_page([run], "Stylised scenes")).values("src"))
    pictures = [photo.pixels for photo in run.photos] + [run.style.pixels]
    for view in run.views:
        pictures += [view.stylised, view.coarse, view.photo, view.depth]
    expected = {data_uri(pixels) for pixels in pictures}
    assert sources == expected | {"data:video/mp4;base64," + base64.b64encode(MP4).decode()}


def test_every_picture_is_described_and_keeps_its_place_while_loading():
    page = Page(gallery_page([make_run()], "Stylised scenes"))
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
    html = gallery_page([run], "Stylised scenes")
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
        views=[View(attack, *map(make_pixels, range(1, 5)))],
        style_name=attack,
        style=None,
        style_note=attack,
        film=Film(MP4, attack),
        tables=[Table(attack, [attack], [(attack, [attack])], attack)],
        settings=[(attack, attack)],
    )
    html = gallery_page([run, run], attack)
    assert html.count("<script>") == 1
    assert attack in Page(html).texts


def test_missing_style_image_is_noted():
    html = gallery_page([make_run(style=None, style_note="The style image, night.jpg, is no longer there.")], "Scenes")
    assert "The style image, night.jpg, is no longer there." in html


def test_page_without_film_or_tables_has_no_empty_places_for_them():
    html = gallery_page([make_run(tables=[])], "Scenes")
    assert "<video" not in html
    assert "<table" not in html


def test_several_runs_get_a_contents_that_leads_to_them():
    page = Page(gallery_page([make_run(name="fern"), make_run(name="flower")], "Scenes"))
    links = [link[1:] for link in page.values("href") if link.startswith("#")]
    assert set(links) == {"run-1", "run-2"} <= set(page.values("id"))


def grid_of(runs):
    """The grid's cells, as rows of the runs that each leads to; its headings; and its HTML."""
    html = gallery_page(runs, "Scenes")
    if '<section class="grid"' not in html:
        return None, None, html
    grid = html[html.index('<section class="grid"') : html.index("</section>")]
    rows = re.findall(r"<tr>(.*?)</tr>", grid)[1:]
    cells = [[re.findall(r'href="#run-(\d)"', cell) for cell in re.findall(r"<td>(.*?)</td>", row)] for row in rows]
    return cells, re.findall(r"<span>(.*?)</span>", grid), grid


def test_the_grid_has_scenes_down_and_paintings_across_with_gaps_where_there_is_no_run():
    hat = {"style_name": "hat", "style": Picture(make_pixels(21), "hat.jpg")}
    night, hat, flower, again = make_run(), make_run(**hat), *(make_run(name="flower", **hat) for _ in range(2))
    cells, headings, grid = grid_of([night, hat, flower, again])
    assert cells == [[["1"], ["2"]], [[], ["3", "4"]]]
    assert headings == ["night", "hat", "fern", "flower"]
    sources = re.findall(r'src="([^"]+)"', grid)
    assert data_uri(make_pixels(20)) in sources  # paintings
    assert data_uri(make_pixels(11)) in sources  # the scene as it was
    assert data_uri(make_pixels(10)) in sources  # and stylised


def test_two_paintings_of_one_name_have_a_column_and_a_name_each():
    hats = [Picture(make_pixels(seed), "hat.jpg") for seed in (21, 22, 21)]
    gone = make_run(style_name="hat", style=None)  # nobody knows which of them it was
    runs = [*(make_run(style_name="hat", style=hat) for hat in hats), gone, make_run(style_name="hat 2", style=hats[0])]
    cells, headings, grid = grid_of(runs)
    assert cells == [[["1", "3"], ["2"], ["4"], ["5"]]]
    assert headings == ["hat", "hat 2", "hat 3", "hat 2 2", "fern"]
    sources = re.findall(r'src="([^"]+)"', grid)
    assert [sources.index(data_uri(make_pixels(seed))) for seed in (21, 22)] == [0, 1]
    texts = Page(gallery_page(runs, "Scenes")).texts
    assert texts.count("fern · hat") == 4  # two sections, and two links to them
    assert texts.count("fern · hat 2") == texts.count("fern · hat 2 2") == 2
    assert runs[1].style_name == "hat"


def test_one_run_has_no_grid():
    assert grid_of([make_run()])[0] is None


def test_the_grids_pictures_are_small():
    large = View("view", *(make_pixels(seed, 400, 500) for seed in range(4)))
    grid = grid_of([make_run(views=[large]), make_run(style_name="hat", views=[large])])[2]
    assert max(map(int, re.findall(r'width="(\d+)"', grid))) == THUMBNAIL_SIDE


def test_figures_are_shown_in_tables_with_a_dash_for_those_that_are_missing():
    measured = Table("Style and content, 25 held-out views", ["NNFM <&>"], [("stylised", ["0.1"]), ("none", [None])])
    texts = Page(gallery_page([make_run(tables=[measured])], "Scenes")).texts
    for text in ("Style and content, 25 held-out views", "NNFM <&>", "stylised", "0.1", "–"):
        assert text in texts


def test_writing_a_page_makes_the_folder_and_leaves_only_the_page(tmp_path):
    target = tmp_path / "new" / "folder" / "index.html"
    assert write_output(target, "<p>Zoë</p>", "The page", "index.html") == target
    assert target.read_text(encoding="utf-8") == "<p>Zoë</p>"
    assert [path.name for path in target.parent.iterdir()] == ["index.html"]


def test_failed_write_leaves_the_former_page(tmp_path, monkeypatch):
    target = tmp_path / "index.html"
    target.write_text("former")

    def fail(source, destination):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(InputError, match="No space left"):
        write_output(target, "page", "The page", "index.html")
    assert target.read_text() == "former"
    assert list(tmp_path.iterdir()) == [target]


def test_page_can_not_take_a_folders_place(tmp_path):
    with pytest.raises(InputError, match=r"is a folder; name a file, such as .*index.html"):
        write_output(tmp_path, "page", "The page", "index.html")


def test_folder_that_can_not_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match=r"can't be written to .*index.html"):
        write_output(tmp_path / "file" / "index.html", "page", "The page", "index.html")
