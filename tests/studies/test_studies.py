"""Comparison and ablations from flags to page, on a tiny scene."""

import copy
import json
import re
import shutil
from html import escape
from pathlib import Path
from types import SimpleNamespace

import pytest
import tyro
from conftest import TINY, TINY_STYLE
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils import writer
from PIL import Image

from sparsestyle_ns.cli import main
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.studies import comparison
from sparsestyle_ns.studies import study as study_module
from sparsestyle_ns.studies.ablations import (
    ablate,
    ablation_experiments,
    ablation_groups,
    annealing_plots,
    moving_mean,
    smoothing,
)
from sparsestyle_ns.studies.comparison import PAPER_ROWS, comparison_experiments
from sparsestyle_ns.studies.experiments import Experiment, Laboratory, SceneSettings
from sparsestyle_ns.studies.study import COARSE_KINDS, STYLE_KINDS, Study, picture_after
from sparsestyle_ns.studies.study_page import write_study
from sparsestyle_ns.style import vgg
from sparsestyle_ns.utils.errors import InputError


def study(draft: bool = True) -> Study:
    return Study(SceneSettings(Path("fern"), "llff-data", Path("outputs")), draft)


def flags_of(experiment: Experiment) -> dict:
    return dict(zip(experiment.flags[::2], experiment.flags[1::2], strict=True))


def test_the_comparisons_runs_are_ours_arfs_kind_and_freenerfs(painting: Path) -> None:
    runs = comparison_experiments(study(), painting)
    assert [(each.coarse.name, each.name.split("-")[1]) for each in runs] == [
        ("ours", "arf"),
        ("freenerf", "arf"),
        ("ours", "ours"),
    ]
    arf = flags_of(runs[0])
    assert arf["--pipeline.model.stylised-field"] == "coarse"
    assert arf["--pipeline.content-decay"] == "1"
    assert flags_of(runs[1].coarse)["--pipeline.model.frequency-reveal"] == "0.9"
    assert runs[2].coarse.flags == ()
    assert flags_of(runs[2]) == {"--logging.steps-per-log": "1", "--backbone": "vgg16-shift-tolerant"}


def test_each_ablation_of_the_paper_is_a_run_and_none_is_done_twice(painting: Path) -> None:
    runs = ablation_experiments(study(), painting, ablation_groups(tuple(COARSE_KINDS)))
    names = [each.name.removesuffix(f"-{painting.stem}") for each in runs]
    assert len(set(names)) == len(names)
    kinds = ("ours", "paper", "vanilla", "dietnerf", "freenerf")
    framework = {f"{coarse}-{style}" for coarse in kinds for style in ("ours", "arf")}
    assert set(names) == framework | {f"ours-{kind}" for kind in STYLE_KINDS}
    assert {each.name for each in comparison_experiments(study(), painting)} <= {each.name for each in runs}
    with_pictures = {name for name, each in zip(names, runs, strict=True) if each.stops}
    assert with_pictures == {"ours-ours", "ours-lambda-10", "ours-lambda-1", "ours-lambda-0.1"}
    assert all(each.stops == (20, 100) for each in runs if each.stops)


def test_without_a_feature_network_the_semantic_loss_is_left_out_and_said_to_be(
    painting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_weights(backbone: str, weights: None) -> None:
        raise InputError("There are no weights.")

    monkeypatch.setattr(vgg, "_find_weights", no_weights)
    kinds = study().coarse_kinds()
    assert kinds == ("ours", "paper", "vanilla", "freenerf")
    groups = ablation_groups(kinds)
    assert not any("dietnerf" in each.name for each in ablation_experiments(study(), painting, groups))
    text, _ = groups["Coarse-to-fine framework (Fig. 5)"]
    assert "DietNeRF's kind is left out: no weights of VGG-16 were found" in text
    given = Study(study().scene, coarse_flags=("--vgg-weights=mine.pth",))
    assert given.coarse_kinds() == tuple(COARSE_KINDS)
    assert "left out: no weights" not in ablation_groups(given.coarse_kinds())["Coarse-to-fine framework (Fig. 5)"][0]


def parse(experiment: Experiment, scene: SceneSettings, iterations: int) -> TrainerConfig:
    """What ns-train makes of the experiment's command; by its one method's parser, as that of all takes seconds."""
    default = copy.deepcopy(method_config(experiment.method))
    command = experiment.command(scene, iterations)
    return tyro.cli(type(default), default=default, args=command[4:], config=(tyro.conf.FlagConversionOff,))


def test_every_flag_of_every_kind_is_one_that_ns_train_knows(llff_scene: Path, painting: Path, tmp_path: Path) -> None:
    scene = SceneSettings(llff_scene, "llff-data", tmp_path, ("--max-image-side", "64"))
    runs = ablation_experiments(Study(scene), painting, ablation_groups(tuple(COARSE_KINDS)))
    wanted = dict.fromkeys([*runs, *(run.coarse for run in runs)])
    parsed = {each.name: parse(each, scene, 7) for each in wanted}
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
    assert all(parsed[each.name].logging.steps_per_log == 1 for each in runs)
    assert {parsed[each.name].pipeline.backbone for each in runs} == {Study(scene).backbone} == {"vgg16-shift-tolerant"}
    assert [settings[f"lambda-{w}"].loss_weights["content"] for w in ("10", "1", "0.1")] == [10.0, 1.0, 0.1]


@pytest.fixture
def train_here(monkeypatch: pytest.MonkeyPatch) -> list:
    """Has runs trained in this process, which saves starting one for each; holds the names of those that were."""
    from nerfstudio.scripts import train

    trained = []

    def train_to(self: Laboratory, experiment: Experiment, iterations: int, jobs: int) -> None:
        trained.append((experiment.name, iterations))
        for state in (writer.EVENT_WRITERS, writer.EVENT_STORAGE, writer.GLOBAL_BUFFER):
            state.clear()  # one process, one run: that is how nerfstudio keeps them
        train.main(parse(experiment, self.scene, iterations))

    monkeypatch.setattr(Laboratory, "_train_to", train_to)
    return trained


def arguments(command: str, scene: Path, painting: Path, folder: Path, style_iterations: int) -> list:
    given = [command, "--data", str(scene), "--style-images", str(painting), "--output-dir", str(folder / "outputs")]
    given += ["--output-path", str(folder / f"{command}.html"), "--coarse-iterations", "3", "--jobs", "1"]
    given += ["--style-iterations", str(style_iterations), f"--coarse-flags={' '.join(TINY)}"]
    return [*given, f"--style-flags={' '.join(TINY_STYLE)}"]


@pytest.fixture
def painted_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has frames turned to their negatives in place of the 2D network, which may be missing and needs larger ones."""
    monkeypatch.setattr(comparison, "can_transfer", lambda: True)
    monkeypatch.setattr(comparison, "transfer_frames", lambda frames, painting: [1.0 - frame for frame in frames])


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
    two_dimensional = [name for name, _ in comparison.ROWS_OF_2D.values()]
    for row in (*comparison.SCENE_ROWS, *two_dimensional, *(f"the paper's {name}" for name in PAPER_ROWS)):
        assert escape(row) in page
    assert page.count("class=cited") == len(PAPER_ROWS)
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
    monkeypatch.setattr(study_module, "render_path", lambda *_: pytest.fail("rendered what was measured"))
    main(given)
    assert train_here == []
    assert (tmp_path / "compare.html").read_text() == page
    assert "5 runs, 5 of them finished." in capsys.readouterr().out

    monkeypatch.setattr(comparison, "can_transfer", lambda: False)
    main(given)
    page = (tmp_path / "compare.html").read_text()
    assert escape("isn't installed") in page
    assert not any(escape(name) in page for name in two_dimensional)


def test_a_run_is_one_of_ns_train_in_a_process_of_its_own(llff_scene: Path, tmp_path: Path) -> None:
    scene = SceneSettings(llff_scene, "llff-data", tmp_path, ("--num-views", "2"))
    run, said = Study(scene, False, tuple(TINY), coarse_iterations=2).coarse("freenerf"), []
    Laboratory(scene, 1, said.append).run([run])
    assert run.is_finished(scene)
    assert json.loads((run.folder(scene) / "scene.json").read_text())["view_ids"] == [1, 11]
    assert (run.folder(scene) / "config.yml").is_file()
    assert said[-1].startswith(f"{run.folder(scene).name}: 2 iterations in")


def test_figures_are_measured_again_when_a_run_has_gone_on(
    llff_scene: Path, painting: Path, tmp_path: Path, train_here: list
) -> None:
    from sparsestyle_ns.studies.study import MEASURED_FOLDER, Painter, measure_run

    scene = SceneSettings(llff_scene, "llff-data", tmp_path)
    whole = Study(scene, False, tuple(TINY), tuple(TINY_STYLE), 2, 2).stylised(painting)
    Laboratory(scene, 1).run([whole])
    first = measure_run(whole.folder(scene), Painter(painting))
    assert {"short_rmse", "long_ssim", "ceiling_short_rmse", "style_loss", "gram_distance", "unstylised_ssim"} <= set(
        first.figures
    )
    assert len(first.pictures) == len(first.coarse_pictures) == 3
    assert measure_run(whole.folder(scene), Painter(Path("gone.png"))) == first
    record = whole.folder(scene) / MEASURED_FOLDER / "figures.json"
    content = json.loads(record.read_text())
    record.write_text(json.dumps({**content, "step": 0, "figures": {}}))
    assert measure_run(whole.folder(scene), Painter(painting)).figures == pytest.approx(first.figures)
    record.write_text("cut sh")
    assert measure_run(whole.folder(scene), Painter(painting)).figures == pytest.approx(first.figures)


def test_ablations_set_out_each_group_with_traces_and_pictures_on_the_way(
    runs: SimpleNamespace, painting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    coarse, style = (shutil.copytree(run, tmp_path / "s" / run.parent.name / "r") for run in (runs.coarse, runs.style))
    Image.new("RGB", (32, 24)).save(picture_after(style, 20))
    monkeypatch.setattr(Experiment, "folder", lambda experiment, _: coarse if experiment.coarse is None else style)
    monkeypatch.setattr(Laboratory, "run", lambda *_: None)
    sections = ablate(study(), [painting], Laboratory(study().scene, 1))
    groups = ablation_groups(tuple(COARSE_KINDS))
    assert [section.heading.split(":")[0] for section in sections[1:]] == list(groups)
    assert [name for name, _ in sections[0].tables[0].rows] == ["ours", "paper", "vanilla", "dietnerf", "freenerf"]
    for section, (text, rows) in zip(sections[1:], groups.values(), strict=True):
        assert [name for name, _ in section.tables[0].rows][: len(rows)] == list(rows)
        assert section.text == text
    annealing = sections[-1]
    assert [len(section.plots) for section in sections] == [0, 0, 0, 0, 3]
    assert [caption for caption, _ in annealing.grid[0][1]] == ["after 20 iterations", "at the end"]
    page = write_study(sections, tmp_path / "ablations.html", "Ablations").read_text()
    assert page.count("data:image/svg+xml") == 3
    assert not re.findall(r'(?:src|href)="(?!data:)', page)


@pytest.mark.slow
def test_ablate_runs_every_ablation_and_shows_traces_and_pictures_on_the_way(
    llff_scene: Path, painting: Path, tmp_path: Path, train_here: list
) -> None:
    main(arguments("ablate", llff_scene, painting, tmp_path, 22))
    names = [name for name, _ in train_here]
    assert len(set(names)) == 5 + 16
    assert names.count(f"ours-ours-{painting.stem}") == 2  # up to its stop, and on
    page = (tmp_path / "ablate.html").read_text()
    assert all(heading.split(" (")[0] in page for heading in ablation_groups(()))
    assert page.count("data:image/svg+xml") == 3
    assert page.count("after 20 iterations") >= 4
    assert not re.findall(r'(?:src|href)="(?!data:)', page)


def test_traces_are_averaged_over_the_last_iterations() -> None:
    assert moving_mean([2.0, 4.0, 6.0, 8.0], 2) == [2.0, 3.0, 5.0, 7.0]


def test_annealing_is_plotted_as_the_way_of_both_losses_and_each_by_iteration() -> None:
    traces = {name: {loss: ([0, 1, 2], [3.0, 2.0, 1.0]) for loss in ("content", "style")} for name in ("ours", "λ = 1")}
    assert [smoothing(views) for views in (1, 3, 5, 8, 20)] == [9, 9, 10, 8, 20]
    plots = annealing_plots(traces, 2)
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
