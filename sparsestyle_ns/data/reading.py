"""Reading a scene with any dataparser, with errors that name what is wrong; nerfstudio's own check next to nothing."""

from dataclasses import replace

import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataparserOutputs
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from sparsestyle_ns.data.photos import open_photo
from sparsestyle_ns.data.scene_info import SCENE_INFO, SceneInfo
from sparsestyle_ns.data.transforms import read_transforms
from sparsestyle_ns.data.view_selection import BLENDER_VIEWS
from sparsestyle_ns.utils.errors import InputError


def _check_blender_files(config: BlenderDataParserConfig, split: str) -> None:
    frames = read_transforms(config.data / f"transforms_{split}.json", with_angle=True)["frames"]
    first = frames[0]["file_path"].replace("./", "")
    open_photo(config.data / f"{first}.png")  # it gives all cameras their size


def read_scene(parser: DataParser, split: str = "train") -> DataparserOutputs:
    """One split of a scene, checked, with its `SceneInfo` in the metadata.

    Raises:
        InputError: the scene can't be read, or a camera in it can't be used.
    """
    config = parser.config
    if isinstance(config, BlenderDataParserConfig):
        _check_blender_files(config, split)
    if isinstance(config, NerfstudioDataParserConfig):
        is_file = config.data.suffix == ".json"
        read_transforms(config.data if is_file else config.data / "transforms.json", with_angle=False)
    try:
        outputs = parser.get_dataparser_outputs(split)
    except InputError:
        raise
    except Exception as error:  # a file that isn't as a parser expects it shows itself in any kind of error
        name = type(config).__name__.removesuffix("DataParserConfig").lower()
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"{config.data} can't be read as a scene of the kind {name} ({type(error).__name__}: {reason}); correct "
            "its files, or choose the dataparser that they were made for."
        ) from error
    _check_cameras(outputs)
    if SCENE_INFO in outputs.metadata:
        return outputs
    standard_views = BLENDER_VIEWS if isinstance(config, BlenderDataParserConfig) else None
    info = SceneInfo(tuple(range(len(outputs.image_filenames))), standard_views=standard_views)
    return replace(outputs, metadata={**outputs.metadata, SCENE_INFO: info})


def _check_cameras(outputs: DataparserOutputs) -> None:
    cameras = outputs.cameras
    if len(cameras) == 0:  # a split may be empty
        return
    sizes = torch.cat([cameras.fx, cameras.fy, cameras.width, cameras.height], dim=-1)
    numbers = torch.cat([cameras.camera_to_worlds.flatten(1), sizes, cameras.cx, cameras.cy], dim=-1)
    usable = numbers.isfinite().all(dim=-1) & (sizes > 0).all(dim=-1)
    if not usable.all():
        photo = outputs.image_filenames[int((~usable).nonzero()[0])]
        raise InputError(
            f"The camera of {photo} has a pose that is not finite, or a focal length or size that is not above 0: "
            "correct it, or take the photo out of the scene."
        )
