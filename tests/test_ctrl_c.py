"""Ctrl-C, as a real signal to a real process, at any moment of any long command: one sentence, and status 130."""

from pathlib import Path
from types import SimpleNamespace
from typing import List

import pytest
from conftest import TINY, TINY_STYLE
from interrupted import interrupt

QUIET = ["--vis", "tensorboard", "--viewer.quit-on-train-completion", "True"]


def coarse_command(scene: Path, outputs: Path, *flags: str) -> List[str]:
    command = ["ns-train", "coarse-fewshot", "--data", str(scene), "--output-dir", str(outputs), *QUIET]
    return [*command, "--max-num-iterations", "4", *TINY, *flags, "llff-data"]


def style_command(runs: SimpleNamespace, scene: Path, painting: Path, outputs: Path, *flags: str) -> List[str]:
    command = ["ns-train", "hier-style", "--data", str(scene), "--output-dir", str(outputs), *QUIET]
    command += ["--style-image", str(painting), "--coarse-run", str(runs.coarse), "--max-num-iterations", "4"]
    return [*command, *TINY_STYLE, *flags, "llff-data"]


BEFORE_STAGE_1 = {
    "reading the scene": "sparsestyle_ns.pipelines.datamanager:read_scene",
    "measuring effects": "sparsestyle_ns.pipelines.scene_pipeline:decide",
    "loading photos": "sparsestyle_ns.pipelines.datamanager:gather_pixels",
    "in nerfstudio's own code": "nerfstudio.utils.writer:setup_event_writer",
    "recording the scene": "sparsestyle_ns.engine.trainer:record_scene",
}
BEFORE_STAGE_2 = {
    "reading the painting": "sparsestyle_ns.style.painting:Painting.read",
    "looking for surfaces": "sparsestyle_ns.core.occupancy:DensityVolume.measure",
    "freezing views": "sparsestyle_ns.pipelines.scene_views:SceneViews._photo_view",
    "warming up": "sparsestyle_ns.pipelines.hier_style:HierStylePipeline.warm_start_loss",
}


@pytest.mark.parametrize("presses", [1, 2])
@pytest.mark.parametrize("moment", BEFORE_STAGE_1.values(), ids=BEFORE_STAGE_1.keys())
def test_before_the_first_iteration_of_stage_1_nothing_is_left(llff_scene, tmp_path, moment, presses):
    command = coarse_command(llff_scene, tmp_path / "outputs")
    interrupt(command, moment, tmp_path / "log", presses).assert_told()
    assert not list((tmp_path / "outputs").rglob("*"))


@pytest.mark.parametrize("presses", [1, 2])
@pytest.mark.parametrize("moment", BEFORE_STAGE_2.values(), ids=BEFORE_STAGE_2.keys())
def test_before_the_first_iteration_of_stage_2_nothing_is_left(runs, llff_scene, painting, tmp_path, moment, presses):
    command = style_command(runs, llff_scene, painting, tmp_path / "outputs")
    interrupt(command, moment, tmp_path / "log", presses).assert_told()
    assert not list((tmp_path / "outputs").rglob("*"))
