"""A process tells the one that started it how far it is."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sparsestyle_ns.utils import progress
from sparsestyle_ns.utils.progress import PROGRESS_FILE, ProgressReport, Work, report


def test_a_report_is_read_as_it_was_written_and_is_empty_before(tmp_path: Path) -> None:
    path = tmp_path / "progress.json"
    assert ProgressReport.read(path) == ProgressReport((), "")
    written = ProgressReport((Work("Stage 1", 15, 200, "iterations"), Work("Views", 1, 3, "")), "Error: \u03bb is gone")
    written.write(path)
    assert ProgressReport.read(path) == written
    assert [file.name for file in tmp_path.iterdir()] == ["progress.json"]  # nothing unfinished stays


def test_a_process_that_nobody_asked_writes_nothing_and_one_that_cant_write_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(PROGRESS_FILE, raising=False)
    monkeypatch.chdir(tmp_path)
    report(ProgressReport(failure="why"))
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setenv(PROGRESS_FILE, str(tmp_path / "gone" / "progress.json"))
    report(ProgressReport(failure="why"))


def test_bars_are_reported_with_all_that_is_under_way_and_not_more_than_once_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "progress.json"
    monkeypatch.setenv(PROGRESS_FILE, str(path))
    monkeypatch.setattr(progress, "_reported_at", -1e9)
    with progress.bar("Stage 1", 200, done=10, unit="iterations") as outer, progress.bar("Views", 3) as inner:
        outer.advance(5)
        first = ProgressReport.read(path)
        inner.advance()
        assert ProgressReport.read(path) == first
        monkeypatch.setattr(progress, "_reported_at", -1e9)
        inner.advance()
        second = ProgressReport.read(path)
    assert first.works == (Work("Stage 1", 15, 200, "iterations"), Work("Views", 0, 3, ""))
    assert second.works == (Work("Stage 1", 15, 200, "iterations"), Work("Views", 2, 3, ""))


CHILD = """
from sparsestyle_ns.utils.progress import bar
with bar("Stage 1", 200, unit="iterations") as shown:
    shown.reach(20)
"""


def test_another_process_is_followed_without_a_look_at_what_it_prints(tmp_path: Path) -> None:
    path = tmp_path / "progress.json"
    environment = {**os.environ, PROGRESS_FILE: str(path)}
    subprocess.run([sys.executable, "-c", CHILD], env=environment, stdout=subprocess.DEVNULL, check=True)
    assert ProgressReport.read(path).works == (Work("Stage 1", 20, 200, "iterations"),)
