"""The table of effects in the viewer."""

from nerfstudio.viewer.viewer_elements import ViewerElement
from viser import ViserServer

from sparsestyle_ns.pipelines.base import CheckedPipeline


class EffectsPanel(ViewerElement[str]):
    """A table of text in the viewer's list of controls.

    Args:
        pipeline: whose effects are told.
    """

    def __init__(self, pipeline: CheckedPipeline) -> None:
        super().__init__("Effects")
        self.markdown = lambda: pipeline.effects.markdown()

    def _create_gui_handle(self, viser_server: ViserServer) -> None:
        self.gui_handle = viser_server.gui.add_markdown(self.markdown(), visible=self.visible)

    def install(self, viser_server: ViserServer) -> None:
        """Makes the panel."""
        self._create_gui_handle(viser_server)
