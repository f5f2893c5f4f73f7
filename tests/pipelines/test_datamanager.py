"""What the data manager makes of a scene's photos and cameras."""

import shutil
from dataclasses import dataclass, field, replace
from typing import Type

import numpy as np
import pytest
import torch
from conftest import decided
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from test_commands import write_ring, write_transforms

from sparsestyle_ns.data.llff import LLFFDataParser, LLFFDataParserConfig
from sparsestyle_ns.data.scene_info import SCENE_INFO, SceneInfo, scene_info
from sparsestyle_ns.effects.decisions import EffectSettings
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.utils.errors import InputError


def photos(data, dataparser, side):
    config = FewShotDataManagerConfig(data=data, dataparser=dataparser, max_image_side=side)
    return config.setup(device="cpu", test_mode="inference").train_dataset


def corner_directions(cameras):
    """Rays through the four corners of the first image, and through its middle."""
    size = torch.tensor([float(cameras.height[0]), float(cameras.width[0])])
    shares = torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [0.5, 0.5]])
    return cameras.generate_rays(camera_indices=0, coords=shares * size).directions


@pytest.mark.parametrize("side", [31, 21, 13])
def test_reduced_photos_show_what_their_rays_meet_up_to_the_border(llff_scene, side):
    whole, reduced = (photos(llff_scene, LLFFDataParserConfig(), each) for each in (None, side))
    height = int(24 * side / 32)
    assert reduced[0]["image"].shape == (height, side, 3)
    torch.testing.assert_close(corner_directions(reduced.cameras), corner_directions(whole.cameras))


@pytest.mark.parametrize("side", [176, 190, 211])
def test_photos_and_their_masks_are_reduced_to_the_size_asked_for(tmp_path, side):
    """At these sizes the product with the scale falls below the whole number in float32 or in double precision."""
    poses = write_ring(tmp_path)
    write_transforms(tmp_path, poses)
    (tmp_path / "masks").mkdir()
    text = (tmp_path / "transforms.json").read_text().replace('"w": 16, "h": 12', f'"w": {side}, "h": {side}')
    for index in range(len(poses)):
        pixels = np.random.default_rng(index).integers(0, 256, (side, side, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / "images" / f"{index}.png")
        Image.new("L", (side, side), 255).save(tmp_path / "masks" / f"{index}.png")
        path = f'"file_path": "images/{index}.png"'
        text = text.replace(path, f'{path}, "mask_path": "masks/{index}.png"')
    (tmp_path / "transforms.json").write_text(text)
    data = photos(tmp_path, NerfstudioDataParserConfig(), 126)[0]
    assert data["image"].shape[:2] == data["mask"].shape[:2] == (126, 126)


def test_held_out_photos_are_kept_in_memory_only_where_batches_of_their_pixels_are_asked_for(llff_scene):
    config = FewShotDataManagerConfig(data=llff_scene, dataparser=LLFFDataParserConfig(), eval_num_rays_per_batch=7)
    manager = config.setup(device="cpu", test_mode="val")
    assert not hasattr(manager, "eval_image_dataloader")
    camera, view = manager.next_eval_image(0)
    assert view["image"].shape == (24, 32, 3) and len(camera) == 1
    assert not hasattr(manager, "eval_image_dataloader")
    rays, batch = manager.next_eval(0)
    assert len(rays) == len(batch["image"]) == 7
    assert len(manager.eval_image_dataloader.cached_collated_batch["image"]) == 2


def test_a_held_out_photo_that_cant_be_used_is_named_before_training(llff_scene, tmp_path):
    scene = shutil.copytree(llff_scene, tmp_path / "scene")
    Image.new("RGB", (32, 24)).save(scene / "images" / "image008.png")
    config = FewShotDataManagerConfig(data=scene, dataparser=LLFFDataParserConfig())
    with pytest.raises(InputError, match=r"image008\.png is black all over"):
        config.setup(device="cpu", test_mode="val")


@dataclass
class OwnDataParserConfig(LLFFDataParserConfig):
    """A dataset that the data manager has never heard of."""

    _target: Type = field(default_factory=lambda: OwnDataParser)


class OwnDataParser(LLFFDataParser):
    def _generate_dataparser_outputs(self, split="train", **kwargs):
        outputs = super()._generate_dataparser_outputs(split, **kwargs)
        info = SceneInfo(scene_info(outputs).view_ids, standard_views=(7, 2, 5), default_num_views=2)
        return replace(outputs, metadata={SCENE_INFO: info})


def test_a_dataset_says_itself_which_views_to_train_on_and_how_space_is_laid_out(llff_scene):
    config = FewShotDataManagerConfig(data=llff_scene, dataparser=OwnDataParserConfig())
    manager = config.setup(device="cpu", test_mode="inference")
    assert [path.name for path in manager.train_dataset.image_filenames] == ["image007.png", "image002.png"]
    assert scene_info(manager.train_dataparser_outputs).view_ids == (7, 2)
    assert not decide(manager.scene, EffectSettings()).on("ndc")


def test_photos_and_rays_are_loaded_once_it_is_decided_what_is_simulated(llff_scene):
    config = FewShotDataManagerConfig(data=llff_scene, dataparser=LLFFDataParserConfig())
    manager = config.setup(device="cpu", test_mode="val")
    assert not hasattr(manager, "pixels")
    manager.set_effects(decided("ndc"))
    assert manager.pixels.colors.shape == (3 * 24 * 32, 3) and manager.matched is None
