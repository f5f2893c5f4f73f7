"""The part of the panel that makes another style of the scene."""

import math
import threading
import time
from pathlib import Path
from typing import Callable, Dict, Optional

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from viser import GuiApi

from sparsestyle_ns.engine.restyling import Progress, Restyling, Workshop
from sparsestyle_ns.fields.fine import StylisedField
from sparsestyle_ns.pipelines.hier_style import STROKE_SIZES, HierStylePipelineConfig
from sparsestyle_ns.runs.run_folder import read_config
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.progress import duration
from sparsestyle_ns.viewer.styles import Facts, plain, style_facts

SECONDS_BETWEEN_TEXTS = 0.5
"""Losses and progress are not told more often than this."""
SECONDS_AT_REST = 0.3
"""A restyling goes on when nothing was moved for so long: a picture on the way needs the processor."""

AddStyle = Callable[[str, StylisedField, Facts, bytes], str]
"""Shows a new style, given a name, its field, what made it and its thumbnail; returns the name that it got."""


def losses_text(losses: Dict[str, float]) -> str:
    """Losses and weights by name, in a line."""
    return ", ".join(f"{name} {value:.3g}" for name, value in losses.items())


def error_text(error: Exception) -> str:
    """An error in one sentence; one that isn't about the user's input keeps its kind."""
    text = in_one_line(error)
    if isinstance(error, InputError):
        return text
    return f"Something went wrong in restyling, and the style on the screen stays ({type(error).__name__}: {text})."


def in_one_line(error: Exception) -> str:
    """An error's message without line breaks, or its kind where it has none."""
    if isinstance(error, InputError):
        return f"{error.fault}."  # what is kept apart from it is advice to one who types commands
    return " ".join(str(error).split()) or type(error).__name__


class Pace:
    """Keeps something from being told more often than every `SECONDS_BETWEEN_TEXTS`."""

    def __init__(self) -> None:
        self._last = -math.inf

    def is_due(self, at_once: bool) -> bool:
        """Whether to tell it now, which counts as told then; always with `at_once`."""
        now = time.monotonic()
        if not at_once and now - self._last < SECONDS_BETWEEN_TEXTS:
            return False
        self._last = now
        return True


class RestylingControls:
    """An image, buttons and a progress bar; one restyling at a time, in a thread of its own.

    `open_workshop` raises an `InputError` that says why a scene can't be restyled. `is_prepared` is false while a
    training is being set up; `seconds_at_rest` count since a camera or a control was moved.
    """

    def __init__(
        self,
        gui: GuiApi,
        open_workshop: Callable[[], Workshop],
        is_prepared: Callable[[], bool],
        seconds_at_rest: Callable[[], float],
        add_style: AddStyle,
    ) -> None:
        self.is_prepared, self.seconds_at_rest, self.add_style = is_prepared, seconds_at_rest, add_style
        self.workshop: Optional[Workshop] = None
        self.thread: Optional[threading.Thread] = None
        self._stopping, self._busy, self._pace = threading.Event(), threading.Lock(), Pace()
        iterations, said = 0, ""
        stroke_size, kept_structure = HierStylePipelineConfig.stroke_size, HierStylePipelineConfig.kept_structure
        try:
            self.workshop = open_workshop()
            config = read_config(self.workshop.folder)
            iterations, settings = config.max_num_iterations, config.pipeline
            stroke_size, kept_structure = settings.stroke_size, settings.kept_structure
        except InputError as error:
            said = f"**No restyling.** {plain(str(error))}"
        with gui.add_folder("Another style", expand_by_default=False):
            self.path = gui.add_text("Image", "", hint="path of a picture on the machine that the viewer runs on")
            self.iterations = gui.add_number("Iterations", iterations)
            self.stroke_size = gui.add_slider("Stroke size", *STROKE_SIZES, step=0.1, initial_value=stroke_size)
            hint = "how much of the photos' light and dark views keep at least (SSIM)"
            self.kept_structure = gui.add_slider("Kept structure", 0.0, 1.0, 0.05, kept_structure, hint=hint)
            gui.add_button("Restyle").on_click(lambda _: self.restyle_path())
            upload = gui.add_upload_button("Upload and restyle", mime_type="image/*")
            upload.on_upload(lambda event: self.restyle_upload(event.target.value.name, event.target.value.content))
        self.message = gui.add_markdown(said, image_root=Path())
        self.bar = gui.add_progress_bar(0.0, visible=False)
        self.stop_button = gui.add_button("Stop restyling", visible=False)
        self.stop_button.on_click(lambda _: self.stop())

    @property
    def is_busy(self) -> bool:
        """Whether a restyling is under way."""
        return self._busy.locked()

    def stop(self) -> None:
        """Ends the restyling soon; the style on the screen stays."""
        self._stopping.set()

    def restyle_path(self) -> None:
        """Restyles with the picture whose path was written."""

        def read() -> Painting:
            path = self.path.value.strip()
            if not path:
                raise InputError("There is no image: write a path, or upload one.")
            return Painting.read(path)

        self._restyle(read)

    def restyle_upload(self, name: str, data: bytes) -> None:
        """Restyles with a picture that a browser sent."""
        self._restyle(lambda: Painting.received(name, data))

    def _restyle(self, read: Callable[[], Painting]) -> None:
        if not self._busy.acquire(blocking=False):
            self.message.content = "One restyling at a time: wait for it, or stop it."
            return
        try:
            painting = read()
            if self.workshop is None:
                raise InputError("This run can't be restyled in this viewer.")
            if not self.is_prepared():
                raise InputError("The scene is still being prepared for training; try again when it has begun.")
            own = {"stroke_size": self.stroke_size.value, "kept_structure": self.kept_structure.value}
            restyling = Restyling(self.workshop, painting, int(self.iterations.value), own)
        except Exception as error:  # whatever it is, the viewer goes on
            self._busy.release()
            self.end(f"**Not restyled.** {plain(error_text(error))}")
            return
        self._stopping.clear()
        self.stop_button.visible = True
        self.thread = threading.Thread(target=self._work, args=(restyling,), name="restyling", daemon=True)
        self.thread.start()

    def _work(self, restyling: Restyling) -> None:
        try:
            with torch.enable_grad():
                for progress in restyling:
                    self.tell(progress)
                    if self._stopping.is_set():
                        self.end("Stopped; the style on the screen stays.")
                        return
                    self.wait_for_rest()
            self.end(self._keep(restyling))
        except Exception as error:  # whatever it is, the viewer goes on
            if not threading.main_thread().is_alive():
                return  # Python's end has begun, and the controls don't work any more
            if not isinstance(error, InputError):
                CONSOLE.print_exception()
            self.end(f"**Not restyled.** {plain(error_text(error))}")
        finally:
            self._busy.release()

    def wait_for_rest(self) -> None:
        """Waits while a camera or a control is being moved."""
        while self.seconds_at_rest() < SECONDS_AT_REST and not self._stopping.is_set():
            time.sleep(0.02)

    def _keep(self, restyling: Restyling) -> str:
        """Saves and shows the new style, which stays even where it can't be saved; returns what came of that."""
        painting = restyling.image
        try:
            run = str(restyling.save())
            ending = f"Saved as a run of its own: {plain(run)}"
        except Exception as error:  # whatever it is, the style is worth more than its copy on the disk
            if not isinstance(error, (OSError, RuntimeError)):
                CONSOLE.print_exception()
            reason = in_one_line(error)
            run = f"not saved ({reason})"
            ending = f"It is **not saved** ({plain(reason)}), and gone when the viewer ends."
        facts = style_facts(painting.name, run, restyling.notes(), restyling.iterations)
        name = self.add_style(Path(painting.name).stem, restyling.field, facts, painting.thumbnail())
        return f"**{plain(name)}** is ready. {ending}"

    def tell(self, progress: Progress) -> None:
        """Says how far a restyling is, if it is time to say so again."""
        if not self._pace.is_due(at_once=progress.losses is None or progress.done == 1.0):
            return
        self.bar.visible, self.bar.value = True, 100.0 * progress.done
        text = f"Restyling. {progress.words}"
        if progress.losses is not None:
            text += f": {losses_text(progress.losses)}, {duration(progress.seconds_left)} left"
        self.message.content = text

    def end(self, message: str) -> None:
        """Says how a restyling ended."""
        self.message.content = message
        self.bar.value = 0.0
        self.bar.visible = self.stop_button.visible = False
