"""The arithmetic of a twist at one row, the same whatever the program: compiled on the processor, one particle after
the other, and for a device all at once.

States are `(N, B, D)` and noise `(N, B, C)`. What the lookahead holds of the row is in double precision: path `(B, D)`,
Λ `(B, D, D)`, λ `(B, D)`, log_scale `(B,)`, and the steering, which is shift `(B, C)`, gain `(B, C, D)`, factor and its
inverse `(B, C, C)`, upper triangular.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from steady_ppl.errors import require
from steady_ppl.gaussian.information_filter import Lookahead, look_ahead
from steady_ppl.gaussian.lanes import Array
from steady_ppl.smc.filter import Proposal
from steady_ppl.smc.resampling import by_component
from steady_ppl.utils.angles import wrap

SteeringParts = tuple[Tensor, Tensor, Tensor, Tensor]


def log_future(
    state: Tensor, path: Tensor, angles: Tensor, precision: Tensor, information: Tensor, log_scale: Tensor
) -> Tensor:
    """log_scale + λᵀδ − ½ δᵀΛδ of every particle's deviation δ from the path, `(N, B)`."""
    out = torch.empty(state.shape[1], state.shape[0], dtype=torch.float64)
    parts = (path, angles, precision, information, log_scale, out)
    _log_future(by_component(state).numpy(), *(part.numpy() for part in parts))
    return out.t()


def steer(
    state: Tensor, path: Tensor, angles: Tensor, steering: SteeringParts, own: Tensor, stays: Tensor, untwisted: float
) -> tuple[Tensor, Tensor]:
    """Draw every particle's noise `(N, B, C)`: its own, standard normal, if it `stays`, else steered.

    Return it, and its log density less that of the mixture that it was drawn from, `(N, B)`. `untwisted` is the
    probability to stay.
    """
    noise = torch.empty(own.shape[::-1], dtype=own.dtype)
    ratio = torch.empty(noise.shape[1:], dtype=torch.float64)
    parts: Any = tuple(part.numpy() for part in steering)
    given = (by_component(state).numpy(), path.numpy(), angles.numpy(), parts)
    _steer(*given, by_component(own).numpy(), stays.t().contiguous().numpy(), untwisted, (noise.numpy(), ratio.numpy()))
    return noise.permute(2, 1, 0), ratio.t()


# the innermost loops run over a trajectory's particles, side by side in memory: the processor takes several at once


@njit(cache=True, error_model="numpy")
def _deviations(state: Array, path: Array, angles: Array, b: int, out: Array) -> None:
    """A trajectory's states less the path's, angles on the circle, into `out` `(D, N)`."""
    for i in range(len(out)):
        mine = out[i]
        mine[:] = state[i, b]
        mine -= path[b, i]
        if angles[i]:
            for n in range(len(mine)):
                mine[n] -= 2 * math.pi * np.rint(mine[n] / (2 * math.pi))


@njit(cache=True, error_model="numpy")
def _add_products(matrix: Array, vectors: Array, first: int, sign: float, out: Array) -> None:
    """Add one row of a matrix, from an element on, times vectors `(·, N)` to `out` `(N,)`."""
    for i in range(first, len(vectors)):
        weight, vector = sign * matrix[i], vectors[i]
        for n in range(len(out)):
            out[n] += weight * vector[n]


@njit(cache=True, error_model="numpy")
def _log_future(
    state: Array, path: Array, angles: Array, precision: Array, information: Array, log_scale: Array, out: Array
) -> None:
    dimension, trajectories, particles = state.shape
    deviation, pulled = np.empty((dimension, particles)), np.empty(particles)
    for b in range(trajectories):
        _deviations(state, path, angles, b, deviation)
        out[b] = log_scale[b]
        for i in range(dimension):
            pulled[:] = information[b, i]
            _add_products(precision[b, i], deviation, 0, -0.5, pulled)
            own, total = deviation[i], out[b]
            for n in range(particles):
                total[n] += pulled[n] * own[n]


@njit(cache=True, error_model="numpy")
def _steer(
    state: Array,
    path: Array,
    angles: Array,
    steering: tuple[Array, Array, Array, Array],
    own: Array,
    stays: Array,
    untwisted: float,
    out: tuple[Array, Array],
) -> None:
    shift, gain, factor, whitening = steering
    noise, log_ratio = out
    dimension, trajectories, particles = state.shape
    channels, deviation, white = len(own), np.empty((dimension, particles)), np.empty(particles)
    wide, mean, drawn = np.empty((3, channels, particles))
    for b in range(trajectories):
        _deviations(state, path, angles, b, deviation)
        ratio = log_ratio[b]
        ratio[:] = 0.0
        for c in range(channels):
            ratio += math.log(whitening[b, c, c])
            wide[c] = own[c, b]
        for c in range(channels):
            mean[c] = shift[b, c]
            _add_products(gain[b, c], deviation, 0, -1.0, mean[c])
            drawn[c] = mean[c]
            _add_products(factor[b, c], wide, c, 1.0, drawn[c])
            mine, unsteered = drawn[c], wide[c]
            for n in range(particles):
                mine[n] = unsteered[n] if stays[b, n] else mine[n]
                ratio[n] += 0.5 * mine[n] * mine[n]
            noise[c, b] = mine
        for c in range(channels):
            white[:] = 0.0
            _add_products(whitening[b, c], drawn, c, 1.0, white)
            _add_products(whitening[b, c], mean, c, -1.0, white)
            for n in range(particles):
                ratio[n] -= 0.5 * white[n] * white[n]
        for n in range(particles):
            value = ratio[n]
            if untwisted > 0:
                smaller = math.exp(-abs(value))
                if value > 0:
                    value += math.log1p(untwisted * (smaller - 1))
                else:
                    value = math.log((1 - untwisted) * smaller + untwisted)
            ratio[n] = -value


def log_future_in_parallel(
    state: Tensor, path: Tensor, angles: Tensor, precision: Tensor, information: Tensor, log_scale: Tensor
) -> Tensor:
    """`log_future` for a device."""
    deviation = _deviation(state, path, angles)
    return log_scale + ((information - 0.5 * _times(precision, deviation)) * deviation).sum(-1)


def steer_in_parallel(
    state: Tensor, path: Tensor, angles: Tensor, steering: SteeringParts, own: Tensor, stays: Tensor, untwisted: float
) -> tuple[Tensor, Tensor]:
    """`steer` for a device."""
    shift, gain, factor, whitening = steering
    mean = shift - _times(gain, _deviation(state, path, angles))
    noise = torch.where(stays.unsqueeze(-1), own.double(), mean + _times(factor, own.double()))
    return noise.to(own.dtype), -mixture(log_steered(noise, mean, whitening), untwisted)


def log_steered(noise: Tensor, mean: Tensor, whitening: Tensor) -> Tensor:
    """log N(noise; mean, factor factorᵀ) − log N(noise; 0, I), `(N, B)`."""
    white = _times(whitening, noise - mean)
    log_determinant = whitening.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return 0.5 * (noise.square().sum(-1) - white.square().sum(-1)) + log_determinant


def mixture(log_ratio: Tensor, untwisted: float) -> Tensor:
    """log((1 − share) ratio + share)."""
    if untwisted == 0:
        return log_ratio
    return torch.logaddexp(log_ratio + math.log1p(-untwisted), torch.full_like(log_ratio, math.log(untwisted)))


def inverse(upper: Tensor) -> Tensor:
    """Of upper triangular matrices."""
    return torch.linalg.solve_triangular(upper, torch.eye(upper.shape[-1]).to(upper), upper=True)


def _deviation(state: Tensor, path: Tensor, angles: Tensor) -> Tensor:
    deviation = state.double() - path
    return torch.where(angles, wrap(deviation), deviation)


def _times(matrix: Tensor, vectors: Tensor) -> Tensor:
    """`(B, R, D)` times `(N, B, D)`: `(N, B, R)`, one product a trajectory."""
    return (vectors.transpose(0, 1) @ matrix.mT).transpose(0, 1)


class Twist(Proposal):
    """A lookahead as proposals.

    Whatever the lookahead is, the filter's estimate of p(y) stays unbiased: each noise is weighted by the ratio of its
    own density to that of the mixture which it was drawn from. A share of untwisted draws bounds these ratios by one
    over the share.

    Args:
        lookahead: along any path; the closer to the posterior, the smaller the variance.
        untwisted: probability with which a particle draws one step's noise as the program does. At 100 intervals a
            share of .05 doubles the scatter of log p(y) that .01 has.
        tempered: weight of the later measurements as the twist sees them, relative to their own; less than 1 guards
            against a twist that is narrower than the posterior.

    Raises:
        UsageError: `untwisted` is not in [0, 1), or `tempered` not in (0, 1].
    """

    looks_ahead = True

    def __init__(self, lookahead: Lookahead, *, untwisted: float = 0.01, tempered: float = 1.0) -> None:
        require(0 <= untwisted < 1, "untwisted", untwisted, "in [0, 1)")
        require(0 < tempered <= 1, "tempered", tempered, "in (0, 1]")
        if tempered < 1:
            seen = lookahead.linearization
            weighted = replace(seen, precision=tempered * seen.precision, log_scale=tempered * seen.log_scale)
            lookahead = look_ahead(weighted)
        self.lookahead, self.untwisted = lookahead, untwisted
        path, steps = lookahead.linearization.path.states, lookahead.steps
        self.dtype, self.path = path.dtype, path.double()
        self.angles = lookahead.linearization.circular
        self.steering = (steps.shift, steps.gain, steps.factor, inverse(steps.factor))

    def log_future(self, row: int, state: Tensor) -> Tensor:
        """log p(y_{row+1}, …, y_T | state) of the linearised program, see `Proposal`."""
        ahead = self.lookahead
        future = log_future if state.device.type == "cpu" else log_future_in_parallel
        parts = (self.path[row], self.angles, ahead.precision[row], ahead.information[row], ahead.log_scale[row])
        return future(state, *parts)

    def start(self, particles: int) -> tuple[Tensor | None, Tensor | float]:
        """Steer the start's noise, of the mixture of all `windings`, see `Proposal`."""
        ahead, starts = self.lookahead, self.lookahead.starts
        _, twisted, own = ahead.draw_starts(particles)
        stays = torch.rand(own.shape[:-1], dtype=torch.float64, device=own.device) < self.untwisted
        noise = torch.where(stays.unsqueeze(-1), own, twisted)
        whitening = inverse(starts.factor)
        ratios = [
            ahead.winding_masses[k] + log_steered(noise, starts.shift[k], whitening[k])
            for k in range(len(ahead.windings))
        ]
        return noise.to(self.dtype), -mixture(torch.stack(ratios).logsumexp(0), self.untwisted)

    def step(self, row: int, state: Tensor) -> tuple[Tensor | None, Tensor | float]:
        """Steer an interval's noise from the states before it, see `Proposal`."""
        particles, trajectories = state.shape[:2]
        kind: Any = {"device": state.device, "dtype": self.dtype}
        own = torch.randn(self.lookahead.steps.shift.shape[-1], trajectories, particles, **kind).permute(2, 1, 0)
        stays = torch.zeros(trajectories, particles, dtype=torch.bool, device=state.device).t()
        if self.untwisted:
            stays = torch.rand(trajectories, particles, **kind).t() < self.untwisted
        steered = steer if state.device.type == "cpu" else steer_in_parallel
        steering: Any = tuple(part[row] for part in self.steering)
        return steered(state, self.path[row], self.angles, steering, own, stays, self.untwisted)
