"""Bars on a terminal, lines in a log, and one last line that says what was made and what to type next."""

import io
import re
import threading
from pathlib import Path

import pytest
from nerfstudio.engine.trainer import Trainer
from rich.console import Console

from sparsestyle_ns.engine.previews import preview_steps
from sparsestyle_ns.engine.trainer import CoarseFewShotTrainer
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.utils import progress
from sparsestyle_ns.utils.errors import InputError


class Clock:
    """Time that passes only when it is told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(progress.time, "monotonic", clock.monotonic)
    return clock


def use_console(monkeypatch: pytest.MonkeyPatch, clock: Clock, terminal: bool) -> io.StringIO:
    """Where bars and lines go to from now on."""
    output = io.StringIO()
    console = Console(file=output, force_terminal=terminal, width=100, get_time=clock.monotonic, color_system=None)
    monkeypatch.setattr(progress, "CONSOLE", console)
    return output


def test_a_log_gets_a_line_now_and_then_and_one_at_the_end(monkeypatch: pytest.MonkeyPatch, clock: Clock) -> None:
    output = use_console(monkeypatch, clock, terminal=False)
    with progress.bar("Stage 1", 100, unit="iterations") as one:
        for step in range(100):
            clock.now += 3.0
            one.advance(note=f"psnr {step}")
    lines = output.getvalue().splitlines()
    assert lines[0] == "Stage 1: 5 of 100 iterations (5%), 4:45 min left; psnr 4"
    assert lines[-1] == "Stage 1: 100 iterations in 5:00 min"
    assert len(lines) == 20


def test_slow_steps_are_told_at_most_a_minute_late(monkeypatch: pytest.MonkeyPatch, clock: Clock) -> None:
    output = use_console(monkeypatch, clock, terminal=False)
    with progress.bar("Stage 1", 10_000) as one:
        for _ in range(20):
            clock.now += 9.0
            one.advance()
    assert [line.split(" (")[0] for line in output.getvalue().splitlines()] == [
        "Stage 1: 7 of 10000",
        "Stage 1: 14 of 10000",
    ]


def test_quick_work_leaves_no_trace_in_a_log(monkeypatch: pytest.MonkeyPatch, clock: Clock) -> None:
    output = use_console(monkeypatch, clock, terminal=False)
    assert list(progress.track(range(9), "Views")) == list(range(9))
    assert output.getvalue() == ""


def test_work_that_was_done_before_does_not_count_as_quick(monkeypatch: pytest.MonkeyPatch, clock: Clock) -> None:
    output = use_console(monkeypatch, clock, terminal=False)
    with progress.bar("Stage 2", 200, done=100) as one:
        for _ in range(50):
            clock.now += 1.0
            one.advance()
    assert output.getvalue().splitlines()[-1] == "Stage 2: 150 of 200 (75%), 0:50 min left"


def test_interrupted_work_is_not_said_to_be_done(monkeypatch: pytest.MonkeyPatch, clock: Clock) -> None:
    output = use_console(monkeypatch, clock, terminal=False)
    with pytest.raises(KeyboardInterrupt), progress.bar("Stage 2", 200) as one:
        clock.now += 30.0
        one.advance()
        raise KeyboardInterrupt
    assert " in " not in output.getvalue()


def test_a_terminal_shows_bars_with_the_time_left_and_none_of_them_stays(
    monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    output = use_console(monkeypatch, clock, terminal=True)
    with progress.bar("Stage 2", 10) as outer:
        clock.now += 2.0
        outer.advance(note="style 0.12")
        progress._display.refresh()
        for _ in progress.track([1, 2], "Held-out views"):
            clock.now += 1.0
            progress._display.refresh()
        progress.say("A line [in brackets]")
    shown = output.getvalue()
    assert re.search(r"Stage 2 +\S+ +1/10 +0:18 min left +style 0.12", shown)
    assert re.search(r"Held-out views .*1/2", shown)
    assert "A line [in brackets]\n" in shown
    assert shown.endswith("\x1b[2K\x1b[?25h\r")  # the last of the bars' lines is cleared, and the cursor is back
    assert progress._display is None


def test_one_thing_alone_needs_no_bar(monkeypatch: pytest.MonkeyPatch, clock: Clock) -> None:
    output = use_console(monkeypatch, clock, terminal=True)
    with progress.bar("The only view", 1) as one:
        progress._display.refresh()
        clock.now += 60.0
        one.advance()
    assert "only view" not in output.getvalue()


def test_threads_share_the_display(monkeypatch: pytest.MonkeyPatch, clock: Clock) -> None:
    output = use_console(monkeypatch, clock, terminal=True)
    ready, done = threading.Barrier(3), threading.Event()

    def work(name: str) -> None:
        with progress.bar(name, 3) as one:
            one.advance()
            ready.wait(5)
            done.wait(5)

    threads = [threading.Thread(target=work, args=(name,)) for name in ("first", "second")]
    for thread in threads:
        thread.start()
    ready.wait(5)
    progress._display.refresh()
    done.set()
    for thread in threads:
        thread.join()
    assert re.search(r"first .*1/3.*\n.*second .*1/3|second .*1/3.*\n.*first .*1/3", output.getvalue())
    assert progress._display is None


@pytest.mark.parametrize("seconds, words", [(59.6, "1:00 min"), (125, "2:05 min"), (7320, "2 h 2 min")])
def test_durations_are_said_in_minutes_or_hours(seconds: float, words: str) -> None:
    assert progress.duration(seconds) == words


def test_previews_are_due_at_shares_of_the_iterations_and_never_before_the_first() -> None:
    assert preview_steps((0.05, 0.5, 1.0), 200) == {10, 100, 200}
    assert preview_steps((0.05, 1.0), 3) == {1, 3}
    assert preview_steps((), 3) == frozenset()


@pytest.mark.parametrize("share", [0.0, -0.5, 1.01])
def test_previews_outside_of_training_are_refused(share: float) -> None:
    with pytest.raises(InputError, match="isn't a share of the iterations"):
        preview_steps((share,), 100)


def test_a_closed_viewer_ends_training_without_a_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def close(self: Trainer) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Trainer, "_train_complete_viewer", close)
    trainer = CoarseFewShotTrainer.__new__(CoarseFewShotTrainer)
    trainer.config, trainer.base_dir = method_config("coarse-fewshot"), Path("run")
    said = []
    trainer.finish = lambda: said.append("the last line")
    trainer._train_complete_viewer()
    assert said == ["the last line"]  # while the viewer is open; the command says it again when it ends
