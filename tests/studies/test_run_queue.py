"""Runs are found again by what they are, gone on with, and not done twice."""

import json
import os
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import List, Tuple

import pytest
from conftest import TINY

from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.engine.previews import preview_path, preview_steps
from sparsestyle_ns.studies import run_queue
from sparsestyle_ns.studies.paper_runs import PaperRuns
from sparsestyle_ns.studies.run_queue import SECONDS_FILE, Run, RunQueue
from sparsestyle_ns.studies.study import Study
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.progress import PROGRESS_FILE, ProgressReport

PRETEND = """
import sys, yaml
from pathlib import Path
config = yaml.safe_load(Path(sys.argv[1]).read_text())
models = Path(config["folder"]) / "nerfstudio_models"
models.mkdir(parents=True, exist_ok=True)
for old in models.glob("*.ckpt"): old.unlink()
(models / f"step-{config['iterations'] - 1:09d}.ckpt").touch()
"""


@pytest.fixture
def study(tmp_path: Path) -> Study:
    (tmp_path / "fern").mkdir()
    return Study(tmp_path / "fern", LLFFDataParserConfig(), False, coarse_iterations=10, style_iterations=6)


@pytest.fixture
def coarse(study: Study, tmp_path: Path) -> Run:
    return Run(study, tmp_path / "outputs", "ours", "coarse-fewshot")


@pytest.fixture
def style(coarse: Run) -> Run:
    return replace(coarse, name="ours-ours", stage="hier-style", coarse=coarse)


@pytest.fixture
def queue(coarse: Run, monkeypatch: pytest.MonkeyPatch) -> RunQueue:
    """One whose training leaves a checkpoint and nothing else; `said` holds its lines, `trained` what it trained."""
    trained: List[Tuple[str, int]] = []

    def config(run: Run) -> dict:
        trained.append((run.name, run.steps_done))
        return {"folder": str(run.folder), "iterations": run.iterations}

    monkeypatch.setattr(Run, "config", config)
    monkeypatch.setattr(run_queue, "TRAINING_PROCESS", (sys.executable, "-c", PRETEND))
    said: List[str] = []
    found = RunQueue(coarse.folder.parents[1], jobs=1, say=said.append)
    found.said, found.trained = said, trained
    return found


def leave_checkpoint(run: Run, step: int) -> Path:
    models = run.folder / "nerfstudio_models"
    models.mkdir(parents=True)
    (models / f"step-{step:09d}.ckpt").touch()
    return models


def test_a_coarse_run_comes_first_and_once(queue: RunQueue, style: Run) -> None:
    other = replace(style, name="ours-arf", settings=(("pipeline.content_weight", 1.0),))
    queue.train([style, other, style])
    assert queue.trained == [("ours", 0), ("ours-ours", 0), ("ours-arf", 0)]


def test_finished_runs_are_not_done_again_and_interrupted_ones_are_gone_on_with(
    queue: RunQueue, coarse: Run, style: Run
) -> None:
    queue.train([coarse])
    leave_checkpoint(style, 2)
    queue.trained.clear()
    queue.train([style])
    assert queue.trained == [("ours-ours", 3)]
    queue.trained.clear()
    queue.train([style])
    assert queue.trained == []
    assert queue.said[-1] == "2 runs, 2 of them finished."


def test_whatever_decides_the_outcome_decides_the_folder(coarse: Run, tmp_path: Path) -> None:
    painting, other = tmp_path / "a.png", tmp_path / "b.png"
    painting.write_bytes(b"one")
    other.write_bytes(b"two")
    settings = (("pipeline.content_weight", 1.0),)
    base = replace(coarse, name="x", stage="hier-style", settings=settings, painting=painting, coarse=coarse)
    study = base.study
    changed = [
        replace(base, study=replace(study, style_iterations=7)),
        replace(base, study=replace(study, style_flags=("--flag",))),
        replace(base, study=replace(study, max_image_side=9)),
        replace(base, study=replace(study, dataparser=LLFFDataParserConfig(eval_interval=4))),
        replace(base, study=replace(study, draft=True)),
        replace(base, settings=(("pipeline.content_weight", 2.0),)),
        replace(base, painting=other),
        replace(base, coarse=replace(coarse, study=replace(study, coarse_iterations=11))),
    ]
    assert len({run.digest for run in (base, *changed)}) == len(changed) + 1
    moved = replace(base, output_dir=tmp_path / "elsewhere")
    assert base.digest == moved.digest == replace(base, name="z", pictures=(3,)).digest


def test_the_config_names_the_folder_the_iterations_and_where_to_start(coarse: Run, style: Run) -> None:
    config = replace(style, pictures=(2, 6)).config()
    assert config.method_name == "hier-style"
    assert config.max_num_iterations == 6
    assert config.vis == "tensorboard" and config.viewer.quit_on_train_completion
    config.set_timestamp()
    assert config.get_base_dir() == style.folder
    assert config.pipeline.coarse_run == coarse.folder and config.load_dir is None
    assert preview_steps(config.previews, 6) == {2, 6}
    models = leave_checkpoint(style, 1)
    config = style.config()
    assert config.pipeline.coarse_run is None and config.load_dir == models


def test_how_long_it_takes_is_told_from_earlier_runs_alone(queue: RunQueue, coarse: Run) -> None:
    assert "known once the first" in queue.forecast([coarse])
    folder = queue.folder / "coarse-fewshot" / "earlier"
    folder.mkdir(parents=True)
    (folder / SECONDS_FILE).write_text(json.dumps({"seconds": 60.0, "iterations": 5}))
    assert "1 take about 2:00 min, as earlier runs did." in queue.forecast([coarse])
    (folder / SECONDS_FILE).write_text('{"seconds": 6')
    assert "known once the first" in queue.forecast([coarse])


def test_what_is_left_is_told_after_each_run(queue: RunQueue, style: Run) -> None:
    queue.train([style, replace(style, name="ours-arf", settings=(("pipeline.content_weight", 1.0),))])
    told = [line for line in queue.said if line.startswith("3 runs")]
    assert [line[:27] for line in told] == [f"3 runs, {done} of them finished." for done in range(3)]
    assert "known once the first" in told[1] and "1 take about" in told[2]


def test_time_spent_is_kept_beside_the_run(queue: RunQueue, style: Run) -> None:
    leave_checkpoint(style, 1)
    (style.folder / SECONDS_FILE).write_text(json.dumps({"seconds": 60.0, "iterations": 2}))
    queue.train([style])
    record = json.loads((style.folder / SECONDS_FILE).read_text())
    assert record["iterations"] == 6 and record["seconds"] > 60


FAILING = f"""
import os
from pathlib import Path
from sparsestyle_ns.utils.progress import ProgressReport
print("something else")
ProgressReport(failure="Error: the scene is gone").write(Path(os.environ["{PROGRESS_FILE}"]))
raise SystemExit(1)
"""


def test_a_run_that_fails_is_named_with_what_it_reports_and_its_log(
    queue: RunQueue, coarse: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_queue, "TRAINING_PROCESS", (sys.executable, "-c", FAILING))
    with pytest.raises(InputError, match=r"ours-[0-9a-f]{8} didn't finish \(Error: the scene is gone\).*\.log"):
        queue.train([coarse])
    monkeypatch.setattr(run_queue, "TRAINING_PROCESS", (sys.executable, "-c", "raise SystemExit(3)"))
    with pytest.raises(InputError, match=r"didn't finish \(its process ended with status 3\)"):
        queue.train([coarse])


@pytest.mark.parametrize(
    ("failure", "sentence"),
    [
        (SystemExit("Error: the scene is gone"), "Error: the scene is gone"),
        (ValueError("no such shape"), "ValueError: no such shape"),
        (SystemExit(0), ""),
    ],
)
def test_a_training_process_reports_why_it_failed(
    failure: BaseException, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(config: object) -> None:
        raise failure

    monkeypatch.setattr(run_queue.train, "main", fail)
    monkeypatch.setenv(PROGRESS_FILE, str(tmp_path / "progress.json"))
    with pytest.raises(type(failure)):
        run_queue.train_run(None)
    assert ProgressReport.read(tmp_path / "progress.json").failure == sentence


def test_after_ctrl_c_nothing_more_is_begun(
    queue: RunQueue, coarse: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    begun = []

    def interrupt(self: RunQueue, run: Run, *_: object) -> None:
        begun.append(run.name)
        raise KeyboardInterrupt

    monkeypatch.setattr(RunQueue, "_train", interrupt)
    with pytest.raises(SystemExit) as ended:
        queue.train([replace(coarse, name=str(number)) for number in range(8)])
    assert ended.value.code == 130
    assert "Stopped by Ctrl-C; the same command goes on where it was." in capsys.readouterr().err
    assert begun == ["0"]


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_run_doesnt_outlive_the_command_that_began_it(
    number: int, jobs: int, queue: RunQueue, coarse: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = tmp_path / "begun"
    begun.mkdir()
    lasting = f"import os, pathlib, time; pathlib.Path({str(begun)!r}, str(os.getpid())).touch(); time.sleep(60)"
    monkeypatch.setattr(run_queue, "TRAINING_PROCESS", (sys.executable, "-c", lasting))

    def press() -> None:
        while len(list(begun.iterdir())) < jobs:
            time.sleep(0.05)
        os.kill(os.getpid(), number)

    threading.Thread(target=press, daemon=True).start()
    before = signal.getsignal(number)
    with pytest.raises(SystemExit) as ended:
        replace(queue, jobs=jobs).train([replace(coarse, name=str(number)) for number in range(jobs)])
    assert ended.value.code == 128 + number
    assert signal.getsignal(number) is before
    assert not [path.name for path in begun.iterdir() if Path("/proc", path.name).exists()]


def test_runs_beside_each_other_share_the_cores(queue: RunQueue, coarse: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs_seen = []
    train = RunQueue._train

    def spy(self: RunQueue, run: Run, jobs: int) -> None:
        jobs_seen.append(jobs)
        train(self, run, jobs)

    monkeypatch.setattr(RunQueue, "_train", spy)
    queue.jobs = 2
    queue.train([replace(coarse, name=name, settings=((name, 1),)) for name in ("a", "b")])
    assert jobs_seen == [2, 2]


SLOW = """
import os, time
from pathlib import Path
from sparsestyle_ns.utils.progress import ProgressReport, Work
works = (Work("Warm start", 3, 4, ""), Work("Stage 1", 7, 10, "iterations"))
ProgressReport(works).write(Path(os.environ["SPARSESTYLE_PROGRESS_FILE"]))
time.sleep(0.5)
"""


def test_how_far_a_run_is_is_shown_by_what_it_reports(
    queue: RunQueue, coarse: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    reached = []
    monkeypatch.setattr(run_queue, "SECONDS_BETWEEN_LOOKS", 0.05)
    monkeypatch.setattr("sparsestyle_ns.utils.progress.Bar.reach", lambda bar, done: reached.append(done))
    monkeypatch.setattr(run_queue, "TRAINING_PROCESS", (sys.executable, "-c", SLOW))
    with pytest.raises(InputError, match="didn't finish"):
        queue.train([coarse])
    assert set(reached) == {7}


def test_a_run_is_one_of_ns_train_in_a_process_of_its_own(llff_scene: Path, tmp_path: Path) -> None:
    flags = (*TINY, "--pipeline.datamanager.num-views", "2")
    study = Study(llff_scene, LLFFDataParserConfig(), False, coarse_iterations=2, coarse_flags=flags)
    run, said = replace(PaperRuns(study, tmp_path).coarse("freenerf"), pictures=(1, 2)), []
    RunQueue(tmp_path / study.name, 1, said.append).train([run])
    assert run.is_finished
    assert json.loads((run.folder / "scene.json").read_text())["view_ids"] == [1, 11]
    assert (run.folder / "config.yml").is_file()
    assert preview_path(run.folder, 1).is_file() and preview_path(run.folder, 2).is_file()
    assert said[-1].startswith(f"{run.folder.name}: 2 iterations in")
