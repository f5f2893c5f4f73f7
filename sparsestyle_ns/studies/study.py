"""What all runs of a study have in common: a scene, and the presets of both stages on it."""

import copy
import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Mapping, Optional, Tuple, TypeVar

import tyro
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig

from sparsestyle_ns.engine.trainer import SparseStyleTrainerConfig
from sparsestyle_ns.method_configs import method_config

Stage = Literal["coarse-fewshot", "hier-style"]
C = TypeVar("C")


@dataclass(frozen=True, eq=False)
class Study:
    """A scene and the presets of both stages on it.

    Attributes:
        data: folder or file of the scene.
        dataparser: how it is read.
        draft: whether the presets are the drafts.
        max_image_side: longer side of the photos in pixels; None: the preset's.
        num_views, view_ids: the photos to train on, as for ns-train.
        vgg_weights, backbone: the feature network, as for ns-train.
        coarse_iterations, style_iterations: of each stage; None: the preset's.
        coarse_flags, style_flags: more flags of ns-train for all runs of each stage.
    """

    data: Path
    dataparser: DataParserConfig
    draft: bool = True
    max_image_side: Optional[int] = None
    num_views: Optional[int] = None
    view_ids: Optional[Tuple[int, ...]] = None
    vgg_weights: Optional[Path] = None
    backbone: str = "auto"
    coarse_iterations: Optional[int] = None
    style_iterations: Optional[int] = None
    coarse_flags: Tuple[str, ...] = ()
    style_flags: Tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The scene's name."""
        return self.data.resolve().name

    def method(self, stage: Stage) -> str:
        """The name that ns-train knows the stage's preset by."""
        return f"{stage}-draft" if self.draft else stage

    def iterations(self, stage: Stage) -> int:
        """How many a whole run of a stage has."""
        given = self.coarse_iterations if stage == "coarse-fewshot" else self.style_iterations
        return given or method_config(self.method(stage)).max_num_iterations

    def flags(self, stage: Stage) -> Tuple[str, ...]:
        """The flags for all runs of a stage."""
        return self.coarse_flags if stage == "coarse-fewshot" else self.style_flags

    def config(
        self, stage: Stage, settings: Optional[Mapping[str, object]] = None, style_image: Optional[Path] = None
    ) -> SparseStyleTrainerConfig:
        """The preset of a stage on this scene, with other settings on top.

        Args:
            stage: which.
            settings: by their place in the config; the study's own flags win over them.
            style_image: the painting.

        Raises:
            SystemExit: there is no such flag; what is wrong has been printed.
        """
        config = copy.deepcopy(method_config(self.method(stage)))
        pipeline, manager = config.pipeline, config.pipeline.datamanager
        manager.data, manager.dataparser = self.data, copy.deepcopy(self.dataparser)
        manager.num_views, manager.view_ids = self.num_views, self.view_ids
        manager.max_image_side = self.max_image_side or manager.max_image_side
        pipeline.vgg_weights, pipeline.backbone = self.vgg_weights, self.backbone
        config.max_num_iterations = self.iterations(stage)
        if stage == "hier-style":
            pipeline.style_image = style_image
        for place, value in (settings or {}).items():
            config = with_setting(config, place, value)
        flags = self.flags(stage)
        if not flags:
            return config
        options = (tyro.conf.FlagConversionOff,)  # as ns-train has it: --flag True
        return tyro.cli(type(config), default=config, args=list(flags), config=options, prog=config.method_name)


def _part(config: object, name: str) -> object:
    return config[name] if isinstance(config, dict) else getattr(config, name)


def get_setting(config: object, place: str) -> object:
    """The value at a place in a config, such as pipeline.model.num_steps.

    Raises:
        AttributeError: there is no such setting.
    """
    return functools.reduce(_part, place.split("."), config)


def with_setting(config: C, place: str, value: object) -> C:
    """A config that differs in the value at one place; it shares its other parts with the given one.

    Raises:
        AttributeError: there is no such setting.
    """
    name, _, rest = place.partition(".")
    before = _part(config, name)
    changed = {name: with_setting(before, rest, value) if rest else value}
    return {**config, **changed} if isinstance(config, dict) else replace(config, **changed)


def flag_of(place: str) -> str:
    """The flag by which ns-train sets what is at a place."""
    return "--" + place.replace("_", "-")
