"""The viewer's list of effects, for a run of `coarse-fewshot`."""

from pathlib import Path

from nerfstudio.viewer.viewer import Viewer
from nerfstudio.viewer.viewer_elements import ViewerControl

from sparsestyle_ns.pipelines.base import CheckedPipeline
from sparsestyle_ns.viewer.texts import plain


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
