"""Long drives: cut into pieces, and refused in one where time and memory would grow with their rows without end."""

from __future__ import annotations

import math

import numpy as np

from steady_ppl.data import Trajectories
from steady_ppl.errors import DataError, require
from steady_ppl.table import from_frame, to_frame

MOST_PIECES = 1_000_000
MOST_ROWS = 20_000
"""Of a trajectory: filters keep the particles of every row, some .17 MB, and `check` simulates it a hundred times."""


def refuse_long(data: Trajectories) -> None:
    """Whatever looks at a drive as a whole does not begin with one that is longer than `MOST_ROWS`.

    Raises:
        DataError: naming the longest.
    """
    longest = int(data.lengths.argmax())
    rows = int(data.lengths[longest])
    if rows > MOST_ROWS:
        raise DataError(
            f"trajectory {data.labels[longest]} has {rows} rows, and at most {MOST_ROWS} are looked at in one piece: "
            "cut it by `steady data cut TABLE --seconds 60 --out PIECES`",
            trajectory=data.labels[longest],
        )


def cut(data: Trajectories, seconds: float) -> Trajectories:
    """The same drives in pieces.

    A drive that is longer becomes `…-1`, `…-2`, … Each piece begins at its first row that has a measurement; pieces of
    one row or without a measurement are left out. Time stays as recorded.

    Args:
        data: drives with labels.
        seconds: of a piece.

    Raises:
        UsageError: no length of time.
        DataError: nothing is left, or two pieces would have one name.

    Example:
        >>> import torch
        >>> from steady_ppl import from_arrays
        >>> time = torch.arange(50) / 10
        >>> cut(from_arrays([{"time": time, "u.push": 0 * time, "y.range": time}]), 2.0).labels
        ('1-1', '1-2', '1-3')
    """
    require(0 < seconds < math.inf, "seconds", seconds, "above 0")
    frame = to_frame(data)
    drives = frame.groupby("trajectory", sort=False)
    since = frame["time"] - drives["time"].transform("first")
    require(float(since.max()) / seconds < MOST_PIECES, "seconds", seconds, f"enough for {MOST_PIECES} pieces")
    piece = np.floor(since / seconds + 1e-6).astype(int)  # a row that rounding puts before its time is in time
    measured = frame.filter(regex=r"^y\.").notna().any(axis=1)
    place = [frame["trajectory"], piece]
    kept = measured.groupby(place).cummax()
    kept &= kept.groupby(place).transform("sum") > 1
    if not kept.any():
        raise DataError(f"no piece of {seconds:g} s has two rows that begin with a measurement: take longer pieces")
    several = piece.groupby(frame["trajectory"]).transform("max") > 0
    called = frame["trajectory"].where(~several, frame["trajectory"].astype(str) + "-" + (piece + 1).astype(str))
    names = called[kept].groupby([series[kept] for series in place], sort=False).first()
    if names.duplicated().any():
        twice = names[names.duplicated()].iloc[0]
        raise DataError(f"two pieces would be called {twice}: give the trajectories other names", trajectory=twice)
    return from_frame(frame.assign(trajectory=called)[kept])
