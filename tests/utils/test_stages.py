"""Stages run once, in their order, with one bar for all; what a command prints and how it ends isn't lost."""

import os
import signal
import subprocess
import sys
from dataclasses import replace

import pytest

from sparsestyle_ns.utils import progress
from sparsestyle_ns.utils import stages as stages_module
from sparsestyle_ns.utils.stages import FINISHED, Stage, StageFailedError, run_command, run_stages, without_config


def append(folder, name):
    """A stage that adds a line to a file, so that one can count how often it ran."""
    code = f"open({str(folder / name)!r}, 'a').write('ran\\n')"
    return Stage(name, f"Writing {name}", [["python", "-c", code]], name)


def times_run(folder):
    return {path.name: len(path.read_text().splitlines()) for path in folder.iterdir() if path.is_file()}


def test_finished_stages_are_not_done_again(tmp_path, capsys):
    stages = [append(tmp_path, "first"), append(tmp_path, "second")]
    run_stages(tmp_path, stages)
    run_stages(tmp_path, stages)
    assert times_run(tmp_path) == {"first": 1, "second": 1}
    assert capsys.readouterr().out.count("done before") == 2


def test_force_does_all_again(tmp_path):
    stages = [append(tmp_path, "first"), append(tmp_path, "second")]
    run_stages(tmp_path, stages)
    run_stages(tmp_path, stages, force=True)
    assert times_run(tmp_path) == {"first": 2, "second": 2}


def test_changed_settings_and_all_that_follows_are_done_again(tmp_path):
    first, second, third = (append(tmp_path, name) for name in ("first", "second", "third"))
    run_stages(tmp_path, [first, second, third])
    second.settings = "48 frames"
    run_stages(tmp_path, [first, second, third])
    assert times_run(tmp_path) == {"first": 1, "second": 2, "third": 2}


def test_stage_whose_product_is_gone_is_done_again(tmp_path):
    stages = [append(tmp_path, "first"), append(tmp_path, "second")]
    run_stages(tmp_path, stages)
    (tmp_path / "first").unlink()
    run_stages(tmp_path, stages)
    assert times_run(tmp_path) == {"first": 1, "second": 2}


def test_failed_stage_ends_with_its_last_lines_and_is_done_again(tmp_path):
    code = "import sys; [print(f'line {i}') for i in range(30)]; sys.exit(3)"
    failing = Stage("second", "Failing", [["python", "-c", code]], "second")
    with pytest.raises(StageFailedError) as failure:
        run_stages(tmp_path, [append(tmp_path, "first"), failing])
    lines = str(failure.value).splitlines()
    assert lines[0] == "Failing: python ended with exit status 3; its last lines were"
    assert [line.strip() for line in lines[1:]] == [f"line {i}" for i in range(10, 30)]
    run_stages(tmp_path, [append(tmp_path, "first"), append(tmp_path, "second")])
    assert times_run(tmp_path) == {"first": 1, "second": 1}


def test_stage_that_makes_nothing_fails(tmp_path):
    idle = Stage("idle", "Doing nothing", [["python", "-c", "pass"]], "something")
    with pytest.raises(StageFailedError, match=r"Doing nothing: it ended without .*something"):
        run_stages(tmp_path, [idle])


def test_program_that_is_missing_is_named(tmp_path):
    missing = Stage("missing", "Calling", [["no-such-program"]], "something")
    with pytest.raises(StageFailedError, match="Calling: no-such-program can't be started"):
        run_stages(tmp_path, [missing])


def test_configuration_that_ns_train_prints_is_left_out():
    printed = [
        "Using --data",
        "─" * 30 + " Config " + "─" * 30,
        "TrainerConfig(",
        "",
        ")",
        "─" * 60,
        "",
        "Saving config",
    ]
    assert list(without_config(printed)) == ["Using --data", "Saving config"]


def test_silent_command_is_said_to_be_running(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(stages_module, "SILENCE", 0.2)
    run_command(["python", "-c", "import time; time.sleep(1); print('awake')"], "Sleeping")
    lines = [line.split(maxsplit=1)[1] for line in capsys.readouterr().out.splitlines()]
    assert lines[1:].count("still running …") >= 2
    assert lines[-1] == "awake"


def reports(done, total, description="Stage 1"):
    """Code of a command that says how far it is, as this package's commands do."""
    code = "from sparsestyle_ns.utils.progress import ProgressReport, Work, report; import time;"
    return code + f"report(ProgressReport((Work({description!r}, {done}, {total}, ''),))); time.sleep(1.5);"


def test_the_bar_for_all_moves_with_what_a_command_says_of_its_own(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", (0.0, 60.0))
    code = reports(1, 2) + f"open({str(tmp_path / 'half')!r}, 'w')"
    half = Stage("half", "Halving", [["python", "-c", code]], "half", seconds=60.0, works={"Stage 1": 0.2})
    run_stages(tmp_path, [half, replace(append(tmp_path, "rest"), seconds=40.0)])
    # A fifth of the first stage's time is before its bar, which is half way then: 60 (0.2 + 0.8 / 2).
    assert "The whole: 36 of 100 (36%)" in capsys.readouterr().out


def test_finished_stages_count_as_done(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", (0.0, 60.0))
    first, code = append(tmp_path, "first"), reports(1, 2) + f"open({str(tmp_path / 'half')!r}, 'w')"
    run_stages(tmp_path, [first])
    half = Stage("half", "Halving", [["python", "-c", code]], "half", works={"Stage 1": 0.0})
    run_stages(tmp_path, [first, half])
    assert "The whole: 75 of 100 (75%)" in capsys.readouterr().out


def test_a_commands_own_lines_of_progress_are_not_repeated(tmp_path, capsys):
    own = "Stage 1: 5 of 10 iterations (50%), 0:01 min left"
    code = f"print({own!r}); print('kept'); open({str(tmp_path / 'a')!r}, 'w')"
    run_stages(tmp_path, [Stage("a", "Printing", [["python", "-c", code]], "a")])
    shown = [line.split(maxsplit=1)[-1] for line in capsys.readouterr().out.splitlines() if line]
    assert "kept" in shown and own not in shown


def test_a_stage_may_find_that_there_is_nothing_left_to_do(tmp_path):
    (tmp_path / "made").touch()
    durations = run_stages(tmp_path, [Stage("made", "Making", lambda: [], "made")])
    assert durations[0][1] is not None and (tmp_path / FINISHED / "made").is_file()


def test_ctrl_c_reaches_the_command_once_and_waits_until_it_has_saved(tmp_path):
    child = (
        "import signal, time\n"
        "count = []\n"
        "signal.signal(signal.SIGINT, lambda *_: count.append(1))\n"
        "print('ready', flush=True)\n"
        "while not count: time.sleep(0.05)\n"
        "time.sleep(1)\n"
        f"open({str(tmp_path / 'saved')!r}, 'w').write(str(len(count)))\n"
    )
    code = (
        "from pathlib import Path\n"
        "from sparsestyle_ns.utils.stages import Stage, run_stages\n"
        f"folder = Path({str(tmp_path)!r})\n"
        f"run_stages(folder, [Stage('slow', 'Saving', [['python', '-c', {child!r}]], 'saved')])\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        for line in process.stdout:
            if line.split()[1:] == [b"ready"]:
                break
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    assert b"KeyboardInterrupt" in errors
    assert (tmp_path / "saved").read_text() == "1"
    assert not (tmp_path / FINISHED / "slow").exists()


def test_a_command_ends_with_what_it_was_started_by(tmp_path):
    child = (
        f"import os, time; open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); print('ready'); time.sleep(60)"
    )
    code = (
        "from pathlib import Path\n"
        "from sparsestyle_ns.utils.stages import Stage, run_stages\n"
        f"run_stages(Path({str(tmp_path)!r}), [Stage('slow', 'Waiting', [['python', '-c', {child!r}]], 'saved')])\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        for line in process.stdout:
            if line.split()[1:] == [b"ready"]:
                break
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=30) == 143
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)
