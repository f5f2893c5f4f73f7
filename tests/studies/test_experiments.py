"""Runs are found again by what they are, gone on with, and not done twice."""

import json
import sys
from pathlib import Path

import pytest

from sparsestyle_ns.studies.experiments import (
    SECONDS_FILE,
    Experiment,
    Laboratory,
    SceneSettings,
    last_words,
    share_done,
)
from sparsestyle_ns.utils import progress
from sparsestyle_ns.utils.errors import InputError

PRETEND = """
import sys
from pathlib import Path
folder, iterations = Path(sys.argv[1]), int(sys.argv[2])
(folder / "nerfstudio_models").mkdir(parents=True, exist_ok=True)
for old in (folder / "nerfstudio_models").glob("*.ckpt"): old.unlink()
(folder / "nerfstudio_models" / f"step-{iterations - 1:09d}.ckpt").touch()
print(f"{iterations} (100.00%)")
"""


@pytest.fixture
def scene(tmp_path: Path) -> SceneSettings:
    (tmp_path / "fern").mkdir()
    return SceneSettings(tmp_path / "fern", "llff-data", tmp_path / "outputs")


@pytest.fixture
def laboratory(scene: SceneSettings, monkeypatch: pytest.MonkeyPatch) -> Laboratory:
    """One whose training leaves a checkpoint and nothing else; `said` holds its lines, `trained` what it trained."""
    trained = []

    def command(experiment: Experiment, scene: SceneSettings, iterations: int) -> list:
        trained.append((experiment.name, experiment.steps_done(scene), iterations))
        return [sys.executable, "-c", PRETEND, str(experiment.folder(scene)), str(iterations)]

    monkeypatch.setattr(Experiment, "command", command)
    said: list = []
    found = Laboratory(scene, jobs=1, say=said.append)
    found.said, found.trained = said, trained
    return found


COARSE = Experiment("ours", "coarse-fewshot", 10)
STYLE = Experiment("ours-ours", "hier-style", 6, coarse=COARSE, stops=(2, 4))


def test_a_coarse_run_comes_first_and_once_and_stops_are_called_on_the_way(laboratory: Laboratory) -> None:
    other = Experiment("ours-arf", "hier-style", 6, ("--flag",), coarse=COARSE)
    stops = []
    laboratory.run([STYLE, other, STYLE], lambda each, at: stops.append((each.name, at)))
    assert laboratory.trained == [
        ("ours", 0, 10),
        ("ours-ours", 0, 2),
        ("ours-ours", 2, 4),
        ("ours-ours", 4, 6),
        ("ours-arf", 0, 6),
    ]
    assert stops == [("ours-ours", 2), ("ours-ours", 4)]


def test_finished_runs_are_not_done_again_and_interrupted_ones_are_gone_on_with(laboratory: Laboratory) -> None:
    laboratory.run([COARSE])
    folder = STYLE.folder(laboratory.scene) / "nerfstudio_models"
    folder.mkdir(parents=True)
    (folder / "step-000000002.ckpt").touch()
    laboratory.trained.clear()
    laboratory.run([STYLE])
    assert laboratory.trained == [("ours-ours", 3, 4), ("ours-ours", 4, 6)]
    laboratory.trained.clear()
    laboratory.run([STYLE])
    assert laboratory.trained == []
    assert laboratory.said[-1] == "2 runs, 2 of them finished."


def test_whatever_decides_the_outcome_decides_the_folder(scene: SceneSettings, tmp_path: Path) -> None:
    painting, other = tmp_path / "a.png", tmp_path / "b.png"
    painting.write_bytes(b"one")
    other.write_bytes(b"two")
    base = Experiment("x", "hier-style", 6, ("--flag",), painting, COARSE)
    changed = [
        Experiment("x", "hier-style", 7, ("--flag",), painting, COARSE),
        Experiment("x", "hier-style", 6, ("--other",), painting, COARSE),
        Experiment("x", "hier-style", 6, ("--flag",), other, COARSE),
        Experiment("x", "hier-style", 6, ("--flag",), painting, Experiment("y", "coarse-fewshot", 11)),
    ]
    digests = {each.digest(scene) for each in (base, *changed)}
    digests.add(base.digest(SceneSettings(scene.data, scene.parser, scene.output_dir, ("--max-image-side", "9"))))
    assert len(digests) == len(changed) + 2
    moved = SceneSettings(scene.data, scene.parser, tmp_path / "elsewhere")
    renamed = Experiment("z", "hier-style", 6, ("--flag",), painting, COARSE, stops=(3,))
    assert base.digest(moved) == base.digest(scene) == renamed.digest(scene)


def test_the_command_names_the_folder_the_iterations_and_where_to_start(scene: SceneSettings) -> None:
    command = STYLE.command(scene, 4)
    assert command[3] == "hier-style" and command[-1] == "llff-data"
    pairs = dict(zip(command[4:-1:2], command[5::2], strict=False))
    assert pairs["--timestamp"] == STYLE.folder(scene).name
    assert pairs["--max-num-iterations"] == "4"
    assert pairs["--coarse-run"] == str(COARSE.folder(scene))
    models = STYLE.folder(scene) / "nerfstudio_models"
    models.mkdir(parents=True)
    (models / "step-000000001.ckpt").touch()
    command = STYLE.command(scene, 4)
    assert "--coarse-run" not in command
    assert command[command.index("--load-dir") + 1] == str(models)


def test_how_long_it_takes_is_told_from_earlier_runs_alone(laboratory: Laboratory) -> None:
    assert "known once the first" in laboratory.forecast([COARSE], [COARSE])
    folder = laboratory.scene.output_dir / "fern" / "coarse-fewshot" / "earlier"
    folder.mkdir(parents=True)
    (folder / SECONDS_FILE).write_text(json.dumps({"seconds": 60.0, "iterations": 5}))
    assert "1 take about 2:00 min, as earlier runs did." in laboratory.forecast([COARSE], [COARSE])


def test_what_is_left_is_told_after_each_run(laboratory: Laboratory) -> None:
    laboratory.run([STYLE, Experiment("ours-arf", "hier-style", 6, ("--flag",), coarse=COARSE)])
    told = [line for line in laboratory.said if line.startswith("3 runs")]
    assert [line[:27] for line in told] == [f"3 runs, {done} of them finished." for done in range(3)]
    assert "known once the first" in told[1] and "1 take about" in told[2]


def test_time_spent_is_kept_beside_the_run(laboratory: Laboratory) -> None:
    laboratory.run([STYLE])
    record = json.loads((STYLE.folder(laboratory.scene) / SECONDS_FILE).read_text())
    assert record["iterations"] == 6 and record["seconds"] > 0


def test_a_run_that_fails_is_named_with_its_log(laboratory: Laboratory, monkeypatch: pytest.MonkeyPatch) -> None:
    fail = [sys.executable, "-c", "raise SystemExit('Error: the scene is gone')"]
    monkeypatch.setattr(Experiment, "command", lambda *_: fail)
    with pytest.raises(InputError, match=r"ours-[0-9a-f]{8} didn't finish \(Error: the scene is gone\).*\.log"):
        laboratory.run([COARSE])


def test_of_a_flag_that_doesnt_exist_the_words_are_told_and_not_the_box_around_them() -> None:
    box = "╭─ Unrecognized options ─────╮\n│ Unrecognized options: --foo │\n│ ─────── │\n│ Run it --help │\n╰──────╯\n"
    assert last_words("before\n" + box) == "Unrecognized options Unrecognized options: --foo Run it --help"
    assert last_words(box + "Error: the scene is gone\n") == "Error: the scene is gone"
    assert last_words("") == ""


def test_after_ctrl_c_nothing_more_is_begun(laboratory: Laboratory, monkeypatch: pytest.MonkeyPatch) -> None:
    begun = []

    def interrupt(self: Laboratory, experiment: Experiment, *_: object) -> None:
        begun.append(experiment.name)
        raise KeyboardInterrupt

    monkeypatch.setattr(Laboratory, "_train", interrupt)
    with pytest.raises(InputError, match="goes on where it was"):
        laboratory.run([Experiment(str(number), "hier-style", 1, (str(number),)) for number in range(8)])
    assert begun == ["0"]


def test_runs_beside_each_other_share_the_cores(laboratory: Laboratory, monkeypatch: pytest.MonkeyPatch) -> None:
    threads = []
    train_to = Laboratory._train_to

    def spy(self: Laboratory, experiment: Experiment, iterations: int, jobs: int) -> None:
        threads.append(jobs)
        train_to(self, experiment, iterations, jobs)

    monkeypatch.setattr(Laboratory, "_train_to", spy)
    laboratory.jobs = 2
    laboratory.run([Experiment("a", "hier-style", 1, ("--a",)), Experiment("b", "hier-style", 1, ("--b",))])
    assert threads == [2, 2]


def test_how_far_a_run_is_is_the_last_share_of_iterations_in_its_log(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", (0.0, 0.0))
    with progress.bar("Caching views", 4) as one:
        one.advance(3)
    assert share_done(capsys.readouterr().out) is None
    with progress.bar("Stage 1", 200, unit="iterations") as one:
        one.advance(10)
        one.advance(20, note="psnr 21.3")
    assert share_done(capsys.readouterr().out + "Warm start: 3 of 4 (75%)\n") == pytest.approx(0.15)
