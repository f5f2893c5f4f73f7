"""What the pipelines of both methods have in common."""

from typing import Any, Dict, Literal, Optional

from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from torch.amp import GradScaler

from sparsestyle_ns.errors import InputError, exit_on_input_error
from sparsestyle_ns.ffmpeg import put_ffmpeg_on_path

TestMode = Literal["test", "val", "inference"]


class CheckedPipeline(VanillaPipeline):
    """A pipeline that ends with a clear sentence on bad input, and never loads a checkpoint in part."""

    @exit_on_input_error
    def __init__(
        self,
        config: VanillaPipelineConfig,
        device: str,
        test_mode: TestMode = "val",
        world_size: int = 1,
        local_rank: int = 0,
        grad_scaler: Optional[GradScaler] = None,
    ) -> None:
        # However many processes there are, the model is not to be wrapped (see `processes`).
        super().__init__(config, device, test_mode, 1, local_rank, grad_scaler)
        if test_mode != "val":
            put_ffmpeg_on_path()

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
