"""Comparison and ablations from flags to page, on a tiny scene."""

import json
import re
import shutil
from html import escape
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import TINY, TINY_STYLE
from nerfstudio.scripts import train
from nerfstudio.utils import writer
from PIL import Image

from sparsestyle_ns import cli
from sparsestyle_ns.cli import main
from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.engine.previews import preview_path
from sparsestyle_ns.evaluation.tables import LABELS
from sparsestyle_ns.pipelines.hier_style import HierStylePipelineConfig
from sparsestyle_ns.studies import front, paper_studies, run_figures
from sparsestyle_ns.studies.paper_runs import COARSE_KINDS, STYLE_KINDS, PaperRuns
from sparsestyle_ns.studies.paper_studies import (
    OF_METHODS,
    PAPER_ROWS,
    ROWS_OF_2D,
    ablations,
    loss_plots,
    moving_mean,
    needed_runs,
    smoothing,
    study_sections,
)
from sparsestyle_ns.studies.run_figures import PaintingMeasure, measure_run, read_figures
from sparsestyle_ns.studies.run_queue import Run, RunQueue
from sparsestyle_ns.studies.study import Study
from sparsestyle_ns.studies.study_options import StudyOptions
from sparsestyle_ns.studies.study_page import study_page
from sparsestyle_ns.style.backbones import BACKBONES


def paper_runs(scene: Path = Path("fern"), folder: Path = Path("outputs"), **settings: object) -> PaperRuns:
    return PaperRuns(Study(scene, LLFFDataParserConfig(), **settings), folder)


def ablation_runs(runs: PaperRuns, painting: Path) -> list:
    return needed_runs(runs, ablations(runs.coarse_kinds()), [painting])


def test_the_comparisons_runs_are_ours_arfs_kind_and_freenerfs(painting: Path) -> None:
    found = needed_runs(paper_runs(), [OF_METHODS], [painting])
    assert [(run.coarse.name, run.name.split("-")[1]) for run in found] == [
        ("ours", "arf"),
        ("freenerf", "arf"),
        ("ours", "ours"),
    ]
    arf = dict(found[0].settings)
    assert arf["pipeline.model.stylised_field"] == "coarse"
    assert arf["pipeline.content_decay"] == arf["pipeline.content_restart"] == 1.0
    assert dict(found[1].coarse.settings)["pipeline.model.frequency_reveal"] == 0.9
    assert found[2].coarse.settings == ()
    assert dict(found[2].settings) == {"logging.steps_per_log": 1, "pipeline.backbone": "vgg16-shift-tolerant"}


def test_each_ablation_of_the_paper_is_a_run_and_none_is_done_twice(painting: Path) -> None:
    found = ablation_runs(paper_runs(), painting)
    names = [run.name.removesuffix(f"-{painting.stem}") for run in found]
    assert len(set(names)) == len(names)
    kinds = ("ours", "paper", "vanilla", "dietnerf", "freenerf")
    framework = {f"{coarse}-{style}" for coarse in kinds for style in ("ours", "arf")}
    assert set(names) == framework | {f"ours-{kind}" for kind in STYLE_KINDS}
    assert {run.name for run in needed_runs(paper_runs(), [OF_METHODS], [painting])} <= {run.name for run in found}
    assert {run.pictures for run in found} == {(20, 80)}
    assert {run.pictures for run in ablation_runs(paper_runs(draft=False), painting)} == {(20, 100, 200)}
    assert {run.pictures for run in ablation_runs(paper_runs(style_iterations=50), painting)} == {(20, 50)}


def test_without_a_feature_network_the_semantic_loss_is_left_out_and_said_to_be(
    painting: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kind in BACKBONES.values():
        monkeypatch.setattr(kind, "find_weights", lambda: None)
    runs = paper_runs()
    kinds = runs.coarse_kinds()
    assert kinds == ("ours", "paper", "vanilla", "freenerf")
    assert not any("dietnerf" in run.name for run in ablation_runs(runs, painting))
    framework, *_ = ablations(kinds)
    assert "DietNeRF's kind is left out: no weights of VGG-16 were found" in framework.text
    given = paper_runs(coarse_flags=("--vgg-weights=mine.pth",))
    assert given.coarse_kinds() == tuple(COARSE_KINDS)
    assert "left out: no weights" not in ablations(given.coarse_kinds())[0].text
    assert "pipeline.backbone" not in dict(given.coarse("dietnerf").settings)


def content_weights(config: HierStylePipelineConfig) -> set:
    """All that the content loss weighs in a run of 50 iterations, at any size of the views."""
    return {
        round(config.weights_at(step, level)["content"], 9)
        for level in config.levels(50)
        for step in range(level.first, level.first + level.length)
    }


def test_every_setting_of_every_kind_is_one_of_its_method(llff_scene: Path, painting: Path, tmp_path: Path) -> None:
    runs = paper_runs(llff_scene, tmp_path, draft=False, max_image_side=64, coarse_iterations=7, style_iterations=7)
    found = ablation_runs(runs, painting)
    wanted = dict.fromkeys([*found, *(run.coarse for run in found)])
    parsed = {run.name: run.config() for run in wanted}
    assert all(config.max_num_iterations == 7 for config in parsed.values())
    assert all(config.pipeline.datamanager.max_image_side == 64 for config in parsed.values())
    octaves = {kind: parsed[kind].pipeline.model.coarse_field.num_levels for kind in COARSE_KINDS}
    assert octaves == {"ours": 7, "paper": 7, "vanilla": 10, "dietnerf": 10, "freenerf": 10}
    assert [kind for kind in COARSE_KINDS if parsed[kind].pipeline.semantic_weight > 0] == ["dietnerf"]
    assert parsed["freenerf"].pipeline.model.occlusion_weight > 0 == parsed["vanilla"].pipeline.model.occlusion_weight
    settings = {kind: parsed[f"ours-{kind}-{painting.stem}"].pipeline for kind in STYLE_KINDS}
    encodings = {kind: config.model.fine_encoding for kind, config in settings.items()}
    assert encodings == {**dict.fromkeys(STYLE_KINDS, "auto"), "ec-only": "none", "frequency": "frequency"}
    assert [kind for kind, config in settings.items() if config.model.stylised_field == "coarse"] == ["arf"]
    assert [kind for kind, config in settings.items() if config.effects.residual_density == "off"] == ["coarse-density"]
    assert all(parsed[run.name].logging.steps_per_log == 1 for run in found)
    assert {parsed[run.name].pipeline.backbone for run in found} == {runs.found_backbone} == {"vgg16-shift-tolerant"}
    assert {round(weight, 9) for weight in content_weights(settings["ours"])} >= {2.0, 0.02}
    for kind, weight in {"lambda-2": 2.0, "lambda-0.2": 0.2, "lambda-0.02": 0.02, "arf": 0.1}.items():
        assert content_weights(settings[kind]) == {weight}, kind
    assert all(parsed[run.name].pipeline.style_image == painting for run in found)


def test_flags_win_over_the_settings_of_a_kind(painting: Path) -> None:
    runs = paper_runs(style_flags=("--pipeline.samples-per-chunk", "65536"), coarse_flags=tuple(TINY))
    assert runs.stylised(painting, "arf").config().pipeline.samples_per_chunk == 65536
    coarse = runs.coarse("vanilla").config().pipeline
    assert (coarse.model.coarse_field.layer_width, coarse.model.coarse_field.num_levels) == (32, 10)
    assert coarse.effects.empty_space == "on" and coarse.effects.view_color == "on"


@pytest.fixture
def train_here(monkeypatch: pytest.MonkeyPatch) -> list:
    """Has runs trained in this process, which saves starting one for each; holds the names of those that were."""
    trained = []

    def train_run(self: RunQueue, run: Run, jobs: int) -> None:
        trained.append(run.name)
        for state in (writer.EVENT_WRITERS, writer.EVENT_STORAGE, writer.GLOBAL_BUFFER):
            state.clear()  # one process, one run: that is how nerfstudio keeps them
        train.main(run.config())

    monkeypatch.setattr(RunQueue, "_train", train_run)
    return trained


def shown(text: str) -> str:
    """As it is written in a page."""
    return escape(text).replace("&#x27;", "&#39;")


def arguments(command: str, scene: Path, painting: Path, folder: Path, style_iterations: int) -> list:
    given = [command, "--data", str(scene), "--style-images", str(painting), "--output-dir", str(folder / "outputs")]
    given += ["--output-path", str(folder / f"{command}.html"), "--coarse-iterations", "3", "--jobs", "1"]
    given += ["--style-iterations", str(style_iterations), f"--coarse-flags={' '.join(TINY)}"]
    return [*given, f"--style-flags={' '.join(TINY_STYLE)}"]


@pytest.fixture
def painted_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has frames turned to their negatives in place of the 2D network, which may be missing and needs larger ones."""
    monkeypatch.setattr(paper_studies, "can_transfer", lambda: True)
    monkeypatch.setattr(paper_studies, "transfer_frames", lambda frames, painting: [1.0 - frame for frame in frames])


@pytest.mark.slow
def test_compare_trains_what_is_missing_measures_each_row_and_writes_the_page(
    llff_scene: Path,
    painting: Path,
    tmp_path: Path,
    train_here: list,
    painted_by_hand: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    given = arguments("compare", llff_scene, painting, tmp_path, 2)
    main(given)
    assert len(train_here) == 5
    page = (tmp_path / "compare.html").read_text()
    for row in (*OF_METHODS.rows, *ROWS_OF_2D.values(), *(f"the paper's {name}" for name in PAPER_ROWS)):
        assert shown(row) in page
    assert page.count('class="cited"') == len(PAPER_ROWS)
    assert len(re.findall("<img", page)) == 3 * (1 + 5)
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    printed = capsys.readouterr().out
    assert "5 runs, 0 of them finished." in printed
    start = (
        f"Made {tmp_path / 'compare.html'} – next: sparsestyle ablate --data {llff_scene} --style-images {painting} "
    )
    assert printed.splitlines()[-1].startswith(start)

    train_here.clear()
    (tmp_path / "compare.html").unlink()
    monkeypatch.setattr(run_figures, "render_path", lambda *_: pytest.fail("rendered what was measured"))
    main(given)
    assert train_here == []
    assert (tmp_path / "compare.html").read_text() == page
    assert "5 runs, 5 of them finished." in capsys.readouterr().out

    monkeypatch.setattr(paper_studies, "can_transfer", lambda: False)
    main(given)
    page = (tmp_path / "compare.html").read_text()
    assert shown("isn't installed") in page
    assert not any(shown(name) in page for name in ROWS_OF_2D.values())


@pytest.mark.slow
def test_compare_draws_style_against_content_in_equal_time(
    llff_scene: Path, painting: Path, tmp_path: Path, train_here: list, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(front, "can_transfer", lambda: True)
    monkeypatch.setattr(front, "transfer_frames", lambda frames, painting: [1.0 - frame for frame in frames])
    kinds = ("ours", "arf")
    monkeypatch.setattr(front, "PROBE_ITERATIONS", 4)
    for kind in kinds:
        strengths = front.SWEEPS[kind].strengths[:1]
        monkeypatch.setitem(front.SWEEPS, kind, front.SWEEPS[kind]._replace(values=(0.1, 1.0), strengths=strengths))
    monkeypatch.setattr(front, "KINDS", {name: front.KINDS[name] for name in (front.OURS, front.ARF)})
    main([*arguments("compare", llff_scene, painting, tmp_path, 4), "--front"])
    assert set(train_here) == {"ours", *(f"ours-{kind}-painting-{weight}" for kind in kinds for weight in ("0.1", "1"))}
    page = (tmp_path / "compare.html").read_text()
    for kind in (*front.KINDS, front.FRAME_BY_FRAME):
        assert shown(kind) in page
    weaker = f"{front.SWEEPS['ours'].strengths[0]:g}"
    assert shown(f"{front.OURS}, structure = 1, strength = {weaker}") in page
    whole, weak = (
        read_figures(next(tmp_path.rglob(name)), 3).figures for name in ("measured", f"measured-strength-{weaker}")
    )
    assert weak[front.KEPT] > whole[front.KEPT]
    for distance in front.DISTANCES:
        assert shown(LABELS[distance][0]) in page


def points_of(kind: str, *pairs: tuple) -> list:
    return [
        front.FrontPoint(kind, 1.0, run_figures.RunFigures({front.KEPT: kept, "style_loss": loss}, []))
        for kept, loss in pairs
    ]


def test_a_front_is_read_between_its_points_and_not_beyond() -> None:
    points = points_of("ours", (0.7, 0.3), (0.3, 0.1), (0.5, 0.2)) + points_of("other", (0.4, 9.0))
    found = [front.at_kept(points, "ours", "style_loss", kept) for kept in (0.2, 0.3, 0.4, 0.6, 0.7, 0.8)]
    assert found == [None, *map(pytest.approx, (0.1, 0.15, 0.25, 0.3)), None]
    assert front.at_kept(points, "ours", "style_loss", 0.2, or_more=True) == found[1]
    assert front.at_kept(points, "ours", "style_loss", 0.8, or_more=True) is None
    assert front.at_kept(points, "other", "style_loss", 0.4) == 9.0
    assert front.at_kept(points, "none", "style_loss", 0.4) is None


@pytest.mark.slow
def test_figures_are_measured_again_when_a_run_has_gone_on(
    llff_scene: Path, painting: Path, tmp_path: Path, train_here: list
) -> None:
    flags = {"coarse_flags": tuple(TINY), "style_flags": tuple(TINY_STYLE)}
    run = paper_runs(llff_scene, tmp_path, draft=False, coarse_iterations=2, style_iterations=2, **flags).stylised(
        painting
    )
    RunQueue(tmp_path / "llff", 1).train([run])
    first = measure_run(run.folder, PaintingMeasure(painting))
    assert {"short_rmse", "long_ssim", "ceiling_short_rmse", "style_loss", "gram_distance", "unstylised_ssim"} <= set(
        first.figures
    )
    assert len(first.pictures) == len(first.coarse_pictures) == 3
    assert measure_run(run.folder, PaintingMeasure(Path("gone.png"))) == first
    record = run.folder / "measured" / "figures.json"
    content = json.loads(record.read_text())
    record.write_text(json.dumps({**content, "step": 0, "figures": {}}))
    assert measure_run(run.folder, PaintingMeasure(painting)).figures == pytest.approx(first.figures)
    record.write_text("cut sh")
    assert measure_run(run.folder, PaintingMeasure(painting)).figures == pytest.approx(first.figures)


def test_ablations_set_out_each_comparison_with_traces_and_pictures_on_the_way(
    runs: SimpleNamespace, painting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    coarse, style = (shutil.copytree(run, tmp_path / "s" / run.parent.name / "r") for run in (runs.coarse, runs.style))
    Image.new("RGB", (32, 24)).save(preview_path(style, 20))
    monkeypatch.setattr(Run, "folder", property(lambda run: style if run.coarse else coarse))
    every = ablations(tuple(COARSE_KINDS))
    sections = study_sections(paper_runs(style_iterations=3), every, tuple(COARSE_KINDS), [painting])
    assert [section.heading.split(":")[0] for section in sections[1:]] == [each.heading for each in every]
    assert [name for name, _ in sections[0].tables[0].rows] == ["ours", "paper", "vanilla", "dietnerf", "freenerf"]
    for section, comparison in zip(sections[1:], every, strict=True):
        assert [name for name, _ in section.tables[0].rows][: len(comparison.rows)] == list(comparison.rows)
        assert section.text == comparison.text
    assert [len(section.plots) for section in sections] == [0, 0, 0, 0, 3]
    assert [caption for caption, _ in sections[-1].grid[0][1]] == ["after 20 iterations", "at the end"]
    page = study_page("Ablations", sections)
    assert page.count("data:image/svg+xml") == 3
    assert not re.findall(r'(?:src|href)="(?!data:)', page)


@pytest.mark.slow
def test_ablate_runs_every_ablation_and_shows_traces_and_pictures_on_the_way(
    llff_scene: Path, painting: Path, tmp_path: Path, train_here: list
) -> None:
    main(arguments("ablate", llff_scene, painting, tmp_path, 22))
    assert len(set(train_here)) == len(train_here) == 5 + 16
    page = (tmp_path / "ablate.html").read_text()
    assert all(shown(heading).split(" (")[0] in page for heading in (each.heading for each in ablations(())))
    assert page.count("data:image/svg+xml") == 3
    assert page.count("after 20 iterations") >= 4
    assert not re.findall(r'(?:src|href)="(?!data:)', page)


def test_traces_are_averaged_over_the_last_iterations() -> None:
    assert moving_mean([2.0, 4.0, 6.0, 8.0], 2) == [2.0, 3.0, 5.0, 7.0]


def test_training_is_plotted_as_the_way_of_both_losses_and_each_by_iteration() -> None:
    traces = {name: {loss: ([0, 1, 2], [3.0, 2.0, 1.0]) for loss in ("content", "style")} for name in ("ours", "λ = 1")}
    assert [smoothing(views) for views in (1, 3, 5, 8, 20)] == [9, 9, 10, 8, 20]
    plots = loss_plots(traces, 2)
    assert len(plots) == 3
    assert all(svg.lstrip().startswith("<?xml") and "<svg" in svg for svg, _ in plots)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("--data", "{tmp}/gone"), "Error: There is no scene at --data {tmp}/gone"),
        (("--jobs", "0"), "Error: --jobs is 0"),
        (("--parser", "llf-data"), "Error: There is no dataparser llf-data; name one of "),
        (("--output-path", "{tmp}"), "Error: --output-path {tmp} is a folder"),
    ],
)
def test_what_can_not_be_used_is_said_before_anything_is_trained(
    change: tuple, sentence: str, llff_scene: Path, painting: Path, tmp_path: Path, train_here: list
) -> None:
    given = arguments("compare", llff_scene, painting, tmp_path, 2)
    given += [part.format(tmp=tmp_path) for part in change]
    with pytest.raises(SystemExit, match=re.escape(sentence.format(tmp=tmp_path))):
        main(given)
    assert train_here == []


def test_a_flag_that_doesnt_exist_is_said_before_anything_is_trained(
    llff_scene: Path, painting: Path, tmp_path: Path, train_here: list, capsys: pytest.CaptureFixture
) -> None:
    given = arguments("compare", llff_scene, painting, tmp_path, 2)
    with pytest.raises(SystemExit):
        main([*given[:-1], "--style-flags=--foo 3"])
    assert "--foo" in capsys.readouterr().err
    assert train_here == []


def test_after_the_comparison_come_the_ablations_of_the_same_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    monkeypatch.setattr("sparsestyle_ns.studies.paper_studies.ablate", given.append)
    options = StudyOptions(
        data=Path("fern"),
        style_images=(Path("a.jpg"), Path("b c.jpg")),
        output_path=Path("pages/compare.html"),
        draft=True,
        max_image_side=64,
        style_flags="--pipeline.samples-per-chunk 65536",
        jobs=2,
    )
    _, *command = options.ablate_command()
    cli.main(list(map(str, command)))
    assert vars(given[0]) == {**vars(options), "output_path": Path("pages/ablate.html")}
