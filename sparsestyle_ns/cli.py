"""`sparsestyle ...`: what has no ns-* command of its own.

A subcommand is a function here: its arguments and docstring are the command line and its help. It imports what it needs
when it runs, so that help is there at once.
"""

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
    from sparsestyle_ns.output_file import prepare_output
    from sparsestyle_ns.run_folder import STYLE_METHOD, find_config

    if not 32 <= resolution <= 1023:
        raise InputError(f"--resolution {resolution} isn't between 32 and 1023; 255 suits most scenes.")
    config = find_config(run, STYLE_METHOD)
    example = "scene.html" if format == "html" else "scene.ply"
    prepare_output(
        output_path, "The scene", example
    )  # rendering takes minutes, so what can fail without it fails before
    from sparsestyle_ns.export.command import export_mesh, export_page, export_points, load_scene

    scene = load_scene(config)
    if format == "html":
        export_page(scene, output_path, resolution)
    elif format == "ply":
        export_points(scene, output_path)
    else:
        export_mesh(scene, output_path)
    print(f"The scene is {output_path.resolve()}")


@exit_on_input_error
def prepare(
    photos: Annotated[Path, tyro.conf.Positional],
    output: Path,
    poses: Literal["auto", "file", "colmap"] = "auto",
) -> None:
    """Makes a scene of three to eight photos: upright, of one size, and with the places they were taken from.

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
    print(f"{scene.folder} has {len(scene.names)} photos with poses")
    print(f"Next: ns-train coarse-fewshot --data {scene.folder} {scene.parser}")


SUBCOMMANDS: Dict[str, Callable[..., Any]] = {
    "evaluate": evaluate,
    "export": export,
    "gallery": gallery,
    "prepare": prepare,
}


def main(arguments: Optional[Sequence[str]] = None) -> None:
    """The command line; `arguments` default to the process's own."""
    tyro.extras.subcommand_cli_from_dict(
        SUBCOMMANDS,
        prog="sparsestyle",
        description="Tools around stylised scenes. Training, rendering and viewing are nerfstudio's ns-* commands.",
        args=arguments,
    )
