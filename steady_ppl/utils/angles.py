"""Angles wrapped to one turn, and paths and draws brought to the same turn."""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

TURN = 2 * np.pi  # rad


def paths_on_one_turn(paths: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Draws of an angle over time, `(M, B, rows)`, each moved as a whole by the turns that part it from the first draw,
    and that to where it begins between −π and π; `inside`, `(B, rows)`, says which rows count, the first always."""
    first = paths[:1]
    apart = np.nanmedian(np.where(inside, paths - first, np.nan), -1, keepdims=True)
    return paths - TURN * (np.round(apart / TURN) + np.round(first[..., :1] / TURN)).astype(paths.dtype)


def draws_on_one_turn(draws: np.ndarray) -> np.ndarray:
    """Draws of an angle, `(M, ...)`, each by itself moved to within half a turn of their circular mean, which is
    between −π and π; some may then lie beyond these."""
    middle = np.arctan2(np.sin(draws).mean(0), np.cos(draws).mean(0))
    return nearest_turn(draws, middle)


def nearest_turn(angles: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Angles moved by whole turns to within half a turn of `middle`."""
    return angles - TURN * np.round((angles - middle) / TURN)


def wrap(angle: Tensor) -> Tensor:
    """The same angle in [−π, π]."""
    return angle - TURN * (angle / TURN).round()


def wrap_angles(difference: Tensor, angles: Sequence[int]) -> Tensor:
    """A difference of states `(..., D)`, its angles, named by their index, in [−π, π]."""
    difference = difference.clone()
    for angle in angles:
        difference[..., angle] = wrap(difference[..., angle])
    return difference
