import json
from pathlib import Path
from types import SimpleNamespace

from sparsestyle_ns.evaluation.held_out import evaluate_run
from sparsestyle_ns.run_folder import find_config


def test_baked_renders_are_held_against_exact_ones_when_asked_for(runs: SimpleNamespace, tmp_path: Path) -> None:
    report = evaluate_run(find_config(runs.style), tmp_path / "style.json", baked=True)
    assert all(view["baked_psnr"] > 30 for view in report.views)
    assert json.loads((tmp_path / "style.json").read_text())["results"]["baked_psnr"] == report.means["baked_psnr"]
    without = evaluate_run(find_config(runs.style), tmp_path / "without.json")
    assert "baked_psnr" not in without.means
    assert without.means.items() <= report.means.items()


def test_a_coarse_run_has_nothing_to_bake(runs: SimpleNamespace, tmp_path: Path) -> None:
    assert "baked_psnr" not in evaluate_run(find_config(runs.coarse), tmp_path / "coarse.json", baked=True).means
