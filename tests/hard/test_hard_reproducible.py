"""The same seed gives the same bits, whether a run is killed and gone on with or not."""

import shutil
import signal
import time
from io import BufferedWriter
from pathlib import Path
from types import SimpleNamespace
from typing import Any, List

import pytest
import torch
from conftest import TINY, TINY_STYLE, only_run
from hard import trial
from hard.table import hard_case

from sparsestyle_ns.runs.checkpoints import load_checkpoint, newest_checkpoint
from sparsestyle_ns.runs.coarse_run import read_coarse_run
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole

BOTH = pytest.mark.parametrize("method", ["coarse-fewshot", "hier-style"])


@pytest.fixture(scope="module")
def command(runs: SimpleNamespace, llff_scene: Path, painting: Path):
    """The command line of a run of ten iterations that is saved after every fourth."""

    def make(method: str, outputs: Path, *more: str) -> List[str]:
        style = ["--style-image", str(painting), "--coarse-run", str(runs.coarse), *TINY_STYLE]
        flags = TINY if method == "coarse-fewshot" else style
        saving = ["--max-num-iterations", "10", "--steps-per-save", "4", "--steps-per-eval-image", "0"]
        return [method, str(llff_scene), str(outputs), *flags, *saving, *more]

    return make


def run(command: List[str], moment: Any = None, threads: int = 1) -> Path:
    """Runs a command in a process of its own; returns the folder of its checkpoints."""
    outputs = Path(command[2])
    outputs.mkdir(parents=True, exist_ok=True)
    process = trial.start(trial.train, outputs / "log.txt", command, threads, moment)
    process.join(timeout=300)
    expected = 0 if moment is None else -signal.SIGKILL
    assert process.exitcode == expected, (outputs / "log.txt").read_text()[-3000:]
    return only_run(outputs, command[0]) / "nerfstudio_models"


@pytest.fixture(scope="module")
def uninterrupted(command, tmp_path_factory: pytest.TempPathFactory):
    """The last checkpoint of a run that nothing happened to, by method."""
    outputs = tmp_path_factory.mktemp("uninterrupted")
    checkpoints = {}

    def find(method: str) -> dict:
        if method not in checkpoints:
            checkpoints[method] = load_checkpoint(newest_checkpoint(run(command(method, outputs))))
        return checkpoints[method]

    return find


def assert_same(first: Any, second: Any, where: str = "checkpoint") -> None:
    """Bit for bit, all that is in two checkpoints."""
    assert type(first) is type(second), where
    if isinstance(first, torch.Tensor):
        assert torch.equal(first, second), where
    elif isinstance(first, dict):
        assert first.keys() == second.keys(), where
        for key in first:
            assert_same(first[key], second[key], f"{where}/{key}")
    elif isinstance(first, (list, tuple)):
        assert len(first) == len(second), where
        for index, parts in enumerate(zip(first, second, strict=True)):
            assert_same(*parts, f"{where}/{index}")
    else:
        assert first == second, where


@hard_case(
    "reproducible",
    case="two runs of the same command, on two threads",
    could_go_wrong="sums in the order in which threads come by, unseeded jitter, a clock or a path in the state",
    must_hold="bit-equal checkpoints of both methods: weights, Adam's state, schedules, notes",
)
@BOTH
def test_the_same_command_gives_the_same_bits(command, tmp_path, method):
    first, second = (run(command(method, tmp_path / name), threads=2) for name in ("first", "second"))
    assert_same(load_checkpoint(newest_checkpoint(first)), load_checkpoint(newest_checkpoint(second)))


def go_on(command, method: str, folder: Path, outputs: Path, *flags: str) -> dict:
    """What a killed run ends with: resumed where there is a checkpoint, begun anew where there is none."""
    newest = newest_checkpoint(folder) if folder.exists() else None
    more = [] if newest is None else ["--load-dir", str(folder)]
    return load_checkpoint(newest_checkpoint(run(command(method, outputs, *flags, *more))))


@hard_case(
    "reproducible",
    case="SIGKILL in an iteration, half way through a checkpoint, before it has its name, before the former is gone",
    could_go_wrong="a half-written checkpoint is the newest, or none is left; the rest of the run goes another way",
    must_hold="there is a whole checkpoint, and the resumed run ends with the bits of one that nothing happened to",
)
@pytest.mark.parametrize(
    "method, moment",
    [
        *(("coarse-fewshot", moment) for moment in trial.MOMENTS),
        ("hier-style", "between two checkpoints"),
        ("hier-style", "after the last iteration"),  # resumed at the ninth of ten, among the larger views
        ("hier-style", "half way through the second checkpoint"),
    ],
)
def test_a_killed_run_ends_as_one_that_was_left_alone(command, uninterrupted, tmp_path, method, moment):
    folder = run(command(method, tmp_path / "killed"), moment)
    names = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    if moment == "in the first iteration":
        assert names == []
    elif moment == "before the former checkpoint is deleted":
        assert names == ["step-000000004.ckpt", "step-000000008.ckpt"]
    elif moment == "after the last iteration":
        assert names == ["step-000000008.ckpt"]
    else:
        assert names == ["step-000000004.ckpt"]
    assert_same(go_on(command, method, folder, tmp_path / "resumed"), uninterrupted(method))


@hard_case(
    "reproducible",
    case="SIGKILL between two checkpoints, in stage 1 with the semantic loss of unseen views",
    could_go_wrong="views and photos drawn from a generator that goes on, places that differ in the last bits",
    must_hold="the resumed run ends with the bits of one that nothing happened to",
)
def test_a_killed_run_with_a_semantic_loss_ends_as_one_that_was_left_alone(command, tmp_path):
    method, every = "coarse-fewshot", ["--pipeline.semantic-weight", "0.1", "--pipeline.semantic-every", "3"]
    flags = [*every, "--pipeline.semantic-side", "16"]
    folder = run(command(method, tmp_path / "killed", *flags), "between two checkpoints")
    resumed = go_on(command, method, folder, tmp_path / "resumed", *flags)
    assert_same(resumed, load_checkpoint(newest_checkpoint(run(command(method, tmp_path / "whole", *flags)))))


@hard_case(
    "reproducible",
    case="SIGKILL whenever it comes, and again in the resumed run",
    could_go_wrong="a moment that nobody thought of",
    must_hold="however often it happens, what is left loads, and the run that ends has the same bits",
)
def test_a_run_killed_at_odd_moments_ends_as_one_that_was_left_alone(command, tmp_path):
    method, checkpoints, more = "coarse-fewshot", tmp_path / "none", []
    often = ["--max-num-iterations", "100", "--steps-per-save", "1"]
    for attempt, delay in enumerate((0.0, 0.1, 0.3)):
        outputs = tmp_path / str(attempt)
        outputs.mkdir()
        process = trial.start(trial.train, outputs / "log.txt", command(method, outputs, *often, *more))
        while not list(outputs.rglob("*.ckpt")):
            assert process.is_alive(), (outputs / "log.txt").read_text()[-3000:]
            time.sleep(0.01)
        time.sleep(delay)
        process.kill()
        process.join()
        checkpoints = only_run(outputs, method) / "nerfstudio_models"
        load_checkpoint(newest_checkpoint(checkpoints))
        more = ["--load-dir", str(checkpoints)]
    resumed = newest_checkpoint(run(command(method, tmp_path / "end", *often, *more)))
    whole = newest_checkpoint(run(command(method, tmp_path / "whole", *often)))
    assert_same(load_checkpoint(resumed), load_checkpoint(whole))


@hard_case(
    "reproducible",
    case="what a kill leaves behind, and other files, beside the checkpoints",
    could_go_wrong="nerfstudio takes every file in the folder for a checkpoint, and fails on its name or loads it",
    must_hold="the newest whole checkpoint is found",
)
def test_other_files_are_never_taken_for_a_checkpoint(command, runs, tmp_path):
    run_folder = shutil.copytree(runs.coarse, tmp_path / "run")
    folder = run_folder / "nerfstudio_models"
    whole = newest_checkpoint(folder)
    (run_folder / "checkpoint.unfinished").write_bytes(b"half of it")
    for name in ("step-000009999.ckpt.unfinished", "step-latest.ckpt", "notes.txt", ".DS_Store"):
        (folder / name).write_bytes(b"half of it")
    assert newest_checkpoint(folder) == whole
    assert read_coarse_run(run_folder).checkpoint == whole
    resumed = run(command("coarse-fewshot", tmp_path / "outputs", "--load-dir", str(folder)))
    assert load_checkpoint(newest_checkpoint(resumed))["step"] == 9


@hard_case(
    "reproducible",
    case="a checkpoint that was cut short in copying, or is something else",
    could_go_wrong="a traceback out of torch's unpickler",
    must_hold="one sentence that names the file",
)
@pytest.mark.parametrize("content", [b"", b"no checkpoint", None])
def test_a_damaged_checkpoint_is_named(runs, tmp_path, content):
    path = tmp_path / "step-000000002.ckpt"
    data = newest_checkpoint(runs.coarse / "nerfstudio_models").read_bytes()
    path.write_bytes(data[: len(data) // 2] if content is None else content)
    with pytest.raises(InputError, match=r"step-000000002\.ckpt can't be read"):
        load_checkpoint(path)
    torch.save({"weights": torch.ones(2)}, path)
    with pytest.raises(InputError, match=r"step-000000002\.ckpt is no checkpoint"):
        load_checkpoint(path)


@hard_case(
    "reproducible",
    case="the disk is full while a file is written",
    could_go_wrong="the former file is gone, or is half the new one",
    must_hold="the former file is as it was",
)
def test_a_file_that_cant_be_written_leaves_the_former_one(tmp_path):
    path = tmp_path / "file"
    write_whole(path, lambda file: file.write(b"former"))

    def fill_the_disk(file: Any) -> None:
        file.write(b"new")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        write_whole(path, fill_the_disk)
    assert path.read_bytes() == b"former"


def test_a_checkpoint_that_doesnt_fit_on_the_disk_is_said_and_the_former_one_stays(
    llff_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from conftest import ns_train

    save, saved = torch.save, []

    def full(state: Any, file: Any, **settings: Any) -> None:
        if isinstance(file, BufferedWriter):  # else it is PyYAML's, which writes a config
            saved.append(file.name)
            if len(saved) == 2:
                raise OSError(28, "No space left on device")
        save(state, file, **settings)

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(SystemExit, match="No space left on device"):
        ns_train("coarse-fewshot", llff_scene, tmp_path, *TINY, "--max-num-iterations", "9", "--steps-per-save", "4")
    run_folder = only_run(tmp_path, "coarse-fewshot")
    assert [path.name for path in (run_folder / "nerfstudio_models").iterdir()] == ["step-000000004.ckpt"]
    assert not list(run_folder.glob("*.unfinished"))
