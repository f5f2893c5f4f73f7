"""What the pipelines of both methods have in common."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Callable, Dict, Literal, Optional, Union

import torch
import tyro
from nerfstudio.data.datamanagers.base_datamanager import DataManagerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerElement
from torch.amp import GradScaler

from sparsestyle_ns.effects.base import Decisions
from sparsestyle_ns.effects.registry import ALL_AUTO, EffectSettings
from sparsestyle_ns.losses.stylization import StyleTargets
from sparsestyle_ns.pipelines.datamanager import FewShotDataManager, FewShotDataManagerConfig
from sparsestyle_ns.style.vgg import VGGFeatures, load_backbone
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error
from sparsestyle_ns.utils.ffmpeg import put_ffmpeg_on_path

TestMode = Literal["test", "val", "inference"]


@dataclass
class CheckedPipelineConfig(VanillaPipelineConfig):
    """Settings of both methods' pipelines."""

    datamanager: DataManagerConfig = field(default_factory=FewShotDataManagerConfig)
    """The photos."""
    effects: EffectSettings = ALL_AUTO
    """Which effects are simulated; auto measures whether the scene calls for them."""
    decided: tyro.conf.Suppress[Optional[Decisions]] = None
    """What was decided, with its reasons; a loaded run has it and measures nothing."""
    vgg_weights: Annotated[Optional[Path], tyro.conf.arg(aliases=("--vgg-weights",))] = None
    """File with the weights of VGG-16. None: torchvision's, where they are cached or can be downloaded, else those in
    the package stlpips-pytorch."""
    backbone: Annotated[Literal["auto", "vgg16", "vgg16-shift-tolerant"], tyro.conf.arg(aliases=("--backbone",))] = (
        "auto"
    )
    """Feature network; auto takes whichever of the two has weights."""
    panel: tyro.conf.Suppress[Optional[Callable[["CheckedPipeline"], Union[ViewerElement, ViewerControl]]]] = None
    """Makes what the viewer shows of a run beside nerfstudio's own controls; None: nothing."""

    def load_backbone(self, device: torch.device) -> VGGFeatures:
        """The feature network of these settings.

        Raises:
            InputError: there are no weights for it, or they can't be read.
        """
        return load_backbone(self.backbone, self.vgg_weights).to(device)


class CheckedPipeline(VanillaPipeline):
    """A pipeline that ends with a clear sentence on bad input, and never loads a checkpoint in part.

    It receives what was decided about the scene's effects, or has it decided, and keeps it in its config.
    """

    config: CheckedPipelineConfig
    datamanager: FewShotDataManager

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
        config.datamanager.effects, config.datamanager.decided = config.effects, config.decided
        # However many processes there are, the model is not to be wrapped (see `processes`).
        super().__init__(config, device, test_mode, 1, local_rank, grad_scaler)
        config.decided = self.datamanager.effects
        config.datamanager.decided = None
        CONSOLE.print("Effects:", self.effects.text(), sep="\n", soft_wrap=True, highlight=False)
        self.panel = None if config.panel is None else config.panel(self)  # nerfstudio's viewer finds it here
        if test_mode != "val":
            put_ffmpeg_on_path()

    @property
    def effects(self) -> Decisions:
        """What is simulated, and why."""
        assert self.config.decided is not None
        return self.config.decided

    def announce(self, backbone: VGGFeatures) -> None:
        """Says which feature network is in use, and where its weights came from."""
        description = backbone.description
        CONSOLE.print(f"Features: {description.name}, {description.source}", soft_wrap=True)

    def painting(self) -> Optional[StyleTargets]:
        """The painting to measure against, where the method has one and it is still there."""
        return None

    @exit_on_input_error
    def get_average_eval_image_metrics(
        self, step: Optional[int] = None, output_path: Optional[Path] = None, get_std: bool = False
    ) -> Dict[str, float]:
        """The figures of `sparsestyle evaluate`, for `ns-eval`, with the time that rendering took."""
        from sparsestyle_ns.evaluation.held_out import evaluate_held_out

        self.eval()
        report = evaluate_held_out(self, self.painting(), picture_folder=output_path)
        self.train()
        return {**report.means, **(report.deviations() if get_std else {}), **report.speed()}

    @exit_on_input_error
    def load_pipeline(self, loaded_state: Dict[str, Any], step: int) -> None:
        """Loads a checkpoint's state.

        nerfstudio would try again without strictness on a mismatch and so lose weights in silence.

        Raises:
            InputError: the checkpoint's names or shapes are not those of this pipeline.
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
