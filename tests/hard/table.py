"""The table of hard cases: where numbers could break, how, and what must hold instead; one test for each row.

A row stands where its test is:

    @hard_case(
        "compositing",
        case="density 1e10 in the first sample",
        could_go_wrong="σ δ overflows, and 0 · inf behind it is not a number",
        must_hold="the first weight is 1, all others 0",
    )
    def test_...

The decorator marks the test `hard`; such tests stand in files of this folder. `test_hard_table.py` fails for a `hard`
test without a row, and for a row whose test pytest can't see. A run that has `hard` tests ends with a summary, with
`-v` the whole table; this module is the pytest plugin that prints it, also where pytest-xdist's workers run the tests.
"""

from collections import Counter
from typing import Callable, Dict, List, NamedTuple, Optional, TypeVar

import pytest

PROPERTY = "hard_case"
"""Reports carry their row under this name, which brings it from a worker to the process that prints."""
OUTCOMES = ("passed", "failed", "skipped")

Test = TypeVar("Test", bound=Callable[..., None])


class Row(NamedTuple):
    """One row of the table; a group is what a file's tests are about."""

    group: str
    case: str
    could_go_wrong: str
    must_hold: str


COLLECTED = pytest.StashKey[List[pytest.Item]]()
"""All `hard` tests of a run, those included that are then deselected."""
ROWS: Dict[Row, str] = {}
"""The rows of the modules that were imported, with the names of their tests."""


def hard_case(group: str, *, case: str, could_go_wrong: str, must_hold: str) -> Callable[[Test], Test]:
    """Enters a row in the table, and marks the test under it `hard`."""
    row = Row(group, case, could_go_wrong, must_hold)

    def enter(test: Test) -> Test:
        ROWS[row] = test.__name__
        return pytest.mark.hard(row)(test)

    return enter


def row_of(item: pytest.Item) -> Optional[Row]:
    """The row a collected test belongs to, or None."""
    rows = [argument for mark in item.iter_markers("hard") for argument in mark.args]
    return rows[0] if rows else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: List[pytest.Item]) -> None:
    hard = config.stash[COLLECTED] = [item for item in items if item.get_closest_marker("hard")]
    for item in hard:
        row = row_of(item)
        if row is not None:
            item.user_properties.append((PROPERTY, tuple(row)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    outcomes = _outcomes(terminalreporter)
    if not outcomes:
        return
    terminalreporter.section("hard cases")
    for group in sorted({row.group for row in outcomes}):
        counts = Counter(outcome for row, outcome in outcomes.items() if row.group == group)
        terminalreporter.line(f"{group:<16}" + ", ".join(f"{counts[key]} {key}" for key in OUTCOMES if counts[key]))
    totals = Counter(outcomes.values())
    total = ", ".join(f"{totals[key]} {key}" for key in OUTCOMES if totals[key])
    terminalreporter.line(f"{len(outcomes)} rows: {total}", red=totals["failed"] > 0, green=totals["failed"] == 0)
    for row, outcome in sorted(outcomes.items()):
        if outcome != "passed" or config.get_verbosity() > 0:
            terminalreporter.line(f"{outcome.upper()} {row.group}: {row.case}", bold=True)
            terminalreporter.line(f"    could go wrong: {row.could_go_wrong}")
            terminalreporter.line(f"    must hold: {row.must_hold}")


def _outcomes(terminalreporter: pytest.TerminalReporter) -> Dict[Row, str]:
    """What became of each row: failed if any of its tests did, passed only if none was left out."""
    seen: Dict[Row, Counter] = {}
    for reports in terminalreporter.stats.values():
        for report in reports:
            if not isinstance(report, pytest.TestReport):  # tests that were deselected stand here too, as they are
                continue
            for name, value in report.user_properties:
                if name == PROPERTY:
                    seen.setdefault(Row(*value), Counter())[report.outcome] += 1
    return {row: next(key for key in ("failed", "skipped", "passed") if found[key]) for row, found in seen.items()}
