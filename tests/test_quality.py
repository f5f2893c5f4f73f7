"""What the main job is worth on real photos, by the commands a user types. Minutes, so marked `slow`."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Dict

import pytest
from conftest import only_run

DATA = Path(os.environ.get("SPARSESTYLE_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
PAINTING = DATA / "styles" / "woman_with_hat_matisse.jpg"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not PAINTING.is_file(), reason=f"{DATA} has no real scenes and paintings; name a folder: SPARSESTYLE_DATA"
    ),
]


def run(*command: str) -> None:
    """Runs a console script of this environment as a process of its own."""
    script = Path(sys.executable).with_name(command[0])
    ended = subprocess.run([script, *map(str, command[1:])], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout[-2000:] + ended.stderr[-4000:]


def results(run_folder: Path, output: Path) -> Dict[str, float]:
    """Means over the held-out views, as `sparsestyle evaluate` reports them."""
    run("sparsestyle", "evaluate", run_folder, "--output-path", output)
    return json.loads(output.read_text())["results"]


@pytest.mark.parametrize("scene, parser", [("llff/fern", "llff-data"), ("blender/lego", "blender-data")])
def test_the_drafts_find_surfaces_and_paint_them(scene, parser, tmp_path):
    common = ["--data", DATA / scene, "--output-dir", tmp_path]
    common += ["--vis", "tensorboard", "--viewer.quit-on-train-completion", "True"]
    run("ns-train", "coarse-fewshot-draft", *common, parser)
    coarse = results(only_run(tmp_path, "coarse-fewshot-draft"), tmp_path / "coarse.json")
    assert coarse["psnr"] > 20.0
    assert coarse["effective_samples"] < 4.0

    run("ns-train", "hier-style-draft", "--style-image", PAINTING, *common, parser)
    style = results(only_run(tmp_path, "hier-style-draft"), tmp_path / "style.json")
    assert style["style_loss"] < 0.75 * style["style_loss_before"]
    assert style["coarse_psnr"] > 20.0
    # Content is recognisable: the structure of the photos is still there. Noise has an SSIM near 0.
    assert style["content_ssim"] > 0.2
