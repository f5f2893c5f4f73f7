"""What all runs of a study have in common: a scene, and the presets of both stages on it."""

import copy
import functools
import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Literal, Mapping, Optional, Tuple, TypeVar

import numpy as np
import tyro
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig

from sparsestyle_ns.data.reading import read_scene
from sparsestyle_ns.engine.trainer import SparseStyleTrainerConfig
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.runs.scene_record import record_views
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import digest

Stage = Literal["coarse-fewshot", "hier-style"]
C = TypeVar("C")


@dataclass(frozen=True, eq=False)
class Study:
    """A scene and the presets of both stages on it, with None for what is as there; flags win over all settings."""

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

    @functools.cached_property
    def photo_digest(self) -> str:
        """By which it is known whether photos or poses are the same; empty where the scene can't be read."""
        try:
            parser = replace(self.dataparser, data=self.data).setup()
            views = [record_views(read_scene(parser, split)) for split in ("train", "test")]
        except InputError:
            return ""
        parts = [[part.names, part.digests, np.round(part.cameras, 3).tolist()] for part in views]
        return digest(json.dumps(parts).encode())

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
        self, stage: Stage, settings: Mapping[str, object] = MappingProxyType({}), style_image: Optional[Path] = None
    ) -> SparseStyleTrainerConfig:
        """The preset of a stage on this scene, with other settings, by their place in the config, on top.

        Raises:
            SystemExit: there is no such flag; what is wrong has been printed.
        """
        config = method_config(self.method(stage))
        pipeline, manager = config.pipeline, config.pipeline.datamanager
        manager.data, manager.dataparser = self.data, copy.deepcopy(self.dataparser)
        manager.num_views, manager.view_ids = self.num_views, self.view_ids
        manager.max_image_side = self.max_image_side or manager.max_image_side
        pipeline.vgg_weights, pipeline.backbone = self.vgg_weights, self.backbone
        config.max_num_iterations = self.iterations(stage)
        if stage == "hier-style":
            pipeline.style_image = style_image
        for place, value in settings.items():
            config = with_setting(config, place, value)
        flags = self.flags(stage)
        if not flags:
            return config
        options = (tyro.conf.FlagConversionOff,)  # as ns-train has it: --flag True
        return tyro.cli(type(config), default=config, args=list(flags), config=options, prog=config.method_name)


def _part(config: object, name: str) -> object:
    return config[name] if isinstance(config, dict) else getattr(config, name)


def get_setting(config: object, place: str) -> object:
    """The value at a place in a config, such as pipeline.model.num_steps; an AttributeError where there is none."""
    return functools.reduce(_part, place.split("."), config)


def with_setting(config: C, place: str, value: object) -> C:
    """A config that differs in the value at one place, or an AttributeError; its other parts are the given one's."""
    name, _, rest = place.partition(".")
    before = _part(config, name)
    changed = {name: with_setting(before, rest, value) if rest else value}
    return {**config, **changed} if isinstance(config, dict) else replace(config, **changed)


def flag_of(place: str) -> str:
    """The flag by which ns-train sets what is at a place."""
    return "--" + place.replace("_", "-")
