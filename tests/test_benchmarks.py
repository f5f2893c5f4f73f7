import copy
import importlib
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

sys.path.append(str(Path(__file__).resolve().parents[1]))  # benchmarks isn't installed

from nerfstudio.data.scene_box import SceneBox

from benchmarks import (
    _measure,
    _scene,
    before,
    effects,
    nnfm,
    profile,
    scaling,
    stability,
    stage1,
    summary,
    torch_options,
)
from benchmarks._measure import Duration, Options, Ratio, Report
from sparsestyle_ns.core.occupancy import Occupancy
from sparsestyle_ns.core.spaces import BoxSpace, ContractedSpace
from sparsestyle_ns.field_components.hash_grid import HashGrid
from sparsestyle_ns.fields.coarse import CoarseField
from sparsestyle_ns.fields.residual import ResidualField
from sparsestyle_ns.losses.nnfm import nnfm_loss
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.rendering.render import freeze_samples, render_stylised
from sparsestyle_ns.rendering.visible_samples import Marching
from sparsestyle_ns.utils import machine
from sparsestyle_ns.utils.errors import InputError

CPU = torch.device("cpu")
AMPLE = Ratio(12.5, (10.0, 15.0))


class FakeClock:
    """A clock that goes on only when work is done."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now

    def work(self, seconds):
        self.now += seconds


def durations(*seconds, stopped=False):
    return [Duration(one, stopped) for one in seconds]


@pytest.fixture
def options(tmp_path):
    return Options(device="cpu", threads=torch.get_num_threads(), output_dir=tmp_path)


@pytest.fixture(autouse=True)
def idle_machine(monkeypatch):
    """Spares each test the second of looking at the machine."""
    monkeypatch.setattr(machine.psutil, "cpu_percent", lambda interval: 4.0)


# ------------------------------------------------------------------------------------------------------------- timing


def test_contenders_take_turns_and_the_warm_up_does_not_count():
    calls = []

    def contender(name):
        def measure(repetition):
            calls.append((name, repetition))
            return Duration(float(repetition))

        return measure

    found = _measure.alternate({"a": contender("a"), "b": contender("b")}, repeats=2)
    assert calls == [("a", -1), ("b", -1), ("a", 0), ("b", 0), ("a", 1), ("b", 1)]
    assert found == {"a": durations(0, 1), "b": durations(0, 1)}


def test_only_the_work_is_on_the_clock():
    clock = FakeClock()

    def prepare(repetition):
        clock.work(100)
        return (3.0 + repetition,)

    measure = _measure.timed(clock.work, CPU, prepare, clock)
    assert [measure(repetition).seconds for repetition in (0, 1)] == [3, 4]


def test_ratios_are_taken_pair_by_pair_and_the_median_is_quoted():
    # Both slow down together in the second pair; the ratio of the sums would be 30 / 16.
    ratio = _measure.ratio_of_pairs(durations(8, 20, 2), durations(2, 10, 4))
    assert ratio == Ratio(2.0, (0.5, 4.0))


def test_a_stopped_peer_gives_a_lower_bound():
    peer = [Duration(20), Duration(30, stopped=True)]
    assert _measure.ratio_of_pairs(peer, durations(2, 2)) == Ratio(12.5, (10, 15), at_least=True)


def test_nothing_is_compared_with_what_never_finished():
    with pytest.raises(ValueError, match="never finished"):
        _measure.ratio_of_pairs(durations(1), durations(1, stopped=True))


def training(psnr_by_step, seconds=2.0):
    """Steps and checks of a field that has these PSNRs after its iterations."""
    done = iter(psnr_by_step)
    state = SimpleNamespace(psnr=0.0)

    def step():
        state.psnr = next(done)
        return seconds

    return step, lambda: state.psnr


def test_time_to_a_psnr_lies_between_the_checks_around_it():
    step, evaluate = training([10, 12, 15, 18, 20, 22])
    duration, history = stage1.time_to_reach(step, evaluate, target=19.0, check_every=2)
    assert history == [(4, 12), (8, 18), (12, 22)]
    assert duration == Duration(9.0)


def test_a_field_that_is_there_at_the_first_check_has_the_time_of_that():
    assert stage1.time_to_reach(*training([5, 20]), target=19.0, check_every=2)[0] == Duration(4.0)


def test_training_that_takes_too_long_is_stopped_after_a_last_check():
    duration, history = stage1.time_to_reach(*training([10, 11, 12, 13]), target=19.0, check_every=50, max_seconds=5.0)
    assert duration == Duration(6.0, stopped=True)
    assert history == [(6.0, 12)]


def test_training_that_gets_there_as_its_time_runs_out_is_not_a_lower_bound():
    duration, _ = stage1.time_to_reach(*training([10, 19.5]), target=19.0, check_every=50, max_seconds=4.0)
    assert duration == Duration(4.0)


def test_training_ends_with_its_iterations():
    duration, _ = stage1.time_to_reach(*training([1, 2, 3, 4]), target=19.0, check_every=50, max_steps=3)
    assert duration == Duration(6.0, stopped=True)


# -------------------------------------------------------------------------------------------------------------- files


def write_report(options, ratio=AMPLE, target=10.0, name="hash_grid", **more):
    report = Report(name, options)
    report.measure("part", {"ours": lambda repetition: Duration(2.0)}, repeats=2)
    report.add_row(name, "a thing", "another", ratio, target, **more)
    return json.loads(report.write().read_text())


def test_a_report_says_what_was_measured_where_and_when(options):
    content = write_report(options)
    assert {"python", "torch", "numpy", "nerfstudio"} <= content["versions"].keys()
    assert content["device"] and content["threads"] == options.num_threads
    assert content["matrix_products"] in ("bfloat16", "float32")
    assert content["date"].endswith("+00:00")
    assert {"commit", "dirty", "note"} <= content.keys()
    assert content["repetitions"] == {"part": {"ours": {"seconds": [2.0, 2.0]}}}
    (row,) = content["rows"]
    assert row == {
        "name": "hash_grid",
        "what": "a thing",
        "against": "another",
        "device": content["device"],
        "ratio": 12.5,
        "spread": [10.0, 15.0],
        "target": 10.0,
    }


def test_a_stopped_repetition_is_recorded_as_such(options):
    report = Report("stage1_even", options)
    report.measure("part", {"peer": lambda repetition: Duration(9.0, stopped=True)}, repeats=1)
    assert report.content()["repetitions"]["part"]["peer"] == {"seconds": [9.0], "stopped": [True]}


def test_load_by_other_processes_marks_a_report(options, monkeypatch):
    monkeypatch.setattr(machine.psutil, "cpu_percent", lambda interval: 55.0)
    load = write_report(options)["load_of_others"]
    assert load["before"] == 0.55 and load["busy"]


def test_summary_collects_rows_and_marks_what_misses_its_target(options, tmp_path, capsys):
    write_report(options)
    write_report(options, Ratio(1.5, (1.4, 1.6)), 2.0, "nnfm", bytes=2_500_000_000, against_bytes=3_000_000_000)
    write_report(options, Ratio(21.0, (21.0, 21.0), at_least=True), 20.0, "stage1_even")
    summary.main(options)
    rows = json.loads((tmp_path / "summary.json").read_text())
    assert [(row["name"], row["met"]) for row in rows] == [("stage1_even", True), ("hash_grid", True), ("nnfm", False)]
    assert [row.get("at_least", False) for row in rows] == [True, False, False]
    assert all(row["commit"] == rows[0]["commit"] for row in rows)
    table = (tmp_path / "summary.md").read_text().splitlines()
    assert len(table) == 2 + len(rows)
    assert "| ≥ 21 (21 – 21) | 20 | yes |" in table[2]
    assert "| 1.5 (1.4 – 1.6) | 2 | **no** |" in table[4]
    assert "peak 2.50 against 3.00 GB" in table[4]
    assert "2 of 3 meet their targets; not: nnfm" in capsys.readouterr().out


def test_a_lower_bound_below_the_target_is_not_called_a_miss(options, tmp_path):
    write_report(options, Ratio(5.0, (5.0, 5.0), at_least=True), 20.0, "stage1_even")
    (row,) = summary.collect(tmp_path)
    assert not row["met"]
    assert "not known" in summary.table([row])


def test_memory_is_as_good_from_a_busy_machine():
    row = {"busy": True, "bytes": 6_500_000_000}
    assert summary._remarks({**row, "timed": False}) == ["peak 6.50 GB"]
    assert summary._remarks(row) == ["**machine was busy**", "peak 6.50 GB"]


def test_summary_of_nothing_says_so(options):
    with pytest.raises(SystemExit, match="There are no results in"):
        summary.main(options)


def test_quick_results_never_replace_real_ones():
    assert Options().results == _measure.ROOT / "benchmarks" / "results"
    folders = {Options(quick=quick, sample=sample).results for quick in (False, True) for sample in (False, True)}
    assert len(folders) == 4


# -------------------------------------------------------------------------------------------------------------- scene


def test_missing_data_ends_with_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setenv("SPARSESTYLE_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match=r"There is no .*nowhere/llff/fern: .* --sample"):
        _scene.find_scene(Options())


def test_impossible_options_end_with_one_sentence(options):
    options.repeats = 0
    with pytest.raises(InputError, match="--repeats is 0, but has to be at least 1"):
        options.set_up()


def test_photos_are_brought_to_a_size_also_a_larger_one(llff_scene, painting):
    scene = _scene.Scene("tiny", llff_scene, painting)
    for side in (16, 64):
        photos = _scene.load_photos(scene, side).train_dataset
        assert photos[0]["image"].shape == (side * 3 // 4, side, 3)
        assert photos.cameras.width[0].item() == side


@pytest.mark.parametrize("background", [None, (1.0, 0.5, 0.0)])
@pytest.mark.parametrize(
    "space", [BoxSpace(SceneBox(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3]))), ContractedSpace()], ids=["box", "open"]
)
def test_the_plain_way_gives_the_picture_and_the_gradients_that_ours_gives(space, background, monkeypatch):
    torch.manual_seed(0)
    coarse = CoarseField(3, 2, 16, feature_dim=4, direction_levels=None, density_activation="exp").requires_grad_(False)
    grid = HashGrid(num_levels=2, min_resolution=4, max_resolution=8, log2_table_size=10, init_scale=1.0)
    residual = ResidualField(grid, feature_dim=4, layer_width=16)
    torch.nn.init.normal_(residual.density_head.weight)
    color = None if background is None else torch.tensor(background)
    origins = 3 * torch.nn.functional.normalize(torch.randn(20, 3), dim=-1)
    directions = torch.nn.functional.normalize(torch.rand(20, 3) - 0.5 - origins, dim=-1)

    marching = Marching(Occupancy(4), _scene.PLAIN_SAMPLES, space.unbounded, min_transmittance=0.0)
    frozen = freeze_samples(coarse, residual, space.segments(origins, directions), marching)
    ours = render_stylised(residual, frozen, color).rgb
    monkeypatch.setattr(_scene, "PLAIN_RAYS_PER_CHUNK", 7)
    plain_field = _scene.PlainField(coarse, residual, space, color)
    plain = plain_field.render(origins, directions)
    # Sums of 64 samples in float32, and corners' features summed in another order.
    torch.testing.assert_close(plain, ours, atol=1e-5, rtol=0)
    target = torch.rand(20, 3)
    for picture in (ours, plain):
        (picture - target).square().sum().backward()
    torch.testing.assert_close(plain_field.encoding.hash_table.grad, residual.grid.table.grad, atol=1e-4, rtol=1e-3)
    with torch.no_grad():
        torch.testing.assert_close(plain_field.render(origins, directions), plain)


def test_arf_written_out_gives_our_loss_and_gradient(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    view, style, content = (torch.rand(rows, 24, generator=generator) for rows in (50, 70, 50))
    monkeypatch.setattr(nnfm, "SIMILARITIES_AT_ONCE", 16 * len(style))
    torch.testing.assert_close(nnfm.arf_nnfm(view, style), nnfm_loss(view, style))
    for one, other in zip(
        nnfm.forward_backward(nnfm.ours, view, style, content),
        nnfm.forward_backward(nnfm.reference, view, style, content),
        strict=True,
    ):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-4)


def test_contenders_that_differ_are_not_timed():
    with pytest.raises(RuntimeError, match=r"colours: the contenders differ by 0\.5"):
        _measure.check_equal(torch.tensor([1.0, 3.0]), torch.tensor([2.0, 2.0]), "colours", 1e-3)


def test_vanilla_nerf_is_made_without_a_network_and_with_its_own_settings(llff_scene, painting, options):
    options = stage1.Stage1Options(**vars(options))
    scene = _scene.Scene("tiny", llff_scene, painting)
    contender = stage1.make_training("vanilla-nerf", scene, options, CPU, seed=0)
    pipeline = contender.pipeline
    assert type(pipeline.model).__module__ == "nerfstudio.models.vanilla_nerf"
    assert pipeline.datamanager.matched is None
    assert pipeline.datamanager.config.train_num_rays_per_batch == 1024
    assert type(contender.optimizers.optimizers["fields"]).__name__ == "RAdam"
    assert 1.0 < pipeline.model.collider.near_plane < pipeline.model.collider.far_plane
    pipeline.datamanager.config.train_num_rays_per_batch = 8
    before = [parameter.clone() for parameter in pipeline.model.parameters()]
    contender.step()
    assert any(not torch.equal(old, new) for old, new in zip(before, pipeline.model.parameters(), strict=True))


def test_effects_are_timed_with_and_without_each_other(tmp_path, monkeypatch):
    monkeypatch.setattr(effects, "CACHE", tmp_path / "cache")
    only = ("exposure", "lens_distortion", "residual_density", "palette")
    here = {"device": "cpu", "threads": torch.get_num_threads(), "output_dir": tmp_path}
    effects.main(effects.EffectOptions(quick=True, repeats=1, only=only, **here))
    content = json.loads((tmp_path / "effects.json").read_text())
    assert tuple(row["name"] for row in content["rows"]) == only
    assert all(row["with_over_without"] > 0 for row in content["rows"])
    with pytest.raises(SystemExit, match="shadow"):
        effects.main(effects.EffectOptions(device="cpu", output_dir=tmp_path, only=("shadow",)))


@pytest.mark.parametrize("path", sorted(Path(_measure.__file__).parent.glob("[a-z]*.py")), ids=lambda path: path.stem)
def test_every_benchmark_finds_what_it_measures(path):
    assert callable(importlib.import_module(f"benchmarks.{path.stem}").main)


def test_a_benchmark_can_be_run_as_a_command(tmp_path):
    command = [sys.executable, "-m", "benchmarks.hash_grid", "--quick", "--repeats", "1", "--device", "cpu"]
    done = subprocess.run([*command, "--output-dir", str(tmp_path)], cwd=_measure.ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "hash_grid.json").read_text())
    assert content["quick"]
    assert [row["name"] for row in content["rows"]] == ["hash_grid_forward", "hash_grid_forward_backward"]
    assert all(len(one["seconds"]) == 1 for part in content["repetitions"].values() for one in part.values())


# ------------------------------------------------------------------------------------------------------------ profile


def test_operators_are_gathered_into_parts_whose_shares_sum_to_one():
    times = [("aten::addmm", 30.0), ("aten::mm", 10.0), ("_FusedBackward", 40.0), ("aten::mul", 20.0)]
    found = profile.gather(times)
    assert {part: content["share"] for part, content in found.items()} == pytest.approx(
        {"hash grid": 0.4, "matrix products": 0.4, profile.REST: 0.2}
    )
    assert list(found["matrix products"]["operators"]) == ["aten::addmm", "aten::mm"]


def test_options_of_torch_are_set_beside_the_usual_way_and_beside_float32():
    seconds = {"as it is": durations(2.0, 4.0), "float32": durations(3.0, 3.0), "fast": durations(1.0, 1.0)}
    results = {
        "as it is": torch.tensor([3.0, 4.0]),
        "float32": torch.tensor([3.0, 4.0]),
        "fast": torch.tensor([3.0, 3.5]),
    }
    rows = torch_options.times_as_fast(seconds, results)
    assert rows["fast"] == {
        "seconds": 1.0,
        "times_as_fast": 3.0,
        "spread": [2.0, 4.0],
        "distance_to_float32": pytest.approx(0.1),
    }
    assert rows["as it is"]["times_as_fast"] == 1.0
    assert torch_options.distance(torch.tensor([1, 2, 3, 4]), torch.tensor([1, 2, 0, 4])) == 0.25


def test_an_option_that_doesnt_run_here_is_named_and_left_out(capsys):
    def fails():
        raise RuntimeError("no compiler\nand more")

    works = {"as it is": lambda: torch.ones(1), "float32": lambda: torch.ones(1), "torch.compile": fails}
    assert list(torch_options.tried(works)) == list(works) == ["as it is", "float32"]
    assert capsys.readouterr().out == "torch.compile doesn't run here: RuntimeError no compiler\n"
    with pytest.raises(RuntimeError, match="no compiler"):
        torch_options.tried({"as it is": fails})


@pytest.mark.parametrize("make", [torch_options.residual_works, torch_options.coarse_works])
def test_options_of_torch_do_the_same_work(make, monkeypatch):
    monkeypatch.setattr(torch_options, "HashGrid", lambda: HashGrid(2, 4, 8, 2, 8))
    works = make(50, CPU)
    assert list(works) == ["as it is", "float32", "bfloat16", "torch.compile"]
    exact = works["float32"]()
    assert exact.norm() > 0
    for name in ("as it is", "bfloat16"):
        assert (works[name]() - exact).norm() < 0.05 * exact.norm()


def test_stage_1_is_compared_with_fields_that_look_at_every_sample(monkeypatch):
    ours = method_config(stage1.COARSE_METHOD)
    monkeypatch.setattr(stage1, "our_config", lambda scene, options: copy.deepcopy(ours))
    even, dense = (config(None, None).pipeline for config in (stage1.even_config, stage1.dense_config))
    assert (even.effects.empty_space, dense.effects.empty_space) == ("off", "off")
    assert even.model.num_samples == dense.model.num_samples == stage1.EVEN_SAMPLES
    assert even.model.thinning > 0 and dense.model.thinning == 0


# --------------------------------------------------------------------------------------------------- earlier versions


class FakeVersion:
    """Says of each piece of work that it took these seconds, one after another."""

    def __init__(self, **seconds):
        self.seconds = {name: iter(values) for name, values in seconds.items()}

    def ask(self, line):
        if line == "facts":
            return {"coarse_iterations": 1000, "warm_start_steps": 10, "style_iterations": 100, "size": [8, 6]}
        return {"seconds": next(self.seconds[line])}


def test_an_earlier_versions_whole_is_its_seconds_an_iteration_times_its_iterations(options):
    options.repeats = 3
    warm_up = [9.0] * (before.WARM_COARSE_STEPS + 1)
    version = FakeVersion(
        coarse_step=[*warm_up, 0.5, 0.25, 1.0], warm_start_step=[9.0, 1.0, 2.0, 3.0], style_step=[9.0, 4.0, 4.0, 5.0]
    )
    found = before.extrapolate(version, Report("before", options))
    assert found["iterations"] == {"coarse_step": 1000, "warm_start_step": 10, "style_step": 100}
    assert found["seconds"] == {"median": 500 + 20 + 400, "least": 250 + 10 + 400, "most": 1000 + 30 + 500}


def test_an_earlier_version_that_isnt_one_is_said(tmp_path):
    with pytest.raises(SystemExit, match="has no sparsestyle_ns; name a git worktree"):
        before.main(before.BeforeOptions(before=tmp_path, device="cpu"))


def test_a_version_that_ends_before_it_answers_is_said(tmp_path, monkeypatch):
    script = tmp_path / "worker.py"
    script.write_text("import sys\nfor line in sys.stdin:\n    print(len(line), flush=True)\n    break\n")
    monkeypatch.setattr(before, "WORKER", script)
    version = before.Version(tmp_path, {"threads": 1})
    assert version.ask("abc") == 4
    with pytest.raises(InputError, match="couldn't do abc"):
        version.ask("abc")
    version.end()


def test_costs_are_drawn_over_the_size_of_the_photos(tmp_path):
    points = [
        {"size": [side, side * 3 // 4], "seconds": [side / 100, side / 90], "peak_bytes": side * 10**7}
        for side in scaling.SIDES
    ]
    scaling.plot({cost: points for cost in scaling.COSTS}, tmp_path / "images" / "scaling.png")
    assert (tmp_path / "images" / "scaling.png").stat().st_size > 1000


# ---------------------------------------------------------------------------------------------------------- stability


def test_the_largest_stable_rate_is_the_last_before_the_first_that_fails():
    trials = [stability.Trial(1.0, 0.2, 0), stability.Trial(2.0, 0.1, 0), stability.Trial(4.0, 0.29, 0)]
    assert stability.largest_stable(trials) == 4.0
    for loss, skipped in ((0.31, 0), (0.1, 1), (float("nan"), 0), (float("inf"), 0)):
        bad = stability.Trial(8.0, loss, skipped)
        assert stability.largest_stable([*trials, bad, stability.Trial(16.0, 0.1, 0)]) == 4.0


def test_a_default_that_doesnt_train_is_said():
    with pytest.raises(InputError, match="Not even the default"):
        stability.largest_stable([stability.Trial(1.0, float("nan"), 0)])
