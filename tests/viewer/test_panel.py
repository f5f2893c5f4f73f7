"""The Style panel, in nerfstudio's own viewer but without a browser: its controls are moved from here."""

import gc
import io
import json
import os
import shutil
import threading
import time
import weakref
from contextlib import contextmanager
from copy import deepcopy
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Callable, Dict, Iterator, List

import numpy as np
import pytest
import torch
import yaml
from conftest import run_entrypoint
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.viewer import render_state_machine
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.utils import CameraState, get_camera
from nerfstudio.viewer.viewer import Viewer
from PIL import Image

from sparsestyle_ns.core.pinhole import pinhole_rays
from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.engine.restyling import Progress, Restyling, Workshop
from sparsestyle_ns.engine.training import Training, warm_start
from sparsestyle_ns.export.stylised_scene import load_scene
from sparsestyle_ns.gallery.make_gallery import collect_run
from sparsestyle_ns.losses.stylization import Losses
from sparsestyle_ns.pipelines.scene_views import cameras_between
from sparsestyle_ns.rendering.baked import MOST_BAKED
from sparsestyle_ns.runs.run_folder import find_config
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.viewer import adjustments
from sparsestyle_ns.viewer.baking import STEPS_BETWEEN
from sparsestyle_ns.viewer.panel import NO_BLEND, StylePanel
from sparsestyle_ns.viewer.styles import Style, plain


class Drawing(RenderStateMachine):
    """One of the viewer's threads, which does what the test says."""

    def __init__(self, work: Callable[[], object]) -> None:
        threading.Thread.__init__(self, daemon=True)
        self.work = work

    def run(self) -> None:
        self.result = self.work()


def drawn(panel: StylePanel, output: str = "rgb") -> torch.Tensor:
    """A picture as the viewer makes it."""
    pipeline = panel.pipeline
    camera = pipeline.datamanager.train_dataset.cameras[:1]
    thread = Drawing(lambda: pipeline.model.get_outputs_for_camera(camera)[output])
    thread.start()
    thread.join()
    return thread.result


@contextmanager
def viewer_of(run: Path) -> Iterator[StylePanel]:
    """The panel of a run in a viewer like ns-viewer's."""
    _, pipeline, _ = load_run(find_config(run))
    config = ViewerConfig(websocket_host="127.0.0.1")
    viewer = Viewer(config, run / "viewer.txt", run, pipeline, train_lock=threading.Lock())
    try:
        yield pipeline.panel
    finally:
        pipeline.panel.close()
        viewer.viser_server.stop()


@pytest.fixture(scope="module")
def panel(patterned_run: Path) -> Iterator[StylePanel]:
    with viewer_of(patterned_run) as panel:
        yield panel


@pytest.fixture(autouse=True)
def at_rest(request: pytest.FixtureRequest) -> Iterator[None]:
    """Puts the controls back afterwards."""
    yield
    if "panel" in request.fixturenames:
        panel = request.getfixturevalue("panel")
        panel.strength.value = panel.geometry.value = 1.0
        panel.style.value, panel.other.value, panel.split.value = panel.styles[0].name, NO_BLEND, False


def wait_for(panel: StylePanel) -> str:
    """What the panel says when it has done what it does."""
    end = time.monotonic() + 60
    while panel.restyling.is_busy:
        assert time.monotonic() < end, panel.restyling.message.content
        time.sleep(0.05)
    return shown_text(panel.restyling.message.content)


def description_with(panel: StylePanel, part: str) -> str:
    """What the panel says about its style, once that has a part: viser tells of a choice in a thread of its own."""
    end = time.monotonic() + 10
    while part not in (text := shown_text(panel.description.content)):
        assert time.monotonic() < end, text
        time.sleep(0.01)
    return text


def shown_text(markdown: str) -> str:
    """What a browser shows of escaped text."""
    return markdown.replace("<wbr />", "").replace("\\", "")


def png(seed: int) -> bytes:
    file = io.BytesIO()
    colors = np.random.default_rng(seed).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    Image.fromarray(colors).resize((64, 48)).save(file, format="PNG")
    return file.getvalue()


def test_sliders_change_the_viewers_picture_and_no_other(panel: StylePanel) -> None:
    camera = panel.pipeline.datamanager.train_dataset.cameras[:1]
    own = panel.pipeline.model.get_outputs_for_camera(camera)["rgb"]
    stylised = drawn(panel)
    panel.strength.value = 0.0
    assert torch.equal(drawn(panel), drawn(panel, "rgb_coarse"))
    assert (stylised - drawn(panel)).abs().max() > 0.1
    assert torch.equal(panel.pipeline.model.get_outputs_for_camera(camera)["rgb"], own)
    panel.strength.value, panel.geometry.value = 1.0, 0.0
    assert torch.equal(drawn(panel, "depth"), drawn(panel, "depth_coarse"))


def test_a_pictures_rays_are_made_once_and_its_depth_map_is_nerfstudios(
    panel: StylePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses, made = panel.pipeline.datamanager.train_dataset.cameras.camera_to_worlds, []
    state = CameraState(fov=0.8, aspect=1.5, c2w=poses[0], camera_type=CameraType.PERSPECTIVE)
    monkeypatch.setattr(adjustments, "pinhole_rays", lambda camera: made.append(camera) or pinhole_rays(camera))
    client = SimpleNamespace(camera=SimpleNamespace(aspect=1.5))

    def picture() -> Dict[str, torch.Tensor]:
        thread = RenderStateMachine(panel.viewer, 10.0, client)
        thread.state = "high"
        return thread._render_img(state)

    found = picture()
    assert len(made) == 1 and found["gl_z_buf_depth"].shape == found["depth"].shape
    monkeypatch.setattr(render_state_machine, "get_camera", get_camera)
    for name, value in picture().items():
        torch.testing.assert_close(found[name], value, atol=2e-3, rtol=1e-3)


def test_without_a_gpu_the_viewer_begins_with_baked_pictures(panel: StylePanel) -> None:
    assert panel.mode.value == "baked" and panel.mode.options == ("exact", "baked")
    drawn(panel)
    assert panel.pipeline.model.residual in panel.pipeline.model.baked.volumes


def test_several_threads_may_fill_one_volume_at_a_time(panel: StylePanel) -> None:
    model = panel.pipeline.model
    cameras = panel.pipeline.datamanager.train_dataset.cameras
    alone = [drawn(panel)]
    model.baked.volumes.clear()
    threads = [
        Drawing(lambda camera=camera: model.get_outputs_for_camera(camera)["rgb"])
        for camera in (cameras[:1], cameras[1:2], cameras[2:3]) * 2
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert torch.equal(threads[0].result, alone[0]) and torch.equal(threads[3].result, alone[0])


def test_volumes_are_filled_ahead_for_the_photos_cameras_and_those_between(
    panel: StylePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sparsestyle_ns.viewer.panel.SECONDS_UNTIL_BAKING", 0.0)
    end = time.monotonic() + 240
    while not panel.baker.is_done():
        assert time.monotonic() < end
        time.sleep(0.05)
    assert len(panel.baker.cameras) == 3 + 2 * STEPS_BETWEEN
    (filled,) = panel.baker.filled.values()
    assert filled == set(range(len(panel.baker.cameras)))
    monkeypatch.setattr(panel.pipeline.model.field, "density_and_feature", None)
    bundle = panel.baker.cameras[-1].generate_rays(camera_indices=0, keep_shape=True)
    thread = Drawing(lambda: panel.pipeline.model.get_outputs_for_camera_ray_bundle(bundle)["rgb"])
    thread.start()
    thread.join()
    assert max(thread.result.shape) == 252 and thread.result.std() > 0.05


def test_a_style_whose_volume_was_thrown_away_is_filled_ahead_again(
    panel: StylePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = panel.pipeline.model
    styles = [panel.styles[0], *(Style(str(number), model.new_style()) for number in range(MOST_BAKED))]
    monkeypatch.setattr(panel, "styles", styles)
    small = deepcopy(panel.baker.cameras[0])
    small.rescale_output_resolution(0.1)
    monkeypatch.setattr(panel.baker, "cameras", [small])
    model.baked.volumes.clear()

    def look_at(style: Style) -> None:
        panel.style.value = style.name
        assert not panel.baker.is_done()  # what was filled is gone, or never was there
        monkeypatch.setattr("sparsestyle_ns.viewer.panel.SECONDS_UNTIL_BAKING", 0.0)
        end = time.monotonic() + 60
        while not panel.baker.is_done():
            assert time.monotonic() < end
            time.sleep(0.05)
        monkeypatch.setattr("sparsestyle_ns.viewer.panel.SECONDS_UNTIL_BAKING", 1e9)

    for style in [*styles, styles[0]]:
        look_at(style)
    assert len(panel.baker.filled) == len(model.baked.volumes) == MOST_BAKED
    panel.style.value = styles[-1].name
    assert panel.baker.is_done()  # one of the latest
    forgotten = weakref.ref(styles.pop(1).field)
    del style
    gc.collect()
    assert forgotten() is None


def test_the_panel_says_what_made_the_style(panel: StylePanel) -> None:
    text = description_with(panel, "**Painting** painting.png")
    assert "![painting](data:image/jpeg;base64," in text
    assert "**Iterations** 3" in text
    assert "**Features** vgg16" in text and "coarse-fewshot" in text.split("**Coarse run**")[1]


def test_the_split_shows_coarse_and_stylised_and_stays_for_the_next_browser(panel: StylePanel) -> None:
    control_panel = panel.viewer.control_panel
    assert control_panel.output_render == "rgb" and not control_panel.split
    panel.split.value = True
    panel.apply_split()
    control_panel.update_output_options(list(control_panel._output_render.options))  # as for each new browser
    assert (control_panel.output_render, control_panel.split_output_render) == ("rgb_coarse", "rgb")
    assert control_panel.split


@pytest.mark.parametrize(
    "data, complaint",
    [
        (b"", "The style image upload.png is an empty file"),
        (b"this is no picture", "The style image upload.png is in no known image format"),
        (png(0)[:200], "The style image upload.png cannot be read as an image"),
    ],
)
def test_a_bad_upload_is_refused_in_a_sentence(panel: StylePanel, data: bytes, complaint: str) -> None:
    before = drawn(panel)
    panel.restyling.restyle_upload("../upload.png", data)
    said = wait_for(panel)
    assert said.startswith(f"**Not restyled.** {complaint}") and "\n" not in said
    assert torch.equal(drawn(panel), before) and len(panel.styles) == 1


@pytest.mark.parametrize(
    "path, complaint",
    [
        ("", "There is no image: write a path"),
        ("/nowhere/painting.png", "The style image /nowhere/painting.png does not exist"),
        ("/", "The style image / is a folder"),
        (os.devnull, "is no file"),
        ("\0", "Something went wrong in restyling"),
    ],
)
def test_a_bad_path_is_refused_in_a_sentence(panel: StylePanel, path: str, complaint: str) -> None:
    panel.restyling.path.value = path
    panel.restyling.restyle_path()
    assert complaint in wait_for(panel) and len(panel.styles) == 1


def test_an_error_in_the_middle_leaves_the_style_on_the_screen(
    panel: StylePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(panel.pipeline, "losses", fail)
    panel.restyling.restyle_upload("a.png", png(1))
    assert "RuntimeError: out of memory" in wait_for(panel)
    assert len(panel.styles) == 1 and drawn(panel).isfinite().all()
    assert not panel.restyling.stop_button.visible and not panel.restyling.bar.visible


def test_a_restyling_can_be_stopped_and_only_one_runs_at_a_time(
    panel: StylePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()
    monkeypatch.setattr(panel.restyling, "wait_for_rest", lambda: go_on.wait(30))
    panel.restyling.restyle_upload("a.png", png(1))
    panel.restyling.restyle_upload("b.png", png(2))
    assert panel.restyling.message.content == "One restyling at a time: wait for it, or stop it."
    panel.restyling.stop()
    go_on.set()
    assert wait_for(panel) == "Stopped; the style on the screen stays."
    assert len(panel.styles) == 1


def test_closing_ends_what_is_at_work(patterned_run: Path) -> None:
    with viewer_of(patterned_run) as panel:
        panel.restyling.iterations.value = 100_000
        panel.restyling.restyle_upload("a.png", png(1))
        threads = [panel.baker, panel.restyling.thread]
        assert all(thread.is_alive() for thread in threads)
        panel.close()
        assert not any(thread.is_alive() for thread in threads)
        assert panel.restyling.message.content == "Stopped; the style on the screen stays."


def test_training_and_restyling_are_told_apart_and_their_last_step_always(
    panel: StylePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sparsestyle_ns.viewer.restyling_controls.SECONDS_BETWEEN_TEXTS", 1e9)
    trainer = SimpleNamespace(config=SimpleNamespace(max_num_iterations=9), notes=dict, training_state="completed")
    monkeypatch.setattr(panel.viewer, "trainer", trainer)
    monkeypatch.setattr(panel, "_knows_training", True)
    told: List[str] = []
    for step in (0, 1, 8):
        content, style = torch.tensor([2.0, 3.0])
        panel.restyling.tell(Progress("Iteration", step / 8, 1.0, {"content": 4.0}))
        panel.show_losses(step, Losses({"content": content, "style": style}, {"content": 1.0, "style": 1.0}))
        told += [panel.training.content.split(":")[0], f"{panel.restyling.bar.value:.0f}"]
    panel.restyling.end("")
    assert told == ["Iteration 1 of 9", "0", "Iteration 1 of 9", "0", "Iteration 9 of 9", "100"]


def test_restyling_gives_a_style_that_blends_and_a_run_that_renders(
    panel: StylePanel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: List[str] = []
    tell = panel.restyling.tell
    monkeypatch.setattr(
        panel.restyling, "tell", lambda progress: [tell(progress), seen.append(drawn(panel).sum().item())]
    )
    first = drawn(panel)
    panel.restyling.stroke_size.value, panel.restyling.kept_structure.value = 1.3, 0.7
    panel.restyling.restyle_upload("other painting.png", png(3))
    said = wait_for(panel)
    assert said.startswith("**other painting** is ready. Saved as a run of its own: ")
    assert len(set(seen)) == 1  # the old style stays on the screen until the new one is ready
    assert panel.style.value == "other painting" and panel.other.options == (NO_BLEND, "painting", "other painting")
    assert "other painting.png" in panel.description.content
    second = drawn(panel)
    assert (first - second).abs().max() > 0.1
    assert not panel.blend.visible
    panel.other.value, panel.blend.value = "painting", 1.0
    assert torch.equal(drawn(panel), first)
    panel.blend.value = 0.5
    assert (drawn(panel) - first).abs().max() > 0.05 and (drawn(panel) - second).abs().max() > 0.05

    saved = max(panel.folder.parent.glob("20*"))
    assert str(saved) in said
    _, pipeline, step = load_run(saved / "config.yml")
    assert step == 2 and pipeline.config.style_image.read_bytes() == png(3)
    assert (pipeline.config.stroke_size, pipeline.config.kept_structure) == (1.3, 0.7)
    camera = pipeline.datamanager.train_dataset.cameras[:1]
    with pipeline.model.display.rendering("baked"):
        assert torch.equal(pipeline.model.get_outputs_for_camera(camera)["rgb"], second)
    render(saved, tmp_path / "pictures")
    assert len(list((tmp_path / "pictures").rglob("*.jpg"))) == 1

    # Everything calls it by its painting, and whoever may read the first run may read this one.
    assert collect_run(saved, num_views=1, frames=0).style_name == "other painting"
    assert load_scene(saved / "config.yml").title == "scene · other painting"
    assert saved.stat().st_mode == panel.folder.stat().st_mode
    assert not list(saved.parent.glob(".*"))


@pytest.fixture
def own_style_alone(panel: StylePanel) -> Iterator[None]:
    """Takes styles that a test adds from the list again."""
    count = len(panel.styles)
    yield
    del panel.styles[count:]
    panel.offer_styles(panel.styles[0].name)


@pytest.mark.parametrize(
    "broken, error",
    [
        ("torch.save", RuntimeError("PytorchStreamWriter failed writing file\ndata/0")),
        ("sparsestyle_ns.engine.restyling.tempfile.mkdtemp", OSError("no room")),
        ("sparsestyle_ns.engine.restyling.save_thumbnail", ValueError("anything else")),
    ],
)
def test_a_style_that_cant_be_saved_is_there_and_says_so_and_leaves_no_folder(
    panel: StylePanel, own_style_alone: None, monkeypatch: pytest.MonkeyPatch, broken: str, error: Exception
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    folders = set(panel.folder.parent.iterdir())
    count = len(panel.styles)
    monkeypatch.setattr(broken, fail)
    panel.restyling.restyle_upload("unsaved.png", png(3))
    reason = " ".join(str(error).split())
    assert wait_for(panel) == f"**unsaved** is ready. It is **not saved** ({reason}), and gone when the viewer ends."
    assert set(panel.folder.parent.iterdir()) == folders
    assert len(panel.styles) == count + 1 and panel.style.value == "unsaved"
    assert ("Run", f"not saved ({reason})") in panel.styles[-1].facts
    assert str(panel.folder) not in description_with(panel, f"not saved ({reason})")


def test_two_restylings_of_a_second_are_two_runs(panel: StylePanel, monkeypatch: pytest.MonkeyPatch) -> None:
    class StandingClock(datetime):
        times = iter([datetime(2020, 1, 1)] * 3 + [datetime(2020, 1, 2)])

        @classmethod
        def now(cls) -> datetime:
            return next(cls.times)

    monkeypatch.setattr("sparsestyle_ns.engine.restyling.datetime", StandingClock)
    restyling = Restyling(panel.restyling.workshop, Painting.received("a.png", png(1)), iterations=1)
    for _ in restyling:
        pass
    saved = [restyling.save(), restyling.save()]
    assert [folder.name for folder in saved] == ["2020-01-01_000000", "2020-01-02_000000"]
    for folder in saved:
        config = yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)
        assert config.timestamp == folder.name and config.pipeline.style_image.is_relative_to(folder)
        assert config.pipeline.style_image.read_bytes() == png(1)
        shutil.rmtree(folder)


def test_a_painting_called_nothing_is_blended_in_only_when_it_is_chosen(
    panel: StylePanel, own_style_alone: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Restyling, "save", lambda _: panel.folder)
    panel.restyling.restyle_upload(f"{NO_BLEND}.png", png(3))
    assert wait_for(panel).startswith(f"**{NO_BLEND} 2** is ready.")
    panel.style.value = panel.styles[0].name
    assert panel.shown() == (panel.pipeline.model.residual,)
    # The run's own painting may be called that, too.
    monkeypatch.setattr(panel, "styles", [])
    monkeypatch.setattr(panel.pipeline.config, "style_image", Path(f"{NO_BLEND}.png"))
    panel._name_own_style()
    assert [style.name for style in panel.styles] == [f"{NO_BLEND} 2"]


def render(run: Path, output: Path) -> None:
    from nerfstudio.scripts import render

    flags = ["--camera-path-filename", str(write_camera_path(output.parent)), "--output-format", "images"]
    arguments = ["camera-path", "--load-config", str(run / "config.yml"), "--output-path", str(output), *flags]
    run_entrypoint(render.entrypoint, arguments)


def write_camera_path(folder: Path) -> Path:
    """A path of one camera, in the form of the viewer's Render tab (another test makes one there)."""
    folder.mkdir(parents=True, exist_ok=True)
    camera = {"camera_to_world": np.eye(4).flatten().tolist(), "fov": 50, "aspect": 1}
    content = {
        "camera_type": "perspective",
        "render_height": 16,
        "render_width": 16,
        "camera_path": [camera],
        "fps": 1,
        "seconds": 1,
        "smoothness_value": 0.5,
        "is_cycle": False,
        "crop": None,
    }
    path = folder / "path.json"
    path.write_text(json.dumps(content))
    return path


def test_restyling_takes_the_trainers_steps(runs: SimpleNamespace, painting: Path) -> None:
    config = yaml.load((runs.style / "config.yml").read_text(), Loader=yaml.Loader)
    coarse = torch.load(next((runs.coarse / "nerfstudio_models").iterdir()), weights_only=True)["pipeline"]
    state = {name.removeprefix("_model."): value for name, value in coarse.items()}
    training = Training(config, torch.device("cpu"), state)
    pipeline = training.pipeline
    fresh = pipeline.model.new_style()
    pipeline.model.residual.load_state_dict(fresh.state_dict())
    for _ in warm_start(pipeline, pipeline.task, training.optimizers):
        pass
    for _ in range(3):
        training.step()

    workshop = Workshop(pipeline, runs.style, threading.Lock())
    workshop.new_field = lambda max_resolution: fresh
    frozen = [view.frozen for view in pipeline.scene_views.views]
    restyling = Restyling(workshop, Painting.read(painting), iterations=3)
    steps = list(restyling)
    assert [view.frozen for view in pipeline.scene_views.views] == frozen  # shared, not made again
    assert steps[-1].done == 1.0 and steps[-1].seconds_left == 0.0
    for name, value in pipeline.model.residual.state_dict().items():
        assert torch.equal(restyling.field.state_dict()[name], value), name


def test_a_restyling_sees_exact_views_between_the_photos_also_of_a_run_that_is_shown_baked(
    panel: StylePanel, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline = panel.pipeline
    monkeypatch.setattr(pipeline.config, "novel_views", 1)
    (camera,) = cameras_between(pipeline.datamanager.train_dataset.cameras, 1)
    with torch.no_grad():
        exact = pipeline.model.get_outputs_for_camera(camera)["rgb_coarse"]
        with pipeline.model.display.rendering("baked"):
            assert not torch.equal(pipeline.model.get_outputs_for_camera(camera)["rgb_coarse"], exact)
            assert torch.equal(pipeline.freeze_views().views[-1].picture, exact)


def test_random_numbers_of_training_go_on_as_if_there_were_no_restyling(panel: StylePanel) -> None:
    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    fields = [panel.restyling.workshop.new_field(64) for _ in range(2)]
    assert torch.equal(torch.rand(3), expected)
    assert all(map(torch.equal, fields[0].parameters(), fields[1].parameters()))


def test_markdown_leaves_plain_text_alone() -> None:
    assert plain("a_b*c`{d}<e>\nf/g-h.png") == r"a\_<wbr />b\*c\`\{d\}\<e\> f/<wbr />g-h.png"
