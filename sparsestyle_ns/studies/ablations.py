"""The paper's ablations (Sec. 4.2): the same classes with other settings."""

from pathlib import Path
from typing import Dict, List, Sequence, Tuple

from sparsestyle_ns.runs.scene_record import SceneRecord
from sparsestyle_ns.studies.comparison import coarse_section, consistency_table, picture_grid, style_table
from sparsestyle_ns.studies.experiments import Experiment, Laboratory
from sparsestyle_ns.studies.study import (
    STOPS,
    Measured,
    Painter,
    Study,
    loss_traces,
    measure_run,
    picture_after,
    save_picture_after,
)
from sparsestyle_ns.studies.study_page import Section, line_plot

Kinds = Tuple[str, str]
Groups = Dict[str, Tuple[str, Dict[str, Kinds]]]
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
GROUPS: Groups = {
    "Hierarchical representation (Fig. 6)": (
        "What the residual field sees of a position: the hash grid and e_c, e_c alone, or sines and cosines of ten "
        "octaves and e_c.",
        {"ours": ("ours", "ours"), "e_c only": ("ec-only", "ours"), "sines and cosines": ("frequency", "ours")},
    ),
    "Fine-level geometry": (
        "With the residual density, and with the coarse field's density alone.",
        {"ours": ("ours", "ours"), "without residual density": ("coarse-density", "ours")},
    ),
    "Content annealing (Fig. 8)": (
        "The content weight falling from 10 to 0.1, and constant ones.",
        {"ours": ("ours", "ours"), **{f"λ = {w}": (f"lambda-{w}", "ours") for w in ("10", "1", "0.1")}},
    ),
}
"""Of each ablation of stage 2 what it is about, and its rows with their kinds of stage 2 and stage 1."""
ANNEALING = "Content annealing (Fig. 8)"
SMOOTHED = 9
"""Iterations, about, that a trace is averaged over: as many whole rounds of the views as come near."""


def ablation_groups(coarse_kinds: Sequence[str]) -> Groups:
    """As `GROUPS`, after the group that compares these kinds of stage 1, of which the first is ours."""
    rows = {
        f"{COARSE_NAMES[coarse]} + {'our stage 2' if style == 'ours' else 'ARF kind'}": (style, coarse)
        for coarse in coarse_kinds
        for style in ("ours", "arf")
        if (style, coarse) != ("ours", "ours")
    }
    text = (
        "Stage 2 on coarse fields of different kinds, against fine-tuning each of them. "
        f"{WITH_DIETNERF if 'dietnerf' in coarse_kinds else WITHOUT_DIETNERF} DiffusioNeRF is left out: it needs a "
        "diffusion model whose weights aren't part of this package."
    )
    return {"Coarse-to-fine framework (Fig. 5)": (text, {"ours": ("ours", "ours"), **rows}), **GROUPS}


def ablation_experiments(study: Study, painting: Path, groups: Groups) -> List[Experiment]:
    """The runs that the ablations need, each once."""
    kinds = dict.fromkeys(pair for _, rows in groups.values() for pair in rows.values())
    return [study.stylised(painting, style, coarse) for style, coarse in kinds]


def ablate(study: Study, paintings: Sequence[Path], laboratory: Laboratory) -> List[Section]:
    """Trains what is missing, measures everything, and sets it out.

    Raises:
        InputError: a run failed.
    """
    coarse_kinds = study.coarse_kinds()
    groups = ablation_groups(coarse_kinds)
    wanted = [each for painting in paintings for each in ablation_experiments(study, painting, groups)]
    laboratory.run(wanted, lambda each, stop: save_picture_after(each.folder(study.scene), stop))
    sections = [coarse_section(study, coarse_kinds)]
    for painting in paintings:
        painter = Painter(painting)
        for heading, (text, rows) in groups.items():
            sections.append(_group(study, painter, heading, text, rows))
    return sections


def _group(study: Study, painter: Painter, heading: str, text: str, rows: Dict[str, Kinds]) -> Section:
    folders = {
        name: study.stylised(painter.painting, style, coarse).folder(study.scene)
        for name, (style, coarse) in rows.items()
    }
    measured: Dict[str, Measured] = {name: measure_run(folder, painter) for name, folder in folders.items()}
    section = Section(
        f"{heading}: {study.scene.name} in the style of {painter.painting.stem}",
        text,
        tables=[style_table(measured), consistency_table(measured, with_paper=False)],
        grid=picture_grid(measured, measured["ours"].coarse_pictures),
    )
    if heading == ANNEALING:
        num_views = len(SceneRecord.load(folders["ours"]).view_ids)
        traces = {name: loss_traces(folder) for name, folder in folders.items()}
        section.plots = annealing_plots(traces, smoothing(num_views))
        section.grid = [(name, _growth(folder, measured[name])) for name, folder in folders.items()]
    return section


def _growth(folder: Path, measured: Measured) -> List[Tuple[str, Path]]:
    """Pictures of a run on its way, and at its end."""
    early = [(f"after {stop} iterations", picture_after(folder, stop)) for stop in STOPS]
    return [*(each for each in early if each[1].is_file()), ("at the end", measured.pictures[1])]


def smoothing(num_views: int) -> int:
    """Iterations to average a trace over, of which each sees one view in turn."""
    return num_views * max(1, round(SMOOTHED / num_views))


def annealing_plots(traces: Dict[str, Dict[str, Tuple[List[int], List[float]]]], count: int) -> List[Tuple[str, str]]:
    """Content against style loss on the way (Fig. 8 b), and both losses by iteration, means over `count` of them."""
    smooth = {
        name: {loss: (steps, moving_mean(values, count)) for loss, (steps, values) in both.items()}
        for name, both in traces.items()
    }
    pareto = {name: (both["content"][1], both["style"][1]) for name, both in smooth.items()}
    mean = f"means over {count} iterations"
    return [
        (line_plot(pareto, "content loss", "style loss", marks=True), f"Way of both losses; dots: the end ({mean})."),
        *(
            (
                line_plot({name: both[loss] for name, both in smooth.items()}, "iteration", f"{loss} loss"),
                f"The {loss} loss in training ({mean}).",
            )
            for loss in ("content", "style")
        ),
    ]


def moving_mean(values: Sequence[float], count: int) -> List[float]:
    """At each place the mean of the last `count` values, of as many as there are at the beginning."""
    return [sum(part) / len(part) for part in (values[max(0, end - count) : end] for end in range(1, len(values) + 1))]
