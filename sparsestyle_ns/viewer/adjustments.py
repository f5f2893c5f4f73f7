"""How nerfstudio's own part of the viewer is made to fit a scene of a few photos."""

import math
from typing import Any, Callable, List

from nerfstudio.cameras.cameras import Cameras
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from viser import ClientHandle

from sparsestyle_ns.core.camera_paths import most_central


def begin_at_central_photo(viewer: Viewer, cameras: Cameras) -> None:
    """Has each new browser look at the scene as its most central photo does."""
    centre = most_central(cameras)
    pose = cameras.camera_to_worlds[centre].cpu().double().numpy()
    position = VISER_NERFSTUDIO_SCALE_RATIO * pose[:, 3]

    def welcome(client: ClientHandle) -> None:
        with client.atomic():
            client.camera.position = position
            client.camera.up_direction = pose[:, 1]
            client.camera.look_at = position - VISER_NERFSTUDIO_SCALE_RATIO * pose[:, 2]
            client.camera.fov = 2.0 * math.atan(float(cameras.cy[centre] / cameras.fy[centre]))

    viewer.viser_server.on_client_connect(welcome)


def hide_frustums(viewer: Viewer) -> None:
    """Hides the photos' frustums as soon as they are drawn: one at a camera's place would fill the window."""
    draw = viewer.init_scene

    def draw_and_hide(*arguments: Any, **named: Any) -> None:
        draw(*arguments, **named)
        viewer.set_camera_visibility(False)
        viewer.toggle_cameravis_button()

    viewer.init_scene = draw_and_hide


def keep_outputs(viewer: Viewer, outputs: List[str], choose: Callable[[], None]) -> None:
    """Offers a model's outputs, and has `choose` pick again when nerfstudio offers its own, as for each new browser."""
    control_panel = viewer.control_panel
    fill = control_panel.update_output_options

    def fill_and_choose(options: List[str]) -> None:
        fill(options)
        choose()

    control_panel.update_output_options = fill_and_choose
    fill_and_choose(outputs)
