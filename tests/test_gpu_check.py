"""`benchmarks/gpu_check.sh`, without a GPU."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from second_device import SecondDevice

sys.path.append(str(Path(__file__).resolve().parents[1]))  # benchmarks isn't installed

from benchmarks import gpu_check
from benchmarks._measure import ROOT
from benchmarks._scene import Scene
from benchmarks.gpu_check import CheckFailedError, GpuCheckOptions, comparable, drawn_on_cpu
from sparsestyle_ns.field_components import hash_grid


@pytest.fixture
def run(llff_scene: Path, painting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Runs the check with some parts in place of its own; returns its exit status, its record and its last line."""
    monkeypatch.setattr(gpu_check, "find_scene", lambda options: Scene("tiny", llff_scene, painting))

    def run_parts(capsys: pytest.CaptureFixture, **settings) -> SimpleNamespace:
        status, device = 0, settings.pop("device", "cpu")
        options = {"quick": True, "device": device, "threads": torch.get_num_threads(), "output_dir": tmp_path}
        try:
            gpu_check.main(GpuCheckOptions(**{**options, **settings}))
        except SystemExit as error:
            status = error.code
        record = tmp_path / "gpu_check.json"
        content = json.loads(record.read_text()) if record.is_file() else None
        return SimpleNamespace(status=status, content=content, last=(capsys.readouterr().out.splitlines() or [""])[-1])

    return run_parts


def part(found=None, error=None, fails=None):
    def work(check):
        """Does something."""
        if error is not None:
            raise error
        check.holds(fails is None, fails or "")
        return found or {}

    return work


def test_the_last_line_says_passed_and_results_are_written(run, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(gpu_check, "PARTS", {"kernels": (part({"distance": 1e-7}), 0), "equal": (part(), 0)})
    ended = run(capsys)
    assert (ended.status, ended.last) == (0, "gpu_check: passed")
    assert ended.content["parts"]["kernels"]["found"] == {"distance": 1e-7}
    assert "| kernels | distance | 1e-07 |" in (tmp_path / "gpu_check.md").read_text()


def test_a_part_that_fails_is_named_and_stops_no_other(run, capsys, monkeypatch):
    parts = {
        "kernels": (part(error=CheckFailedError("no")), 0),
        "equal": (part(fails="another view"), 0),
        "waits": (part(error=RuntimeError("device-side assert")), 0),
        "whole": (part({"seconds": 1.0}), 0),
    }
    monkeypatch.setattr(gpu_check, "PARTS", parts)
    ended = run(capsys)
    assert ended.status == 1
    assert ended.last == (
        "gpu_check: failed: kernels: CheckFailedError: no; another view; waits: RuntimeError: device-side assert"
    )
    assert [name for name, each in ended.content["parts"].items() if each["passed"]] == ["whole"]


def test_parts_can_be_left_out_and_those_without_time_are_named(run, capsys, monkeypatch):
    monkeypatch.setattr(gpu_check, "PARTS", {name: (part(), 1.0) for name in ("kernels", "equal", "whole")})
    ended = run(capsys, skip=("equal",), minutes=0.01)
    assert ended.last == "gpu_check: passed (left out, as the time was over: kernels, whole)"
    assert run(capsys, only=("whole",)).content["parts"].keys() == {"whole"}
    assert "--skip and --only know the parts" in str(run(capsys, only=("everything",)).status)


def test_a_part_has_its_share_of_the_time_and_what_those_before_it_left(run, capsys, monkeypatch):
    left = []

    def work(check):
        """Looks at the clock."""
        left.append(check.seconds_left())
        return {}

    monkeypatch.setattr(gpu_check, "PARTS", {"kernels": (work, 10.0), "equal": (part(), 30.0), "whole": (work, 40.0)})
    assert run(capsys, minutes=4.0).status == 0
    assert left == [pytest.approx(30.0, abs=8.0), pytest.approx(240.0, abs=8.0)]


def test_random_numbers_are_the_cpus_on_every_device():
    drawn = {}
    for device in ("cpu", "cuda"):
        with SecondDevice(), comparable():
            generator = torch.Generator(device=device).manual_seed(3)
            numbers = torch.rand(4, device=device, generator=generator)
            assert str(numbers.device).startswith(device)
            drawn[device] = numbers.tolist()
    assert drawn["cpu"] == drawn["cuda"]
    assert drawn_on_cpu(torch.rand)(2).shape == (2,)


@pytest.mark.slow
def test_the_devices_are_compared_on_a_second_device(run, capsys, monkeypatch):
    monkeypatch.setattr(hash_grid, "find_spec", lambda name: None)  # Triton's kernels need a driver
    with SecondDevice() as second:
        ended = run(capsys, device="cuda", only=("equal",))
    found = ended.content["parts"]["equal"]["found"]
    assert ended.last == "gpu_check: passed" and second.mistakes == []
    assert found["coarse_psnr"] > 30 and found["gradient_distance"] < 0.02 and found["baked_psnr"] > 40


@pytest.mark.slow
def test_the_script_runs_on_a_cpu(tmp_path):
    command = ["bash", "benchmarks/gpu_check.sh", "--device", "cpu", "--quick", "--skip", "bench", "--minutes", "30"]
    environment = {"PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin", "PYTHON": sys.executable}
    environment["OMP_NUM_THREADS"] = "1"  # other tests run beside it
    ended = subprocess.run(
        [*command, "--output-dir", str(tmp_path)], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stdout[-4000:] + ended.stderr[-4000:]
    assert ended.stdout.splitlines()[-1] == "gpu_check: passed"
    content = json.loads((tmp_path / "gpu_check.json").read_text())
    assert content["parts"].keys() == {"kernels", "equal", "waits", "commands", "whole"}
