"""Where the linearised program believes the vehicle was, row by row, and how log p(y) would change.

The scores are the derivatives of log p(y) by a push on the state of any row and by a shift of any measurement (de Jong
1989; Harvey and Koopman 1992 call them auxiliary residuals). Their sums over rows test for anything that pushes or
shifts. They are no estimates: the smoother has believed the program, so that a missing effect appears in them a tenth
of its size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.linearize import Linearization, ReferencePath, linearize
from steady_ppl.model.program import Program


@dataclass(frozen=True)
class Tracked:
    """The Kalman filter and smoother of a linearised program, in double precision.

    Attributes:
        linearization: of the program, along the path that the last pass began with.
        states, covariances: `(T + 1, B, D)` and `(T + 1, B, D, D)`, given the measurements up to each row.
        smoothed: `(T + 1, B, D)`, the states given all measurements.
        noise: `(T, B, C)`, E[ε | y]: also the score of a push by each channel, per standard deviation of it.
        arrival: `(T + 1, B, D)`, the score of a push on the state that each row begins with.
        reading: `(T + 1, B, K)`, the score of a shift of each measurement; zero where it is missing.
        log_likelihood: `(B,)` log p(y).
    """

    linearization: Linearization
    states: Tensor
    covariances: Tensor
    smoothed: Tensor
    noise: Tensor
    arrival: Tensor
    reading: Tensor
    log_likelihood: Tensor

    def path(self, data: Trajectories) -> ReferencePath:
        """The posterior mean as a path to linearise along, the padding filled with the first row."""
        kind = data.controls.dtype
        return ReferencePath(
            states=torch.where(data.rows[..., None], self.smoothed, self.smoothed[:1]).to(kind),
            noise=torch.where(data.transitions[..., None], self.noise, 0.0).to(kind),
        )

    def variances_ahead(self, horizon: int) -> Tensor:
        """Variances of measurements predicted `horizon` rows ahead, `(T + 1 − horizon, B, K)`; NaN where missing."""
        linear = self.linearization
        rows, drives, components = linear.residual.shape
        out = np.empty((rows - horizon, drives, components))
        spread_ahead(
            horizon,
            _array(self.covariances),
            _moving(linear),
            _array(linear.measurement),
            _array(linear.precision),
            out,
        )
        return torch.from_numpy(out)


def track(
    program: Program,
    data: Trajectories,
    path: ReferencePath,
    *,
    known_start: bool,
    passes: int = 2,
    kernels: bool | None = None,
) -> Tracked:
    """Linearise along a path, filter and smooth, and again along what was smoothed.

    Args:
        program: with normal noise; see `linearize`.
        data: as returned by `for_program`.
        path: near the posterior's mode.
        known_start: the first state is certain.
        passes: linearisations.
        kernels: see `linearize`.
    """
    tracked = filter_and_smooth(linearize(program, data, path, known_start=known_start, kernels=kernels))
    for _ in range(passes - 1):
        path = tracked.path(data)
        tracked = filter_and_smooth(linearize(program, data, path, known_start=known_start, kernels=kernels))
    return tracked


def filter_and_smooth(linear: Linearization) -> Tracked:
    """Run the recursions along a linearization."""
    rows, drives, components, dimension = linear.measurement.shape
    filtered = np.empty((rows, drives, dimension)), np.empty((rows, drives, dimension, dimension))
    update = (
        np.empty((rows, drives, components)),
        np.empty((rows, drives, components)),
        np.empty((rows, drives, components, dimension)),
    )
    by_state, precision = _array(linear.measurement), _array(linear.precision)
    start = _array(linear.start_offset), _array(linear.start_noise)
    moving = _moving(linear)
    forward(start, moving, (_array(linear.residual), by_state, precision), filtered, update)
    arrival, reading, smoothed = np.empty_like(filtered[0]), np.empty_like(update[0]), np.empty_like(filtered[0])
    backward(filtered, update, moving, by_state, arrival, reading, smoothed)
    innovation, variance, _ = update
    with np.errstate(divide="ignore", invalid="ignore"):
        misfit = innovation**2 / variance + np.log(np.where(precision > 0, variance * precision, 1.0))
    pushes = torch.from_numpy(arrival)
    around = linear.path.states.double()
    return Tracked(
        linearization=linear,
        states=around + torch.from_numpy(filtered[0]),
        covariances=torch.from_numpy(filtered[1]),
        smoothed=around + torch.from_numpy(smoothed),
        noise=(linear.noise * pushes[1:].unsqueeze(-1)).sum(-2),
        arrival=pushes,
        reading=torch.from_numpy(reading),
        log_likelihood=linear.log_scale.sum(0) - 0.5 * torch.from_numpy(misfit).sum((0, 2)),
    )


def _moving(linear: Linearization) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return _array(linear.offset), _array(linear.state), _array(linear.noise)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.contiguous().numpy(force=True)


Array = np.ndarray[Any, np.dtype[np.float64]]


@njit(cache=True, error_model="numpy")
def forward(
    start: tuple[Array, Array],
    moving: tuple[Array, Array, Array],
    measuring: tuple[Array, Array, Array],
    filtered: tuple[Array, Array],
    update: tuple[Array, Array, Array],
) -> None:
    """Kalman (1960), a measurement component at a time.

    Args:
        start: mean `(B, D)` and G₀ `(B, D, C₀)`.
        moving: offset `(T, B, D)`, F `(T, B, D, D)` and G `(T, B, D, C)`.
        measuring: residual `(T + 1, B, K)`, H `(T + 1, B, K, D)` and precision `(T + 1, B, K)`.
        filtered: filled with the means `(T + 1, B, D)` and covariances `(T + 1, B, D, D)` given all up to a row.
        update: filled with each component's innovation given those before it and its variance, `(T + 1, B, K)`, and its
            gain `(T + 1, B, K, D)`; zero, one and zero where it is missing.
    """
    rows, trajectories, components = measuring[0].shape
    dimension, channels = moving[2].shape[2:]
    covariance, half = np.zeros((dimension, dimension)), np.zeros((dimension, dimension))
    mean, moved = np.zeros(dimension), np.zeros(dimension)
    for b in range(trajectories):
        mean[:] = start[0][b]
        _outer(start[1][b], covariance)
        for t in range(rows):
            if t > 0:
                step, noise = moving[1][t - 1, b], moving[2][t - 1, b]
                for i in range(dimension):
                    moved[i] = moving[0][t - 1, b, i]
                    for j in range(dimension):
                        moved[i] += step[i, j] * mean[j]
                        half[i, j] = 0.0
                        for k in range(dimension):
                            half[i, j] += step[i, k] * covariance[k, j]
                mean[:] = moved
                for i in range(dimension):
                    for j in range(i + 1):
                        entry = 0.0
                        for k in range(dimension):
                            entry += half[i, k] * step[j, k]
                        for c in range(channels):
                            entry += noise[i, c] * noise[j, c]
                        covariance[i, j] = entry
                        covariance[j, i] = entry
            for k in range(components):
                gain = update[2][t, b, k]
                gain[:] = 0.0
                update[0][t, b, k] = 0.0
                update[1][t, b, k] = 1.0
                if measuring[2][t, b, k] == 0.0:
                    continue
                by_state = measuring[1][t, b, k]
                variance, innovation = 1.0 / measuring[2][t, b, k], measuring[0][t, b, k]
                for i in range(dimension):
                    innovation -= by_state[i] * mean[i]
                    for j in range(dimension):
                        gain[i] += covariance[i, j] * by_state[j]
                    variance += by_state[i] * gain[i]
                for i in range(dimension):
                    gain[i] /= variance
                    mean[i] += gain[i] * innovation
                for i in range(dimension):
                    for j in range(dimension):
                        covariance[i, j] -= gain[i] * gain[j] * variance
                update[0][t, b, k] = innovation
                update[1][t, b, k] = variance
            filtered[0][t, b] = mean
            filtered[1][t, b] = covariance


@njit(cache=True, error_model="numpy")
def _outer(factor: Array, out: Array) -> None:
    for i in range(factor.shape[0]):
        for j in range(factor.shape[0]):
            out[i, j] = 0.0
            for c in range(factor.shape[1]):
                out[i, j] += factor[i, c] * factor[j, c]


@njit(cache=True, error_model="numpy")
def backward(
    filtered: tuple[Array, Array],
    update: tuple[Array, Array, Array],
    moving: tuple[Array, Array, Array],
    by_state: Array,
    arrival: Array,
    reading: Array,
    smoothed: Array,
) -> None:
    """The scores of log p(y): its derivatives by a push on the state of every row and by a shift of every measurement.

    De Jong (1989): what is left of later innovations, carried back. Gᵀ arrival is the posterior mean of the noise.

    Args:
        filtered, update, moving: of `forward`.
        by_state: H `(T + 1, B, K, D)`.
        arrival: filled with the derivative by a push on the state that a row begins with, `(T + 1, B, D)`.
        reading: filled with the derivative by a shift of what is measured, `(T + 1, B, K)`; zero where it is missing.
        smoothed: filled with the posterior means of the states, `(T + 1, B, D)`.
    """
    rows, trajectories, components, dimension = by_state.shape
    later, moved = np.zeros(dimension), np.zeros(dimension)
    for b in range(trajectories):
        later[:] = 0.0
        for t in range(rows - 1, -1, -1):
            for i in range(dimension):
                smoothed[t, b, i] = filtered[0][t, b, i]
                for j in range(dimension):
                    smoothed[t, b, i] += filtered[1][t, b, i, j] * later[j]
            for k in range(components - 1, -1, -1):
                gain = update[2][t, b, k]
                score = update[0][t, b, k] / update[1][t, b, k]
                for i in range(dimension):
                    score -= gain[i] * later[i]
                for i in range(dimension):
                    later[i] += by_state[t, b, k, i] * score
                reading[t, b, k] = score
            arrival[t, b] = later
            if t > 0:
                for j in range(dimension):
                    moved[j] = 0.0
                    for i in range(dimension):
                        moved[j] += moving[1][t - 1, b, i, j] * later[i]
                later[:] = moved


@njit(cache=True, error_model="numpy")
def spread_ahead(
    horizon: int,
    covariances: Array,
    moving: tuple[Array, Array, Array],
    by_state: Array,
    precision: Array,
    variances: Array,
) -> None:
    """Variances of the measurements that are predicted `horizon` rows ahead, their own noise included.

    Args:
        horizon: how many rows lie between what is known and what is predicted.
        covariances: of the states given all up to a row, `(T + 1, B, D, D)`.
        moving: of `forward`.
        by_state, precision: H `(T + 1, B, K, D)` and `(T + 1, B, K)`.
        variances: filled, `(T + 1 − horizon, B, K)`; NaN where the precision is zero.
    """
    rows, trajectories, components, dimension = by_state.shape
    channels = moving[2].shape[3]
    along, moved = np.zeros(dimension), np.zeros(dimension)
    for b in range(trajectories):
        for t in range(rows - horizon):
            for k in range(components):
                if precision[t + horizon, b, k] == 0.0:
                    variances[t, b, k] = np.nan
                    continue
                along[:] = by_state[t + horizon, b, k]
                variance = 1.0 / precision[t + horizon, b, k]
                for back in range(t + horizon - 1, t - 1, -1):
                    noise, step = moving[2][back, b], moving[1][back, b]
                    for c in range(channels):
                        entry = 0.0
                        for i in range(dimension):
                            entry += along[i] * noise[i, c]
                        variance += entry * entry
                    for j in range(dimension):
                        moved[j] = 0.0
                        for i in range(dimension):
                            moved[j] += along[i] * step[i, j]
                    along[:] = moved
                for i in range(dimension):
                    for j in range(dimension):
                        variance += along[i] * covariances[t, b, i, j] * along[j]
                variances[t, b, k] = variance
