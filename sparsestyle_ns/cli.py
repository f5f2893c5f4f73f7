"""`sparsestyle ...`: what has no ns-* command of its own.

A subcommand is a function here: its arguments and docstring are the command line and its help. It imports what it needs
when it runs, so that help is there at once.
"""

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Callable, Dict, List, Literal, Optional, Sequence, Tuple

import tyro

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
    from sparsestyle_ns.studies.tradeoff import command
    from sparsestyle_ns.studies.tradeoff.budget import parse_duration

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


@dataclass
class StudyOptions:
    """What `compare` and `ablate` are run on."""

    data: Path
    """Folder of the scene."""
    style_images: Tuple[Path, ...]
    """Paintings; each is a table of its own."""
    output_path: Path
    """The HTML page to write."""
    output_dir: Path = Path("outputs/studies")
    """Where the runs are; those that are there are used. Apart from other runs: hier-style takes the newest coarse run
    below its own --output-dir, and must not find an ablation's."""
    parser: str = "llff-data"
    """nerfstudio's name of the scene's dataparser."""
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


@exit_on_input_error
def compare(options: Annotated[StudyOptions, tyro.conf.arg(name="")]) -> None:
    """Runs the paper's comparison on a scene: baselines and ours, in one table and one grid beside the paper's rows.

    Rows: frame-by-frame 2D transfer of the coarse renders (needs `pip install -e .[compare]`), the same smoothed along
    the optical flow, fine-tuning the coarse field (ARF's kind), a FreeNeRF-style field fine-tuned, and ours.
    Interrupted, the same command goes on where it was.
    """
    from sparsestyle_ns.engine.hints import study_arguments
    from sparsestyle_ns.studies.comparison import compare as run

    _write_study(options, run, "Comparison", lambda given, _: ["sparsestyle", "ablate", *study_arguments(given)])


@exit_on_input_error
def ablate(options: Annotated[StudyOptions, tyro.conf.arg(name="")]) -> None:
    """Runs the paper's ablations on a scene, and sets them out on one page.

    Stage 1 as ours, as the paper writes it, as vanilla NeRF, with a semantic loss of DietNeRF's kind and with
    FreeNeRF's regularisers, each with our stage 2 and fine-tuned; stage 2 on e_c alone, with sines and cosines,
    without residual density, with constant content weights.
    Interrupted, the same command goes on where it was; runs that `compare` has made are used.
    """
    from sparsestyle_ns.studies.ablations import ablate as run

    _write_study(options, run, "Ablations", lambda _, stylised: ["sparsestyle", "gallery", *stylised])


def _write_study(
    options: StudyOptions,
    run: Callable[..., Any],
    title: str,
    next_command: Callable[[StudyOptions, List[Path]], List[object]],
) -> None:
    """Runs a study, prints its tables and writes its page.

    Args:
        next_command: what to type next, from the options and the folders of our own stylised runs.
    """
    from sparsestyle_ns.data.parser_choice import check_parser
    from sparsestyle_ns.engine.hints import finish
    from sparsestyle_ns.studies.experiments import Laboratory, SceneSettings
    from sparsestyle_ns.studies.study import Study
    from sparsestyle_ns.studies.study_page import write_study
    from sparsestyle_ns.style.painting import Painting
    from sparsestyle_ns.utils.page import prepare_page

    check_parser(options.parser)
    if not options.data.exists():
        raise InputError(f"There is no scene at --data {options.data}; name its folder.")
    if not options.style_images:
        raise InputError("There is no painting; name at least one with --style-images.")
    if options.jobs is not None and options.jobs < 1:
        raise InputError(f"--jobs is {options.jobs}; at least one run at a time is needed.")
    for painting in options.style_images:
        Painting.read(painting)
    prepare_page(options.output_path)
    side = options.max_image_side
    scene = SceneSettings(
        options.data,
        options.parser,
        options.output_dir,
        () if side is None else ("--max-image-side", str(side)),
    )
    study = Study(
        scene,
        options.draft,
        tuple(shlex.split(options.coarse_flags)),
        tuple(shlex.split(options.style_flags)),
        options.coarse_iterations,
        options.style_iterations,
    )
    sections = run(study, options.style_images, Laboratory(scene, options.jobs))
    for section in sections:
        for table in section.tables:
            table.print()
    page = write_study(sections, options.output_path, f"{title}: {scene.name}")
    finish(page, next_command(options, [study.stylised(painting).folder(scene) for painting in options.style_images]))


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
