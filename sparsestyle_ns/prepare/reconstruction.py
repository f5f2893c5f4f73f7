"""Where photos were taken and with which focal length, from their matches alone: COLMAP's incremental mapping.

Three photos say little about the focal length, so mapping starts from several and the result that explains most is
kept; then the focal length is the most probable one, by the photos and by what lenses usually have.
"""

import copy
import signal
import tempfile
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Callable, Dict, List, Optional, Sequence, Tuple

import numpy as np
import pycolmap
from jaxtyping import Float, Int

from sparsestyle_ns.data.features import Pair, PhotoMatches
from sparsestyle_ns.prepare.framing import MIN_PHOTOS, Size
from sparsestyle_ns.prepare.lenses import USUAL_FOCAL, Lens

FOCALS = (0.75, 1.0, 1.4, 2.0)
"""Focal lengths, in longer sides, that mapping starts from where EXIF gives none."""
MATCH_ERROR = 2.0
"""Pixels that a match may be off the geometry of two photos, of the reduced size that is matched."""
MIN_PAIR_MATCHES, MIN_PHOTO_MATCHES, MIN_FIRST_MATCHES = 15, 15, 50
"""Matches between two photos that count at all; by which a photo joins the others; and of the two that come first."""
MIN_FIRST_ANGLE = 4.0
"""Degrees between rays to points of those two."""
MAX_ERROR = 2.0
"""Pixels that a point may be off a photo's feature to count as seen there."""
MIN_ANGLE = 1.0
"""Degrees between the outermost rays to a point, in the median, below which the camera hardly moved."""
MIN_ZOOM, MIN_ZOOM_GAIN = 1.2, 0.25
"""Factor between focal lengths of photos from which on they may be zoomed; and the share by which focal lengths of
their own must lower the error, for that to be believed. Zoomed photos lowered it by more than half."""
MIN_GAIN = 0.05
"""Share by which a lens's distortion must lower the squared error to be believed."""
CORRELATED = 8.0
"""Observations whose errors count as one, since features near each other share theirs. In 34 sets of three to eight
photos the variance of focal lengths was 3 times what independent errors explain, in those of fern 5 times."""
STEP, STEPS = 0.1, 6
"""Factors by which focal lengths are tried about those that fit best: the step of their logarithms, and steps to either
side."""

# What it logs, and the trace that it prints when it is asked to end, are for its developers.
pycolmap.logging.minloglevel, pycolmap.logging.alsologtostderr = pycolmap.logging.FATAL, False
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)


@dataclass
class Reconstruction:
    """What was found.

    Attributes:
        photos: numbers of the photos that have a pose.
        poses: of these, camera to world, with columns right, up, back, position, in no known unit.
        focals: of these, in pixels of the matched size.
        distortion: of these, k1 of the radial polynomial, in focal lengths.
        points: in the world.
        seen: photo (a number), point and feature of each observation.
        error: mean distance of points from features, in pixels of the matched size.
    """

    photos: List[int]
    poses: Float[np.ndarray, "photos 3 4"]
    focals: Float[np.ndarray, "photos"]
    distortion: Float[np.ndarray, "photos"]
    points: Float[np.ndarray, "points 3"]
    seen: Int[np.ndarray, "observations 3"]
    error: float

    def depths(self, photo: int) -> Float[np.ndarray, "points"]:
        """Depths of the points that a photo sees."""
        pose = self.poses[self.photos.index(photo)]
        points = self.points[self.seen[self.seen[:, 0] == photo, 1]]
        return -(points - pose[:, 3]) @ pose[:, 2]

    def angle(self) -> float:
        """The largest angle between rays to a point, in degrees, in the median of the points."""
        places = {photo: pose[:, 3] for photo, pose in zip(self.photos, self.poses, strict=True)}
        rays = self.points[self.seen[:, 1]] - np.stack([places[photo] for photo in self.seen[:, 0]])
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        by_point = np.split(rays[np.argsort(self.seen[:, 1], kind="stable")], _starts(self.seen[:, 1]))
        widest = [float((rays @ rays.T).min()) for rays in by_point]
        return float(np.degrees(np.arccos(np.clip(np.median(widest), -1.0, 1.0))))


def _starts(points: Int[np.ndarray, "observations"]) -> Int[np.ndarray, "others"]:
    """Where each point but the first begins in the sorted observations."""
    return np.flatnonzero(np.diff(np.sort(points))) + 1


def reconstruct(
    matches: PhotoMatches,
    size: Size,
    longer: float,
    lenses: Sequence[Lens],
    lens_of: Sequence[int],
    step: Callable[[], None] = lambda: None,
) -> Optional[Reconstruction]:
    """Finds poses, focal lengths and points; None where fewer than three photos have a pose.

    Args:
        matches: of photos of one size.
        size: their width and height.
        longer: the longer side, in their pixels, that whole photos have, of which these may be cut.
        lenses, lens_of: with which lenses photos may have been taken, and each photo's one.
        step: called after each of `num_steps` pieces of work.
    """
    best = _best_of_starts(matches, size, longer, lenses, lens_of, step)
    split = _split_by_zoom(best, matches, size, lenses, lens_of)
    step()
    if split is not None:
        other = _best_of_starts(matches, size, longer, *split, lambda: None)
        if other is not None and _is_better(other, best):
            best, (lenses, lens_of) = other, split
    if best is None:
        return None
    best = _distorted_where_it_matters(best)
    step()
    settled = _settle_focals(best, longer, lenses)
    step()
    return None if settled is None else _checked(_read(settled))


def _checked(found: Reconstruction) -> Optional[Reconstruction]:
    """What was found, if each photo sees enough points, from places that are far enough apart."""
    counts = np.bincount(found.seen[:, 0], minlength=max(found.photos) + 1)[found.photos]
    good = np.isfinite(found.poses).all() and np.isfinite(found.focals).all() and counts.min() >= MIN_PHOTO_MATCHES
    return found if good and found.angle() >= MIN_ANGLE else None


def _best_of_starts(
    matches: PhotoMatches,
    size: Size,
    longer: float,
    lenses: Sequence[Lens],
    lens_of: Sequence[int],
    step: Callable[[], None],
) -> Optional[pycolmap.Reconstruction]:
    """Of what mapping finds from several focal lengths, that which explains most; None for fewer than three photos."""
    attempts, pairs = [], _pair_geometries(matches, size, longer, lenses, lens_of)
    for focal in starting_focals(lenses):
        attempts.append(_map(matches, pairs, _cameras(size, longer, lenses, focal), lens_of))
        step()
    found = [model for model in attempts if model is not None and model.num_reg_images() >= MIN_PHOTOS]
    return max(found, key=lambda model: (model.num_reg_images(), model.compute_num_observations()), default=None)


def _is_better(split: pycolmap.Reconstruction, shared: Optional[pycolmap.Reconstruction]) -> bool:
    """Whether zoomed photos explain much that one lens for all doesn't."""
    if shared is None or split.num_reg_images() != shared.num_reg_images():
        return shared is None or split.num_reg_images() > shared.num_reg_images()
    errors = (model.compute_mean_reprojection_error() for model in (split, shared))
    return next(errors) < (1.0 - MIN_ZOOM_GAIN) * next(errors)


def _split_by_zoom(
    best: Optional[pycolmap.Reconstruction],
    matches: PhotoMatches,
    size: Size,
    lenses: Sequence[Lens],
    lens_of: Sequence[int],
) -> Optional[Tuple[List[Lens], List[int]]]:
    """Lenses of which photos that seem to be zoomed have their own; None where none does, or EXIF knows the lenses."""
    if any(lens.known for lens in lenses):
        return None
    count, longer = len(lens_of), float(max(size))
    start = USUAL_FOCAL if best is None else float(np.median([one.params[0] for one in best.cameras.values()])) / longer
    each = [Lens() for _ in range(count)]
    pairs = _pair_geometries(matches, size, longer, each, range(count))
    own = _map(matches, pairs, _cameras(size, longer, each, start), range(count))
    if own is None or own.num_reg_images() < MIN_PHOTOS:
        return None
    posed = (image for image in own.images.values() if image.has_pose)
    focals = {image.image_id - 1: own.cameras[image.camera_id].params[0] for image in posed}
    usual = float(np.median(list(focals.values())))
    zoomed = [photo for photo, focal in sorted(focals.items()) if abs(np.log(focal / usual)) > np.log(MIN_ZOOM)]
    if not zoomed:
        return None
    which = [len(lenses) + zoomed.index(photo) if photo in zoomed else lens_of[photo] for photo in range(count)]
    return [*lenses, *(Lens() for _ in zoomed)], which


def starting_focals(lenses: Sequence[Lens]) -> Sequence[float]:
    """Focal lengths that mapping starts from, in longer sides; one where EXIF knows all lenses."""
    return FOCALS if any(not lens.known for lens in lenses) else FOCALS[:1]


def num_steps(lenses: Sequence[Lens]) -> int:
    """How often `reconstruct` calls its `step`."""
    return len(starting_focals(lenses)) + 3


def _cameras(size: Size, longer: float, lenses: Sequence[Lens], focal: float) -> List[pycolmap.Camera]:
    """A camera for each lens, numbered from 1; `focal` is that of lenses that EXIF doesn't know, in longer sides."""
    cameras, middle = [], [0.5 * side for side in size]
    for number, lens in enumerate(lenses, start=1):
        camera = pycolmap.Camera(
            model="SIMPLE_PINHOLE",
            width=size[0],
            height=size[1],
            params=[longer * (lens.focals[0] if lens.known else focal), *middle],
            has_prior_focal_length=lens.known,
        )
        camera.camera_id = number
        cameras.append(camera)
    return cameras


def _pair_geometries(
    matches: PhotoMatches, size: Size, longer: float, lenses: Sequence[Lens], lens_of: Sequence[int]
) -> Dict[Pair, pycolmap.TwoViewGeometry]:
    options = pycolmap.TwoViewGeometryOptions(min_num_inliers=MIN_PAIR_MATCHES, detect_watermark=False)
    options.ransac.max_error, options.ransac.random_seed = MATCH_ERROR, 0
    cameras, found = _cameras(size, longer, lenses, USUAL_FOCAL), {}
    for pair, rows in matches.pairs.items():
        if rows.shape[1] >= MIN_PAIR_MATCHES:
            first, second = ((cameras[lens_of[index]], _corner_based(matches.points[index])) for index in pair)
            seen = np.ascontiguousarray(rows.T, dtype=np.uint32)
            found[pair] = pycolmap.estimate_two_view_geometry(*first, *second, seen, options)
    return found


def _corner_based(points: Float[np.ndarray, "features 2"]) -> Float[np.ndarray, "features 2"]:
    """As COLMAP has them: the centre of the first pixel is at (0.5, 0.5)."""
    return np.ascontiguousarray(points + 0.5)


def _map(
    matches: PhotoMatches,
    pairs: Dict[Pair, pycolmap.TwoViewGeometry],
    cameras: Sequence[pycolmap.Camera],
    lens_of: Sequence[int],
) -> Optional[pycolmap.Reconstruction]:
    """COLMAP's incremental mapping; it counts cameras and images from 1."""
    pycolmap.set_random_seed(0)
    with tempfile.TemporaryDirectory(prefix="sparsestyle-") as name:
        path, folder = Path(name) / "matches.db", Path(name)
        with pycolmap.Database.open(path) as database:
            for camera in cameras:
                database.write_camera(camera, True)
                rig = pycolmap.Rig(rig_id=camera.camera_id)
                rig.add_ref_sensor(camera.sensor_id)
                database.write_rig(rig, True)
            for number, (points, lens) in enumerate(zip(matches.points, lens_of, strict=True), start=1):
                image = pycolmap.Image(name=str(number), camera_id=lens + 1, image_id=number)
                database.write_image(image, True)
                frame = pycolmap.Frame(frame_id=number, rig_id=lens + 1)
                frame.add_data_id(image.data_id)
                database.write_frame(frame, True)
                database.write_keypoints(number, _corner_based(points).astype(np.float32))
            for (first, second), geometry in pairs.items():
                database.write_two_view_geometry(first + 1, second + 1, geometry)
        found = pycolmap.incremental_mapping(path, folder, folder, _mapping_options())
    return max(found.values(), key=lambda model: model.num_reg_images()) if found else None


def _mapping_options() -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(
        multiple_models=False, min_model_size=2, extract_colors=False, num_threads=1, random_seed=0
    )
    mapper, triangulation = options.mapper, options.triangulation
    mapper.init_min_num_inliers, mapper.abs_pose_min_num_inliers = MIN_FIRST_MATCHES, MIN_PHOTO_MATCHES
    mapper.init_min_tri_angle = MIN_FIRST_ANGLE
    mapper.abs_pose_refine_focal_length = False  # a photo alone says less of it than all together
    mapper.random_seed, mapper.num_threads, triangulation.random_seed = 0, 1, 0
    triangulation.ignore_two_view_tracks = False
    return options


def _adjust(model: pycolmap.Reconstruction, focals: bool, distortion: bool = False) -> float:
    """Bundle adjustment that outliers hardly move; returns half the sum of its robust squared errors, in pixels²."""
    options = pycolmap.BundleAdjustmentOptions(
        print_summary=False, refine_focal_length=focals, refine_extra_params=distortion
    )
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.num_threads = 1
    images = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        images.add_image(image)
    images.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_ceres_bundle_adjuster(options, images, model).solve()
    return 0.5 * float(np.log1p(_errors(model) ** 2).sum())


def _errors(model: pycolmap.Reconstruction) -> Float[np.ndarray, "observations"]:
    """Distances of points from where photos show them, in pixels; infinite where they are behind the camera."""
    errors = []
    for point in model.points3D.values():
        for element in point.track.elements:
            image = model.images[element.image_id]
            at = image.project_point(point.xyz)
            errors.append(np.inf if at is None else np.linalg.norm(at - image.points2D[element.point2D_idx].xy))
    return np.array(errors)


def _distorted_where_it_matters(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The model adjusted anew, with a lens's distortion if that explains clearly more."""
    bent = copy.deepcopy(model)
    for camera in bent.cameras.values():
        focal, *middle = camera.params
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
        camera.params = [focal, *middle, 0.0]
    straight_cost = _adjust(model, focals=True)
    bent_cost = _adjust(bent, focals=True, distortion=True)
    return bent if bent_cost < (1.0 - MIN_GAIN) * straight_cost else model


def _settle_focals(
    model: pycolmap.Reconstruction, longer: float, lenses: Sequence[Lens]
) -> Optional[pycolmap.Reconstruction]:
    """The model with the most probable focal lengths, by the photos and by what lenses usually have; None for no sense.

    Where the photos say little, as of small moves, the latter weighs more.
    """
    used = {image.camera_id for image in model.images.values() if image.has_pose}
    focals = {lens: model.cameras[lens].params[0] / longer for lens in used}
    variance = max(float(np.mean(np.minimum(_errors(model), MAX_ERROR) ** 2)) / 2.0, 1e-6)

    def of_photos(step: int) -> float:
        return _adjust(_with_focals(model, STEP * step), focals=False, distortion=True) / (variance * CORRELATED)

    def of_lenses(shift: float) -> float:
        return sum(lenses[lens - 1].improbability(focal * np.exp(shift)) for lens, focal in focals.items())

    fits = {step: of_photos(step) for step in (-1, 0, 1)}
    if not np.isfinite(list(fits.values())).all() or not np.isfinite(list(focals.values())).all():
        return None
    while (lowest := min(fits, key=lambda step: fits[step] + of_lenses(STEP * step))) in (min(fits), max(fits)):
        if abs(lowest) == STEPS:
            break
        beyond = lowest + (1 if lowest > 0 else -1)
        fits[beyond] = of_photos(beyond)
    middle = min(max(lowest, min(fits) + 1), max(fits) - 1)
    parabola = np.polyfit([-STEP, 0.0, STEP], [fits[middle + side] for side in (-1, 0, 1)], 2)
    around = np.linspace(-STEP, STEP, 201)
    values = [np.polyval(parabola, shift) + of_lenses(STEP * middle + shift) for shift in around]
    settled = _with_focals(model, STEP * middle + float(around[int(np.argmin(values))]))
    _adjust(settled, focals=False, distortion=True)
    return settled


def _with_focals(model: pycolmap.Reconstruction, shift: float) -> pycolmap.Reconstruction:
    """A copy whose focal lengths are exp(shift) times as long."""
    other = copy.deepcopy(model)
    for camera in other.cameras.values():
        focal, *rest = camera.params
        camera.params = [focal * np.exp(shift), *rest]
    return other


def _read(model: pycolmap.Reconstruction) -> Reconstruction:
    """What COLMAP found, with its observations that fit."""
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.image_id)
    cameras = [model.cameras[image.camera_id] for image in images]
    numbers = {point: index for index, point in enumerate(model.points3D)}
    elements = [
        (each.image_id - 1, numbers[key], each.point2D_idx)
        for key, point in model.points3D.items()
        for each in point.track.elements
    ]
    errors = _errors(model)
    good = errors < MAX_ERROR
    return Reconstruction(
        photos=[image.image_id - 1 for image in images],
        poses=np.stack([_pose(image) for image in images]),
        focals=np.array([camera.params[0] for camera in cameras]),
        distortion=np.array([camera.params[3] if len(camera.params) > 3 else 0.0 for camera in cameras]),
        points=np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3),
        seen=np.array(elements, dtype=int).reshape(-1, 3)[good],
        error=float(errors[good].mean()) if good.any() else np.inf,
    )


def _pose(image: pycolmap.Image) -> Float[np.ndarray, "3 4"]:
    """Camera to world, from COLMAP's world to camera with axes right, down, ahead."""
    matrix = image.cam_from_world().matrix()
    turned = matrix[:, :3].T
    return np.concatenate([turned * [1.0, -1.0, -1.0], -turned @ matrix[:, 3:]], axis=1)
