"""What the pipelines of both methods have in common."""

from pathlib import Path
from typing import Any, Dict, Literal, Optional

from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig

from sparsestyle_ns.errors import InputError, exit_on_input_error
from sparsestyle_ns.ffmpeg import put_ffmpeg_on_path
from sparsestyle_ns.style.targets import StyleTargets

TestMode = Literal["test", "val", "inference"]


class CheckedPipeline(VanillaPipeline):
    """A pipeline that ends with a clear sentence on bad input, and never loads a checkpoint in part."""

    @exit_on_input_error
    def __init__(
        self, config: VanillaPipelineConfig, device: str, test_mode: TestMode = "val", *args: Any, **kwargs: Any
    ) -> None:
        super().__init__(config, device, test_mode, *args, **kwargs)
        if test_mode != "val":
            put_ffmpeg_on_path()

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
