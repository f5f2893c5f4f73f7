"""The whole command on a tiny scene. Its clock goes on by a hundredth of a second with every look at it, so that what
fits into the budget doesn't depend on the machine."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

sys.path.append(str(Path(__file__).parent))

from clock import FakeClock

from sparsestyle_ns.cli import main
from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.data.parser_choice import parse_dataparser
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.studies import tradeoff
from sparsestyle_ns.studies.measure_training import StageRuns
from sparsestyle_ns.studies.study import Study, get_setting
from sparsestyle_ns.studies.study_options import TradeoffOptions
from sparsestyle_ns.studies.time_budget import Budget
from sparsestyle_ns.studies.workbench import Workbench, squeezed
from sparsestyle_ns.utils.errors import InputError

TICK = 0.01
COARSE_FLAGS = (
    *("--pipeline.datamanager.train-num-rays-per-batch", "32"),
    *("--pipeline.model.coarse-field.layer-width", "16"),
    *("--pipeline.model.coarse-field.feature-dim", "4"),
    *("--pipeline.model.num-eval-samples", "8"),
    *("--pipeline.model.num-steps", "16"),
    *("--pipeline.model.volume-resolution", "8"),
    *("--pipeline.model.precision", "float32"),
)
STYLE_FLAGS = (
    *("--pipeline.warm-start-steps", "1"),
    *("--pipeline.feature-side", "48"),
    *("--pipeline.model.hash-levels", "2"),
    *("--pipeline.model.log2-table-size", "10"),
    *("--pipeline.model.num-steps", "8"),
    *("--pipeline.model.layer-width", "16"),
    *("--pipeline.model.occupancy-resolution", "8"),
    *("--pipeline.model.bake-resolution", "32"),
    *("--pipeline.model.precision", "float32"),
    *("--pipeline.effects.residual-density", "on"),
)
STYLISED_SAMPLES = ("stylised samples, no residual density", "stylised samples, residual density")
AXES = {
    "training": ["stage-1 iterations", "width", "levels", "batch"],
    "quadrature": ["samples", "steps", "skipping", "stopping", *STYLISED_SAMPLES],
    "fine-field": ["hash levels", "resolution", "table"],
    "style": ["stage-2 iterations", "feature size", "style features"],
    "rendering": ["baking"],
    "precision": ["precision"],
}


def make_study(scene, dataparser=None, **more):
    tiny = {"coarse_iterations": 8, "style_iterations": 2, "coarse_flags": COARSE_FLAGS, "style_flags": STYLE_FLAGS}
    return Study(scene, dataparser or LLFFDataParserConfig(), **tiny, **more)


def measure(scene, folder, seconds, dataparser=None, **more):
    clock = FakeClock(TICK)
    options = TradeoffOptions(scene, output_dir=folder, rounds=1, **more)
    return tradeoff.measure(make_study(scene, dataparser), options, Budget(seconds, clock)), clock


@pytest.fixture(scope="module")
def content(llff_scene, painting, tmp_path_factory):
    """The JSON report of a run with time for everything."""
    folder = tmp_path_factory.mktemp("report")
    report, _ = measure(llff_scene, folder, 1000.0, style_image=painting)
    report.write(folder)
    return json.loads((folder / "tradeoff.json").read_text())


def points_of(content, name):
    (axis,) = (axis for axis in content["axes"] if axis["name"] == name)
    return {(point["setting"], point["moment"]): point["values"] for point in axis["points"]}


def test_every_axis_is_measured_where_there_is_time(content):
    found = {}
    for axis in content["axes"]:
        found.setdefault(axis["group"], []).append(axis["name"])
    assert found == AXES
    unavailable = [line for line in content["left_out"] if "has no instructions" not in line]
    assert unavailable == []


def test_every_axis_has_a_front_one_recommended_point_and_a_flag(content):
    for axis in content["axes"]:
        assert sum(point["recommended"] for point in axis["points"]) == 1, axis["name"]
        assert any(point["on_front"] for point in axis["points"]), axis["name"]
        assert axis["flag"].startswith("--"), axis["name"]
    assert len(content["recommendation"]) == len(content["axes"])


def test_every_flag_is_one_of_the_methods(content):
    configs = [method_config("coarse-fewshot"), method_config("hier-style")]
    for axis in content["axes"]:
        place = axis["flag"].removeprefix("--").replace("-", "_")
        assert any(has_setting(config, place) for config in configs), axis["flag"]


def has_setting(config, place):
    try:
        get_setting(config, place)
    except AttributeError:
        return False
    return True


def test_more_samples_come_closer_to_the_converged_render(content):
    samples = points_of(content, "samples")
    errors = [samples[str(number), ""]["rmse"]["median"] for number in (2, 4, 8, 16)]
    assert errors[-1] < errors[0]
    (axis,) = (axis for axis in content["axes"] if axis["name"] == "samples")
    assert axis["observed_order"] > 0
    assert "256 even samples" in axis["note"]


@pytest.mark.parametrize("name", STYLISED_SAMPLES)
def test_few_samples_of_the_stylised_field_are_compared_with_16_times_as_many(content, name):
    points = points_of(content, name)
    assert [setting for setting, _ in points] == ["2", "4", "8"]
    assert points["8", ""]["rmse"]["median"] <= points["2", ""]["rmse"]["median"]
    (axis,) = (axis for axis in content["axes"] if axis["name"] == name)
    assert axis["flag"] == "--pipeline.model.num-eval-samples"
    assert "128 samples" in axis["note"]


def test_training_is_one_run_with_several_moments(content):
    run = points_of(content, "stage-1 iterations")
    seconds = [values["train_seconds"]["median"] for values in run.values()]
    assert len(seconds) > 2
    assert seconds == sorted(seconds)
    assert max(int(setting) for setting, _ in run) == 8
    assert {setting for setting, _ in points_of(content, "width")} == {"16", "8", "4"}


def test_fine_fields_are_compared_by_time_an_iteration_and_memory(content):
    for values in points_of(content, "table").values():
        assert values["step_seconds"]["median"] > 0
        assert values["memory_mb"]["median"] > 0
        assert 0 <= values["style_loss"]["median"] <= 1


def test_baked_pictures_are_compared_with_exact_ones(content):
    points = points_of(content, "baking")
    assert points["exact", ""]["rmse"]["median"] == 0
    assert points["256", ""]["psnr"]["median"] > points["64", ""]["psnr"]["median"] - 3
    assert {"first_seconds", "memory_mb", "fps"} <= points["64", ""].keys()


def test_without_a_painting_what_stylises_is_left_out(llff_scene, tmp_path):
    report, _ = measure(llff_scene, tmp_path, 1000.0, groups=("style", "rendering"))
    assert report.left_out == ["Style (stage 2): there is no painting; name one with --style-image."]
    assert [axis.name for axis in report.measured] == ["stage-1 iterations", "baking"]
    assert "there is no painting" in report.measured[1].note


def test_a_blender_scene_is_measured_too(tmp_path):
    import make_sample_scene

    sizes = ["--num-train", "9", "--num-val", "1", "--num-test", "1", "--width", "16"]
    make_sample_scene.main([str(tmp_path), "--layout", "blender", *sizes])
    scene = tmp_path / "blender"
    report, _ = measure(scene, tmp_path, 1000.0, parse_dataparser((), scene), groups=("quadrature",))
    assert [axis.name for axis in report.measured] == ["stage-1 iterations", *AXES["quadrature"]]


def test_the_budget_is_kept_and_what_does_not_fit_is_named(llff_scene, painting, tmp_path):
    report, clock = measure(llff_scene, tmp_path, 2.0, style_image=painting)
    # Only what is under way when time runs out may still end: a few looks at the clock.
    assert clock.now <= 2.0 + 20 * TICK
    assert report.measured
    assert any("no time was left" in line for line in report.everything_left_out())
    report.write(tmp_path)


def test_ctrl_c_leaves_a_report_of_what_there_was(llff_scene, tmp_path, monkeypatch):
    def interrupt(self, curves, budget):
        raise KeyboardInterrupt

    monkeypatch.setattr(StageRuns, "_short", interrupt)
    report, _ = measure(llff_scene, tmp_path, 1000.0, groups=("training",))
    assert [axis.name for axis in report.measured] == ["stage-1 iterations"]
    assert report.left_out == ["Stopped by Ctrl-C; what was measured before is here."]


def test_a_coarse_run_is_taken_where_one_is_given(runs, llff_scene):
    bench = Workbench(make_study(llff_scene), Budget(1000.0, FakeClock(TICK)), coarse_run=runs.coarse)
    assert bench.coarse_model.config.coarse_field.layer_width == 32
    assert 0 < bench.own_error < 1
    assert bench.model_to_render().field.feature_dim == 8


def test_a_coarse_run_of_other_views_is_refused(runs, llff_scene):
    with pytest.raises(InputError, match="doesn't fit"):
        Workbench(make_study(llff_scene, num_views=2), Budget(1000.0, FakeClock(TICK)), coarse_run=runs.coarse)


def test_a_squeezed_run_has_its_presets_schedules_and_a_share_of_its_warm_start():
    coarse = squeezed(method_config("coarse-fewshot-draft"), 250)
    assert coarse.max_num_iterations == 250
    preset = method_config("hier-style-draft")
    style = squeezed(preset, 20)
    assert style.pipeline.warm_start_steps == 8
    assert preset.pipeline.warm_start_steps == 30
    # What is at which size of the views, and how the content weight falls there, is in shares of the iterations.
    ends = [
        (level.scale, config.pipeline.weights_at(level.first + level.length - 1, level)["content"])
        for config in (style, preset)
        for level in config.pipeline.levels(config.max_num_iterations)
    ]
    assert ends[:2] == ends[2:]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--data", "{tmp}/gone"], "Error: There is no scene at --data {tmp}/gone; name its folder"),
        (["--data", "{tmp}"], "Error: {tmp} has none of poses_bounds.npy"),
        (["--data", "{tmp}", "--budget", "soon"], "Error: --budget soon is no duration"),
        (["--data", "{tmp}", "--rounds", "0"], "Error: --rounds is 0"),
    ],
)
def test_what_can_not_be_used_is_said_in_one_sentence(tmp_path, arguments, sentence):
    with pytest.raises(SystemExit) as ended:
        main(["tradeoff", *(argument.format(tmp=tmp_path) for argument in arguments)])
    assert ended.value.code.startswith(sentence.format(tmp=tmp_path))
    assert "\n" not in ended.value.code


def test_the_last_line_names_the_report_and_trains_on_the_scene(tmp_path, monkeypatch, capsys):
    (tmp_path / "poses_bounds.npy").touch()
    report = SimpleNamespace(
        write=lambda folder: folder / "index.html",
        measured=["a curve"],
        recommendation=["Take 4."],
        everything_left_out=lambda: [],
        left_out=[],
    )
    monkeypatch.setattr(tradeoff, "measure", lambda *_: report)
    options = TradeoffOptions(
        tmp_path, ("llff-data", "--eval-interval", "4"), output_dir=tmp_path, max_image_side=64, num_views=4
    )
    tradeoff.tradeoff(options)
    train = f"ns-train coarse-fewshot-draft --num-views 4 --max-image-side 64 --data {tmp_path} llff-data"
    last = f"Made {tmp_path / 'index.html'} – next: {train} --eval-interval 4"
    assert capsys.readouterr().out.splitlines() == ["Take 4.", last]


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        ([], "Error: Nothing could be measured in the time there was; give a larger --budget."),
        (["--groups", "style"], "Error: Nothing could be measured: Style (stage 2): there is no painting; name one"),
    ],
)
def test_where_nothing_is_measured_there_is_no_report(llff_scene, tmp_path, flags, sentence):
    command = ["tradeoff", "--data", str(llff_scene), "--budget", "0.1s", "--output-dir", str(tmp_path / "a" / "b")]
    with pytest.raises(SystemExit) as ended:
        main([*command, *flags])
    assert ended.value.code.startswith(sentence)
    assert not list(tmp_path.iterdir())


def test_options_become_the_study(tmp_path):
    (tmp_path / "poses_bounds.npy").touch()
    options = TradeoffOptions(tmp_path, full=True, view_ids=(1, 2), backbone="vgg16", vgg_weights=Path("mine.pth"))
    study = tradeoff.study_of(options)
    config = study.config("hier-style", style_image=Path("hat.jpg"))
    assert (config.method_name, config.pipeline.style_image) == ("hier-style", Path("hat.jpg"))
    assert (config.pipeline.backbone, config.pipeline.vgg_weights) == ("vgg16", Path("mine.pth"))
    assert config.pipeline.datamanager.view_ids == (1, 2)
    assert config.pipeline.datamanager.max_image_side == method_config("hier-style").pipeline.datamanager.max_image_side
