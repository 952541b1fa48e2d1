"""Responses to commands, fitted by simulating them on the 100 Hz grid, and the accelerations that they leave."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import savgol_filter
from truck_capture_logs import DEGREE, STEP, TICK, Array, Segment, moving
from truck_capture_regressions import by_block, draws_of_blocks, solved, summary

Numbers = Mapping[str, float]


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
    across = np.corrcoef([np.concatenate([row[name] for row in rows]) for name in result["channels"]])
    result["across"] = {"forward-lateral": across[0, 1], "forward-yaw": across[0, 2], "lateral-yaw": across[1, 2]}
    return result
