"""Controls that nerfstudio's viewer elements lack."""

from pathlib import Path
from typing import Any, Callable, Optional

from nerfstudio.viewer.viewer_elements import ViewerElement
from viser import ViserServer


class Markdown(ViewerElement[str]):
    """A text in the viewer's panel that can change.

    Args:
        content: what it says at first.
        visible: whether it is shown.
    """

    def __init__(self, content: str = "", visible: bool = True) -> None:
        super().__init__("Markdown", visible=visible)
        self._content = content

    def _create_gui_handle(self, viser_server: ViserServer) -> None:
        # viser warns where it is told no folder of pictures; pictures here are data, not files.
        self.gui_handle = viser_server.gui.add_markdown(self._content, visible=self.visible, image_root=Path())

    def install(self, viser_server: ViserServer) -> None:
        """Makes it."""
        self._create_gui_handle(viser_server)

    @property
    def content(self) -> str:
        """What it says, as Markdown."""
        return self._content

    @content.setter
    def content(self, content: str) -> None:
        changed, self._content = content != self._content, content
        if self.gui_handle is not None and changed:
            self.gui_handle.content = content


class ProgressBar(ViewerElement[float]):
    """A bar that fills, hidden until something is under way."""

    def __init__(self) -> None:
        super().__init__("Progress", visible=False)

    def _create_gui_handle(self, viser_server: ViserServer) -> None:
        self.gui_handle = viser_server.gui.add_progress_bar(0.0, visible=self.visible)

    def install(self, viser_server: ViserServer) -> None:
        """Makes it."""
        self._create_gui_handle(viser_server)

    def show(self, share: Optional[float]) -> None:
        """Fills a share of it, in [0, 1]; None hides it."""
        if self.gui_handle is not None:
            self.gui_handle.visible = share is not None
            self.gui_handle.value = 100.0 * (share or 0.0)


class UploadButton(ViewerElement[bytes]):
    """A button that takes a file from the browser's machine.

    Args:
        name: what it says.
        received: called with the file's name and contents.
    """

    def __init__(self, name: str, received: Callable[[str, bytes], Any]) -> None:
        super().__init__(name)
        self.received = received

    def _create_gui_handle(self, viser_server: ViserServer) -> None:
        self.gui_handle = viser_server.gui.add_upload_button(self.name, mime_type="image/*", visible=self.visible)

    def install(self, viser_server: ViserServer) -> None:
        """Makes it."""
        self._create_gui_handle(viser_server)
        assert self.gui_handle is not None
        self.gui_handle.on_upload(lambda event: self.received(event.target.value.name, event.target.value.content))
