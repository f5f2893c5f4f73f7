"""The table of effects in the viewer."""

from typing import Callable

from nerfstudio.viewer.viewer_elements import ViewerElement
from viser import ViserServer


class EffectsPanel(ViewerElement[str]):
    """A table of text in the viewer's list of controls.

    Args:
        markdown: gives the text whenever the panel is made.
    """

    def __init__(self, markdown: Callable[[], str]) -> None:
        super().__init__("Effects")
        self.markdown = markdown

    def _create_gui_handle(self, viser_server: ViserServer) -> None:
        self.gui_handle = viser_server.gui.add_markdown(self.markdown(), visible=self.visible)

    def install(self, viser_server: ViserServer) -> None:
        """Makes the panel."""
        self._create_gui_handle(viser_server)
