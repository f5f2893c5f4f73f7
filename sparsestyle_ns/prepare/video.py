"""Which frames of a video a scene is made of: sharp ones, with equal moves of the camera between them."""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import List, Optional

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from sparsestyle_ns.data.features import Features, find_features, mutual_matches
from sparsestyle_ns.prepare.diagnosis import BLURRED, sharpness
from sparsestyle_ns.prepare.framing import MIN_PHOTOS, Photo
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.progress import bar, track

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
WINDOWS, LOOKED_AT = 32, 4
"""Stretches of the video, of each of which the sharpest frame counts, and frames that are looked at in each."""
COMPARED_WIDTH = 480
"""Pixels across at which frames are compared."""
MOST_FRAMES = 8
SMALLEST_MOVE, USUAL_MOVE, LARGEST_MOVE = 0.02, 0.08, 0.2
"""How far what is seen moves between two frames, in widths of the picture: less is no other place; as it should be;
more overlaps too little."""
MIN_MATCHES = 20


@dataclass
class _Frame:
    number: int
    seconds: float
    sharpness: float
    pixels: UInt8[np.ndarray, "H W 3"]


def choose_frames(video: Path) -> List[Photo]:
    """At most eight frames of a video, as photos.

    Raises:
        InputError: it can't be read, or its camera hardly moves.
    """
    frames = _sharpest_frames(video)
    moves = _moves(frames)
    path = np.concatenate([[0.0], np.cumsum(moves)])
    if path[-1] < SMALLEST_MOVE * (MIN_PHOTOS - 1):
        raise InputError(f"The camera hardly moves in {video}: film a slow walk to the side, of two or three steps.")
    count = int(np.clip(np.ceil(path[-1] / USUAL_MOVE) + 1, MIN_PHOTOS, MOST_FRAMES))
    covered = min(path[-1], LARGEST_MOVE * (count - 1))
    start = 0.5 * (path[-1] - covered)
    wanted = start + covered * np.linspace(0.0, 1.0, count)
    chosen = sorted({int(np.abs(path - place).argmin()) for place in wanted})
    if len(chosen) < MIN_PHOTOS:
        raise InputError(
            f"The camera moves too fast in {video}: only {len(chosen)} frames of it show enough of the same things; "
            "film a slow walk to the side."
        )
    if covered < path[-1]:
        first, last = (frames[chosen[end]].seconds for end in (0, -1))
        print(
            f"The camera goes farther in {video.name} than {MOST_FRAMES} photos can follow; those from {first:.1f} to "
            f"{last:.1f} seconds are taken"
        )
    print(
        f"{len(chosen)} frames of {video.name} are taken, at {', '.join(f'{frames[i].seconds:.1f}' for i in chosen)} s"
    )
    return [
        Photo(video.with_name(f"{video.stem}_{frames[i].seconds:06.2f}s.png"), Image.fromarray(frames[i].pixels))
        for i in chosen
    ]


def _sharpest_frames(video: Path) -> List[_Frame]:
    reader = cv2.VideoCapture(str(video))
    try:
        total = int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
        rate = reader.get(cv2.CAP_PROP_FPS) or 30.0
        windows = max(1, min(WINDOWS, total // LOOKED_AT))
        best: List[Optional[_Frame]] = [None] * windows
        step = max(1, total // (windows * LOOKED_AT))
        with bar("Reading the video", max(total, 2)) as progress:
            for number in range(total):
                if not reader.grab():
                    break
                progress.advance()
                if number % step:
                    continue
                window = min(windows - 1, number * windows // total)
                frame = _read_frame(reader, number, rate)
                if frame is not None and (best[window] is None or frame.sharpness > best[window].sharpness):
                    best[window] = frame
    finally:
        reader.release()
    found = [frame for frame in best if frame is not None]
    usual = float(np.median([frame.sharpness for frame in found])) if found else 0.0
    frames = [frame for frame in found if frame.sharpness >= BLURRED * usual]
    if len(frames) < MIN_PHOTOS:
        raise InputError(f"{video} can't be read as a video of at least {MIN_PHOTOS} frames; save it as MP4 (H.264).")
    return frames


def _read_frame(reader: cv2.VideoCapture, number: int, rate: float) -> Optional[_Frame]:
    good, pixels = reader.retrieve()
    if not good:
        return None
    return _Frame(number, number / rate, sharpness(_small(pixels)), np.ascontiguousarray(pixels[..., ::-1]))


def _small(pixels: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w"]:
    grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    scale = COMPARED_WIDTH / max(grey.shape)
    return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1.0 else grey


def _moves(frames: List[_Frame]) -> Float[np.ndarray, "gaps"]:
    """How far what is seen moves from each frame to the next, in widths."""
    features = [find_features(_small(frame.pixels[..., ::-1])) for frame in track(frames, "Looking at frames")]
    return np.array([_move(first, second) for first, second in pairwise(features)])


def _move(first: Features, second: Features) -> float:
    here, there = mutual_matches(first.descriptors, second.descriptors)
    if len(here) < MIN_MATCHES:
        return LARGEST_MOVE
    return float(np.median(np.linalg.norm(first.points[here] - second.points[there], axis=-1))) / COMPARED_WIDTH
