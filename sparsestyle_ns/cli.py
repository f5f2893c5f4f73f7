"""`sparsestyle ...`: what has no ns-* command of its own.

A subcommand is a function here: its arguments and docstring are the command line and its help. It imports what it needs
when it runs, so that help is there at once.
"""

import sys
from pathlib import Path
from typing import Annotated, Any, Callable, Dict, Literal, Optional, Sequence, Tuple

import tyro

from sparsestyle_ns.errors import InputError, exit_on_input_error


@exit_on_input_error
def gallery(
    runs: Annotated[Tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]")],
    output_path: Path,
    video: Tuple[Path, ...] = (),
    title: str = "Stylised scenes",
    num_views: int = 3,
) -> None:
    """Makes one HTML page of stylised runs that opens without a network.

    Args:
        runs: Stylised runs to show, each by its folder or its config.yml.
        output_path: The page to write.
        video: MP4 files, as ns-render writes them, for the runs in the same order.
        title: Heading of the page.
        num_views: Held-out views to render of each run.
    """
    from sparsestyle_ns.gallery import collect_run, prepare_folder, read_video, write_page
    from sparsestyle_ns.run_folder import STYLE_METHOD, find_config

    if not runs:
        raise InputError("There is no run to show; name at least one run's folder.")
    if len(video) > len(runs):
        raise InputError(f"There are {len(video)} videos for {len(runs)} runs; give at most one for each run.")
    configs = [find_config(run, STYLE_METHOD) for run in runs]
    for path in video:
        read_video(path)
    prepare_folder(output_path)  # rendering takes minutes, so what can fail without it fails before
    videos = [*video, *[None] * (len(runs) - len(video))]
    pictures = []
    for config, path in zip(configs, videos, strict=True):
        print(f"Rendering views of {config.parent} …", flush=True)
        pictures.append(collect_run(config, path, num_views))
    print(f"The page is {write_page(pictures, output_path, title)}")


@exit_on_input_error
def evaluate(
    run: Annotated[Path, tyro.conf.Positional],
    output_path: Path,
    style_image: Optional[Path] = None,
    baked: bool = False,
) -> None:
    """Measures a run on the views it hasn't seen.

    Coarse: PSNR, SSIM, LPIPS where its weights are on the machine, and effective samples a ray. Stylised: the coarse
    field's quality, and style and content loss before and after stylising.

    Args:
        run: The run's folder or its config.yml.
        output_path: JSON file to write, in the layout of ns-eval.
        style_image: Painting to measure a stylised run against, if not the one it was made with.
        baked: Also measure how close a stylised run's baked renders are to exact ones (PSNR in dB).
    """
    from sparsestyle_ns.evaluation.held_out import evaluate_run
    from sparsestyle_ns.run_folder import find_config

    report = evaluate_run(find_config(run), output_path, style_image, baked)
    for name, value in report.means.items():
        print(f"{name:>20} {value:9.4f}")
    print(f"{len(report.views)} held-out views; the report is {output_path}")


@exit_on_input_error
def effects(
    dataparser: Annotated[str, tyro.conf.Positional],
    data: Path,
    json: bool = False,
    num_views: Optional[int] = None,
    view_ids: Optional[Tuple[int, ...]] = None,
    coarse_run: Optional[Path] = None,
    style_image: Optional[Path] = None,
) -> None:
    """Prints which effects a scene calls for, and why, without training.

    Args:
        dataparser: What reads the scene: llff-data, blender-data, nerfstudio-data, colmap or another of nerfstudio's.
        data: The scene's folder or file.
        json: Print JSON: a list `effects` of name, on, measured, threshold, reason.
        num_views: How many photos to train on, as for ns-train.
        view_ids: Which photos to train on, as for ns-train.
        coarse_run: A coarse run of the scene, on which the effects of stage 2 are measured.
        style_image: The painting, with which the photos' palette is compared.
    """
    from contextlib import redirect_stdout

    from sparsestyle_ns.effects.command import measure_scene

    with redirect_stdout(sys.stderr):  # what dataparsers have to say must not get into the JSON
        decisions = measure_scene(dataparser, data, num_views, view_ids, coarse_run, style_image)
    print(decisions.json() if json else decisions.text())


@exit_on_input_error
def tradeoff(
    data: Path,
    dataparser: Annotated[Tuple[str, ...], tyro.conf.Positional] = (),
    style_image: Optional[Path] = None,
    budget: str = "10m",
    output_dir: Path = Path("tradeoff"),
    coarse_run: Optional[Path] = None,
    max_image_side: Optional[int] = None,
    num_views: Optional[int] = None,
    view_ids: Optional[Tuple[int, ...]] = None,
    full: bool = False,
    groups: Tuple[Literal["quadrature", "training", "fine-field", "style", "rendering", "precision"], ...] = (),
    rounds: int = 3,
    vgg_weights: Optional[Path] = None,
    backbone: Literal["auto", "vgg16", "vgg16-shift-tolerant"] = "auto",
) -> None:
    """Measures what accuracy costs in time, on this machine and a scene of yours.

    Writes curves of error against time for each setting that trades one for the other, as a page that opens offline,
    JSON and CSV, and says in plain words what to turn. Ctrl-C keeps what has been measured.

    Args:
        data: The scene, as for ns-train.
        dataparser: How to read it, where its files don't tell: llff-data, blender-data, colmap …; its options come
            after two dashes: -- llff-data --eval-interval 4.
        style_image: The painting; without it, what stylises is left out.
        budget: Time that it may take, such as 90s, 10m or 1h30m. More of it gives longer runs and more repetitions.
        output_dir: Folder of the report.
        coarse_run: Folder of a coarse-fewshot run of this scene to render; left out, one is trained in a part of the
            time.
        max_image_side: Longer side of the photos in pixels; left out, the preset's.
        num_views: How many photos to train on, by the standard split.
        view_ids: The photos to train on, by number, instead.
        full: Start from the full methods' settings instead of the drafts'.
        groups: What to measure; left out, everything.
        rounds: Repetitions of each measurement at most.
        vgg_weights: File with the weights of VGG-16, as for ns-train.
        backbone: Feature network, as for ns-train.
    """
    from sparsestyle_ns.evaluation.tradeoff import command
    from sparsestyle_ns.evaluation.tradeoff.budget import parse_duration

    seconds = parse_duration(budget)
    if rounds < 1:
        raise InputError(f"--rounds is {rounds}, but has to be at least 1.")
    command.run(
        command.Options(
            dataparser=command.parse_dataparser(dataparser, data),
            data=data,
            output_dir=output_dir,
            style_image=style_image,
            coarse_run=coarse_run,
            full=full,
            max_image_side=max_image_side,
            num_views=num_views,
            view_ids=view_ids,
            vgg_weights=vgg_weights,
            backbone=backbone,
            rounds=rounds,
            groups=groups,
        ),
        seconds,
    )


SUBCOMMANDS: Dict[str, Callable[..., Any]] = {
    "effects": effects,
    "evaluate": evaluate,
    "gallery": gallery,
    "tradeoff": tradeoff,
}


def main(arguments: Optional[Sequence[str]] = None) -> None:
    """The command line; `arguments` default to the process's own."""
    tyro.extras.subcommand_cli_from_dict(
        SUBCOMMANDS,
        prog="sparsestyle",
        description="Tools around stylised scenes. Training, rendering and viewing are nerfstudio's ns-* commands.",
        args=arguments,
    )
