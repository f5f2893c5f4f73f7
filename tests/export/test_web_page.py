"""The page carries the scene whole and nothing from elsewhere, and shows in a browser what its twin in torch says."""

import base64
import gzip
import json
import re
import time

import numpy as np
import pytest
import torch
from chromium import needs_chromium, open_tab
from conftest import run_entrypoint
from PIL import Image
from small_scenes import HEIGHT, KINDS, WIDTH, look_ahead, psnr, put_specks, scene
from torchvision.transforms.functional import to_tensor

from sparsestyle_ns.cli import main
from sparsestyle_ns.core.camera_paths import showing_path
from sparsestyle_ns.export.export_options import ExportOptions
from sparsestyle_ns.export.orbit import turned
from sparsestyle_ns.export.stylised_scene import load_scenes
from sparsestyle_ns.export.voxel_grid import EMPTY, VoxelGrid, Voxels, picture_of_voxels
from sparsestyle_ns.export.web_page import FLIGHT_POSES, build_page, fit_page
from sparsestyle_ns.rendering.mixing import Mix
from sparsestyle_ns.utils.errors import InputError

READY = "document.body.dataset.state === 'ready'"
SETTLED = "document.body.dataset.state !== 'moving'"


def page_of(kind, names=None, styles=1, **made):
    small = scene(kind, styles)
    vars(small).update(made, names=names or small.names)
    return build_page(small.voxels, [small] * styles, small.orbit)


def unpack(page):
    """What a page says of its scene, and the voxels that it carries, read as web_page.py describes them."""
    text = page.decode()
    told, packed = (
        re.search(f'<script id="{name}"[^>]*>(.*?)</script>', text, re.DOTALL)[1] for name in ("scene", "voxels")
    )
    told = json.loads(told)
    data = np.frombuffer(gzip.decompress(base64.b64decode(packed)), np.uint8)
    styles, coarse = told["styles"], told["coarse"]
    sides = told["cells"], styles[0]["resolution"] + 1, coarse["resolution"] + 1
    *grids, planes = np.split(data, np.cumsum([-(-(side**3) // 8) for side in sides]))
    occupied, known, coarse_known = (
        torch.from_numpy(np.unpackbits(bits, count=side**3, bitorder="little").astype(bool)).view(side, side, side)
        for bits, side in zip(grids, sides, strict=True)
    )
    each = [4 * field["known"] for field in (*styles, coarse)]
    *parts, rest = np.split(planes, np.cumsum(each))
    assert len(rest) == 0
    tables = [np.cumsum(part.reshape(4, -1), axis=1, dtype=np.uint8) for part in parts]
    for table in tables[1:-1]:
        table[0] += tables[0][0]
    fields = []
    for table, where in zip(tables, [*[known] * len(styles), coarse_known], strict=True):
        codes = torch.zeros(*where.shape, 4, dtype=torch.uint8)
        codes[..., 0] = EMPTY
        codes[where] = torch.from_numpy(table.T.copy())
        fields.append(Voxels(codes, where))
    return told, VoxelGrid(fields[:-1], fields[-1], occupied)


def shown(tab):
    """The canvas in the window's corner, as a picture in [0, 1]."""
    return torch.from_numpy(tab.screenshot()[:HEIGHT, :WIDTH] / 255.0).float()


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with open_tab(tmp_path_factory.mktemp("profile")) as tab:
        yield tab


@pytest.mark.parametrize("styles", [1, 2])
def test_what_is_packed_is_unpacked(styles):
    small = scene("box", styles)
    told, voxels = unpack(page_of("box", styles=styles))
    assert told["styles"][0]["resolution"] == voxels.resolution == 31
    assert torch.equal(voxels.occupied, small.voxels.occupied)
    pairs = [(voxels.coarse, small.voxels.coarse), *zip(voxels.styles, small.voxels.styles, strict=True)]
    for mine, theirs in pairs:
        assert torch.equal(mine.codes, theirs.codes) and torch.equal(mine.known, theirs.known)


def test_the_same_scene_gives_the_same_file():
    assert page_of("ndc") == page_of("ndc")


def test_the_page_asks_nothing_of_a_network():
    text = page_of("ndc").decode()
    assert "default-src 'none'" in text
    assert not re.search(r'https?://|\b(src|href)="(?!data:)|@import|fetch\(', text)


def test_titles_and_file_names_are_text_never_markup():
    attack = '</script><script>alert("1")</script>'
    text = page_of("box", title=attack, painting=attack, name=attack, names=[attack] * 3).decode()
    assert attack not in text
    assert unpack(text.encode())[0]["cameras"][0]["name"] == attack


def test_a_page_that_is_too_large_gets_fewer_cells():
    tried = []

    def bake(resolution):
        tried.append(resolution)
        return resolution

    voxels, page = fit_page(bake, lambda resolution: bytes(resolution**3), 100, max_bytes=600_000)
    assert tried == [100, 82]  # the cube root of 0.95 · 0.6 is 0.829
    assert voxels == 82
    assert len(page) <= 600_000


def test_a_scene_that_does_not_fit_is_refused():
    with pytest.raises(InputError, match=r"doesn't fit into a page of 0 MB, even with 40 cells"):
        fit_page(lambda resolution: resolution, lambda resolution: bytes(1000), 40, max_bytes=10)


@needs_chromium
@pytest.mark.parametrize("kind", KINDS)
def test_a_browser_shows_what_the_twin_in_torch_says(tab, tmp_path, kind):
    small, path = scene(kind), tmp_path / "page.html"
    path.write_bytes(page_of(kind))
    for view in (0, 2):
        tab.open(f"{path.as_uri()}#view={view}&size={WIDTH}x{HEIGHT}")
        tab.wait_for(READY)
        expected = picture_of_voxels(small.voxels, small.model, small.cameras[view : view + 1])
        assert expected.std() > 0.05  # there is something to see
        # A screen has 256 shades: rounding alone leaves 59 dB. Cells' borders are where float32 puts them.
        assert psnr(shown(tab), expected) > 45


@needs_chromium
@pytest.mark.parametrize("kind", KINDS)
def test_cones_that_find_where_rays_begin_pass_over_nothing(tab, tmp_path, kind):
    small = scene(kind)
    voxels = put_specks(small.voxels, 100)
    page = build_page(voxels, [small], small.orbit).decode()
    assert page.count("    draw(true);\n") == 1
    without = page.replace("    draw(true);\n", "    gl.clear(gl.COLOR_BUFFER_BIT);\n")  # all rays begin at the camera
    for view in range(3):
        pictures = []
        for name, text in (("with", page), ("without", without)):
            path = tmp_path / f"{name}.html"
            path.write_text(text)
            tab.open(f"{path.as_uri()}#view={view}&size={WIDTH}x{HEIGHT}")
            tab.wait_for(READY)
            pictures.append(shown(tab))
        assert pictures[0].std() > 0.02
        assert psnr(*pictures) > 55
        assert psnr(pictures[0], picture_of_voxels(voxels, small.model, small.cameras[view : view + 1])) > 40


@needs_chromium
def test_a_camera_that_has_flown_into_a_forward_facing_scene_sees_only_what_is_ahead_of_it(tab, tmp_path):
    small, path = scene("ndc"), tmp_path / "page.html"
    small.cameras = look_ahead((0.0, 0.0, 0.0), (-0.2, 0.1, -2.1))  # past the nearest things
    small.names = ["0.png", "1.png"]
    path.write_bytes(build_page(small.voxels, [small], small.orbit))
    tab.open(f"{path.as_uri()}#view=1&size={WIDTH}x{HEIGHT}")
    tab.wait_for(READY)
    expected = picture_of_voxels(small.voxels, small.model, small.cameras[1:])
    assert expected.std() > 0.05
    assert psnr(shown(tab), expected) > 45


@needs_chromium
@pytest.mark.parametrize("kind", ["ndc", "box"])
def test_dragging_turns_the_camera_as_the_orbit_says(tab, tmp_path, kind):
    small, path = scene(kind), tmp_path / "page.html"
    path.write_bytes(page_of(kind))
    tab.open(f"{path.as_uri()}#size={WIDTH}x{HEIGHT}")
    tab.wait_for(READY)
    tab.mouse("mousePressed", 40, 24, button="left", clickCount=1)
    tab.mouse("mouseMoved", 20, 30, button="left")
    tab.mouse("mouseReleased", 20, 30, button="left")
    tab.wait_for(READY)
    degrees = 180 / 480
    expected = picture_of_voxels(
        small.voxels, small.model, turned(small.orbit, small.cameras, yaw=20 * degrees, pitch=6 * degrees)
    )
    before = picture_of_voxels(small.voxels, small.model, small.cameras[:1])
    assert psnr(before, expected) < 30
    assert psnr(shown(tab), expected) > 45


def opened(tab, folder):
    """The picture that the page of a scene in a box opens with."""
    path = folder / "page.html"
    path.write_bytes(page_of("box"))
    tab.open(f"{path.as_uri()}#size={WIDTH}x{HEIGHT}")
    tab.wait_for(READY)
    return shown(tab)


@needs_chromium
def test_the_wheel_comes_nearer_keys_turn_and_the_button_goes_back_to_the_photos(tab, tmp_path):
    opening = opened(tab, tmp_path)
    background = torch.tensor([1.0, 0.9, 0.8])

    def covered(picture):
        return int(((picture - background).abs().amax(dim=-1) > 0.02).sum())

    tab.mouse("mouseWheel", 30, 20, deltaX=0, deltaY=-400)
    tab.wait_for("document.body.dataset.state === 'moving'")
    tab.wait_for(READY)
    near = shown(tab)
    assert covered(near) > 1.2 * covered(opening)
    tab.evaluate("canvas.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowLeft'}))")
    tab.wait_for(READY)
    assert psnr(shown(tab), near) < 35
    tab.evaluate("document.getElementById('next').click()")
    tab.wait_for(READY)
    torch.testing.assert_close(shown(tab), opening)


@needs_chromium
def test_a_fine_picture_that_is_asked_for_while_a_coarse_one_is_due_is_drawn(tab, tmp_path):
    opening = opened(tab, tmp_path)
    # Both before the next frame, which a callback that is asked for after them comes at the end of.
    state = tab.evaluate(
        """new Promise((done) => {
            canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft" }));
            document.getElementById("next").click();
            requestAnimationFrame(() => done(document.body.dataset.state));
        })"""
    )
    assert state == "ready"
    torch.testing.assert_close(shown(tab), opening)


@needs_chromium
def test_without_webgl_the_page_says_what_to_do(tab, tmp_path):
    path = tmp_path / "page.html"
    path.write_bytes(page_of("box"))
    script = tab.call(
        "Page.addScriptToEvaluateOnNewDocument", source="HTMLCanvasElement.prototype.getContext = () => null;"
    )
    try:
        tab.open(path.as_uri())
        tab.wait_for("document.body.dataset.state === 'failed'")
    finally:
        tab.call("Page.removeScriptToEvaluateOnNewDocument", identifier=script["identifier"])
    assert "shows no WebGL2" in tab.evaluate("document.getElementById('message').textContent")


@needs_chromium
def test_an_exported_run_looks_in_a_browser_as_ns_render_shows_it(tab, patterned_run, tmp_path, capsys):
    from nerfstudio.scripts import render

    main(["export", str(patterned_run), "--output-path", str(tmp_path / "run.html"), "--resolution", "95"])
    printed = capsys.readouterr().out
    told = [float(value) for value in re.findall(r"view of \S+: ([\d.]+) dB", printed)]
    flags = ["--split", "train", "--rendered-output-names", "rgb", "--image-format", "png"]
    where = ["--load-config", str(patterned_run / "config.yml"), "--output-path", str(tmp_path)]
    run_entrypoint(render.entrypoint, ["dataset", *where, *flags])
    names = ("image001", "image005", "image011")
    assert len(told) == len(names)
    for view, name in enumerate(names):
        tab.open(f"{(tmp_path / 'run.html').as_uri()}#view={view}&size=32x24")
        tab.wait_for(READY)
        picture = torch.from_numpy(tab.screenshot()[:24, :32] / 255.0).float()
        expected = to_tensor(Image.open(tmp_path / "train" / "rgb" / f"{name}.png")).movedim(0, -1)
        assert told[view] > 35
        assert psnr(picture, expected) == pytest.approx(told[view], abs=1.0)
        assert psnr(picture, expected.flip(1)) < 30  # the scene has a left and a right


def two_styles(tab, folder, kind="box"):
    """The page of two styles of a scene, opened; the scene."""
    path = folder / "page.html"
    path.write_bytes(page_of(kind, styles=2))
    tab.open(f"{path.as_uri()}#size={WIDTH}x{HEIGHT}")
    tab.wait_for(READY)
    return scene(kind, 2)


def set_slider(tab, name, value):
    tab.evaluate(f"element('{name}').value = {value}; element('{name}').dispatchEvent(new Event('input'))")
    tab.wait_for(READY)


def key(tab, name):
    tab.call("Input.dispatchKeyEvent", type="keyDown", key=name)
    tab.call("Input.dispatchKeyEvent", type="keyUp", key=name)


def mixed(small, camera=None, **mix):
    """What a page shows with sliders that stand so, by its twin in torch."""
    return picture_of_voxels(small.voxels, small.model, camera or small.cameras[:1], Mix(**mix))


@needs_chromium
@pytest.mark.parametrize("kind", KINDS)
def test_sliders_mix_fields_as_the_viewer_does(tab, tmp_path, kind):
    small, now = two_styles(tab, tmp_path, kind), {"strength": 1.0, "geometry": 1.0, "blend": 0.0}
    before = mixed(small)
    for name, value in (("strength", 0.6), ("geometry", 0.3), ("blend", 0.75), ("strength", 0.0)):
        set_slider(tab, name, value)
        now[name] = value
        expected = mixed(small, **now)
        assert psnr(expected, before) < 40
        assert psnr(shown(tab), expected) > 45
        before = expected
    assert tab.evaluate("element('strength').parentElement.querySelector('output').textContent") == "0.00"


@needs_chromium
def test_keys_move_the_sliders_and_the_page_lists_them(tab, tmp_path):
    small = two_styles(tab, tmp_path)
    for name in ("[", "[", ",", "'", "'", "'"):
        key(tab, name)
    tab.wait_for(READY)
    assert psnr(shown(tab), mixed(small, strength=0.8, geometry=0.9, blend=0.3)) > 45
    listed = tab.evaluate("element('help').textContent")
    for word in ("turn", "zoom", "pinch", "flight", "strength", "blend", "before and after", "full screen", "save"):
        assert word in listed


@needs_chromium
def test_a_page_of_one_style_has_no_blend(tab, tmp_path):
    opened(tab, tmp_path)
    assert tab.evaluate("element('blend')") is None
    assert "blend" not in tab.evaluate("element('help').textContent")


@needs_chromium
def test_left_of_the_divider_is_before_right_of_it_after_and_it_is_dragged(tab, tmp_path):
    small = two_styles(tab, tmp_path)
    before, after = mixed(small, strength=0.0), mixed(small)
    key(tab, "b")
    tab.wait_for(READY)
    tab.evaluate("for (const label of element('divider').children) label.style.display = 'none'")
    for at in (WIDTH // 2, 20):
        if at != WIDTH // 2:
            tab.mouse("mousePressed", WIDTH // 2, 30, button="left", clickCount=1)
            tab.mouse("mouseMoved", at, 30, button="left")
            tab.mouse("mouseReleased", at, 30, button="left")
            tab.wait_for(READY)
        expected = torch.cat([before[:, :at], after[:, at:]], dim=1)
        line = slice(at - 1, at + 1)  # it is drawn over these
        picture = shown(tab)
        picture[:, line] = expected[:, line]
        assert psnr(picture, expected) > 45
    tab.evaluate("element('compare').click()")
    tab.wait_for(READY)
    assert psnr(shown(tab), after) > 45


@needs_chromium
@pytest.mark.parametrize("kind", ["ndc", "box"])
def test_the_flight_plays_along_the_path_and_rests_where_it_is_paused(tab, tmp_path, kind):
    small = two_styles(tab, tmp_path, kind)
    opening = shown(tab)
    tab.evaluate("element('play').click()")
    tab.wait_for("stage.place > 15")
    assert tab.evaluate("element('play').textContent") == "Pause"
    tab.evaluate("stage.pause()")
    tab.wait_for(READY)
    place = tab.evaluate("stage.place")
    path = showing_path(small.cameras, FLIGHT_POSES)
    camera = path[int(place) : int(place) + 1]
    camera.camera_to_worlds = torch.lerp(
        camera.camera_to_worlds, path[int(place) + 1 : int(place) + 2].camera_to_worlds, place % 1.0
    )
    assert psnr(shown(tab), opening) < 40
    assert psnr(shown(tab), mixed(small, camera)) > 45
    key(tab, " ")  # goes on from there
    tab.wait_for(f"stage.place > {place} + 1")
    key(tab, " ")
    assert not tab.evaluate("stage.isFlying")


@needs_chromium
def test_the_still_that_is_saved_is_the_picture_on_the_screen(tab, tmp_path):
    small = two_styles(tab, tmp_path)
    tab.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    tab.evaluate("element('save').click()")
    end = time.monotonic() + 20
    while not (saved := list(tmp_path.glob("*.png"))):
        assert time.monotonic() < end, "nothing was saved"
        time.sleep(0.1)
    picture = to_tensor(Image.open(saved[0]).convert("RGB")).movedim(0, -1)
    assert psnr(picture, mixed(small)) > 45


@needs_chromium
def test_fingers_turn_and_pinch(tab, tmp_path):
    small = two_styles(tab, tmp_path)
    tab.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)

    def touch(kind, *points):
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
        tab.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    try:
        touch("touchStart", (40, 24))
        for x in (36, 30, 24):
            touch("touchMove", (x, 24))
        touch("touchEnd")
        tab.wait_for(READY)
        turn = tab.evaluate("stage.viewpoint.turn")
        assert turn["yaw"] > 2 and turn["distance"] == 1
        expected = mixed(small, turned(small.orbit, small.cameras, turn["yaw"], turn["pitch"]))
        assert psnr(shown(tab), expected) > 45
        touch("touchStart", (24, 24), (40, 24))
        for step in range(1, 5):
            touch("touchMove", (24 - 4 * step, 24), (40 + 4 * step, 24))
        touch("touchEnd")
        tab.wait_for(READY)
        assert tab.evaluate("stage.viewpoint.turn.distance") < 0.8
        assert psnr(shown(tab), expected) < 30
    finally:
        tab.call("Emulation.setTouchEmulationEnabled", enabled=False)


@needs_chromium
def test_the_button_goes_to_full_screen_and_back(tab, tmp_path):
    two_styles(tab, tmp_path)
    box = tab.evaluate("(({x, y}) => [x, y])(element('full').getBoundingClientRect())")
    for expected in ("true", "false"):
        for kind in ("mousePressed", "mouseReleased"):  # a browser wants a real click
            tab.mouse(kind, box[0] + 8, box[1] + 8, button="left", clickCount=1)
        tab.wait_for(f"(document.fullscreenElement !== null) === {expected}")


@needs_chromium
def test_the_caption_says_what_made_the_page(tab, tmp_path):
    two_styles(tab, tmp_path)
    told = tab.evaluate("document.querySelector('footer').textContent")
    for word in ("scene from 3 photos (0.png, 1.png, 2.png)", "sea.jpg", "hier-style", "7 iterations"):
        assert word in told


def test_two_runs_that_share_no_coarse_field_are_refused_in_one_sentence(patterned_run, runs):
    with pytest.raises(InputError, match=r"can't be blended: .* stylise one coarse run twice"):
        load_scenes([patterned_run / "config.yml", runs.style / "config.yml"])
    first, second = load_scenes([patterned_run / "config.yml"] * 2)
    assert first.title == second.title


@pytest.mark.parametrize(("form", "count"), [("html", 3), ("ply", 2), ("html", 0)])
def test_only_pages_take_two_runs(form, count, tmp_path):
    options = ExportOptions(runs=(tmp_path,) * count, output_path=tmp_path / "scene", format=form)
    with pytest.raises(InputError, match=rf"--format {form} takes one run.*, not {count}"):
        options.check()
