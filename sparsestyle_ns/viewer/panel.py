"""Our part of nerfstudio's viewer: a panel of the style for `hier-style`, and of the effects for both methods."""

import atexit
import threading
import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import List, Optional, Tuple, get_args

from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.viewer import Viewer
from nerfstudio.viewer.viewer_elements import ViewerControl

from sparsestyle_ns.engine.restyling import Workshop
from sparsestyle_ns.fields.fine import StylisedField
from sparsestyle_ns.losses.stylization import Losses
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline
from sparsestyle_ns.pipelines.scene_pipeline import CheckedPipeline
from sparsestyle_ns.rendering.look import Look, RenderMode
from sparsestyle_ns.rendering.mixing import Mix
from sparsestyle_ns.runs.checkpoints import CheckpointNotes
from sparsestyle_ns.runs.scene_record import find_thumbnail
from sparsestyle_ns.utils.files import free_name
from sparsestyle_ns.utils.threads import wait_for_end
from sparsestyle_ns.viewer.adjustments import (
    begin_at_central_photo,
    end_drawing,
    hide_frustums,
    keep_outputs,
    make_rays_once,
)
from sparsestyle_ns.viewer.baking import Baker
from sparsestyle_ns.viewer.restyling_controls import Pace, RestylingControls, losses_text
from sparsestyle_ns.viewer.splat_controls import SplatControls
from sparsestyle_ns.viewer.styles import Facts, Style, plain, saved_notes, style_facts

NO_BLEND = "nothing"
"""What a style is blended with at first; no style has this name."""
OUTPUTS = ["rgb", "rgb_coarse", "accumulation", "depth", "accumulation_coarse", "depth_coarse"]
"""The model's, those first that are looked at most."""
SECONDS_UNTIL_BAKING = 2.0
"""Volumes are filled ahead when nothing was moved for so long, so that the still picture comes first."""
SECONDS_TO_END = 60.0
"""What is at work when the viewer ends gets so long to come to an end."""
MAX_SIDE_ON_CPU = 256
"""Longer side of still pictures where there is no GPU; nerfstudio's own is 512."""


class StylePanel(ViewerControl):
    """Controls of the style, in a folder of their own; they are made when a viewer is.

    Controls change what the viewer's threads draw and nothing else: all other pictures are as the run's config says.
    """

    def __init__(self, pipeline: HierStylePipeline) -> None:
        self.pipeline = pipeline
        self.baker: Optional[Baker] = None
        self._last_change = 0.0
        self._pace = Pace()
        self._knows_training = False

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        self.folder = Path(viewer.log_filename).parent.resolve()
        self._name_own_style()
        # After nerfstudio's buttons and step, before its tabs.
        with viewer.viser_server.gui.add_folder("Style", order=viewer.stats_markdown.order + 0.5):
            self._add_controls()
        self.describe_run()
        keep_outputs(viewer, OUTPUTS, self.apply_split)
        hide_frustums(viewer)
        make_rays_once()
        cameras = self.pipeline.datamanager.train_dataset.cameras
        begin_at_central_photo(viewer, cameras)
        self.pipeline.model.display.viewer = self.look
        self.pipeline.on_losses = self.show_losses
        if self.pipeline.device.type == "cpu":
            viewer.control_panel._max_res.value = MAX_SIDE_ON_CPU
            self.baker = Baker(self.pipeline.model, cameras, self.shown, self._is_free, self._lock())
            self.baker.start()
        atexit.register(self.close)

    def _add_controls(self) -> None:
        gui, config = self.viewer.viser_server.gui, self.pipeline.model.config
        strength, geometry, names = config.strength, config.geometry_strength, [style.name for style in self.styles]
        # While a field learns, nothing that is baked lasts.
        bakes = self.pipeline.device.type == "cpu" and self.viewer.trainer is None
        mode = "baked" if bakes else config.render_mode
        self.strength = gui.add_slider("Strength", 0.0, 1.0, 0.01, strength, hint="0: coarse field, 1: stylised field")
        self.geometry = gui.add_slider("Geometry", 0.0, 1.0, 0.01, geometry, hint="share of the residual density")
        self.style = gui.add_dropdown("Style", names)
        self.other = gui.add_dropdown("Blend with", [NO_BLEND, *names])
        self.blend = gui.add_slider("Blend", 0.0, 1.0, 0.01, 0.5, visible=False, hint="0: the style, 1: the other one")
        hint = "baked: quick from a voxel grid, once it has seen a place"
        self.mode = gui.add_dropdown("Render mode", get_args(RenderMode), mode, hint=hint)
        self.split = gui.add_checkbox("Coarse | stylised", False)
        for control in (self.strength, self.geometry, self.blend, self.mode):
            control.on_update(lambda _: self._changed())
        for control in (self.style, self.other):
            control.on_update(lambda _: self._style_chosen())
        self.split.on_update(lambda _: self.apply_split())
        self.training = gui.add_markdown("", image_root=Path(), visible=False)
        self.restyling = RestylingControls(
            gui,
            lambda: Workshop(self.pipeline, self.folder, self._lock()),
            lambda: self.viewer.trainer is None or self._knows_training,
            self.seconds_at_rest,
            self.add_style,
        )
        with gui.add_folder("Splats", expand_by_default=False):
            self.splats = SplatControls(self.viewer.viser_server, self.folder)
        with gui.add_folder("What made it"):
            self.description = gui.add_markdown("", image_root=Path())
        add_effects(self.viewer, self.pipeline)

    def close(self) -> None:
        """Ends what is at work in the background and waits for that; a style that is being saved is saved.

        Python calls it at its end: a thread that is in the middle of torch then would abort the process.
        """
        atexit.unregister(self.close)
        self.restyling.stop()
        if self.baker is not None:
            self.baker.ending.set()
        if self.restyling.is_busy:
            CONSOLE.print("The restyling is being stopped; Ctrl-C ends it at once.")
        own = [thread for thread in (self.baker, self.restyling.thread) if thread is not None]
        wait_for_end([*own, *end_drawing(self.viewer)], SECONDS_TO_END)

    def _lock(self) -> AbstractContextManager:
        """The lock that iterations of training and the viewer's pictures take turns by."""
        return nullcontext() if self.viewer.train_lock is None else self.viewer.train_lock

    def _name_own_style(self) -> None:
        painting = self.pipeline.config.style_image
        name = free_name("this run" if painting is None else painting.stem, [NO_BLEND])
        self.styles: List[Style] = [Style(name, self.pipeline.model.residual)]

    def describe_run(self) -> None:
        """Says what made the run's own style, as far as it is known by now."""
        painting, trainer = self.pipeline.config.style_image, self.viewer.trainer
        notes, iterations = CheckpointNotes(), None
        if trainer is None:
            notes, iterations = saved_notes(self.folder / "nerfstudio_models")
        elif self.pipeline.targets is not None:
            notes = trainer.notes()
        own = self.styles[0]
        own.facts = style_facts(None if painting is None else painting.name, str(self.folder), notes, iterations)
        own.thumbnail = find_thumbnail(self.folder, painting)
        self.description.content = self._chosen().markdown()

    def add_style(self, name: str, field: StylisedField, facts: Facts, thumbnail: bytes) -> str:
        """Adds a style and chooses it; returns its name, which may have got a number to tell it from the others."""
        name = free_name(name, [NO_BLEND, *(style.name for style in self.styles)])
        with self._lock():
            self.styles.append(Style(name, field, facts, thumbnail))
        self.offer_styles(name)
        return name

    def offer_styles(self, chosen: str) -> None:
        """Fills the lists with the styles that there are, and chooses one by its name."""
        self.style.options = [style.name for style in self.styles]
        self.other.options = [NO_BLEND, *self.style.options]
        self.style.value = chosen

    def _named(self, name: str) -> Optional[Style]:
        return next((style for style in self.styles if style.name == name), None)

    def _chosen(self) -> Style:
        return self._named(self.style.value) or self.styles[0]

    def look(self) -> Optional[Look]:
        """What the controls say, to the viewer's own threads; None to all others."""
        if not isinstance(threading.current_thread(), RenderStateMachine):
            return None
        return Look(self.mode.value, Mix(self.strength.value, self.geometry.value, self.blend.value), self.shown())

    def shown(self) -> Tuple[StylisedField, ...]:
        """The fields of the style and of the one that it is blended with."""
        style, other = self._chosen(), self._named(self.other.value)
        return (style.field,) if other is None or other is style else (style.field, other.field)

    def _changed(self) -> None:
        self._last_change = time.monotonic()
        self.viewer._trigger_rerender()

    def _style_chosen(self) -> None:
        self.description.content = self._chosen().markdown()
        self.blend.visible = self.other.value != NO_BLEND
        self._changed()

    def apply_split(self) -> None:
        """Shows the coarse field on the left and the stylised one on the right, or the stylised one alone."""
        panel = self.viewer.control_panel
        left, right = ("rgb_coarse", "rgb") if self.split.value else ("rgb", "rgb_coarse")
        if self.split.value or panel._split.value:
            panel._output_render.value = left
        panel._split_output_render.value = right
        panel._split.value = self.split.value

    def seconds_at_rest(self) -> float:
        """Seconds since a camera or a control was moved."""
        return min(time.time() - self.viewer.last_move_time, time.monotonic() - self._last_change)

    def _is_free(self) -> bool:
        if self.mode.value != "baked" or self.restyling.is_busy:
            return False
        trainer = self.viewer.trainer
        is_over = trainer is None or trainer.training_state == "completed"
        return is_over and self.seconds_at_rest() > SECONDS_UNTIL_BAKING

    def show_losses(self, step: int, losses: Losses) -> None:
        """Tells of an iteration of training."""
        total = self.viewer.trainer.config.max_num_iterations
        if not self._pace.is_due(at_once=step + 1 == total):
            return
        if not self._knows_training:
            self._knows_training = self.training.visible = True
            self.describe_run()
        values = {name: float(value) for name, value in losses.metrics().items()}
        self.training.content = f"Iteration {step + 1} of {total}: {losses_text(values)}"


def add_effects(viewer: Viewer, pipeline: CheckedPipeline) -> None:
    """Adds a folder that says which effects of a scene are simulated, and why."""
    lines = [  # a table would be wider than the panel
        f"**{plain(name)}** {state}: {measured} {plain(why)} (threshold {threshold})"
        for name, state, measured, threshold, why in (item.cells() for item in pipeline.effects.items)
    ]
    gui = viewer.viser_server.gui
    with gui.add_folder("Effects of this scene", expand_by_default=False):
        # viser warns where it is given no folder of pictures; there are none here.
        gui.add_markdown("\n\n".join(lines), image_root=Path())


class EffectsPanel(ViewerControl):
    """The effects of a scene, in a folder of their own."""

    def __init__(self, pipeline: CheckedPipeline) -> None:
        self.pipeline = pipeline

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        add_effects(viewer, self.pipeline)
        atexit.register(lambda: wait_for_end(end_drawing(viewer), SECONDS_TO_END))
