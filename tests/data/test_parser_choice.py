"""Which dataparser reads a scene."""

from pathlib import Path

import pytest
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.data.parser_choice import parse_dataparser
from sparsestyle_ns.utils.errors import InputError


def test_the_scenes_files_tell_its_dataparser(llff_scene: Path) -> None:
    assert isinstance(parse_dataparser((), llff_scene), LLFFDataParserConfig)


def test_a_dataparser_is_named_with_its_options(llff_scene: Path) -> None:
    named = parse_dataparser(("llff-data", "--eval-interval", "4"), llff_scene)
    assert isinstance(named, LLFFDataParserConfig) and named.eval_interval == 4
    other = parse_dataparser(("colmap", "--colmap-path", "sparse/0"), llff_scene)
    assert isinstance(other, ColmapDataParserConfig) and other.colmap_path == Path("sparse/0")


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    for words, folder, sentence in (
        (("no-data",), tmp_path, "There is no dataparser no-data"),
        (("llff-data",), tmp_path / "gone", "There is no scene at --data .*gone"),
        ((), tmp_path, "has none of poses_bounds.npy, .* the dataparser isn't known"),
    ):
        with pytest.raises(InputError, match=sentence):
            parse_dataparser(words, folder)
