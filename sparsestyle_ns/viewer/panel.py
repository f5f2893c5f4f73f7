"""The "Style" panel of `hier-style` in nerfstudio's viewer, in ns-train and ns-viewer alike."""

import atexit
import math
import threading
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Callable, Dict, List, Optional, Tuple

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.viewer_elements import (
    ViewerButton,
    ViewerCheckbox,
    ViewerControl,
    ViewerDropdown,
    ViewerElement,
    ViewerNumber,
    ViewerSlider,
    ViewerText,
)
from torch import nn

from sparsestyle_ns.effects.base import Decisions
from sparsestyle_ns.engine.restyling import Progress, Restyling, Workshop
from sparsestyle_ns.losses.stylization import Losses
from sparsestyle_ns.models.hier_style import RENDER_MODES, Look
from sparsestyle_ns.rendering.mixing import Mix
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.names import free_name
from sparsestyle_ns.viewer.baking import Baker
from sparsestyle_ns.viewer.elements import Markdown, ProgressBar, UploadButton
from sparsestyle_ns.viewer.styles import (
    Style,
    StyleImage,
    checkpoint_notes,
    find_thumbnail,
    plain,
    style_facts,
)

NO_BLEND = "nothing"
"""What a style is blended with at first; no style has this name."""
OUTPUTS = ["rgb", "rgb_coarse", "accumulation", "depth", "accumulation_coarse", "depth_coarse"]
"""The model's, those first that are looked at most."""
SECONDS_BETWEEN_TEXTS = 0.5
"""Losses and progress are not told more often than this."""
SECONDS_AT_REST = 0.3
"""A restyling goes on when nothing was moved for so long: a picture on the way needs the processor."""
SECONDS_UNTIL_BAKING = 2.0
"""Volumes are filled ahead when nothing was moved for so long, so that the still picture comes first."""
SECONDS_TO_END = 60.0
"""What is at work when the viewer ends gets so long to come to an end."""
MAX_SIDE_ON_CPU = 256
"""Longer side of still pictures where there is no GPU; nerfstudio's own is 512."""


class StylePanel(ViewerControl):
    """Controls of the style, in a folder of their own.

    Controls change what the viewer's threads draw and nothing else: what is drawn in training and for evaluation, files
    and videos is what the run's config says.

    Args:
        pipeline: the `HierStylePipeline`, whose model is there already.
    """

    def __init__(self, pipeline: Any) -> None:
        self.pipeline = pipeline
        config, redraw = pipeline.model.config, lambda _: self._changed()
        self.description = Markdown()
        self.style = ViewerDropdown("Style", "…", ["…"], cb_hook=lambda _: self._style_chosen())
        self.other = ViewerDropdown("Blend with", NO_BLEND, [NO_BLEND], cb_hook=lambda _: self._other_chosen())
        self.blend = ViewerSlider(
            "Blend", 0.5, 0.0, 1.0, 0.01, visible=False, cb_hook=redraw, hint="0: the style, 1: the other one"
        )
        self.strength = ViewerSlider(
            "Strength", config.strength, 0.0, 1.0, 0.01, cb_hook=redraw, hint="0: the coarse field, 1: the stylised one"
        )
        self.geometry = ViewerSlider(
            "Geometry", config.geometry_strength, 0.0, 1.0, 0.01, cb_hook=redraw, hint="share of the residual density"
        )
        self.mode = ViewerDropdown(
            "Render mode",
            config.render_mode,
            list(RENDER_MODES),
            cb_hook=redraw,
            hint="baked: quick once it has been somewhere, from a voxel grid",
        )
        self.split = ViewerCheckbox("Coarse | stylised", False, cb_hook=lambda _: self._apply_split())
        self.training = Markdown(visible=False)
        self.path = ViewerText("Image", "", hint="path of a picture on the machine that the viewer runs on")
        self.iterations = ViewerNumber("Iterations", 0)
        self.start = ViewerButton("Restyle", lambda _: self.restyle(self._read_path))
        self.upload = UploadButton(
            "Upload and restyle", lambda name, data: self.restyle(lambda: StyleImage.received(name, data))
        )
        self.stop = ViewerButton("Stop restyling", lambda _: self._stop.set(), visible=False)
        self.bar, self.message = ProgressBar(), Markdown()
        self.styles: List[Style] = []
        self.viewer: Any = None
        self.baker: Optional[Baker] = None
        self._workshop: Optional[Workshop] = None
        self._restyler: Optional[threading.Thread] = None
        self._stop, self._busy = threading.Event(), threading.Lock()
        self._last_change = 0.0
        self._losses_told, self._progress_told = Pace(), Pace()
        self._described = False

    # Making the panel

    def _setup(self, viewer: Any) -> None:
        """Called by nerfstudio when everything else of the viewer is there; see `ViewerControl`."""
        super()._setup(viewer)
        self.folder = Path(viewer.log_filename).parent.resolve()
        self._take_defaults()
        self._describe_run()
        self._install()
        self._guard_outputs()
        self._hide_frustums()
        self.pipeline.model.viewer_look = self.look
        self.pipeline.on_losses = self.show_losses
        if self.pipeline.device.type == "cpu":
            cameras = self.pipeline.datamanager.train_dataset.cameras
            self.baker = Baker(self.pipeline.model, cameras, self._shown, self._is_free, self._lock())
            self.baker.start()
        atexit.register(self.close)
        viewer.viser_server.on_client_connect(self._welcome)

    def close(self) -> None:
        """Ends what is at work in the background and waits for that; a style that is being saved is saved.

        Python calls it at its end: a thread that is in the middle of torch then would abort the process.
        """
        atexit.unregister(self.close)
        self._stop.set()
        if self.baker is not None:
            self.baker.ending.set()
        if self._busy.locked():
            CONSOLE.print("The restyling is being stopped; Ctrl-C ends it at once.")
        for thread in (self.baker, self._restyler):
            if thread is not None:
                thread.join(SECONDS_TO_END)

    def _take_defaults(self) -> None:
        if self.pipeline.device.type == "cpu":
            self.viewer.control_panel._max_res.value = MAX_SIDE_ON_CPU
            if self.viewer.trainer is None:  # while a field learns, nothing that is baked lasts
                self.mode.value = "baked"
        try:
            self._workshop = Workshop(self.pipeline, self.folder, self._lock())
            self.iterations.value = self._workshop.config().max_num_iterations
        except InputError as error:
            self.message.content = f"**No restyling.** {plain(str(error))}"

    def _lock(self) -> Any:
        """The lock that iterations of training and the viewer's pictures take turns by."""
        return nullcontext() if self.viewer.train_lock is None else self.viewer.train_lock

    def _describe_run(self) -> None:
        """Says what made the run's own style, as far as it is known by now."""
        config, trainer = self.pipeline.config, self.viewer.trainer
        if trainer is None:
            notes = checkpoint_notes(self.folder / "nerfstudio_models")
        else:
            notes = trainer.notes() if self.pipeline.targets is not None else {}
        if not self.styles:
            name = self._free_name("this run" if config.style_image is None else config.style_image.stem)
            self.styles.append(Style(name, self.pipeline.model.residual))
            self._offer_styles(name)
        own, painting = self.styles[0], None if config.style_image is None else config.style_image.name
        own.facts = style_facts(painting, str(self.folder), notes)
        own.thumbnail = find_thumbnail(self.folder, config.style_image)
        self._show_description()

    def _install(self) -> None:
        gui = self.viewer.viser_server.gui
        # After nerfstudio's buttons and step, before its tabs.
        with gui.add_folder("Style", order=self.viewer.stats_markdown.order + 0.5):
            self._add(self.strength, self.geometry, self.style, self.other, self.blend, self.mode, self.split)
            self._add(self.training)
            with gui.add_folder("Another style", expand_by_default=False):
                self._add(self.path, self.iterations, self.start, self.upload)
            self._add(self.message, self.bar, self.stop)
            with gui.add_folder("What made it"):
                self._add(self.description)
            with gui.add_folder("Effects of this scene", expand_by_default=False):
                self._add(Markdown(_effects_text(self.pipeline.effects)))

    def _add(self, *elements: ViewerElement) -> None:
        for element in elements:
            element.install(self.viewer.viser_server)

    def _guard_outputs(self) -> None:
        """Keeps the split as it was chosen when nerfstudio fills its lists of outputs, for each browser that comes."""
        control_panel = self.viewer.control_panel
        fill = control_panel.update_output_options

        def fill_and_keep(options: List[str]) -> None:
            fill(options)
            self._apply_split()

        fill(OUTPUTS)
        control_panel.update_output_options = fill_and_keep
        self._apply_split()

    def _welcome(self, client: Any) -> None:
        """Has a new browser look at the scene as its most central photo does."""
        from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO

        cameras = self.pipeline.datamanager.train_dataset.cameras
        poses = cameras.camera_to_worlds.cpu().double().numpy()
        centre = int(np.argmin(np.linalg.norm(poses[:, :, 3] - poses[:, :, 3].mean(axis=0), axis=-1)))
        pose = poses[centre]
        position = VISER_NERFSTUDIO_SCALE_RATIO * pose[:, 3]
        with client.atomic():
            client.camera.position = position
            client.camera.up_direction = pose[:, 1]
            client.camera.look_at = position - VISER_NERFSTUDIO_SCALE_RATIO * pose[:, 2]
            client.camera.fov = 2.0 * math.atan(float(cameras.cy[centre] / cameras.fy[centre]))

    def _hide_frustums(self) -> None:
        """Has the photos' frustums hidden as soon as they are drawn: one at a camera's place would fill the window."""
        viewer, draw = self.viewer, self.viewer.init_scene

        def draw_and_hide(*arguments: Any, **named: Any) -> None:
            draw(*arguments, **named)
            viewer.set_camera_visibility(False)
            viewer.toggle_cameravis_button()

        viewer.init_scene = draw_and_hide

    # What is drawn

    def look(self) -> Optional[Look]:
        """What the controls say, to the viewer's own threads; None to all others."""
        if not isinstance(threading.current_thread(), RenderStateMachine):
            return None
        mix = Mix(self.strength.value, self.geometry.value, self.blend.value)
        return Look(self.mode.value, mix, self._shown())

    def _shown(self) -> Tuple[nn.Module, ...]:
        """The fields of the style and of the one that it is blended with."""
        style, other = self._named(self.style.value) or self.styles[0], self._named(self.other.value)
        return (style.field,) if other is None or other is style else (style.field, other.field)

    def _named(self, name: str) -> Optional[Style]:
        return next((style for style in self.styles if style.name == name), None)

    def _free_name(self, name: str) -> str:
        """A name by which a new style can be told from the others and from none."""
        return free_name(name, [NO_BLEND, *(style.name for style in self.styles)])

    def _changed(self) -> None:
        self._last_change = time.monotonic()
        self.viewer._trigger_rerender()

    def _style_chosen(self) -> None:
        self._show_description()
        self._changed()

    def _other_chosen(self) -> None:
        self.blend.set_visible(self.other.value != NO_BLEND)
        self._changed()

    def _apply_split(self) -> None:
        """Shows the coarse field on the left and the stylised one on the right, or the stylised one alone."""
        panel = self.viewer.control_panel
        outputs = ("rgb_coarse", "rgb") if self.split.value else ("rgb", "rgb_coarse")
        if self.split.value or panel._split.value:
            panel._output_render.value, panel._split_output_render.value = outputs
        else:
            panel._split_output_render.value = outputs[1]
        panel._split.value = self.split.value

    def _show_description(self) -> None:
        style = self._named(self.style.value)
        self.description.content = "" if style is None else style.markdown()

    def _offer_styles(self, chosen: str) -> None:
        names = [style.name for style in self.styles]
        self.style.set_options(names)
        self.other.set_options([NO_BLEND, *names])
        self.style.value = chosen

    # Training

    def show_losses(self, step: int, losses: Losses) -> None:
        """Tells of an iteration of training, where there is a viewer."""
        if self.viewer is None:
            return
        total = self.viewer.trainer.config.max_num_iterations
        if not self._losses_told.is_due(at_once=step + 1 == total):
            return
        if not self._described:
            self._described = True
            self._describe_run()
            self.training.set_visible(True)
        values = {name: float(value) for name, value in losses.metrics().items()}
        self.training.content = _loss_text(f"Iteration {step + 1} of {total}", values)

    # Restyling

    def _read_path(self) -> StyleImage:
        path = self.path.value.strip()
        if not path:
            raise InputError("There is no image: write a path, or upload one.")
        return StyleImage.read(Path(path))

    def restyle(self, read: Callable[[], StyleImage]) -> None:
        """Starts a restyling, or says why not.

        Args:
            read: gives the painting.
        """
        if not self._busy.acquire(blocking=False):
            self.message.content = "One restyling at a time: wait for it, or stop it."
            return
        try:
            restyling = self._new_restyling(read())
        except Exception as error:  # whatever it is, the viewer goes on
            self._busy.release()
            self._end(f"**Not restyled.** {plain(_sentence(error))}")
            return
        self._stop.clear()
        self.stop.set_visible(True)
        self._restyler = threading.Thread(target=self._work, args=(restyling,), name="restyling", daemon=True)
        self._restyler.start()

    def _new_restyling(self, image: StyleImage) -> Restyling:
        if self._workshop is None:
            raise InputError("This run can't be restyled in this viewer.")
        if self.viewer.trainer is not None and not self._described:
            raise InputError("The scene is still being prepared for training; try again when it has begun.")
        return Restyling(self._workshop, image, int(self.iterations.value))

    def _work(self, restyling: Restyling) -> None:
        """Stylises, then shows what came out; the thread of one restyling."""
        try:
            with torch.enable_grad():
                for progress in restyling:
                    self._tell(progress)
                    if self._stop.is_set():
                        self._end("Stopped; the style on the screen stays.")
                        return
                    self._let_pictures_pass()
            self._end(self._keep(restyling))
        except Exception as error:  # whatever it is, the viewer goes on
            if not threading.main_thread().is_alive():
                return  # Python's end has begun, and the controls don't work any more
            if not isinstance(error, InputError):
                CONSOLE.print_exception()
            self._end(f"**Not restyled.** {plain(_sentence(error))}")
        finally:
            self._busy.release()

    def _let_pictures_pass(self) -> None:
        """Waits while a camera or a control is being moved."""
        while self._at_rest() < SECONDS_AT_REST and not self._stop.is_set():
            time.sleep(0.02)

    def _at_rest(self) -> float:
        """Seconds since a camera or a control was moved."""
        return min(time.time() - self.viewer.last_move_time, time.monotonic() - self._last_change)

    def _is_free(self) -> bool:
        """Whether volumes may be filled ahead."""
        trainer = self.viewer.trainer
        trains = trainer is not None and trainer.training_state != "completed"
        idle = not self._busy.locked() and self._at_rest() > SECONDS_UNTIL_BAKING
        return self.mode.value == "baked" and idle and not trains

    def _keep(self, restyling: Restyling) -> str:
        """Adds the new style, which stays even where it can't be saved, and shows it; what came of that."""
        image = restyling.image
        notes = {
            "step": restyling.iterations - 1,
            "backbone": vars(self._workshop.backbone().description),
            "coarse_run": str(self.pipeline.config.coarse_run),
        }
        try:
            run = str(restyling.save())
            ending = f"Saved as a run of its own: {plain(run)}"
        except Exception as error:  # whatever it is, the style is worth more than its copy on the disk
            if not isinstance(error, (OSError, RuntimeError)):
                CONSOLE.print_exception()
            reason = _in_one_line(error)
            run = f"not saved ({reason})"
            ending = f"It is **not saved** ({plain(reason)}), and gone when the viewer ends."
        name = self._free_name(Path(image.name).stem)
        facts = style_facts(image.name, run, notes)
        with self._lock():
            self.styles.append(Style(name, restyling.field, facts, image.thumbnail()))
        self._offer_styles(name)
        return f"**{plain(name)}** is ready. {ending}"

    def _tell(self, progress: Progress) -> None:
        if not self._progress_told.is_due(at_once=progress.losses is None or progress.done == 1.0):
            return
        self.bar.show(progress.done)
        text = f"Restyling. {progress.words}"
        if progress.losses is not None:
            text = _loss_text(text, progress.losses) + f", {_minutes(progress.seconds_left)} left"
        self.message.content = text

    def _end(self, message: str) -> None:
        self.message.content = message
        self.bar.show(None)
        self.stop.set_visible(False)


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


def _loss_text(what: str, values: Dict[str, float]) -> str:
    shown = [f"{'λ' if name == 'lambda' else name} {value:.3g}" for name, value in values.items()]
    return f"{what}: {', '.join(shown)}"


def _effects_text(effects: Decisions) -> str:
    """Each effect in a line; a table would be wider than the panel."""
    lines = []
    for name, state, measured, threshold, why in (item.cells() for item in effects.items):
        lines.append(f"**{plain(name)}** {state}: {measured} {plain(why)} (threshold {threshold})")
    return "\n\n".join(lines)


def _minutes(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def _sentence(error: Exception) -> str:
    """An error in one sentence; what isn't the user's input keeps its kind."""
    text = _in_one_line(error)
    if isinstance(error, InputError):
        return text
    return f"Something went wrong in restyling, and the style on the screen stays ({type(error).__name__}: {text})."


def _in_one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
