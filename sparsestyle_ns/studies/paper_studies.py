"""`sparsestyle compare` and `sparsestyle ablate`: from their options to trained runs, tables and a page."""

import shlex
from pathlib import Path
from typing import Sequence

from sparsestyle_ns.data.parser_choice import parse_dataparser
from sparsestyle_ns.engine.hints import finish
from sparsestyle_ns.studies.paper_runs import PaperRuns
from sparsestyle_ns.studies.paper_tables import OF_METHODS, Comparison, ablations, needed_runs, study_sections
from sparsestyle_ns.studies.run_queue import RunQueue
from sparsestyle_ns.studies.study import Study
from sparsestyle_ns.studies.study_options import StudyOptions
from sparsestyle_ns.studies.study_page import study_page
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import prepare_output, write_output


def compare(options: StudyOptions) -> None:
    """Trains what the comparison needs, and writes its page.

    Raises:
        InputError: something in the options can't be used, or a run failed.
    """
    runs = check_options(options)
    page = _run_study("Comparison", options, runs, [OF_METHODS], ("ours", "freenerf"))
    finish(page, options.ablate_command())


def ablate(options: StudyOptions) -> None:
    """Trains what the ablations need, and writes their page.

    Raises:
        InputError: something in the options can't be used, or a run failed.
    """
    runs = check_options(options)
    kinds = runs.coarse_kinds()
    page = _run_study("Ablations", options, runs, ablations(kinds), kinds)
    finish(page, ["sparsestyle", "gallery", *(runs.stylised(painting).folder for painting in options.style_images)])


def check_options(options: StudyOptions) -> PaperRuns:
    """The runs that options describe; what can be wrong with these is found here, before hours of training.

    Raises:
        InputError: something in the options can't be used.
    """
    dataparser = parse_dataparser([options.parser], options.data)
    if not options.style_images:
        raise InputError("There is no painting; name at least one with --style-images.")
    if options.jobs is not None and options.jobs < 1:
        raise InputError(f"--jobs is {options.jobs}; at least one run at a time is needed.")
    for painting in options.style_images:
        Painting.read(painting)
    prepare_output(options.output_path, "The page", "index.html")
    study = Study(
        options.data,
        dataparser,
        options.draft,
        max_image_side=options.max_image_side,
        coarse_iterations=options.coarse_iterations,
        style_iterations=options.style_iterations,
        coarse_flags=tuple(shlex.split(options.coarse_flags)),
        style_flags=tuple(shlex.split(options.style_flags)),
    )
    return PaperRuns(study, options.output_dir)


def _run_study(
    title: str, options: StudyOptions, runs: PaperRuns, comparisons: Sequence[Comparison], coarse_kinds: Sequence[str]
) -> Path:
    """Trains the runs, prints the tables of what is measured, and writes the page."""
    queue = RunQueue(options.output_dir / runs.study.name, options.jobs)
    queue.train(needed_runs(runs, comparisons, options.style_images))
    sections = study_sections(runs, comparisons, coarse_kinds, options.style_images)
    for section in sections:
        for table in section.tables:
            table.print()
    page = study_page(f"{title}: {runs.study.name}", sections)
    return write_output(options.output_path, page, "The page", "index.html")
