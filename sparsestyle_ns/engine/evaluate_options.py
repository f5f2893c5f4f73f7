"""What `sparsestyle evaluate` is asked for. Nothing heavy is imported here, so that help and refusals come at once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Optional

import tyro

from sparsestyle_ns.runs.run_folder import REPORT_FILE, STYLE_METHOD, find_config
from sparsestyle_ns.utils.errors import CommandOptions, InputError
from sparsestyle_ns.utils.files import prepare_output


@dataclass
class EvaluateOptions(CommandOptions):
    """Measures a run on the views it hasn't seen.

    Coarse: PSNR, SSIM, LPIPS where its weights are on the machine, ST-LPIPS, and effective samples a ray. Stylised: the
    coarse field's quality; style strength and what is kept of the content, with ArtFID where its weights are on the
    machine; and short- and long-range consistency on a path of cameras between the training views, beside that of the
    unstylised scene.
    """

    run: Annotated[Path, tyro.conf.Positional]
    """The run's folder or its config.yml."""
    output_path: Optional[Path] = None
    """JSON file to write, in the layout of ns-eval; left out, evaluation.json in the run's folder, where another report
    from before is kept as evaluation-2.json."""
    style_image: Optional[Path] = None
    """Painting to measure a stylised run against, if not the one it was made with; needs --output-path."""
    baked: bool = False
    """Also measure how close a stylised run's baked renders are to exact ones (PSNR in dB)."""
    vgg_weights: Optional[Path] = None
    """File with the weights of the feature network, where those that the run was made with aren't found."""
    force: bool = False
    """Write over the file that --output-path names, if there is one."""

    def check(self) -> None:
        """Makes sure that there is such a run, and that the report can be written."""
        needs_style = self.baked or self.style_image is not None
        config = find_config(self.run, STYLE_METHOD if needs_style else "")
        is_own = self.output_path is None
        if self.output_path is None:
            if self.style_image is not None:
                raise InputError(
                    f"{REPORT_FILE} in the run's folder is for its own painting; name a file with --output-path."
                )
            self.output_path = config.parent / REPORT_FILE
        prepare_output(self.output_path, "The report", "report.json", self.force or is_own)  # measuring takes minutes
