"""The AlphaTruck's 100 Hz motion capture and commands: read, resampled on a regular grid and differentiated.

Poses are smoothed and differentiated by Savitzky-Golay filters. v, w and yaw_rate are the forward velocity, the
lateral velocity and the turn rate.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.ndimage import grey_opening
from scipy.signal import savgol_filter

Array = np.ndarray

TICK = 0.01  # s, of the motion capture
STEP = 0.1  # s, of the models that learn from bearings
DEGREE = 3  # of the Savitzky-Golay polynomials
WINDOW = 0.25  # s, of the Savitzky-Golay filters
BLOCK = 8.0  # s, resampled as a whole
GAP = 0.1  # s without a pose that end a segment
POSE = ("x", "y", "x", "y", "z", "w")
POSE_COLUMNS = tuple(f"pose.{'position' if i < 2 else 'orientation'}.{axis}" for i, axis in enumerate(POSE))
COMMAND_COLUMNS = ("twist.linear.x", "twist.angular.z")


class LogError(Exception):
    """A log that cannot be analysed."""


@dataclass
class Segment:
    """Motion without a gap on a regular grid, `(N,)` each, and the commands.

    time s; x, y m; heading rad; v, w m/s; yaw_rate rad/s; yaw_acceleration rad/s²; block: number of the block that a
    sample belongs to. `stamps` s, `(M,)`, and `commands` m/s and rad/s, `(M, 2)`, each held until the next one.
    """

    time: Array
    x: Array
    y: Array
    heading: Array
    v: Array
    w: Array
    yaw_rate: Array
    yaw_acceleration: Array
    block: Array
    stamps: Array
    commands: Array
    length: int  # of the Savitzky-Golay filter, ticks
    restart: int = 0  # ticks after which simulations start again from what was measured; 0: never

    def commanded(self, delay: float) -> tuple[Array, Array]:
        """Return the speed (m/s) and the turn rate (rad/s) commanded `delay` s before, averaged over each tick."""
        tick = self.time[1] - self.time[0]
        sums = np.concatenate([np.zeros((1, 2)), np.cumsum(self.commands[:-1] * np.diff(self.stamps)[:, None], 0)])
        edges = np.append(self.time, self.time[-1] + tick) - delay
        speed, turn = (np.diff(np.interp(edges, self.stamps, column)) / tick for column in sums.T)
        return speed, turn


def read(path: Path, columns: Sequence[str]) -> tuple[Array, Array]:
    """Return the header stamps (ns, increasing, none twice) and the named columns of a log.

    Raises:
        LogError: for a file that cannot be read, a missing column or a cell that is not a finite number.
    """
    stamp = ["header.stamp.secs", "header.stamp.nsecs"]
    where = f"{path.parent.name}/{path.name}"
    try:
        log = pd.read_csv(path, usecols=[*stamp, *columns], low_memory=False)
        values = log[list(columns)].to_numpy(np.float64)
        seconds, nanoseconds = (log[name].to_numpy(np.float64) for name in stamp)
    except (OSError, ValueError) as error:
        raise LogError(f"{where}: {str(error).partition(chr(10))[0]}") from error
    if len(values) < 100 or not (np.isfinite(values).all() and np.isfinite(seconds + nanoseconds).all()):
        raise LogError(f"{where}: expected 100 rows or more of finite numbers")
    times = seconds.astype(np.int64) * 10**9 + nanoseconds.astype(np.int64)
    times, first = np.unique(times, return_index=True)
    return times, values[first]


def on_time(stamps: Array, tick: float = TICK) -> Array:
    """Return the stamps (s) of frames without the delays of late messages.

    Frames are taken every `tick` s. A message that is later than its neighbours on both sides was delivered late;
    a lasting change (lost frames, a clock that drifts) is kept.
    """
    regular = tick * np.arange(len(stamps))
    return regular + grey_opening(stamps - regular, 25)


def yaw(quaternion: Array) -> Array:
    """Return the heading (rad, unwrapped) of quaternions `(N, 4)` in the order x, y, z, w."""
    qx, qy, qz, qw = quaternion.T
    return np.unwrap(np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy**2 + qz**2)))


def read_split(
    folder: Path, *, window: float = WINDOW, block: float = BLOCK, late: bool = False, frames: slice = slice(None)
) -> list[Segment]:
    """Read a split and differentiate its poses.

    Args:
        folder: holds vrpn-pose.csv and vesc_drive.csv.
        window: of the Savitzky-Golay filters, s.
        block: length of the blocks that are resampled, s.
        late: keep the stamps of messages that were delivered late.
        frames: of the motion capture, the ones to use.
    """
    pose_stamps, pose = read(folder / "vrpn-pose.csv", POSE_COLUMNS)
    stamps, commands = read(folder / "vesc_drive.csv", COMMAND_COLUMNS)
    begin = min(pose_stamps[0], stamps[0])
    times, stamps = (pose_stamps - begin) * 1e-9, (stamps - begin) * 1e-9
    ends = np.flatnonzero(np.diff(times) > GAP) + 1
    segments = []
    for part in np.split(np.arange(len(times)), ends):
        clean = times[part] if late else on_time(times[part])
        clean = np.maximum.accumulate(clean) + 1e-9 * np.arange(len(part))
        pieces = (clean[frames], np.column_stack([pose[part, :2], yaw(pose[part, 2:])])[frames])
        segment = differentiate(*pieces, stamps, commands, window=window, block=block)
        segments += [] if segment is None else [segment]
    if not segments:
        raise LogError(f"{folder.name}: there is no second of poses without a gap")
    return segments


def differentiate(
    times: Array, pose: Array, stamps: Array, commands: Array, *, window: float, block: float
) -> Segment | None:
    """Resample poses `(N, 3)` (m, m, rad) at 100 Hz and differentiate them; None for less than a second."""
    begin, end = max(times[0], stamps[0] + 0.5), min(times[-1], stamps[-1])
    if end - begin < 1 + 2 * window:
        return None
    grid = np.arange(begin, end, TICK)
    x, y, heading = (np.interp(grid, times, column) for column in pose.T)
    length = 2 * round(window / TICK / 2) + 1

    def smooth(values: Array, order: int = 0) -> Array:
        return savgol_filter(values, length, DEGREE, deriv=order, delta=TICK)[length // 2 : -(length // 2)]

    angle, east, north = smooth(heading), smooth(x, 1), smooth(y, 1)
    inside = slice(length // 2, -(length // 2))
    time = grid[inside]
    count = max(1, round((time[-1] - time[0]) / block))
    return Segment(
        time=time,
        x=x[inside],
        y=y[inside],
        heading=angle,
        v=np.cos(angle) * east + np.sin(angle) * north,
        w=-np.sin(angle) * east + np.cos(angle) * north,
        yaw_rate=smooth(heading, 1),
        yaw_acceleration=smooth(heading, 2),
        block=np.minimum(np.arange(len(time)) * count // len(time), count - 1),
        stamps=stamps,
        commands=commands,
        length=length,
    )


def as_rows(segments: Sequence[Segment], *, held: bool = False, step: float = STEP) -> list[Segment]:
    """Return segments whose simulations start again from what was measured every `step` s.

    held: commands are those of a table with a row every `step` s, interpolated and held for a row.
    """
    rows = [dataclasses.replace(s, restart=round(step / TICK)) for s in segments]
    if not held:
        return rows
    result = []
    for s in rows:
        stamps = np.arange(s.time[0] - 4 * step, s.time[-1] + step, step)
        columns = np.column_stack([np.interp(stamps, s.stamps, column) for column in s.commands.T])
        result.append(dataclasses.replace(s, stamps=stamps, commands=columns))
    return result


def numbered(segments: Sequence[Segment]) -> list[Segment]:
    """Return the segments with blocks numbered through all of them."""
    before, result = 0, []
    for segment in segments:
        result.append(dataclasses.replace(segment, block=segment.block - segment.block.min() + before))
        before = int(result[-1].block.max()) + 1
    return result


def gather(segments: Sequence[Segment], *names: str) -> list[Array]:
    """Join the named columns of all segments."""
    return [np.concatenate([getattr(segment, name) for segment in segments]) for name in names]


def moving(v: Array, w: Array, yaw_rate: Array, fastest: float = math.inf) -> Array:
    """Say where the truck moves (more than .2 m/s) and does not tumble (under 2 m/s sideways and 4 rad/s)."""
    return (np.abs(v) > 0.2) & (np.abs(v) < fastest) & (np.abs(w) < 2) & (np.abs(yaw_rate) < 4)
