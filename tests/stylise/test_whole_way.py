"""`sparsestyle stylise` from photos without poses to pages, by real commands."""

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import TINY, TINY_STYLE
from PIL import Image

from sparsestyle_ns.stylise.stylise import stylise
from sparsestyle_ns.stylise.stylise_options import StyliseOptions
from sparsestyle_ns.utils import stages as stages_module

DATA = Path(os.environ.get("SPARSESTYLE_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
FERN = DATA / "llff" / "fern" / "images_8"
FLAGS = {
    "coarse-fewshot-draft": ["--max-num-iterations", "4", *TINY],
    "hier-style-draft": ["--max-num-iterations", "3", *TINY_STYLE],
    "gallery": ["--frames", "2", "--num-views", "1"],
    "export": ["--resolution", "32"],
}
"""What makes each command quick, and its result worthless."""


def check_pages(output: Path) -> None:
    for page in ("index.html", "scene.html"):
        assert (output / page).stat().st_size > 10_000


@pytest.mark.slow
def test_photos_without_poses_become_pages(tmp_path, painting, monkeypatch, capfd):
    import make_sample_scene

    make_sample_scene.main([str(tmp_path / "sample"), "--layout", "llff", "--width", "252", "--num-views", "3"])
    photos = shutil.copytree(next((tmp_path / "sample" / "llff").glob("images*")), tmp_path / "photos")
    run = stages_module.run_command

    def quickly(command, *others):
        flags = FLAGS.get(command[1], [])
        run([*command[:-1], *flags, command[-1]] if command[0] == "ns-train" else [*command, *flags], *others)

    monkeypatch.setattr(stages_module, "run_command", quickly)
    output = tmp_path / "out"
    stylise(StyliseOptions(photos, painting, output, methods="draft", device="cpu"))
    check_pages(output)
    printed = capfd.readouterr().out
    assert printed.count("      $ ") == 5 and "Poses are estimated from 3 photos" in printed
    assert printed.splitlines()[-1].startswith(f"Made {output / 'index.html'}")
    stylise(StyliseOptions(photos, painting, output, methods="draft", device="cpu"))
    assert capfd.readouterr().out.count("done before") == 5


@pytest.mark.slow
@pytest.mark.skipif(not FERN.is_dir(), reason=f"{DATA} has no llff/fern; set SPARSESTYLE_DATA")
def test_ferns_three_bare_photos_are_stylised_also_after_ctrl_c(tmp_path, painting):
    photos, output = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    for number in (1, 10, 19):
        with Image.open(FERN / f"image{number:03d}.png") as photo:
            photo.resize((252, 189), Image.Resampling.LANCZOS).save(photos / f"{number}.png")
    program = [sys.executable, "-c", "from sparsestyle_ns.cli import main; main()"]
    command = [*program, "stylise", str(photos), str(painting), "--output", str(output), "--methods", "draft"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        for line in process.stdout:
            share = re.match(r"The whole: (\d+) of 100", line)
            if share is not None and int(share[1]) >= 5:  # the first twentieth is more than the photos'
                break
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
    assert process.returncode == 130 and "goes on where it was" in rest
    assert "finishing this iteration" in rest
    (checkpoint,) = output.glob("outputs/*/coarse-fewshot-draft/*/nerfstudio_models/*.ckpt")
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert done.returncode == 0, done.stdout[-2000:]
    assert f"Going on from {checkpoint}" in done.stdout.replace("\n", "")
    check_pages(output)
