"""`sparsestyle gallery`: from runs to one page."""

from itertools import zip_longest

from sparsestyle_ns.engine.hints import finish
from sparsestyle_ns.gallery.collect import collect_run
from sparsestyle_ns.gallery.film import read_film
from sparsestyle_ns.gallery.gallery_options import GalleryOptions
from sparsestyle_ns.gallery.layout import gallery_page
from sparsestyle_ns.runs.run_folder import find_config
from sparsestyle_ns.utils.page import write_page
from sparsestyle_ns.utils.progress import say


def make_gallery(options: GalleryOptions) -> None:
    """Writes the page, and says where it is.

    Args:
        options: checked.

    Raises:
        InputError: a run or a video can't be used.
    """
    films = list(map(read_film, options.video))  # rendering takes minutes, so what can fail before does
    runs = []
    for run, film in zip_longest(options.runs, films):
        say(f"Showing {run}")
        runs.append(collect_run(run, film, options.num_views, options.frames, options.evaluate))
    page = write_page(gallery_page(runs, options.title), options.output_path)
    first = find_config(options.runs[0]).parent
    finish(page, ["sparsestyle", "export", first, "--format", "html", "--output-path", "scene.html"])
