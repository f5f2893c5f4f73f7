"""How nerfstudio's own part of the viewer is made to fit a scene of a few photos."""

import math
from threading import Thread
from typing import Any, Callable, List

from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.viewer import render_state_machine
from nerfstudio.viewer.utils import get_camera
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from viser import ClientHandle

from sparsestyle_ns.core.camera_paths import most_central
from sparsestyle_ns.core.pinhole import pinhole_rays


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


class ViewerCamera(Cameras):
    """The camera of a picture in the viewer; its rays are quick to make, and kept: its depth map needs them too."""

    def generate_rays(self, camera_indices: Any, **settings: Any) -> RayBundle:
        """The rays of all its pixels; nerfstudio's own where there is a crop or the camera is no pinhole."""
        if settings.get("obb_box") is not None:
            return super().generate_rays(camera_indices, **settings)
        if "rays" not in self.__dict__:
            self.__dict__["rays"] = pinhole_rays(self) or super().generate_rays(camera_indices, **settings)
        return self.__dict__["rays"]


def make_rays_once() -> None:
    """Has nerfstudio's viewer take its pictures with a `ViewerCamera`."""

    def viewer_camera(*arguments: Any, **named: Any) -> ViewerCamera:
        camera = get_camera(*arguments, **named)
        camera.__class__ = ViewerCamera
        return camera

    render_state_machine.get_camera = viewer_camera


def end_drawing(viewer: Viewer) -> List[Thread]:
    """Ends the threads that draw pictures, those that are being drawn too; returns them, which may take a while."""
    threads = list(viewer.render_statemachines.values())
    for thread in threads:
        thread.running, thread.interrupt_render_flag = False, True
    return threads
