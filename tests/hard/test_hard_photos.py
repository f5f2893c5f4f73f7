"""One photo among the others that can't be trained on: it is found when the scene is loaded, and named."""

import shutil
from pathlib import Path
from typing import Callable

import numpy as np
import pytest
from hard.table import hard_case
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from PIL import Image

from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.utils.errors import InputError


@pytest.fixture(scope="module")
def scenes(llff_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict:
    """Folder, dataparser and one training photo of a scene of either kind."""
    import make_sample_scene

    folder = tmp_path_factory.mktemp("photos")
    sizes = ["--num-train", "8", "--num-val", "1", "--num-test", "1", "--width", "16"]
    make_sample_scene.main([str(folder), "--layout", "blender", *sizes])
    return {
        "llff": (llff_scene, LLFFDataParserConfig, "images/image005.png"),
        "blender": (folder / "blender", BlenderDataParserConfig, "train/r_3.png"),
        "blender, first": (folder / "blender", BlenderDataParserConfig, "train/r_0.png"),
    }


def sentence_about(scenes: dict, kind: str, tmp_path: Path, spoil: Callable[[Path], None]) -> str:
    """What is said of a scene, one of whose photos was spoilt."""
    folder, parser, photo = scenes[kind]
    spoilt = shutil.copytree(folder, tmp_path / "scene")
    spoil(spoilt / photo)
    config = FewShotDataManagerConfig(data=spoilt, dataparser=parser())
    with pytest.raises(InputError) as refused:
        config.setup(device="cpu", test_mode="val").load_pixels()
    message = str(refused.value)
    assert str(spoilt / photo) in message
    assert "\n" not in message
    return message


def repainted(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def spoil(path: Path) -> None:
        Image.fromarray(change(np.asarray(Image.open(path).convert("RGBA")))).save(path)

    return spoil


def test_a_scene_whose_photos_are_all_right_is_read(scenes: dict) -> None:
    for folder, parser, _ in scenes.values():
        FewShotDataManagerConfig(data=folder, dataparser=parser()).setup(device="cpu", test_mode="val").load_pixels()


KINDS = pytest.mark.parametrize("kind", ["llff", "blender", "blender, first"])


@hard_case(
    "training",
    case="a photo of floating-point numbers, NaN or infinity among them",
    could_go_wrong="cast to 8 bits, which makes anything of it, or NaN in the loss from the first step that meets it",
    must_hold="found when the scene is loaded; the sentence names the file and counts the pixels",
)
@KINDS
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_photo_with_numbers_that_arent_finite_is_named(scenes, kind, value, tmp_path):
    def spoil(path: Path) -> None:
        width, height = Image.open(path).size
        pixels = np.full((height, width), 0.5, np.float32)
        pixels[1, 2:5] = value
        Image.fromarray(pixels).save(path, format="TIFF")

    assert "3 of which are not finite" in sentence_about(scenes, kind, tmp_path, spoil)


@hard_case(
    "training",
    case="a black photo",
    could_go_wrong="a third of the views say that there is nothing, and the field learns it",
    must_hold="found when the scene is loaded, and named",
)
@KINDS
def test_a_black_photo_is_named(scenes, kind, tmp_path):
    black = repainted(lambda pixels: np.zeros_like(pixels[..., :3]))
    assert "is black all over" in sentence_about(scenes, kind, tmp_path, black)


@hard_case(
    "training",
    case="a photo that is transparent all over",
    could_go_wrong="a view of nothing but background, which empties the scene",
    must_hold="found when the scene is loaded, and named",
)
@KINDS
def test_a_transparent_photo_is_named(scenes, kind, tmp_path):
    clear = repainted(lambda pixels: np.concatenate([pixels[..., :3], 0 * pixels[..., 3:]], axis=-1))
    assert "is transparent all over" in sentence_about(scenes, kind, tmp_path, clear)


@hard_case(
    "training",
    case="a photo of one pixel",
    could_go_wrong="pixels of one photo paired with rays of another, or cameras of 1x1 for all photos",
    must_hold="found when the scene is loaded; it is named, not the photos that are as they should be",
)
@KINDS
def test_a_photo_of_one_pixel_is_named(scenes, kind, tmp_path):
    message = sentence_about(scenes, kind, tmp_path, repainted(lambda pixels: pixels[:1, :1]))
    assert "is 1x1 pixels" in message


@hard_case(
    "training",
    case="a photo of another size",
    could_go_wrong="pixels paired with the wrong rays, in silence",
    must_hold="found when the scene is loaded; the sentence has both sizes",
)
@KINDS
def test_a_photo_of_another_size_is_named(scenes, kind, tmp_path):
    message = sentence_about(scenes, kind, tmp_path, repainted(lambda pixels: pixels[:-3]))
    width, height = (32, 24) if kind == "llff" else (16, 16)
    assert f"{width}x{height - 3}" in message
    assert f"{width}x{height}" in message


@hard_case(
    "training",
    case="a photo that is cut short, empty, missing, or no image at all",
    could_go_wrong="a traceback out of a decoder, minutes into training for a held-out photo",
    must_hold="found when the scene is loaded, and named",
)
@KINDS
@pytest.mark.parametrize("content", [b"", b"not an image", None])
def test_a_photo_that_cant_be_read_is_named(scenes, kind, content, tmp_path):
    def spoil(path: Path) -> None:
        path.write_bytes(path.read_bytes()[:200] if content is None else content)

    assert "cannot be read as an image" in sentence_about(scenes, kind, tmp_path, spoil)


def test_a_photo_that_is_missing_is_named(scenes, tmp_path):
    assert "There is no photo" in sentence_about(scenes, "blender", tmp_path, Path.unlink)


@hard_case(
    "training",
    case="a mask of another size, or one that can't be read",
    could_go_wrong="an assertion of nerfstudio's, without a file's name",
    must_hold="the sentence names mask and photo",
)
@pytest.mark.parametrize("spoil", ["size", "bytes"])
def test_a_mask_that_doesnt_fit_is_named(tmp_path, spoil):
    import json

    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
    from test_commands import write_ring, write_transforms

    write_transforms(tmp_path, write_ring(tmp_path))
    path = tmp_path / "transforms.json"
    content = json.loads(path.read_text())
    for index, frame in enumerate(content["frames"]):
        frame["mask_path"] = f"images/mask_{index}.png"
        Image.fromarray(np.full((12, 16), 255, np.uint8)).save(tmp_path / frame["mask_path"])
    path.write_text(json.dumps(content))
    config = FewShotDataManagerConfig(data=tmp_path, dataparser=NerfstudioDataParserConfig(eval_mode="all"))
    config.setup(device="cpu", test_mode="val").load_pixels()
    if spoil == "size":
        Image.fromarray(np.full((5, 16), 255, np.uint8)).save(tmp_path / "images" / "mask_2.png")
    else:
        (tmp_path / "images" / "mask_2.png").write_bytes(b"no mask")
    with pytest.raises(InputError, match=r"The mask .*mask_2\.png doesn't fit .*2\.png"):
        config.setup(device="cpu", test_mode="val").load_pixels()
