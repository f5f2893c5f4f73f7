"""A browser without a network shows every picture, plays the film, and moves the slider where the pointer goes."""

import numpy as np
import pytest
from chromium import needs_chromium, open_tab
from test_gallery_page import make_pixels, make_run

from sparsestyle_ns.evaluation.tables import Table
from sparsestyle_ns.gallery.film import encode_mp4
from sparsestyle_ns.gallery.layout import Film, View, gallery_page

pytestmark = needs_chromium
RED, BLUE = (200, 30, 20), (20, 40, 190)
WIDTH = 900


def plain(color, height=60, width=80):
    return np.full((height, width, 3), color, np.uint8)


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    folder = tmp_path_factory.mktemp("browser")
    turning = [np.roll(make_pixels(3, 48, 64), 4 * step, axis=1) for step in range(8)]
    wide = Table("Consistency", ["a rather long heading of a column"] * 9, [("stylised", ["0.1234"] * 9)])
    effects = [("effect", "why"), ("ndc", "the cameras look one way, and depth has no end " * 3)]
    run = make_run(
        views=[View("held-out view 0", plain(RED), plain(BLUE), plain((9, 9, 9)), plain((90, 90, 90)))],
        film=Film(encode_mp4(turning), "A turn"),
        tables=[wide],
        effects=effects,
    )
    path = folder / "gallery.html"
    path.write_text(gallery_page([run, make_run(name="flower")], "Two scenes"), encoding="utf-8")
    with open_tab(folder / "profile", WIDTH, 700) as tab:
        moving = {"name": "prefers-reduced-motion", "value": "no-preference"}
        tab.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "light"}, moving])
        tab.open(path.as_uri())
        yield tab


def slider(tab):
    """The slider's place on the screen: left, top, width, height."""
    tab.evaluate("document.querySelector('.compare').scrollIntoView({behavior: 'instant', block: 'center'})")
    box = "document.querySelector('.compare').getBoundingClientRect()"
    return [round(tab.evaluate(f"{box}.{side}")) for side in ("left", "top", "width", "height")]


def colors_at(tab, share):
    """Whether the picture left and right of the middle of some share of the slider is the coarse or the stylised."""
    left, top, width, height = slider(tab)
    row = tab.screenshot()[top + height // 4].astype(int)
    return "".join(
        "b"
        if np.abs(row[left + int(width * part)] - BLUE).sum() < 30
        else "r"
        if np.abs(row[left + int(width * part)] - RED).sum() < 30
        else "?"
        for part in (share - 0.1, share + 0.1)
    )


def test_every_picture_is_shown(tab):
    pictures = tab.evaluate("[...document.images].map(image => [image.complete, image.naturalWidth > 0])")
    assert len(pictures) > 10
    assert all(map(all, pictures))


def test_nothing_is_asked_of_a_network(tab):
    asked = tab.evaluate("performance.getEntriesByType('resource').map(entry => entry.name)")
    assert [name for name in asked if not name.startswith("data:")] == []


def test_the_slider_shows_coarse_on_its_left_and_stylised_on_its_right(tab):
    assert colors_at(tab, 0.5) == "br"


def test_dragging_moves_the_slider(tab):
    left, top, width, height = slider(tab)
    x, y = left + width // 2, top + height // 2
    tab.mouse("mousePressed", x, y, button="left", buttons=1, clickCount=1)
    tab.mouse("mouseMoved", left + 0.8 * width, y, button="left", buttons=1)
    assert colors_at(tab, 0.8) == "br"
    tab.mouse("mouseMoved", left + 0.2 * width, y, button="left", buttons=1)
    tab.mouse("mouseReleased", left + 0.2 * width, y, button="left", clickCount=1)
    assert colors_at(tab, 0.2) == "br"
    tab.mouse("mouseMoved", left + 0.5 * width, y)  # the button is up: nothing follows
    assert colors_at(tab, 0.2) == "br"


def test_keys_move_the_slider(tab):
    slider(tab)
    tab.evaluate("document.querySelector('.compare input').focus()")
    tab.evaluate("document.querySelector('.compare input').value = 50")
    for _ in range(10):
        for kind in ("keyDown", "keyUp"):
            tab.call("Input.dispatchKeyEvent", type=kind, key="ArrowRight", code="ArrowRight", windowsVirtualKeyCode=39)
    assert colors_at(tab, 0.6) == "br"


def test_the_film_plays(tab):
    tab.evaluate("document.querySelector('video').scrollIntoView({behavior: 'instant'})")  # out of sight it rests
    tab.wait_for("document.querySelector('video').readyState >= 2")
    size = tab.evaluate("[document.querySelector('video').videoWidth, document.querySelector('video').videoHeight]")
    assert size == [64, 48]
    assert tab.evaluate("document.querySelector('video').duration") == pytest.approx(0.5, abs=0.1)
    before = tab.evaluate("document.querySelector('video').currentTime")
    tab.wait_for(f"document.querySelector('video').currentTime !== {before}")


def test_a_narrow_screen_never_scrolls_sideways(tab):
    narrow = {"width": 400, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    tab.call("Emulation.setDeviceMetricsOverride", **narrow)
    try:
        assert tab.evaluate("document.documentElement.scrollWidth") <= 400
    finally:
        tab.call("Emulation.setDeviceMetricsOverride", **{**narrow, "width": WIDTH, "height": 700})


def test_the_grid_leads_to_the_runs(tab):
    links = tab.evaluate("[...document.querySelectorAll('.grid a')].map(link => link.hash)")
    assert links == ["#run-1", "#run-2"]
    tab.evaluate("document.querySelectorAll('.grid a')[1].click()")
    assert tab.evaluate("location.hash") == "#run-2"
