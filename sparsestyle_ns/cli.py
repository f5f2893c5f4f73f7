"""`sparsestyle ...`: what has no ns-* command of its own.

A subcommand is a function here: its arguments and docstring are the command line and its help. It imports what it needs
when it runs, so that help is there at once.
"""

import sys
from pathlib import Path
from typing import Annotated, Any, Callable, Dict, Literal, Optional, Sequence, Tuple

import tyro

from sparsestyle_ns.export.export_options import ExportOptions
from sparsestyle_ns.gallery.gallery_options import GalleryOptions
from sparsestyle_ns.studies.study_options import StudyOptions, TradeoffOptions
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error


@exit_on_input_error
def gallery(options: Annotated[GalleryOptions, tyro.conf.arg(name="")]) -> None:
    """Makes one HTML page of stylised runs that opens without a network.

    It shows the photos, the painting, a slider between the scene before and after, a film, settings, effects, and the
    figures that `sparsestyle evaluate` has saved in the run's folder. Several runs also get a grid of scenes and
    paintings.
    """
    options.check()  # before torch is loaded, so that what can't be used is said at once
    from sparsestyle_ns.gallery.make_gallery import make_gallery

    make_gallery(options)


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
    from sparsestyle_ns.utils.files import prepare_output

    needs_style = baked or style_image is not None
    config = find_config(run, STYLE_METHOD if needs_style else "")
    if output_path is None and style_image is not None:
        raise InputError(f"{REPORT_FILE} in the run's folder is for its own painting; name a file with --output-path.")
    path = output_path or config.parent / REPORT_FILE
    prepare_output(path, "The report", "report.json")  # measuring takes minutes, so what can fail fails before
    if style_image is not None:
        from sparsestyle_ns.style.painting import Painting

        Painting.read(style_image)
    from sparsestyle_ns.engine.hints import after_evaluation, finish
    from sparsestyle_ns.engine.loading import evaluate_run
    from sparsestyle_ns.evaluation.tables import report_tables

    report = evaluate_run(config, path, style_image, baked)
    for table in report_tables(report.means, len(report.views)):
        table.print()
    finish(path, after_evaluation(config.parent, stylised="content_ssim" in report.means))


@exit_on_input_error
def effects(
    data: Path,
    dataparser: Annotated[
        Tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[DATAPARSER [OPTION ...]]")
    ] = (),
    json: bool = False,
    num_views: Optional[int] = None,
    view_ids: Optional[Tuple[int, ...]] = None,
    coarse_run: Optional[Path] = None,
    style_image: Optional[Path] = None,
) -> None:
    """Prints which effects a scene needs, and why, without training.

    Each effect has what was measured, the threshold it was compared with, and the reason.

    Args:
        data: The scene's folder or file.
        dataparser: What reads the scene, where its files don't tell: llff-data, blender-data, nerfstudio-data, colmap
            …; its options come after two dashes: -- colmap --colmap-path sparse/0.
        json: Print JSON: a list `effects` of name, on, measured, threshold, reason.
        num_views: How many photos to train on, as for ns-train.
        view_ids: Which photos to train on, as for ns-train.
        coarse_run: A coarse run of the scene, to measure the effects of stage 2; left out, they are assumed.
        style_image: The painting, to compare its palette with the photos'.
    """
    from contextlib import redirect_stdout

    from sparsestyle_ns.data.parser_choice import parse_dataparser
    from sparsestyle_ns.engine.hints import after_effects, finish
    from sparsestyle_ns.prepare.measure_effects import measure_scene

    parser = parse_dataparser(dataparser, data)
    with redirect_stdout(sys.stderr):  # what dataparsers print must not get into the JSON
        decisions = measure_scene(parser, data, num_views, view_ids, coarse_run, style_image)
    print(decisions.json() if json else decisions.text(), flush=True)
    with redirect_stdout(sys.stderr if json else sys.stdout):
        finish(None, after_effects(parser, data, num_views, view_ids, coarse_run, style_image))


@exit_on_input_error
def tradeoff(options: Annotated[TradeoffOptions, tyro.conf.arg(name="")]) -> None:
    """Measures what accuracy costs in time, on this machine and a scene of yours.

    Writes curves of error against time for each setting that trades one for the other, as a page that opens offline,
    JSON and CSV, and says in plain words what to turn. Ctrl-C keeps what has been measured.
    """
    from sparsestyle_ns.studies.tradeoff import tradeoff as run

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
def export(options: Annotated[ExportOptions, tyro.conf.arg(name="")]) -> None:
    """Writes a stylised run as one file that needs no Python, and prints how close it comes to the exact render.

    html is a page that shows the scene in any browser with WebGL2, without server or network: drag to turn, wheel or
    pinch to zoom. It has at most 30 MB; if it would be larger, the scene gets fewer cells. ply is a cloud of coloured
    points. mesh is a PLY mesh with coloured vertices, made by Open3D's Poisson reconstruction.
    """
    options.check()  # before torch is loaded, so that what can't be used is said at once
    from sparsestyle_ns.export.export_run import export_run

    export_run(options)


@exit_on_input_error
def prepare(
    photos: Annotated[Path, tyro.conf.Positional],
    output: Path,
    poses: Literal["auto", "file", "colmap"] = "auto",
) -> None:
    """Makes a scene of three to eight photos: of one size, and with camera poses.

    Photos are turned upright as EXIF says. With poses from a file they stay as they are stored, because such poses are
    for the stored pixels, unless only the upright photo has the pose's shape.

    Prints what is wrong with the photos: too few features or matches, too little overlap, a camera that only turned, or
    that only moved along its line of sight.

    Args:
        photos: Folder of the photos: JPEG, PNG, WebP, TIFF, and HEIC where pillow-heif is installed.
        output: Folder to write the scene to.
        poses: Where the camera poses are from: a poses_bounds.npy or transforms.json beside the photos (file), COLMAP
            (colmap, through ns-process-data), or the file if there is one, else COLMAP (auto).
    """
    from sparsestyle_ns.prepare.prepare_scene import prepare_scene

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
