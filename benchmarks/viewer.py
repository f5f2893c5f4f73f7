"""Pictures a second in nerfstudio's viewer: its own loop for one browser, without the browser and the way to it.

Baked pictures on new ground and on ground that is filled, the sliders moved, two styles blended, and exact pictures.
"""

import copy
import math
import statistics
import tempfile
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Callable, Dict, List, Optional, Tuple

import torch
import tyro
from nerfstudio.cameras.camera_utils import get_interpolated_poses
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.utils import CameraState
from nerfstudio.viewer.viewer import Viewer
from torch import Tensor

from benchmarks._measure import Report, timed
from benchmarks._scene import find_scene
from benchmarks.render import RenderOptions, stylise
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline
from sparsestyle_ns.utils.errors import exit_on_input_error
from sparsestyle_ns.viewer.panel import NO_BLEND
from sparsestyle_ns.viewer.styles import Style

SIDE = 504
"""Of the pictures; the scene that is looked at is trained at the size of `benchmarks.render`."""
FRAMES = 8


class Screen(RenderStateMachine):
    """What nerfstudio has for each browser, a thread; draws as it is told, and nothing by itself.

    Args:
        pipeline: what to look at.
        folder: for what the viewer writes.
        side: longer side of its pictures, in pixels.
    """

    def __init__(self, pipeline: HierStylePipeline, folder: Path, side: int) -> None:
        cameras = pipeline.datamanager.train_dataset.cameras
        self.aspect = float(cameras.width[0] / cameras.height[0])
        self.angle = 2.0 * math.atan(float(0.5 * cameras.height[0] / cameras.fy[0]))
        config = ViewerConfig(websocket_host="127.0.0.1")
        viewer = Viewer(config, folder / "viewer.txt", folder, pipeline, train_lock=threading.Lock())
        viewer.control_panel._max_res.value = side
        super().__init__(viewer, 10.0, SimpleNamespace(camera=SimpleNamespace(aspect=self.aspect)))
        self.state = "high"
        self._tour: Callable[[], None] = lambda: None
        self._error: Optional[BaseException] = None

    def guide(self, tour: Callable[[], None]) -> None:
        """Does something on the screen's own thread, the only kind that the panel's controls hold for."""
        self._tour = tour
        self.start()
        self.join()
        if self._error is not None:
            raise self._error

    def run(self) -> None:
        """See `guide`."""
        try:
            self._tour()
        except BaseException as error:
            self._error = error

    def draw(self, camera_to_world: Tensor) -> Dict[str, Tensor]:
        """The viewer's picture from a camera."""
        state = CameraState(
            fov=self.angle, aspect=self.aspect, c2w=camera_to_world.double(), camera_type=CameraType.PERSPECTIVE
        )
        return self._render_img(state)


def flight_between(pipeline: HierStylePipeline, frames: int) -> List[Tensor]:
    """Cameras from one photo's to the next one's."""
    poses = pipeline.datamanager.train_dataset.cameras.camera_to_worlds.cpu().numpy()
    return [torch.as_tensor(pose)[:3, :4] for pose in get_interpolated_poses(poses[0], poses[1], frames)]


@exit_on_input_error
def main(options: RenderOptions) -> None:
    """Stylises for a few iterations, opens the viewer, and looks around."""
    report = Report("viewer", options)
    side = SIDE // 8 if options.quick else SIDE
    pipeline, settings = stylise(options, find_scene(options), report.device)
    with tempfile.TemporaryDirectory() as folder:
        screen = Screen(pipeline, Path(folder), side)
        panel = pipeline.panel
        if panel.baker is not None:  # it would fill new ground before it is looked at
            panel.baker.ending.set()
        frames = 2 if options.quick else FRAMES
        flight = flight_between(pipeline, frames + 1)

        def look(part: str, frame_of: Callable[[int], int], control: Any = None) -> None:
            def before(number: int) -> Tuple[Tensor]:
                if control is not None:
                    control.value = number / frames
                return (flight[frame_of(number)],)

            report.measure(part, {part: timed(screen.draw, report.device, before)}, frames, warm_up=False)

        def onward(number: int) -> int:
            return number + 1

        def at_rest(number: int) -> int:
            return 1

        def tour() -> None:
            panel.mode.value = "baked"
            screen.draw(flight[0])
            look("baked, new ground", onward)
            look("baked, known ground", onward)
            look("baked, strength moved", at_rest, panel.strength)
            panel.strength.value = 1.0
            look("baked, geometry moved", at_rest, panel.geometry)
            panel.geometry.value = 1.0
            other = copy.deepcopy(pipeline.model.residual)
            with torch.no_grad():
                other.color_head.weight.neg_()
            panel.styles.append(Style("other", other))
            panel.offer_styles(panel.styles[0].name)
            panel.other.value = "other"
            screen.draw(flight[1])
            look("baked, two styles blended", at_rest, panel.blend)
            panel.other.value, panel.mode.value = NO_BLEND, "exact"
            look("exact", onward)

        screen.guide(tour)
        panel.close()
    rates = {part: 1.0 / statistics.median(found[part]["seconds"]) for part, found in report.repetitions.items()}
    for part, rate in rates.items():
        print(f"  {part}: {rate:.1f} a second")
    report.extra["settings"] = {"longer_side": side, **settings}
    report.extra["pictures_per_second"] = rates
    report.write()


if __name__ == "__main__":
    main(tyro.cli(RenderOptions, description=__doc__))
