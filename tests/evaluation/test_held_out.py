import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from conftest import run_entrypoint

from sparsestyle_ns.cli import main
from sparsestyle_ns.engine.loading import evaluate_run, load_run
from sparsestyle_ns.evaluation.held_out import StyleFigures, by_figure, saved_report
from sparsestyle_ns.evaluation.tables import report_tables
from sparsestyle_ns.pipelines.hier_style import HierStylePipelineConfig
from sparsestyle_ns.runs.run_folder import find_config


def test_baked_renders_are_held_against_exact_ones_when_asked_for(runs: SimpleNamespace, tmp_path: Path) -> None:
    report = evaluate_run(find_config(runs.style), tmp_path / "style.json", baked=True)
    assert all(view["baked_psnr"] > 30 for view in report.views)
    assert json.loads((tmp_path / "style.json").read_text())["results"]["baked_psnr"] == report.means["baked_psnr"]
    without = evaluate_run(find_config(runs.style), tmp_path / "without.json")
    assert "baked_psnr" not in without.means
    assert without.means.items() <= report.means.items()


def test_a_coarse_run_has_nothing_to_bake(runs: SimpleNamespace, tmp_path: Path) -> None:
    assert "baked_psnr" not in evaluate_run(find_config(runs.coarse), tmp_path / "coarse.json", baked=True).means


def test_a_view_that_shows_no_surface_has_no_sharpness_and_the_report_is_json(runs: SimpleNamespace) -> None:
    _, pipeline, _ = load_run(find_config(runs.coarse))
    with torch.no_grad():
        pipeline.model.field.density_head.weight.zero_()
        pipeline.model.field.density_head.bias.fill_(-20.0)
    pipeline.model.space.unbounded = False
    report = pipeline.held_out_report()
    assert "psnr" in report.means and "effective_samples" not in report.means
    json.dumps(report.means, allow_nan=False)
    assert by_figure([{"a": 1.0, "b": 2.0}, {"a": 3.0}]) == {"a": [1.0, 3.0], "b": [2.0]}
    assert "effective_samples_std" not in report.deviations() and "psnr_std" in report.deviations()


def test_a_stylised_run_is_measured_for_truth_consistency_style_and_content(runs: SimpleNamespace) -> None:
    means = evaluate_run(find_config(runs.style), runs.outputs / "evaluation.json").means
    for key in ("coarse_psnr", "coarse_ssim", "coarse_st_lpips", "content_ssim", "content_loss"):
        assert key in means
    for key in ("style_loss", "style_loss_before", "gram_distance", "gram_distance_before"):
        assert means[key] > 0
    for part in ("short", "long"):
        assert 0 < means[f"{part}_visible"] <= 1
        for kind in ("rmse", "ssim", "st_lpips"):
            assert f"{part}_{kind}" in means and f"ceiling_{part}_{kind}" in means
    assert means["short_visible"] >= means["long_visible"]
    assert means["ceiling_short_rmse"] <= means["ceiling_long_rmse"]


def test_the_painting_itself_uses_all_of_its_features_and_a_flat_picture_hardly_any(painting: Path) -> None:
    settings = HierStylePipelineConfig(style_image=painting)
    targets = settings.targets_of(*settings.load_style(), torch.device("cpu"), 48)
    picture, figures = targets.style_picture.permute(1, 2, 0), StyleFigures(targets)
    assert figures.of(picture, picture, None)["features_used"] == pytest.approx(1.0, abs=0.02)
    assert figures.of(picture, torch.full_like(picture, 0.5), None)["features_used"] < 0.3


def test_ns_eval_gives_the_same_figures(runs: SimpleNamespace, tmp_path: Path) -> None:
    from nerfstudio.scripts import eval as ns_eval

    for run in (runs.coarse, runs.style):
        output = tmp_path / f"{run.parent.name}.json"
        run_entrypoint(ns_eval.entrypoint, ["--load-config", str(run / "config.yml"), "--output-path", str(output)])
        found = json.loads(output.read_text())["results"]
        expected = evaluate_run(find_config(run), tmp_path / "ours.json").means
        assert expected == pytest.approx({key: found[key] for key in expected})
        assert found["fps"] > 0 and found["num_rays_per_sec"] > 0
        assert all(f"{key}_std" in found for key in ("psnr", "ssim") if key in found)


def test_a_run_whose_painting_is_gone_is_measured_without_the_style_and_says_so(
    runs: SimpleNamespace, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    text = (runs.style / "config.yml").read_text()
    moved = tmp_path / "scene" / "hier-style" / "run"
    shutil.copytree(runs.style, moved)
    (moved / "config.yml").write_text(text.replace("painting.png", "gone.png"))
    means = evaluate_run(find_config(moved), tmp_path / "report.json").means
    assert "style_loss" not in means and "gram_distance" not in means
    assert "gone.png isn't there any more, so nothing is measured against it." in capsys.readouterr().out
    assert "short_rmse" in means and "coarse_psnr" in means


def test_the_tables_show_each_figure_and_say_what_is_missing(capsys: pytest.CaptureFixture) -> None:
    means = {"coarse_psnr": 20.5, "content_ssim": 0.5, "style_loss": 0.1, "style_loss_before": 0.2}
    means |= {"short_rmse": 0.04, "ceiling_short_rmse": 0.03, "short_visible": 0.9}
    quality, style, content, consistency = report_tables(means, 3)
    assert (quality.columns, quality.rows) == (["PSNR dB ↑"], [("coarse", ["20.50"])])
    assert style.rows == [("unstylised", ["0.2000"]), ("stylised", ["0.1000"])]
    assert content.rows == [("stylised", ["0.500"])] and "ArtFID" in content.note
    assert consistency.rows == [("stylised", ["0.040", "0.900"]), ("unstylised (the ceiling)", ["0.030", None])]
    consistency.print()
    assert "short RMSE ↓" in capsys.readouterr().out
    assert len(report_tables({"psnr": 20.0}, 1)) == 1


def test_the_command_leaves_the_report_in_the_runs_folder_and_says_what_follows(runs, tmp_path, capsys):
    moved = tmp_path / "outputs" / "scene" / "hier-style" / "run"
    shutil.copytree(runs.style, moved)
    main(["evaluate", str(moved)])
    report = saved_report(moved, step=2)
    assert len(report.views) == 2
    assert "content_ssim" in report.means
    line = capsys.readouterr().out.splitlines()[-1]
    assert line == f"Made {moved / 'evaluation.json'} – next: sparsestyle gallery {moved}"
