"""A stylised run as 3D Gaussians, which any viewer of splats shows.

c_f doesn't depend on the direction, so a Gaussian has one colour. They are placed where cameras see something, and then
fitted to exact pictures: of the photos' cameras, and of those that one may fly to (`orbit.py`).
"""

from pathlib import Path
from typing import List, Literal, Optional, Tuple

import torch
from nerfstudio.cameras.cameras import Cameras

from sparsestyle_ns.core.camera_paths import most_central, unseen_places
from sparsestyle_ns.core.spaces import ForwardFacingSpace
from sparsestyle_ns.data.view_selection import evenly_spaced
from sparsestyle_ns.evaluation.held_out import exact_outputs
from sparsestyle_ns.export.export_options import EXAMPLES
from sparsestyle_ns.export.fit_gaussians import fit_gaussians
from sparsestyle_ns.export.gaussians import DRAWINGS, Gaussians, picture_of_gaussians
from sparsestyle_ns.export.gltf import GLTF_SPLAT_BYTES, ColoredMesh, encode_gltf
from sparsestyle_ns.export.orbit import SURVEY_SIDE, make_orbit, pinholes, turned
from sparsestyle_ns.export.place_gaussians import look_at, place_gaussians
from sparsestyle_ns.export.splat_file import FULL_FLOATS, SMALL_FLOATS, encode_splats
from sparsestyle_ns.export.stylised_scene import StylisedScene
from sparsestyle_ns.export.web_page import COMPARED_SIDE, MAX_BYTES, median_depth
from sparsestyle_ns.metrics.image import psnr
from sparsestyle_ns.rendering.render import Background
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_output

STEPS = 200
"""Of the fit; a tenth of a second each on a CPU, at 252 pixels."""
BETWEEN = 6
"""In forward-facing scenes, views on the way from photo to photo that the fit sees, about."""
TOWARDS_EDGE = 0.7
"""Others there are turned by this share of how far one may turn."""
YAWS, PITCHES = 8, 6
"""Views around any other scene that the fit sees, at so many heights."""
SplatForm = Literal["splat", "sh0", "glb", "spz"]
SPLAT_BYTES = {"splat": 4 * FULL_FLOATS, "sh0": 4 * SMALL_FLOATS, "glb": GLTF_SPLAT_BYTES, "spz": 20}
"""What a splat takes in a file, at most."""
LEAST_SPLATS, MOST_SPLATS = 1000, 400_000
MOST_COMPARED = 6
"""Held-out views on which splats are compared, at most."""


def most_splats(asked: Optional[int], splat_bytes: int, taken: int = 0) -> int:
    """How many splats a file may have: as many as are asked for, else at most `MOST_SPLATS` in `MAX_BYTES`.

    `taken` is what the file holds besides.
    """
    if asked is not None:
        return asked
    return max(LEAST_SPLATS, min(MOST_SPLATS, (MAX_BYTES - 2000 - taken) // splat_bytes))


def export_splats(
    scene: StylisedScene, output_path: Path, form: SplatForm, asked: Optional[int], mesh: Optional[ColoredMesh] = None
) -> None:
    """Writes a scene's Gaussians, and prints their number and error; `InputError` if none are seen.

    A file of the form glb may have a mesh besides.
    """
    space, more = scene.model.space, [] if mesh is None else [mesh]
    gaussians = make_splats(scene, most_splats(asked, SPLAT_BYTES[form], sum(each.bytes_in_gltf for each in more)))
    frame = "nerfstudio's coordinates" if form in ("splat", "sh0") else "glTF's coordinates, y up"
    if form == "glb":
        content = encode_gltf([gaussians, *more], space)
    elif form == "spz":  # it rounds: what is compared is what it holds
        from sparsestyle_ns.export.spz_file import decode_spz, encode_spz

        content = encode_spz(gaussians, space)
        gaussians = decode_spz(content, space)
    else:
        content = encode_splats(gaussians, form == "sh0")
    write_output(output_path, content, "The splats", EXAMPLES.get(form, "scene.ply"))
    print(f"{len(gaussians):,} splats, {len(content) / 1e6:.1f} MB, in {frame}")
    print_likeness_of_splats(scene, gaussians)


def make_splats(scene: StylisedScene, most: int) -> Gaussians:
    """At most `most` Gaussians that look as a scene does; `InputError` if its cameras see nothing of it."""
    model, cameras = scene.model, pinholes(scene.cameras, COMPARED_SIDE)
    views = look_at(model, cameras_for_splats(scene, cameras), "Exact renders")
    if not any(len(view.weights) for view in views):
        raise InputError("The views show nothing, so there is nothing to write; train the coarse field longer.")
    return fit_gaussians(place_gaussians(model.space, views, most), views, background_of(scene), STEPS)


def background_of(scene: StylisedScene) -> Background:
    """A scene's background colour, on the CPU."""
    return None if scene.model.background is None else scene.model.background.cpu()


def cameras_for_splats(scene: StylisedScene, cameras: Cameras) -> List[Cameras]:
    """The photos' cameras, and others where one may fly."""
    opening, space = most_central(cameras), scene.model.space
    small = pinholes(cameras[opening : opening + 1], SURVEY_SIDE).to(scene.model.device)
    orbit = make_orbit(space, cameras, opening, median_depth(exact_outputs(scene.model, small)))
    views = one_by_one(cameras)
    if isinstance(space, ForwardFacingSpace):
        if len(cameras) > 1:
            views += one_by_one(pinholes(unseen_places(cameras, BETWEEN)))
        ends = [(-TOWARDS_EDGE * most, 0.0, TOWARDS_EDGE * most) for most in (orbit.yaw[1], orbit.pitch[1])]
        angles = torch.cartesian_prod(*map(torch.tensor, ends)).tolist()
        return views + [turned(orbit, cameras, *each) for each in angles]
    step = 360.0 / YAWS
    low, high = orbit.pitch
    for number in range(PITCHES):  # each height is turned against the one below
        pitch = low + (high - low) * (number + 0.5) / PITCHES
        views += [turned(orbit, cameras, step * (yaw + 0.382 * number), pitch) for yaw in range(YAWS)]
    return views


def one_by_one(cameras: Cameras) -> List[Cameras]:
    """Each of some cameras by itself."""
    return [cameras[index : index + 1] for index in range(len(cameras))]


def compared_views(scene: StylisedScene) -> Tuple[str, List[Cameras], List[str]]:
    """What to compare files on, in words, the cameras, and their photos' names: held-out views where there are any."""
    what, cameras, names = "held-out", scene.held_out, scene.held_out_names
    if len(names) == 0:
        what, cameras, names = "training", scene.cameras, scene.names
    chosen = evenly_spaced(len(names), MOST_COMPARED)
    views = one_by_one(pinholes(cameras, COMPARED_SIDE))
    return what, [views[index] for index in chosen], [names[index] for index in chosen]


def print_likeness_of_splats(scene: StylisedScene, gaussians: Gaussians) -> None:
    """Prints how far splats are from the exact render: by view in the viewer that shows them worst, and on average."""
    what, cameras, names = compared_views(scene)
    views, background = look_at(scene.model, cameras, "Exact renders to compare with"), background_of(scene)
    errors = {
        viewer: [
            psnr(picture_of_gaussians(gaussians, view.camera, background, drawing).clamp(0.0, 1.0), view.picture)
            for view in views
        ]
        for viewer, drawing in DRAWINGS.items()
    }
    means = {viewer: sum(values) / len(values) for viewer, values in errors.items()}
    worst = min(means, key=means.__getitem__)
    for name, error in zip(names, errors[worst], strict=True):
        print(f"PSNR to the exact render, {what} view of {name}: {error:.1f} dB")
    height, width = views[0].picture.shape[:2]
    others = ", ".join(f"as {viewer} does {mean:.1f} dB" for viewer, mean in means.items() if viewer != worst)
    told = f"Mean of the {what} views at {width} × {height}, drawn as {worst} does: {means[worst]:.1f} dB"
    print(f"{told} ({others})")
