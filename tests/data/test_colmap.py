"""COLMAP models at nerfstudio's edges: photos over 1,600 pixels, and names with spaces in models of text."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from PIL import Image

from sparsestyle_ns.data.reading import read_scene
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.utils.errors import InputError

NAMES = ["my photo 1.png", "my photo 2.png", "my  photo 3.png", "plain.png"]


def write_model(folder, names=NAMES, size=(16, 12)):
    """Photos and a model of text; returns the dataparser's config."""
    (folder / "images").mkdir(parents=True)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    lines = ["# a comment", ""]
    for index, name in enumerate(names):
        colors = np.random.default_rng(index).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
        Image.fromarray(colors).save(folder / "images" / name)
        lines += [f"{index + 1} 1 0 0 0 {index} 0 0 1 {name}", "1 1 1" if index % 2 else ""]
    width, height = size
    (sparse / "cameras.txt").write_text(f"1 PINHOLE {width} {height} {width} {width} {width / 2} {height / 2}\n")
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    (sparse / "points3D.txt").write_text("1 0 0 0 255 0 0 0.5 1 0\n")
    return ColmapDataParserConfig(data=folder, colmap_path="sparse/0", eval_mode="all")


def files_below(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


def test_names_with_spaces_are_read_whole(tmp_path):
    config = write_model(tmp_path / "a scene")
    before = files_below(tmp_path)
    outputs = read_scene(config.setup())
    assert [path.name for path in outputs.image_filenames] == NAMES
    assert all(path.is_file() for path in outputs.image_filenames)
    assert files_below(tmp_path) == before


def test_masks_of_photos_with_spaces_are_found(tmp_path):
    config = write_model(tmp_path)
    (tmp_path / "masks").mkdir()
    for name in NAMES:
        Image.new("L", (16, 12), 255).save(tmp_path / "masks" / name)
    outputs = read_scene(replace(config, masks_path="masks").setup())
    assert [path.name for path in outputs.mask_filenames] == NAMES


def test_photos_over_1600_pixels_are_reduced_in_memory_and_nothing_is_written(tmp_path, monkeypatch):
    config = write_model(tmp_path, ["a.png", "b.png", "c.png"], size=(1640, 12))
    before = files_below(tmp_path)
    monkeypatch.setenv("PATH", "")  # no ffmpeg
    monkeypatch.setattr("builtins.input", lambda *_: pytest.fail("nobody is asked"))
    manager = FewShotDataManagerConfig(dataparser=config, max_image_side=1640).setup(device="cpu", test_mode="val")
    manager.load_pixels()
    assert manager.pixels.sizes == ((12, 1640),) * 3
    assert manager.photo_side == 1640
    assert files_below(tmp_path) == before


@pytest.mark.parametrize("factor", [2, 0])
def test_reduced_photos_that_are_not_there_are_named(tmp_path, factor):
    config = replace(write_model(tmp_path), downscale_factor=factor)
    with pytest.raises(
        InputError, match=f"There is no folder .*images_{factor} for --downscale-factor {factor}: leave"
    ):
        read_scene(config.setup())
    assert not (tmp_path / "images_2").exists()


def test_reduced_photos_that_are_there_are_read(tmp_path):
    config = replace(write_model(tmp_path), downscale_factor=2)
    (tmp_path / "images_2").mkdir()
    for name in NAMES:
        Image.open(tmp_path / "images" / name).resize((8, 6)).save(tmp_path / "images_2" / name)
    outputs = read_scene(config.setup())
    assert int(outputs.cameras.width[0]) == 8
    assert outputs.image_filenames[0] == tmp_path / "images_2" / NAMES[0]


def test_a_model_somewhere_else_is_named_with_the_flag_that_leads_there(tmp_path):
    config = write_model(tmp_path)
    advice = r"There is no COLMAP model at .*colmap/sparse/0; there is one at (\S+): add --colmap-path (\S+) behind"
    with pytest.raises(InputError, match=advice) as refused:
        read_scene(replace(config, colmap_path=ColmapDataParserConfig().colmap_path).setup())
    place = re.search(advice, str(refused.value))[2]
    assert len(read_scene(replace(config, colmap_path=place).setup()).image_filenames) == len(NAMES)
    (tmp_path / "sparse" / "0").rename(tmp_path / "sparse" / "7")
    with pytest.raises(InputError, match="say where it is behind the word colmap, as by --colmap-path sparse/0"):
        read_scene(config.setup())


@pytest.mark.parametrize("names", [NAMES, ["a.png", "b.png", "c.png", "d.png"]])
def test_a_scene_may_be_named_from_where_one_is(tmp_path, monkeypatch, names):
    write_model(tmp_path / "capture", names)
    monkeypatch.chdir(tmp_path)
    config = ColmapDataParserConfig(data=Path("capture"), colmap_path=Path("sparse/0"), eval_mode="all")
    assert [path.name for path in read_scene(config.setup()).image_filenames] == names
