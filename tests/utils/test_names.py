"""Names of files and paintings are told apart, and fit for any disk."""

import pytest

from sparsestyle_ns.utils.files import LONGEST, free_name, safe_file_name


def test_names_are_told_apart():
    assert [free_name("a", ["b"]), free_name("a", ["a"]), free_name("a", ["a", "a 2"])] == ["a", "a 2", "a 3"]


@pytest.mark.parametrize(
    "name, safe",
    [
        ("Sternennacht (1889), Ölfarbe.jpg", "Sternennacht (1889), Ölfarbe.jpg"),
        ("星月夜.png", "星月夜.png"),
        ("what? <a>:\n*.webp", "what_ _a____.webp"),
        ("a/b\\c\0.png", "a_b_c_.png"),
        ("not utf-8 \udcff.png", "not utf-8 _.png"),
        (".hidden.png", "hidden.png"),
        ("..", "painting"),
        ("", "painting"),
        ("upload", "upload"),
    ],
)
def test_a_files_name_keeps_its_letters_and_loses_what_disks_and_shells_dont_take(name, safe):
    assert safe_file_name(name, "painting") == safe


@pytest.mark.parametrize("name", ["é" * 300 + ".jpeg", "a." + "b" * 300, "星" * 300])
def test_a_long_name_is_cut_and_keeps_its_suffix(name, tmp_path):
    safe = safe_file_name(name, "painting")
    assert 100 < len(safe.encode()) <= LONGEST or "." in name[:2]
    assert safe.endswith(".jpeg") == name.endswith(".jpeg")
    (tmp_path / (safe + ".unfinished")).write_text("a disk takes it")
