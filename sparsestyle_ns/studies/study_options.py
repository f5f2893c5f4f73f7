"""What the command lines of the studies say. Imports next to nothing, so that help is there at once."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, List, Literal, Optional, Tuple

import tyro

from sparsestyle_ns.utils.errors import CommandOptions

Group = Literal["quadrature", "training", "fine-field", "style", "rendering", "precision"]


@dataclass
class StudyOptions(CommandOptions):
    """What `compare` and `ablate` are run on."""

    data: Path
    """Folder of the scene."""
    style_images: Tuple[Path, ...]
    """Paintings; each is a table of its own."""
    output_path: Path
    """The HTML page to write; one of that name that says something else is kept with a number behind its name."""
    output_dir: Path = Path("outputs/studies")
    """Folder of the runs; those in it are used again. Keep other runs out of it: hier-style takes the newest coarse
    run below its --output-dir, and that must not be an ablation's."""
    parser: Optional[str] = None
    """nerfstudio's name of the scene's dataparser, where its files don't tell, with its options behind it:
    --parser='llff-data --eval-interval 4'."""
    max_image_side: Optional[int] = None
    """Longer side, in pixels, that photos are reduced to; None: the methods' own limit."""
    draft: bool = False
    """Whether to run the drafts of both methods."""
    coarse_iterations: Optional[int] = None
    """Iterations of stage 1; None: the method's own."""
    style_iterations: Optional[int] = None
    """Iterations of stage 2; None: the method's own."""
    coarse_flags: str = ""
    """More flags of ns-train for all runs of stage 1, with an equals sign: --coarse-flags='--flag value'."""
    style_flags: str = ""
    """The same for all runs of stage 2: --style-flags='--flag value'."""
    jobs: Optional[int] = None
    """Runs at a time; None: one, or one for every four CPU cores where there is no GPU."""

    def ablate_command(self) -> List[object]:
        """The command that runs the ablations on the same runs."""
        other = replace(self, output_path=self.output_path.with_name("ablate.html"))
        command: List[object] = ["sparsestyle", "ablate", "--data", other.data, "--style-images", *other.style_images]
        command += ["--output-path", other.output_path]
        for each in fields(StudyOptions)[3:]:
            value, flag = getattr(other, each.name), f"--{each.name.replace('_', '-')}"
            if value != each.default:
                command.append(flag if value is True else f"{flag}={value}")
        return command


@dataclass
class CompareOptions(StudyOptions):
    """Runs the paper's comparison on a scene: baselines and ours, in one table and one grid beside the paper's rows.

    Rows: frame-by-frame 2D transfer of the coarse renders (needs `pip install -e .[compare]`), the same smoothed along
    the optical flow, fine-tuning the coarse field (ARF's kind), a FreeNeRF-style field fine-tuned, and ours.
    Interrupted, the same command goes on where it was.
    """

    front: bool = False
    """Draw style against kept content instead: each way of stylising keeps less and more, all in equal time."""


@dataclass
class AblateOptions(StudyOptions):
    """Runs the paper's ablations on a scene, and sets them out on one page.

    Stage 1 as ours, as the paper writes it, as vanilla NeRF, with a semantic loss of DietNeRF's kind and with
    FreeNeRF's regularisers, each with our stage 2 and fine-tuned; stage 2 on e_c alone, with sines and cosines,
    without residual density, with constant content weights.
    Interrupted, the same command goes on where it was; runs that `compare` has made are used.
    """


@dataclass
class TradeoffOptions(CommandOptions):
    """Measures what accuracy costs in time, on this machine and a scene of yours.

    Writes curves of error against time for each setting that trades one for the other, as a page that opens offline,
    JSON and CSV, and says in plain words what to turn. Ctrl-C keeps what has been measured.
    """

    data: Path
    """The scene, as for ns-train."""
    dataparser: Annotated[Tuple[str, ...], tyro.conf.Positional] = ()
    """What reads the scene, where its files don't tell: llff-data, blender-data, colmap …; its options come after two
    dashes: -- llff-data --eval-interval 4."""
    style_image: Optional[Path] = None
    """The painting; without it, what stylises is left out."""
    budget: str = "10m"
    """Time that it may take, such as 90s, 10m or 1h30m. More of it gives longer runs and more repetitions."""
    output_dir: Optional[Path] = None
    """Folder of the report; left out, tradeoff here, or tradeoff-2 where that is there already."""
    coarse_run: Optional[Path] = None
    """Folder of a coarse-fewshot run of this scene to render; left out, one is trained in a part of the time."""
    max_image_side: Optional[int] = None
    """Longer side of the photos in pixels; left out, the preset's."""
    num_views: Optional[int] = None
    """How many photos to train on, by the standard split."""
    view_ids: Optional[Tuple[int, ...]] = None
    """The photos to train on, by number, instead."""
    full: bool = False
    """Start from the full methods' settings instead of the drafts'."""
    groups: Tuple[Group, ...] = ()
    """What to measure; left out, everything."""
    rounds: int = 3
    """Repetitions of each measurement at most."""
    vgg_weights: Optional[Path] = None
    """File with the weights of VGG-16, as for ns-train."""
    backbone: Literal["auto", "vgg16", "vgg16-shift-tolerant"] = "auto"
    """Feature network, as for ns-train."""
    force: bool = False
    """Write over the report in the folder that --output-dir names, if there is one."""
