"""Linear laws of the truck's motion by least squares, with intervals from resampling blocks of time.

The lateral velocity is regressed in continuous time, by instruments and in explicit Euler steps; the speed where it is
steady.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import t as student
from truck_capture_logs import STEP, TICK, Array, Segment, gather, moving

UNDETERMINED = (1e-9, 10.0)  # sd of the bootstrap outside of which there is no interval
LATERAL = {
    "lever alone": ("lever",),
    "lever, slip": ("lever", "slip"),
    "lever, slip, crab, offset": ("lever", "slip", "crab", "offset"),
    "lever, slip, crab, yaw lag": ("lever", "slip", "crab", "yaw_lag"),
}


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
