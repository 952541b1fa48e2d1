"""Say what the AlphaTruck does in continuous time, from its 100 Hz motion capture.

    python benchmarks/truck_motion_capture.py --data FOLDER --json FILE --markdown FILE

FOLDER holds train/, valid/ and test/ with the authors' logs. No code of steady-ppl is used: the numbers are a
reference for what is found from bearings alone. Poses are smoothed and differentiated by Savitzky-Golay filters.
Linear laws are fitted by least squares, responses by simulating them on the 100 Hz grid. Intervals come from
resampling blocks of time. v, w and yaw_rate are the forward velocity, the lateral velocity and the turn rate.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.ndimage import grey_opening
from scipy.optimize import least_squares
from scipy.signal import savgol_filter
from scipy.stats import t as student

Array = np.ndarray
Numbers = Mapping[str, float]

TICK = 0.01  # s, of the motion capture
STEP = 0.1  # s, of the models that learn from bearings
DEGREE = 3  # of the Savitzky-Golay polynomials
WINDOW = 0.25  # s, of the Savitzky-Golay filters
OTHER_WINDOWS = (0.15, 0.41)  # s
BLOCK = 8.0  # s, resampled as a whole
GAP = 0.1  # s without a pose that end a segment
UNDETERMINED = (1e-9, 10.0)  # sd of the bootstrap outside of which there is no interval
SPLITS = ("train", "valid", "test")
TOGETHER = "together"
POSE = ("x", "y", "x", "y", "z", "w")
POSE_COLUMNS = tuple(f"pose.{'position' if i < 2 else 'orientation'}.{axis}" for i, axis in enumerate(POSE))
COMMAND_COLUMNS = ("twist.linear.x", "twist.angular.z")

UNITS = {
    "lever": "m",
    "slip": "s",
    "crab": "rad",
    "offset": "m/s",
    "yaw_lag": "m s",
    "settling": "s",
    "gain": "1",
    "lag": "s",
    "delay": "s",
    "bias": "m/s²",
    "turning": "1",
    "limit": "m/s²",
    "integral": "1/s²",
    "share": "1",
    "caster": "1/m",
    "reverse": "1",
    "understeer": "s²/m²",
    "forwards": "1",
    "backwards": "1",
}
PER_ROW = {"forward": "m/s²", "lateral": "m/s²", "yaw": "rad/s²"}


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


# ---------------------------------------------------------------------------------------------------------- reading


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


# -------------------------------------------------------------------------------------------------------- intervals


def draws_of_blocks(blocks: int, draws: int, seed: int) -> Array:
    """Return how often each block is taken, `(draws, blocks)`: as many as there are, with replacement."""
    return np.random.default_rng(seed).multinomial(blocks, np.full(blocks, 1 / blocks), size=draws).astype(float)


def by_block(values: Array, block: Array) -> Array:
    """Sum values `(N, …)` within each block, `(B, …)`."""
    total = np.zeros((int(block.max()) + 1, *values.shape[1:]))
    np.add.at(total, block, values)
    return total


def summary(value: float, drawn: Array, blocks: int) -> dict[str, float | None]:
    """Return value, mean and sd of the bootstrap and a 95 % interval, by Student's t with a block less of freedom.

    What the data do not determine (draws that all agree or lie far apart) has no sd and no interval.
    """
    sd = float(np.std(drawn, ddof=1))
    if not UNDETERMINED[0] < sd < UNDETERMINED[1]:
        return {"value": float(value), "mean": None, "sd": None, "low": None, "high": None}
    half = float(student.ppf(0.975, max(blocks - 1, 1))) * sd
    return {
        "value": float(value),
        "mean": float(np.mean(drawn)),
        "sd": sd,
        "low": float(value - half),
        "high": float(value + half),
    }


def solved(matrices: Array, vectors: Array) -> Array:
    """Solve one small linear system after the other; one that is singular has the least-norm solution."""
    return np.einsum("...ij,...j->...i", np.linalg.pinv(matrices), vectors)


def regression(
    target: Array, terms: Mapping[str, Array], block: Array, *, instruments: Mapping[str, Array] | None = None,
    draws: int = 1000, seed: int = 0,
) -> dict[str, Any]:  # fmt: skip
    """Fit target = Σ coefficient · term by least squares, or by instruments against noise in the terms.

    Returns:
        The parameters' summaries, the residuals' rms in the target's unit and the number of blocks.
    """
    a = np.column_stack(list(terms.values()))
    z = a if instruments is None else np.column_stack([instruments[name] for name in terms])
    _, block = np.unique(block, return_inverse=True)
    matrices, vectors = by_block(z[:, :, None] * a[:, None], block), by_block(z * target[:, None], block)
    best = solved(matrices.sum(0), vectors.sum(0))
    taken = draws_of_blocks(len(matrices), draws, seed)
    drawn = solved(np.tensordot(taken, matrices, 1), np.tensordot(taken, vectors, 1))
    return {
        "parameters": {k: summary(best[i], drawn[:, i], len(matrices)) for i, k in enumerate(terms)},
        "rms": float(np.sqrt(np.mean((target - a @ best) ** 2))),
        "blocks": len(matrices),
    }


# ------------------------------------------------------------------------------------------------ lateral velocity


def gather(segments: Sequence[Segment], *names: str) -> list[Array]:
    """Join the named columns of all segments."""
    return [np.concatenate([getattr(segment, name) for segment in segments]) for name in names]


def moving(v: Array, w: Array, yaw_rate: Array, fastest: float = math.inf) -> Array:
    """Say where the truck moves (more than .2 m/s) and does not tumble (under 2 m/s sideways and 4 rad/s)."""
    return (np.abs(v) > 0.2) & (np.abs(v) < fastest) & (np.abs(w) < 2) & (np.abs(yaw_rate) < 4)


def lateral_terms(names: Sequence[str], v: Array, yaw_rate: Array, yaw_acceleration: Array) -> dict[str, Array]:
    """Return the terms of the lateral velocity: lever ω + slip v ω + crab v + offset + yaw_lag dω/dt."""
    every = {
        "lever": yaw_rate,
        "slip": v * yaw_rate,
        "crab": v,
        "offset": np.ones_like(v),
        "yaw_lag": yaw_acceleration,
    }
    return {name: every[name] for name in names}


def lateral(
    segments: Sequence[Segment], names: Sequence[str], *, fastest: float = math.inf, draws: int = 1000, seed: int = 0
) -> dict[str, Any]:
    """Regress the lateral velocity in continuous time; see `lateral_terms`."""
    v, w, yaw_rate, acceleration, block = gather(segments, "v", "w", "yaw_rate", "yaw_acceleration", "block")
    use = moving(v, w, yaw_rate, fastest)
    terms = lateral_terms(names, v[use], yaw_rate[use], acceleration[use])
    return regression(w[use], terms, block[use], draws=draws, seed=seed)


def lateral_by_instruments(
    odd: Sequence[Segment], even: Sequence[Segment], names: Sequence[str], *, draws: int = 1000, seed: int = 0
) -> dict[str, Any]:
    """Regress as `lateral`, with every other frame; the frames between are the instruments, whose noise is another."""
    pairs = [aligned(a, b) for a, b in zip(odd, even, strict=True)]
    v, w, yaw_rate, acceleration, block = gather(
        [a for a, _ in pairs], "v", "w", "yaw_rate", "yaw_acceleration", "block"
    )
    others = gather([b for _, b in pairs], "v", "yaw_rate", "yaw_acceleration")
    use = moving(v, w, yaw_rate)
    terms = lateral_terms(names, v[use], yaw_rate[use], acceleration[use])
    instruments = lateral_terms(names, *(column[use] for column in others))
    return regression(w[use], terms, block[use], instruments=instruments, draws=draws, seed=seed)


def aligned(one: Segment, other: Segment) -> tuple[Segment, Segment]:
    """Return both segments at the times of the first that the second covers."""
    inside = (one.time >= other.time[0]) & (one.time <= other.time[-1])
    columns = ("time", "x", "y", "heading", "v", "w", "yaw_rate", "yaw_acceleration", "block")
    first = {name: getattr(one, name)[inside] for name in columns}
    second = {name: np.interp(first["time"], other.time, getattr(other, name)) for name in columns[1:-1]}
    return dataclasses.replace(one, **first), dataclasses.replace(other, **(first | second))


def euler_rows(segment: Segment, step: float = STEP) -> dict[str, Array]:
    """Return rows as a model in explicit Euler steps sees them.

    Its velocity over the row from k to k + 1 is in the axes of the heading at k − 1, its turn rate is that of the
    row from k − 1 to k. Nothing is smoothed.
    """
    every = slice(None, None, round(step / TICK))
    x, y, heading, block = (getattr(segment, name)[every] for name in ("x", "y", "heading", "block"))
    east, north, before = np.diff(x)[1:] / step, np.diff(y)[1:] / step, heading[:-2]
    return {
        "v": np.cos(before) * east + np.sin(before) * north,
        "w": -np.sin(before) * east + np.cos(before) * north,
        "yaw_rate": np.diff(heading)[:-1] / step,
        "block": block[1:-1],
    }


def lateral_by_euler(
    segments: Sequence[Segment], names: Sequence[str], *, draws: int = 1000, seed: int = 0
) -> dict[str, Any]:
    """Regress the lateral velocity in the form of a model that takes explicit Euler steps at 10 Hz."""
    rows = [euler_rows(segment) for segment in segments]
    v, w, yaw_rate, block = (np.concatenate([row[name] for row in rows]) for name in ("v", "w", "yaw_rate", "block"))
    use = moving(v, w, yaw_rate)
    terms = lateral_terms(names, v[use], yaw_rate[use], np.zeros(use.sum()))
    return regression(w[use], terms, block[use], draws=draws, seed=seed)


def euler_from_continuous(
    segments: Sequence[Segment], lever: float, slip: float, step: float = STEP
) -> dict[str, float]:
    """Predict what the Euler form finds from the continuous lever (m) and slip (s).

    The middle of the row is 1.5 steps after the heading in whose axes the velocity is taken. The velocity turns by
    1.5 · step · ω in the meantime, which adds 1.5 · step · v · ω to the lateral velocity. A lever arm alone takes up
    the slip by the mean of v weighted with ω².
    """
    v, w, yaw_rate = gather(segments, "v", "w", "yaw_rate")
    use = moving(v, w, yaw_rate)
    weighted = float(np.sum(v[use] * yaw_rate[use] ** 2) / np.sum(yaw_rate[use] ** 2))
    seen = slip + 1.5 * step
    return {
        "weighted speed [m/s]": weighted,
        "lever alone, continuous [m]": lever + slip * weighted,
        "slip, Euler [s]": seen,
        "lever alone, Euler [m]": lever + seen * weighted,
    }


# ------------------------------------------------------------------------------------------------------- responses


def between(values: Array) -> Array:
    """Return the values in the middle of each tick; the last one is repeated."""
    return np.append((values[1:] + values[:-1]) / 2, values[-1])


def filtered(velocity: Array, s: Segment) -> Array:
    """Filter a simulated velocity as the measured one is, so that smoothing does not pass for a lag.

    Velocities that start again from what was measured every row are left as they are. At a window of .25 s this
    makes lags about .01 s too long and the caster a tenth too small.
    """
    if s.restart:
        return velocity
    path = np.concatenate([[0.0], np.cumsum((velocity[1:] + velocity[:-1]) / 2 * TICK)])
    return savgol_filter(path, s.length, DEGREE, deriv=1, delta=TICK)


def lagged(drive: Array, rate: Array, measured: Array, restart: int = 0) -> Array:
    """Integrate dx/dt = drive − rate · x, both held over each tick, from the first measured value.

    Every `restart` ticks the result is what was reached, and goes on from what was measured.
    """
    keep = np.exp(-rate * TICK)
    small = np.abs(rate) < 1e-9
    push = np.where(small, TICK, (1 - keep) / np.where(small, 1.0, rate)) * drive
    x, result = float(measured[0]), np.empty(len(drive))
    for i, (a, b) in enumerate(zip(keep.tolist(), push.tolist(), strict=True)):
        result[i] = x
        if restart and i % restart == 0:
            x = float(measured[i])
        x = a * x + b
    return result


def lateral_response(
    s: Segment, lever: float, settling: float, slip: float = 0.0, crab: float = 0.0, centripetal: float = 0.0
) -> Array:
    """Simulate dw/dt = (lever ω + slip v ω + crab v − w) / settling − centripetal v ω, m/s.

    `centripetal` is 0 where the constraint is held through a turn, 1 where tyres must first push the truck around.
    """
    v, yaw_rate = between(s.v), between(s.yaw_rate)
    target = lever * yaw_rate + slip * v * yaw_rate + crab * v
    drive = target / settling - centripetal * v * yaw_rate
    return lagged(drive, np.full(len(v), 1 / settling), s.w, s.restart)


def speed_response(
    s: Segment, gain: float, lag: float, delay: float, bias: float = 0.0, turning: float = 0.0,
    limit: float = math.inf, integral: float = 0.0,
) -> Array:  # fmt: skip
    """Simulate dv/dt = clip(e / lag + integral ∫e dt, ±limit) + bias + turning ω w, e = gain speed − v, m/s.

    `turning` is 0 where the wheels hold the speed through a turn, 1 where the command pushes a free body.
    """
    speed, _ = s.commanded(delay)
    more = bias + turning * between(s.yaw_rate) * between(s.w)
    if limit == math.inf and integral == 0:
        return lagged(gain * speed / lag + more, np.full(len(speed), 1 / lag), s.v, s.restart)
    v, summed, result = float(s.v[0]), 0.0, np.empty(len(speed))
    for i, (target, push) in enumerate(zip((gain * speed).tolist(), more.tolist(), strict=True)):
        result[i] = v
        if s.restart and i % s.restart == 0:
            v = float(s.v[i])
        error = target - v
        v += TICK * (min(max(error / lag + integral * summed, -limit), limit) + push)
        summed += TICK * error
    return result


def turn_response(
    s: Segment, gain: float, lag: float, delay: float, share: float = 0.0, caster: float = 0.0, reverse: float = 0.0,
    understeer: float = 0.0,
) -> Array:  # fmt: skip
    """Simulate dω/dt = (gain turned − ω) / lag − caster v ω, rad/s.

    turned = ((1 − share) turn + share · turn / speed · v) (1 − reverse tanh(v / .1)) (1 − understeer v²)
    """
    speed, turn = s.commanded(delay)
    v = between(s.v)
    by_curvature = turn * speed * v / (speed**2 + 0.05**2)
    turned = turn + share * (by_curvature - turn)
    turned = turned * (1 - reverse * np.tanh(v / 0.1)) * (1 - understeer * v**2)
    return lagged(gain * turned / lag, 1 / lag + caster * v, s.yaw_rate, s.restart)


START = {
    "lever": 0.3,
    "settling": 0.06,
    "slip": 0.0,
    "crab": 0.0,
    "gain": 0.9,
    "lag": 0.15,
    "delay": 0.08,
    "bias": 0.0,
    "turning": 0.5,
    "limit": 6.0,
    "integral": 2.0,
    "share": 0.5,
    "caster": 0.3,
    "reverse": 0.0,
    "understeer": 0.0,
}
LEAST = {"settling": 0.004, "lag": 0.01, "delay": 0.0, "limit": 1.0, "gain": 0.05}
NUDGE = {"limit": 0.2, "integral": 0.2, "delay": 0.01, "settling": 0.003, "lag": 0.005}  # for derivatives; others .01


@dataclass(frozen=True)
class Response:
    """A response with free parameters `names` and `fixed` ones, and the measured column that it explains."""

    simulate: Callable[..., Array]
    column: str
    names: tuple[str, ...]
    fixed: tuple[tuple[str, float], ...] = ()

    def residuals(self, segments: Sequence[Segment], point: Sequence[float]) -> Array:
        """Return measured minus simulated; see `used` for the samples."""
        parameters = dict(zip(self.names, point, strict=True)) | dict(self.fixed)
        rests = [getattr(s, self.column) - filtered(self.simulate(s, **parameters), s) for s in segments]
        return np.concatenate(
            [
                np.clip(np.nan_to_num(rest[self.used(s)], nan=10.0), -10, 10)
                for s, rest in zip(segments, rests, strict=True)
            ]
        )

    def used(self, s: Segment) -> Array:
        """Say which samples count, `(N,)`.

        Left out are tumbling, for w resting as well, and the ends of segments. Of rows only the ends count.
        """
        use = moving(s.v, s.w, s.yaw_rate) if self.column == "w" else np.abs(s.yaw_rate) < 4
        index = np.arange(len(use))
        if s.restart:
            return use & (index % s.restart == 0)
        return use & (index >= s.length // 2) & (index < len(use) - s.length // 2)

    def derivatives(self, segments: Sequence[Segment], point: Sequence[float]) -> Array:
        """Return the residuals' derivatives `(N, P)` by central differences."""
        columns = []
        for i, name in enumerate(self.names):
            nudge, least = NUDGE.get(name, 0.01), LEAST.get(name, -math.inf)
            up, down = np.array(point, float), np.array(point, float)
            up[i], down[i] = up[i] + nudge, max(down[i] - nudge, least)
            columns.append((self.residuals(segments, up) - self.residuals(segments, down)) / (up[i] - down[i]))
        return np.column_stack(columns)


def fitted(response: Response, segments: Sequence[Segment], *, draws: int = 1000, seed: int = 0) -> dict[str, Any]:
    """Fit a response to what was measured, simulated through whole segments.

    The bootstrap takes one step of Gauss and Newton from the best parameters for each draw of blocks.
    """
    first = [START[name] for name in response.names]
    least = [LEAST.get(name, -math.inf) for name in response.names]
    best = least_squares(
        lambda p: response.residuals(segments, p),
        first,
        jac=lambda p: response.derivatives(segments, p),
        bounds=(least, math.inf),
        x_scale=[10 * NUDGE.get(name, 0.01) for name in response.names],
        xtol=1e-5,
        ftol=1e-7,
        max_nfev=40,
    ).x
    rest, slope = response.residuals(segments, best), response.derivatives(segments, best)
    block = np.concatenate([s.block[response.used(s)] for s in segments])
    _, block = np.unique(block, return_inverse=True)
    matrices, vectors = by_block(slope[:, :, None] * slope[:, None], block), by_block(slope * rest[:, None], block)
    taken = draws_of_blocks(len(matrices), draws, seed)
    drawn = best - solved(np.tensordot(taken, matrices, 1), np.tensordot(taken, vectors, 1))
    return {
        "parameters": {k: summary(best[i], drawn[:, i], len(matrices)) for i, k in enumerate(response.names)},
        "rms": float(np.sqrt(np.mean(rest**2))),
        "blocks": len(matrices),
    }


def values(fit: Mapping[str, Any]) -> dict[str, float]:
    """Return the best parameters of a fit."""
    return {name: entry["value"] for name, entry in fit["parameters"].items()}


LATERAL = {
    "lever alone": ("lever",),
    "lever, slip": ("lever", "slip"),
    "lever, slip, crab, offset": ("lever", "slip", "crab", "offset"),
    "lever, slip, crab, yaw lag": ("lever", "slip", "crab", "yaw_lag"),
}
LATERAL_RESPONSES = {
    "inertial: lever, settling": Response(
        lateral_response, "w", ("lever", "settling"), (("centripetal", 1.0),)
    ),
    "inertial: lever, settling, crab": Response(
        lateral_response, "w", ("lever", "settling", "crab"), (("centripetal", 1.0),)
    ),
    "held: lever, slip, settling": Response(lateral_response, "w", ("lever", "slip", "settling")),
    "held: lever, slip, settling, crab": Response(lateral_response, "w", ("lever", "slip", "settling", "crab")),
}  # fmt: skip
_LAG = ("gain", "lag", "delay")
SPEED_RESPONSES = {
    "lag": Response(speed_response, "v", _LAG),
    "lag, bias": Response(speed_response, "v", (*_LAG, "bias")),
    "lag, turning": Response(speed_response, "v", (*_LAG, "turning")),
    "lag, bias, turning": Response(speed_response, "v", (*_LAG, "bias", "turning")),
    "lag, inertial": Response(speed_response, "v", _LAG, (("turning", 1.0),)),
    "lag, inertial, bias": Response(speed_response, "v", (*_LAG, "bias"), (("turning", 1.0),)),
    "lag, limit": Response(speed_response, "v", (*_LAG, "limit")),
    "lag, limit, integral": Response(speed_response, "v", (*_LAG, "limit", "integral")),
}
TURN_RESPONSES = {
    "lag": Response(turn_response, "yaw_rate", _LAG),
    "lag, share": Response(turn_response, "yaw_rate", (*_LAG, "share")),
    "lag, share, caster": Response(turn_response, "yaw_rate", (*_LAG, "share", "caster")),
    "lag, share, reverse": Response(turn_response, "yaw_rate", (*_LAG, "share", "reverse")),
    "lag, share, understeer": Response(turn_response, "yaw_rate", (*_LAG, "share", "understeer")),
    "lag, share, caster, reverse": Response(turn_response, "yaw_rate", (*_LAG, "share", "caster", "reverse")),
    "lag, share, caster, understeer": Response(turn_response, "yaw_rate", (*_LAG, "share", "caster", "understeer")),
}
RESPONSES = {"lateral response": LATERAL_RESPONSES, "speed": SPEED_RESPONSES, "turn rate": TURN_RESPONSES}
CHOSEN = {
    "lateral response": "held: lever, slip, settling",
    "speed": "lag",
    "turn rate": "lag, share, caster",
}


def steady_gains(segments: Sequence[Segment], *, draws: int = 1000, seed: int = 0) -> dict[str, Any]:
    """Regress v on the commanded speed, forwards and backwards, where the command has not changed for .8 s."""
    parts = []
    for s in segments:
        speed, _ = s.commanded(0.0)
        changed = np.append(True, np.abs(np.diff(speed)) > 0.01)
        since = np.arange(len(speed)) - np.maximum.accumulate(np.where(changed, np.arange(len(speed)), 0))
        use = (since > 0.8 / TICK) & (np.abs(speed) > 0.3)
        parts.append((s.v[use], speed[use], s.block[use]))
    v, speed, block = (np.concatenate(column) for column in zip(*parts, strict=True))
    terms = {"forwards": np.maximum(speed, 0.0), "backwards": np.minimum(speed, 0.0)}
    terms = {name: term for name, term in terms.items() if term.any()}
    if not terms:
        return {"parameters": {}, "rms": None, "blocks": 0}
    return regression(v, terms, block, draws=draws, seed=seed)


# ---------------------------------------------------------------------------------------------------- process noise


def row_residuals(segment: Segment, numbers: Mapping[str, Numbers], step: float = STEP) -> dict[str, Array]:
    """Return the acceleration, held over a row, that explains where each row ends, `(rows,)` each.

    Each row starts at the measured velocities and follows the responses with the given numbers for `step` s.

    Returns:
        forward, lateral (m/s²) and yaw (rad/s²); block; slow (m/s) and askew (rad/s), how far the command is ahead
        of the state.
    """
    ticks = round(step / TICK)
    rows = dataclasses.replace(segment, restart=ticks)
    starts = np.arange(0, len(segment.time) - ticks, ticks)
    result = {"block": segment.block[starts]}
    for channel, part, settled in (("forward", "speed", "lag"), ("lateral", "lateral response", "settling"),
                                   ("yaw", "turn rate", "lag")):  # fmt: skip
        response, lag = RESPONSES[part][CHOSEN[part]], numbers[part][settled]
        rest = getattr(segment, response.column) - response.simulate(rows, **numbers[part], **dict(response.fixed))
        result[channel] = rest[starts + ticks] / (lag * (1 - math.exp(-step / lag)))
    lead, steer = numbers["speed"], numbers["turn rate"]
    result["slow"] = (lead["gain"] * segment.commanded(lead["delay"])[0] - segment.v)[starts]
    result["askew"] = (steer["gain"] * segment.commanded(steer["delay"])[1] - segment.yaw_rate)[starts]
    return result


def correlation(rows: Sequence[Array], lag: int) -> float | None:
    """Return the correlation of values with those `lag` rows later, within each segment, about zero."""
    pairs = sum(float(np.sum(row[lag:] * row[:-lag])) for row in rows)
    spread = sum(float(np.sum(row[lag:] ** 2 + row[:-lag] ** 2)) / 2 for row in rows)
    return pairs / spread if spread > 0 else None


def process_noise(
    segments: Sequence[Segment], numbers: Mapping[str, Numbers], *, draws: int = 1000, seed: int = 0
) -> dict[str, Any]:
    """Return for each channel the residual accelerations' sd, overall, near and far from the command, and memory.

    sd: root mean square; middle: 1.4826 times the median of absolute values; calm and busy: sd where the state is
    within .2 (m/s or rad/s) of its command and where it is not; correlation after 1, 2, 5 and 10 rows.
    """
    rows = [row_residuals(segment, numbers) for segment in segments]
    _, block = np.unique(np.concatenate([row["block"] for row in rows]), return_inverse=True)
    taken = draws_of_blocks(int(block.max()) + 1, draws, seed)
    result: dict[str, Any] = {"blocks": int(block.max()) + 1, "rows": len(block), "channels": {}}
    for channel, ahead in (("forward", "slow"), ("lateral", "askew"), ("yaw", "askew")):
        rest, away = (np.concatenate([row[name] for row in rows]) for name in (channel, ahead))
        squares, counts = by_block(rest**2, block), by_block(np.ones_like(rest), block)
        calm = np.abs(away) < 0.2
        result["channels"][channel] = {
            "sd": summary(
                float(np.sqrt(np.mean(rest**2))), np.sqrt(taken @ squares / (taken @ counts)), len(squares)
            ),
            "middle": float(1.4826 * np.median(np.abs(rest))),
            "calm": float(np.sqrt(np.mean(rest[calm] ** 2))) if calm.any() else None,
            "busy": float(np.sqrt(np.mean(rest[~calm] ** 2))) if (~calm).any() else None,
            "correlation": {
                f"{lag * STEP:.1f} s": correlation([row[channel] for row in rows], lag) for lag in (1, 2, 5, 10)
            },
        }  # fmt: skip
    across = np.corrcoef([np.concatenate([row[name] for row in rows]) for name in PER_ROW])
    result["across"] = {"forward-lateral": across[0, 1], "forward-yaw": across[0, 2], "lateral-yaw": across[1, 2]}
    return result


# ------------------------------------------------------------------------------------------------------------ output


def analyse(
    data: Path, *, window: float = WINDOW, block: float = BLOCK, draws: int = 1000, seed: int = 0
) -> dict[str, Any]:
    """Fit everything on each split and on all together, and what hinges on a choice on all together.

    Returns:
        `fits`: part, split, variant, form, parameters, rms, blocks; `euler`: what the Euler form is predicted to
        find, by split; `noise`: by split.
    """
    options: dict[str, Any] = {"draws": draws, "seed": seed}

    def load(**more: Any) -> dict[str, list[Segment]]:
        splits = {name: read_split(data / name, **({"window": window, "block": block} | more)) for name in SPLITS}
        return splits | {TOGETHER: numbered([segment for name in SPLITS for segment in splits[name]])}

    fits: list[dict[str, Any]] = []

    def note(part: str, split: str, form: str, fit: dict[str, Any], variant: str = "") -> dict[str, Any]:
        fits.append({"part": part, "split": split, "variant": variant or f"{window:g} s", "form": form} | fit)
        return fit

    euler, noise = {}, {}
    for split, raw in load().items():
        segments = numbered(raw)
        for form, names in LATERAL.items():
            note("lateral velocity", split, form, lateral(segments, names, **options))
            if "yaw_lag" not in names:
                note("lateral velocity, Euler", split, form, lateral_by_euler(segments, names, **options), "10 Hz")
        found = values(lateral(segments, LATERAL["lever, slip"], **options))
        euler[split] = euler_from_continuous(segments, **found)
        note("steady speed", split, "forwards, backwards", steady_gains(segments, **options))
        rows, held = as_rows(segments), as_rows(segments, held=True)
        numbers = {}
        for part, responses in RESPONSES.items():
            for form, response in responses.items():
                note(part, split, form, fitted(response, segments, **options))
                if "integral" not in response.names:  # whose state a row does not know
                    fit = note(f"{part}, a row ahead", split, form, fitted(response, rows, **options))
                    numbers |= {part: values(fit)} if form == CHOSEN[part] else {}
                    if "delay" in response.names:
                        fit = fitted(response, held, **options)
                        note(f"{part}, a row ahead", split, form, fit, "commands of 10 Hz rows")
        noise[split] = process_noise(segments, numbers, **options)
    variants: list[tuple[str, dict[str, Any], float]] = [
        *((f"{other:g} s", {"window": other}, math.inf) for other in OTHER_WINDOWS),
        ("stamps of late messages kept", {"late": True}, math.inf),
        ("slower than 2.5 m/s", {}, 2.5),
    ]
    for variant, more, fastest in variants:
        segments = load(**more)[TOGETHER]
        for form in ("lever alone", "lever, slip", "lever, slip, crab, offset"):
            fit = lateral(segments, LATERAL[form], fastest=fastest, **options)
            note("lateral velocity", TOGETHER, form, fit, variant)
        if fastest == math.inf:
            for part, form in CHOSEN.items():
                note(part, TOGETHER, form, fitted(RESPONSES[part][form], segments, **options), variant)
    odd, even = (load(frames=slice(first, None, 2))[TOGETHER] for first in (0, 1))
    for form in ("lever alone", "lever, slip"):
        fit = lateral_by_instruments(odd, even, LATERAL[form], **options)
        note("lateral velocity", TOGETHER, form, fit, "every other frame, the others as instruments")
    settings = {"window [s]": window, "degree": DEGREE, "block [s]": block, "draws": draws, "seed": seed}
    return {"settings": settings, "fits": fits, "euler": euler, "noise": noise}


def number(value: float | None) -> str:
    """Return a number to three decimals without the zero before the point; a dash for none."""
    if value is None:
        return "–"
    return f"{value:.3f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.3f}"


def spread(entry: Numbers) -> str:
    """Return value ± sd [low, high]."""
    return f"{number(entry['value'])} ± {number(entry['sd'])} [{number(entry['low'])}, {number(entry['high'])}]"


def with_interval(name: str, entry: Numbers) -> str:
    """Return name, value ± sd and 95 % interval with the unit."""
    unit = "" if UNITS[name] == "1" else f" {UNITS[name]}"
    if entry["low"] is None:
        return f"{name} {number(entry['value'])} (not determined)"
    return f"{name} {spread(entry)}{unit}"


def table(rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; the first row is its head."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])


def markdown(result: Mapping[str, Any]) -> str:
    """Return the tables: fits by part, what the Euler form makes of them, residual accelerations."""
    settings = result["settings"]
    texts = [
        f"Savitzky-Golay filters of degree {settings['degree']} over {settings['window [s]']:g} s; 95 % intervals by "
        f"resampling blocks of {settings['block [s]']:g} s {settings['draws']} times. Delays count from a command's "
        "stamp; each command is held until the next."
    ]
    for part in dict.fromkeys(fit["part"] for fit in result["fits"]):
        rows = [["form", "split", "smoothing", "value ± sd [95 % interval]", "rms", "blocks"]]
        for fit in sorted((fit for fit in result["fits"] if fit["part"] == part), key=lambda fit: fit["form"]):
            found = "; ".join(with_interval(name, entry) for name, entry in fit["parameters"].items())
            rows.append([fit["form"], fit["split"], fit["variant"], found, number(fit["rms"]), str(fit["blocks"])])
        texts += [f"## {part.capitalize()}", table(rows)]
    heads = list(result["euler"][TOGETHER])
    rows = [["split", *heads]] + [[k, *(number(entry[h]) for h in heads)] for k, entry in result["euler"].items()]
    texts += ["## What the Euler form must find, from the continuous lever and slip", table(rows)]
    rows = [
        [
            "channel",
            "split",
            "sd ± its sd [95 % interval]",
            "middle",
            "calm",
            "busy",
            "correlation after .1, .2, .5, 1 s",
        ]
    ]
    for split, noise in result["noise"].items():
        for channel, entry in noise["channels"].items():
            sd = f"{spread(entry['sd'])} {PER_ROW[channel]}"
            parts = [number(entry[name]) for name in ("middle", "calm", "busy")]
            rows.append([channel, split, sd, *parts, ", ".join(number(c) for c in entry["correlation"].values())])
    texts += ["## Residual accelerations, held over rows of .1 s", table(rows)]
    return "\n\n".join(texts) + "\n"


def write(path: Path, text: str) -> None:
    """Write a file as a whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.write_text(text, encoding="utf-8")
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code: 0, or 2 where the logs are missing or cannot be read."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with train/, valid/ and test/")
    parser.add_argument("--json", type=Path, help="file for the numbers")
    parser.add_argument("--markdown", type=Path, help="file for the tables")
    parser.add_argument("--window", type=float, default=WINDOW, help="of the Savitzky-Golay filters, s")
    parser.add_argument("--block", type=float, default=BLOCK, help="of the bootstrap, s")
    parser.add_argument("--draws", type=int, default=1000, help="of the bootstrap")
    parser.add_argument("--seed", type=int, default=0, help="of the bootstrap")
    given = parser.parse_args(arguments)
    for low, high, name in ((0.05, 1.0, "window"), (1.0, 60.0, "block"), (2, 10**6, "draws")):
        if not low <= getattr(given, name) <= high:
            print(f"--{name}: expected {low:g} to {high:g}, got {getattr(given, name):g}", file=sys.stderr)
            return 2
    missing = [name for name in SPLITS if not (given.data / name).is_dir()]
    if missing:
        print(f"skipped: {given.data} holds no folder {missing[0]}/ of AlphaTruck logs", file=sys.stderr)
        return 2
    try:
        result = analyse(given.data, window=given.window, block=given.block, draws=given.draws, seed=given.seed)
    except LogError as error:
        print(f"skipped: {error}", file=sys.stderr)
        return 2
    text = markdown(result)
    if given.json:
        write(given.json, json.dumps(result, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    if given.markdown:
        write(given.markdown, text)
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
