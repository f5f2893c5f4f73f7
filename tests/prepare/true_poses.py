"""How far found cameras are from known ones, where neither the world's axes nor its unit are shared."""

from itertools import combinations
from typing import Dict, Sequence, Tuple

import numpy as np


def _between(poses: Sequence[np.ndarray], pair: Tuple[int, int]) -> Tuple[np.ndarray, np.ndarray]:
    """The second camera's rotation and position, as the first one has them."""
    first, second = (poses[index] for index in pair)
    return second[:3, :3].T @ first[:3, :3], first[:3, :3].T @ (second[:3, 3] - first[:3, 3])


def degrees_off(found: Sequence[np.ndarray], known: Sequence[np.ndarray]) -> Dict[str, float]:
    """The largest errors of any two cameras' relative rotation and direction of translation."""
    rotations, directions = [], []
    for pair in combinations(range(len(found)), 2):
        (turn, move), (true_turn, true_move) = _between(found, pair), _between(known, pair)
        rotations.append((np.trace(turn.T @ true_turn) - 1.0) / 2.0)
        directions.append(move @ true_move / np.linalg.norm(move) / np.linalg.norm(true_move))
    return {
        "rotation": float(np.degrees(np.arccos(np.clip(min(rotations), -1.0, 1.0)))),
        "translation": float(np.degrees(np.arccos(np.clip(min(directions), -1.0, 1.0)))),
    }
