"""Masks of every kind, transparent photos and depth maps of a scene: honoured, or named in a line."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from test_commands import write_ring, write_transforms

from sparsestyle_ns.pipelines.datamanager import FewShotDataManager, FewShotDataManagerConfig
from sparsestyle_ns.pipelines.nerfstudio_options import unused_of_scene
from sparsestyle_ns.utils.errors import InputError


def manager_of(folder: Path) -> FewShotDataManager:
    parser = NerfstudioDataParserConfig(eval_mode="all")
    manager = FewShotDataManagerConfig(data=folder, dataparser=parser).setup(device="cpu", test_mode="val")
    manager.load_pixels()
    return manager


def with_masks(folder: Path, **entries: str) -> np.ndarray:
    """A capture, with a mask for each photo that is to be written; returns which pixels it leaves in."""
    write_transforms(folder, write_ring(folder))
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    for index, frame in enumerate(content["frames"]):
        frame.update({key: value.format(index) for key, value in entries.items()})
    path.write_text(json.dumps(content))
    inside = np.zeros((12, 16), bool)
    inside[3:9, 4:12] = True
    return inside


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "I;16"])
def test_masks_of_every_mode_say_what_is_trained_on(tmp_path, mode):
    inside = with_masks(tmp_path, mask_path="images/mask_{}.png")
    grey = np.where(inside, 255, 0)
    deep = Image.fromarray((grey * 257).astype(np.uint16))
    picture = deep if mode == "I;16" else Image.fromarray(grey.astype(np.uint8)).convert(mode)
    for index in range(6):
        picture.save(tmp_path / "images" / f"mask_{index}.png")
    manager = manager_of(tmp_path)
    trusted = np.zeros(6 * 12 * 16, bool)
    trusted[manager.pixels.trusted.numpy()] = True
    np.testing.assert_array_equal(trusted.reshape(6, 12, 16), np.repeat(inside[None], 6, axis=0))
    assert unused_of_scene(manager.train_dataparser_outputs)[0].startswith("Masks say what stage 1 trains on")


def test_a_mask_that_leaves_nothing_in_is_named(tmp_path):
    with_masks(tmp_path, mask_path="images/mask_{}.png")
    for index in range(6):
        Image.new("L", (16, 12), 255 * (index != 2)).save(tmp_path / "images" / f"mask_{index}.png")
    with pytest.raises(InputError, match=r"The mask .*mask_2\.png leaves nothing of .*2\.png in"):
        manager_of(tmp_path)


def test_transparent_photos_are_laid_over_white_and_named(tmp_path):
    write_transforms(tmp_path, write_ring(tmp_path))
    path = tmp_path / "images" / "1.png"
    pixels = np.dstack([np.asarray(Image.open(path)), np.full((12, 16), 255, np.uint8)])
    pixels[:, :8, 3] = 0
    Image.fromarray(pixels).save(path)
    manager = manager_of(tmp_path)
    colors = manager.pixels.colors[manager.pixels.rows(1)].view(12, 16, 3)
    assert (colors[:, :8] == 1).all() and not (colors[:, 8:] == 1).all()
    assert manager.scene.transparent
    lines = unused_of_scene(manager.train_dataparser_outputs)
    assert lines == ["Transparent in places, and laid over RGB 1, 1, 1: 1.png."]


def test_depth_maps_are_said_to_have_no_use(tmp_path):
    with_masks(tmp_path, depth_file_path="images/depth_{}.png")
    outputs = manager_of(tmp_path).train_dataparser_outputs
    assert "depth maps aren't used" in unused_of_scene(outputs)[0]
    assert unused_of_scene(replace(outputs, metadata={})) == []
