from pathlib import Path

import pytest
from hard.table import COLLECTED, ROWS, row_of

FEWEST_ROWS = 1


class Collected:
    def pytest_collection_finish(self, session):
        self.items = session.items


@pytest.fixture(scope="module")
def hard_tests():
    """Every `hard` test of this folder, as pytest itself finds them; a run may have been asked for a few files only."""
    collected = Collected()
    folder = Path(__file__).parent
    status = pytest.main(["--collect-only", "-q", "-m", "hard", str(folder)], plugins=[collected])
    assert status == pytest.ExitCode.OK
    return collected.items


def test_every_hard_test_has_a_row(hard_tests, pytestconfig):
    everywhere = [*hard_tests, *pytestconfig.stash[COLLECTED]]
    assert {item.nodeid for item in everywhere if row_of(item) is None} == set()


def test_every_row_has_a_test(hard_tests):
    found = {row_of(item) for item in hard_tests}
    assert {row: test for row, test in ROWS.items() if row not in found} == {}


def test_no_two_tests_share_a_row_and_no_two_rows_a_case(hard_tests):
    tests = {(row_of(item), item.location[0], item.originalname) for item in hard_tests}
    assert len(tests) == len(ROWS) == len({(row.group, row.case) for row in ROWS})


def test_rows_say_all_three_things():
    assert [row for row in ROWS if not all(text.strip() for text in row)] == []


def test_no_row_is_skipped_or_expected_to_fail(hard_tests):
    excuses = {"skip", "skipif", "xfail"}
    assert [item.nodeid for item in hard_tests if excuses & {mark.name for mark in item.iter_markers()}] == []


def test_the_table_is_as_long_as_it_was(hard_tests):
    assert len(ROWS) >= FEWEST_ROWS
