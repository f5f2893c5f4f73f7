"""What the pipelines of both methods have in common."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Callable, Dict, Literal, Optional, Union

import torch
import tyro
from nerfstudio.data.datamanagers.base_datamanager import DataManagerConfig
from nerfstudio.pipelines.base_pipeline import Pipeline, VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerElement
from torch.amp import GradScaler

from sparsestyle_ns.data.photos import PhotoDataset
from sparsestyle_ns.data.scene_info import scene_info
from sparsestyle_ns.effects.decisions import Decisions, EffectSettings
from sparsestyle_ns.effects.pose_refinement import build_camera_refinement
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.evaluation.held_out import HeldOutReport, evaluate_held_out
from sparsestyle_ns.losses.stylization import StyleTargets
from sparsestyle_ns.pipelines.command_output import running_command
from sparsestyle_ns.pipelines.datamanager import FewShotDataManager, FewShotDataManagerConfig
from sparsestyle_ns.pipelines.export_command import check_export_of
from sparsestyle_ns.pipelines.nerfstudio_options import unused_in_training, unused_of_scene
from sparsestyle_ns.pipelines.render_command import prepare_render
from sparsestyle_ns.style.backbone import Backbone
from sparsestyle_ns.style.backbones import BackboneChoice, load_backbone
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error
from sparsestyle_ns.utils.machine import put_ffmpeg_on_path
from sparsestyle_ns.utils.progress import say

TestMode = Literal["test", "val", "inference"]


@dataclass
class CheckedPipelineConfig(VanillaPipelineConfig):
    """Settings of both methods' pipelines."""

    datamanager: DataManagerConfig = field(default_factory=FewShotDataManagerConfig)
    """The photos."""
    effects: EffectSettings = field(default_factory=EffectSettings)
    """Which effects are simulated; auto measures whether the scene needs them."""
    decided: tyro.conf.Suppress[Optional[Decisions]] = None
    """What was decided for a run that exists, with its reasons; nothing is measured then."""
    vgg_weights: Annotated[Optional[Path], tyro.conf.arg(aliases=("--vgg-weights",))] = None
    """File with the weights of VGG-16. None: torchvision's, where they are cached or can be downloaded, else those in
    the package stlpips-pytorch."""
    backbone: Annotated[BackboneChoice, tyro.conf.arg(aliases=("--backbone",))] = "auto"
    """Feature network; auto takes the first that has weights."""
    panel: tyro.conf.Suppress[Optional[Callable[["CheckedPipeline"], Union[ViewerElement, ViewerControl]]]] = None
    """Makes what the viewer shows of a run beside nerfstudio's own controls; None: nothing."""

    def load_backbone(self, device: torch.device) -> Backbone:
        """The feature network of these settings; InputError where it has no weights that can be read."""
        return load_backbone(self.backbone, self.vgg_weights).to(device)


class CheckedPipeline(VanillaPipeline):
    """A pipeline that ends with a clear sentence on bad input, and never loads a checkpoint in part.

    It decides which of the scene's effects are simulated, unless its config says so already, as that of a saved run.
    """

    config: CheckedPipelineConfig
    datamanager: FewShotDataManager
    effects: Decisions
    """What is simulated, and why."""

    @exit_on_input_error
    def __init__(
        self,
        config: CheckedPipelineConfig,
        device: str,
        test_mode: TestMode = "val",
        world_size: int = 1,
        local_rank: int = 0,
        grad_scaler: Optional[GradScaler] = None,
    ) -> None:
        Pipeline.__init__(self)  # VanillaPipeline's would build the model before anything is decided
        self.config, self.test_mode = config, test_mode
        self.world_size = 1  # several processes share the rays themselves (`utils.distributed`); no model is wrapped
        self.datamanager = config.datamanager.setup(device=device, test_mode=test_mode, local_rank=local_rank)
        self.datamanager.to(device)
        self.effects = config.decided or decide(self.datamanager.scene, config.effects)
        self.datamanager.set_effects(self.effects)
        self.settle()
        dataset, ndc = self.datamanager.train_dataset, scene_info(self.datamanager.train_dataparser_outputs).ndc
        self._model = config.model.setup(
            scene_box=dataset.scene_box,
            num_train_data=len(dataset),
            effects=self.effects,
            ndc=ndc,
            refinement=build_camera_refinement(self.effects, dataset.cameras, ndc),
            device=device,
        ).to(device)
        self.datamanager.refine_cameras(self.model.refinement)
        self._say_what_is_unused()
        CONSOLE.print("Effects:", self.effects.text(), sep="\n", soft_wrap=True, highlight=False)
        self.panel = None if config.panel is None else config.panel(self)  # nerfstudio's viewer finds it here
        if test_mode != "val":
            put_ffmpeg_on_path()

    def settle(self) -> None:
        """Replaces settings of the model that follow from the photos, before it is built."""

    def _say_what_is_unused(self) -> None:
        """Names what was asked for, or is in the scene, and has no effect; and sees to it that ns-render can go on."""
        prepare_render(self)
        if self.test_mode == "val":
            scene = unused_of_scene(self.datamanager.train_dataparser_outputs)
            for line in (*unused_in_training(self.config), *scene):
                say(line)

    def announce(self, backbone: Backbone) -> None:
        """Says which feature network is in use, and where its weights came from."""
        CONSOLE.print(f"Features: {backbone.description.name}, {backbone.description.source}", soft_wrap=True)

    def style_targets(self, style_image: Optional[Path] = None) -> Optional[StyleTargets]:
        """The painting to measure against, the run's own or another, where the method has one and it is still there."""
        return None

    def held_out_report(
        self,
        style_image: Optional[Path] = None,
        baked: bool = False,
        picture_folder: Optional[Path] = None,
        views: Optional[PhotoDataset] = None,
    ) -> HeldOutReport:
        """What `sparsestyle evaluate` measures, on the scene's held-out views or others; see `evaluate_held_out`."""
        manager = self.datamanager
        cameras, targets = manager.train_dataset.cameras, self.style_targets(style_image)
        align = self.model.refinement is not None and manager.has_held_out
        align, views = align or views is not None, views or manager.eval_dataset
        return evaluate_held_out(self.model, views, cameras, targets, baked, picture_folder, align)

    @exit_on_input_error
    def get_average_eval_image_metrics(
        self, step: Optional[int] = None, output_path: Optional[Path] = None, get_std: bool = False
    ) -> Dict[str, float]:
        """The figures of `sparsestyle evaluate`, for `ns-eval`, with the time that rendering took."""
        self.eval()
        report = self.held_out_report(picture_folder=output_path)
        self.train()
        return {**report.means, **(report.deviations() if get_std else {}), **report.speed}

    @exit_on_input_error
    def load_pipeline(self, loaded_state: Dict[str, Any], step: int) -> None:
        """Loads a checkpoint's state; InputError where its names or shapes aren't this pipeline's.

        nerfstudio would try again without strictness and so lose weights in silence.
        """
        expected = self.state_dict()
        found = {key.removeprefix("module."): value for key, value in loaded_state.items()}
        wrong = sorted(expected.keys() ^ found.keys())
        wrong += [key for key in expected.keys() & found.keys() if expected[key].shape != found[key].shape]
        if wrong:
            raise InputError(
                f"The checkpoint doesn't fit this configuration: it differs in {len(wrong)} entries, the first of "
                f"them {wrong[0]}; load it with the config.yml of its own run."
            )
        super().load_pipeline(found, step)
        check_export_of(running_command("exporter"), self)
