"""What was decided goes with a run: into its files, through loading and resuming, and on to stage 2."""

import json
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import torch
import yaml
from conftest import TINY, TINY_STYLE, decided, ns_train, only_run

from sparsestyle_ns.effects.decisions import Decisions
from sparsestyle_ns.effects.matched_colors import ExposureCorrection
from sparsestyle_ns.effects.registry import EFFECTS, decided_on_photos
from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.gallery.layout import RunPictures, gallery_page
from sparsestyle_ns.pipelines import scene_pipeline as pipelines
from sparsestyle_ns.runs.checkpoints import newest_checkpoint
from sparsestyle_ns.runs.run_folder import find_config
from sparsestyle_ns.viewer.panel import EffectsPanel

AUTO = [flag for flag in TINY if flag not in ("--pipeline.effects.empty-space", "on")]


def load(run: Path) -> dict:
    return torch.load(newest_checkpoint(run / "nerfstudio_models"), weights_only=True)


def decisions_of(run: Path) -> Decisions:
    """What a run's folder says, the same in all three places."""
    in_json = Decisions.from_records(json.loads((run / "effects.json").read_text())["effects"])
    in_config = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader).pipeline.decided
    assert in_json == in_config == Decisions.from_records(load(run)["effects"])
    return in_json


def refuse(*arguments: object) -> None:
    raise AssertionError("something was measured")


def test_a_loaded_run_has_what_was_decided_and_measures_nothing(
    runs: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(pipelines, "decide", refuse)
    for run in (runs.coarse, runs.style):
        _, pipeline, _ = load_run(find_config(run))
        saved = decisions_of(run)
        assert pipeline.effects == saved
        assert [item.name for item in saved.items] == list(EFFECTS)
        assert all(line in capsys.readouterr().out for line in [saved.text().splitlines()[1]])


def test_a_stylised_run_takes_over_what_photos_decided_and_measures_the_rest(runs: SimpleNamespace) -> None:
    coarse, style = decisions_of(runs.coarse), decisions_of(runs.style)
    assert [coarse[name] for name in decided_on_photos(coarse)] == [style[name] for name in decided_on_photos(coarse)]
    for name in ("empty_space", "residual_density", "palette"):
        assert coarse[name].measured is None and style[name].measured is not None


def test_empty_space_is_decided_again_and_the_grid_goes_where_there_is_only_fog(
    llff_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    ns_train("coarse-fewshot", llff_scene, tmp_path / "whole", "--max-num-iterations", "4", *AUTO)
    assert "Empty-space skipping is off from iteration 3 on: 0% of space is empty." in capsys.readouterr().out
    run = only_run(tmp_path / "whole", "coarse-fewshot")
    assert not decisions_of(run).on("empty_space")
    assert not any(name.startswith("_model.grid") for name in load(run)["pipeline"])
    _, pipeline, _ = load_run(find_config(run))
    assert pipeline.model.grid is None


def test_a_resumed_run_goes_on_with_its_effects_and_refuses_others(
    runs: SimpleNamespace, llff_scene: Path, tmp_path: Path
) -> None:
    resume = ["--load-dir", str(runs.coarse / "nerfstudio_models"), "--max-num-iterations", "4", *TINY]
    with pytest.raises(SystemExit, match=r"exposure is on, but the checkpoint .* has it off"):
        ns_train("coarse-fewshot", llff_scene, tmp_path, *resume, "--pipeline.effects.exposure", "on")
    ns_train("coarse-fewshot", llff_scene, tmp_path / "second", *resume)
    assert decisions_of(only_run(tmp_path / "second", "coarse-fewshot")) == decisions_of(runs.coarse)


def test_a_coarse_run_with_other_effects_doesnt_fit(
    runs: SimpleNamespace, llff_scene: Path, painting: Path, tmp_path: Path
) -> None:
    flags = ["--style-image", str(painting), "--coarse-run", str(runs.coarse), *TINY_STYLE]
    with pytest.raises(SystemExit, match=r"effect exposure off, as by --pipeline\.effects\.exposure off"):
        ns_train("hier-style", llff_scene, tmp_path, *flags, "--pipeline.effects.exposure", "on")


def test_exposures_are_learned_in_stage_1_and_taken_off_the_photos_in_stage_2(
    llff_scene: Path, painting: Path, tmp_path: Path
) -> None:
    exposure = ["--pipeline.effects.exposure", "on"]
    ns_train("coarse-fewshot", llff_scene, tmp_path, "--max-num-iterations", "3", *TINY, *exposure)
    style = ["--style-image", str(painting), "--max-num-iterations", "1", *TINY_STYLE, *exposure]
    ns_train("hier-style", llff_scene, tmp_path, *style)
    gains = [load(only_run(tmp_path, method))["pipeline"]["_model.exposure.log_gain"] for method in METHODS]
    assert gains[0].shape == (3, 3) and gains[0].abs().max() > 0
    assert torch.equal(*gains)


METHODS = ("coarse-fewshot", "hier-style")


def test_gains_have_a_geometric_mean_of_one_and_taking_them_off_is_the_inverse_of_putting_them_on():
    correction = ExposureCorrection(4)
    torch.nn.init.normal_(correction.log_gain)
    torch.testing.assert_close(correction.gains().log().mean(dim=0), torch.zeros(3), atol=1e-6, rtol=0)
    colors, behind = 0.1 + 0.2 * torch.rand(10, 3), 0.1 * torch.rand(10, 3)
    photo = correction(colors, behind, torch.full((10,), 2))
    torch.testing.assert_close(photo, (colors - behind) * correction.gains()[2] + behind)
    torch.testing.assert_close(correction.undone(photo, behind, 2), colors)


def test_a_background_is_not_exposed():
    correction = ExposureCorrection(2)
    torch.nn.init.normal_(correction.log_gain)
    white = torch.ones(5, 3)
    assert torch.equal(correction(white, white, torch.zeros(5, dtype=torch.long)), white)


def test_the_page_has_a_line_for_every_effect() -> None:
    rows = decided("box", "palette").rows()
    page = gallery_page([RunPictures(name="toy", subtitle="", photos=[], views=[view()], effects=rows)], "Toys")
    for name in EFFECTS:
        assert f"<tr><td>{name}</td><td>{'on' if name in ('box', 'palette') else 'off'}</td>" in page


def view():
    import numpy as np

    from sparsestyle_ns.gallery.layout import View

    picture = np.zeros((4, 4, 3), np.uint8)
    return View("view", picture, picture, picture, picture)


def test_the_viewer_lists_every_effect() -> None:
    gui = MagicMock()
    viewer = SimpleNamespace(viser_server=SimpleNamespace(gui=gui))
    EffectsPanel(SimpleNamespace(effects=decided("box")))._setup(viewer)
    (shown,) = (call.args[0] for call in gui.add_markdown.call_args_list)
    assert "**box** on: " in shown and len(shown.split("\n\n")) == len(EFFECTS)
