"""`sparsestyle ...`: what has no ns-* command of its own.

A subcommand is a function here: its arguments and docstring are the command line and its help. It imports what it needs
when it runs, so that help is there at once.
"""

import sys
from pathlib import Path
from typing import Annotated, Any, Callable, Dict, Literal, Optional, Sequence, Tuple

import tyro

from sparsestyle_ns.studies.options import StudyOptions, TradeoffOptions
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error


@exit_on_input_error
def gallery(
    runs: Annotated[Tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]")],
    output_path: Path = Path("gallery.html"),
    video: Tuple[Path, ...] = (),
    title: str = "Stylised scenes",
    num_views: int = 3,
    frames: int = 48,
    evaluate: bool = False,
) -> None:
    """Makes one HTML page of stylised runs that opens without a network.

    It shows photos, painting, a slider between the scene before and after, a film, settings, effects, and what
    `sparsestyle evaluate` has left in the run's folder; of several runs also a grid of scenes and paintings.

    Args:
        runs: Stylised runs to show, each by its folder or its config.yml.
        output_path: The page to write.
        video: MP4 files, as ns-render writes them, for the runs in the same order, instead of films made here.
        title: Heading of the page.
        num_views: Held-out views to render of each run.
        frames: Frames of a film, 16 a second; 0 for none. In a scene with photos from all around it is a turn about
            it, else a flight through the photos' viewpoints.
        evaluate: Measure runs that have no evaluation.json of their newest checkpoint, and leave them one.
    """
    from sparsestyle_ns.gallery.page import gallery_page, read_film
    from sparsestyle_ns.runs.run_folder import STYLE_METHOD, find_config
    from sparsestyle_ns.utils.page import prepare_page, write_page

    if not runs:
        raise InputError("There is no run to show; name at least one run's folder.")
    if len(video) > len(runs):
        raise InputError(f"There are {len(video)} videos for {len(runs)} runs; give at most one for each run.")
    if frames < 0:
        raise InputError(f"--frames is {frames}; give 0 for no film, or more.")
    configs = [find_config(run, STYLE_METHOD) for run in runs]
    for path in video:
        read_film(path)
    prepare_page(output_path)  # rendering takes minutes, so what can fail without it fails before
    from sparsestyle_ns.engine.hints import finish
    from sparsestyle_ns.gallery.collect import collect_run
    from sparsestyle_ns.utils.progress import say

    videos = [*video, *[None] * (len(runs) - len(video))]
    pictures = []
    for config, path in zip(configs, videos, strict=True):
        say(f"Showing {config.parent}")
        pictures.append(collect_run(config, path, num_views, frames, evaluate))
    page = write_page(gallery_page(pictures, title), output_path)
    run = configs[0].parent
    finish(page, ["sparsestyle", "export", run, "--format", "html", "--output-path", "scene.html"])


@exit_on_input_error
def evaluate(
    run: Annotated[Path, tyro.conf.Positional],
    output_path: Optional[Path] = None,
    style_image: Optional[Path] = None,
    baked: bool = False,
) -> None:
    """Measures a run on the views it hasn't seen.

    Coarse: PSNR, SSIM, LPIPS where its weights are on the machine, ST-LPIPS, and effective samples a ray. Stylised: the
    coarse field's quality; style strength and what is kept of the content, with ArtFID where its weights are on the
    machine; and short- and long-range consistency on a path of cameras between the training views, beside that of the
    unstylised scene.

    Args:
        run: The run's folder or its config.yml.
        output_path: JSON file to write, in the layout of ns-eval; left out, evaluation.json in the run's folder.
        style_image: Painting to measure a stylised run against, if not the one it was made with; needs --output-path.
        baked: Also measure how close a stylised run's baked renders are to exact ones (PSNR in dB).
    """
    from sparsestyle_ns.runs.run_folder import REPORT_FILE, STYLE_METHOD, find_config
    from sparsestyle_ns.utils.output_file import prepare_output

    needs_style = baked or style_image is not None
    config = find_config(run, STYLE_METHOD if needs_style else "")
    if output_path is None and style_image is not None:
        raise InputError(f"{REPORT_FILE} in the run's folder is for its own painting; name a file with --output-path.")
    path = output_path or config.parent / REPORT_FILE
    prepare_output(path, "The report", "report.json")  # measuring takes minutes, so what can fail fails before
    if style_image is not None:
        from sparsestyle_ns.style.painting import load_style_image

        load_style_image(style_image)
    from sparsestyle_ns.engine.hints import after_evaluation, finish
    from sparsestyle_ns.evaluation.held_out import evaluate_run
    from sparsestyle_ns.evaluation.tables import report_tables

    report = evaluate_run(config, path, style_image, baked)
    for table in report_tables(report.means, len(report.views)):
        table.print()
    finish(path, after_evaluation(config.parent, stylised="content_ssim" in report.means))


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

    from sparsestyle_ns.engine.hints import after_effects, finish
    from sparsestyle_ns.prepare.measure_effects import measure_scene

    with redirect_stdout(sys.stderr):  # what dataparsers have to say must not get into the JSON
        decisions = measure_scene(dataparser, data, num_views, view_ids, coarse_run, style_image)
    print(decisions.json() if json else decisions.text(), flush=True)
    with redirect_stdout(sys.stderr if json else sys.stdout):
        finish(None, after_effects(dataparser, data, num_views, view_ids, coarse_run, style_image))


@exit_on_input_error
def tradeoff(options: Annotated[TradeoffOptions, tyro.conf.arg(name="")]) -> None:
    """Measures what accuracy costs in time, on this machine and a scene of yours.

    Writes curves of error against time for each setting that trades one for the other, as a page that opens offline,
    JSON and CSV, and says in plain words what to turn. Ctrl-C keeps what has been measured.
    """
    from sparsestyle_ns.studies.tradeoff.measuring import tradeoff as run

    run(options)


@exit_on_input_error
def compare(options: Annotated[StudyOptions, tyro.conf.arg(name="")]) -> None:
    """Runs the paper's comparison on a scene: baselines and ours, in one table and one grid beside the paper's rows.

    Rows: frame-by-frame 2D transfer of the coarse renders (needs `pip install -e .[compare]`), the same smoothed along
    the optical flow, fine-tuning the coarse field (ARF's kind), a FreeNeRF-style field fine-tuned, and ours.
    Interrupted, the same command goes on where it was.
    """
    from sparsestyle_ns.studies.paper_studies import compare as run

    run(options)


@exit_on_input_error
def ablate(options: Annotated[StudyOptions, tyro.conf.arg(name="")]) -> None:
    """Runs the paper's ablations on a scene, and sets them out on one page.

    Stage 1 as ours, as the paper writes it, as vanilla NeRF, with a semantic loss of DietNeRF's kind and with
    FreeNeRF's regularisers, each with our stage 2 and fine-tuned; stage 2 on e_c alone, with sines and cosines,
    without residual density, with constant content weights.
    Interrupted, the same command goes on where it was; runs that `compare` has made are used.
    """
    from sparsestyle_ns.studies.paper_studies import ablate as run

    run(options)


@exit_on_input_error
def export(
    run: Annotated[Path, tyro.conf.Positional],
    output_path: Path,
    format: Literal["html", "ply", "mesh"] = "html",
    resolution: int = 255,
) -> None:
    """Writes a stylised run as one file for those who don't have this package, and prints how close it is to the run.

    html is a page that shows the scene in any browser with WebGL2, without server or network: drag to turn, wheel or
    pinch to zoom. It has at most 30 MB; where it would have more, it gets fewer cells. ply is a cloud of coloured
    points, mesh a PLY mesh with coloured vertices (by Open3D's Poisson reconstruction).

    Args:
        run: The run's folder or its config.yml.
        output_path: The file to write.
        format: What to write.
        resolution: html: cells along a side of the scene's cube. 255 fits into the graphics memory that every browser
            with WebGL2 promises.
    """
    from sparsestyle_ns.runs.run_folder import STYLE_METHOD, find_config
    from sparsestyle_ns.utils.output_file import prepare_output

    if not 32 <= resolution <= 1023:
        raise InputError(f"--resolution {resolution} isn't between 32 and 1023; 255 suits most scenes.")
    config = find_config(run, STYLE_METHOD)
    example = "scene.html" if format == "html" else "scene.ply"
    prepare_output(
        output_path, "The scene", example
    )  # rendering takes minutes, so what can fail without it fails before
    from sparsestyle_ns.engine.hints import after_export, finish
    from sparsestyle_ns.export.command import export_mesh, export_page, export_points, load_scene

    scene = load_scene(config)
    if format == "html":
        export_page(scene, output_path, resolution)
    elif format == "ply":
        export_points(scene, output_path)
    else:
        export_mesh(scene, output_path)
    finish(output_path.resolve(), after_export(run, output_path, format))


@exit_on_input_error
def prepare(
    photos: Annotated[Path, tyro.conf.Positional],
    output: Path,
    poses: Literal["auto", "file", "colmap"] = "auto",
) -> None:
    """Makes a scene of three to eight photos: of one size, and with the places they were taken from.

    Photos are turned upright as EXIF says. With poses from a file they stay as they are stored, which such poses are
    for, unless only the upright photo has the pose's shape.

    Says in words what is wrong with the photos: too few features or matches, too little overlap, a camera that only
    turned, or only moved along its line of sight.

    Args:
        photos: Folder of the photos: JPEG, PNG, WebP, TIFF, and HEIC where pillow-heif is installed.
        output: Folder to write the scene to.
        poses: Where the photos were taken from: a poses_bounds.npy or transforms.json beside them (file), as COLMAP
            works it out (colmap, through ns-process-data), or the file if there is one, else COLMAP (auto).
    """
    from sparsestyle_ns.prepare.command import prepare_scene

    scene = prepare_scene(photos, output, poses)
    from sparsestyle_ns.engine.hints import finish

    made = f"{scene.folder}, {len(scene.names)} photos with poses"
    finish(made, ["ns-train", "coarse-fewshot", "--data", scene.folder, scene.parser])


SUBCOMMANDS: Dict[str, Callable[..., Any]] = {
    "ablate": ablate,
    "compare": compare,
    "effects": effects,
    "evaluate": evaluate,
    "export": export,
    "gallery": gallery,
    "prepare": prepare,
    "tradeoff": tradeoff,
}


def main(arguments: Optional[Sequence[str]] = None) -> None:
    """The command line; `arguments` default to the process's own."""
    try:
        tyro.extras.subcommand_cli_from_dict(
            SUBCOMMANDS,
            prog="sparsestyle",
            description="Tools around stylised scenes. Training, rendering and viewing are nerfstudio's ns-* commands.",
            args=arguments,
        )
    except KeyboardInterrupt:
        print("Stopped by Ctrl-C.", file=sys.stderr)
        raise SystemExit(130) from None
