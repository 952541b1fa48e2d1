"""Kalman filter and smoother of the linearised program, and how log p(y) changes by row.

The scores are the derivatives of log p(y) by a push on the state of any row and by a shift of any measurement (de Jong
1989; Harvey and Koopman 1992 call them auxiliary residuals). Their sums over rows test for anything that pushes or
shifts. They are no estimates: the smoother has believed the program, so that a missing effect appears in them a tenth
of its size.

The recursions are compiled, on numpy arrays in double precision; rows or intervals first, trajectories second. The
notation is that of `linearize`: δ' = F δ + offset + G ε, and a measurement's residual r̄ − H δ with the given precision,
zero where it is missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.linearize import Linearization, ReferencePath, linearize
from steady_ppl.model.program import Program

Array = np.ndarray[Any, np.dtype[np.float64]]


class Moving(NamedTuple):
    """δ' = F δ + offset + G ε of every interval.

    Attributes:
        offset: `(T, B, D)`.
        state: F `(T, B, D, D)`.
        noise: G `(T, B, D, C)`.
    """

    offset: Array
    state: Array
    noise: Array


class Measuring(NamedTuple):
    """residual = H δ + N(0, 1 / precision) of every row.

    Attributes:
        residual: `(T + 1, B, K)`.
        by_state: H `(T + 1, B, K, D)`.
        precision: `(T + 1, B, K)`; zero where a measurement is missing.
    """

    residual: Array
    by_state: Array
    precision: Array


class Start(NamedTuple):
    """The first state, N(mean, G₀ G₀ᵀ): `(B, D)` and `(B, D, C₀)`."""

    mean: Array
    noise: Array


class Moments(NamedTuple):
    """The states given the measurements up to each row: `(T + 1, B, D)` and `(T + 1, B, D, D)`."""

    means: Array
    covariances: Array


class Updates(NamedTuple):
    """What each measured component changes, given those before it; zero, one and zero where it is missing.

    Attributes:
        innovation, variance: `(T + 1, B, K)`.
        gain: `(T + 1, B, K, D)`.
    """

    innovation: Array
    variance: Array
    gain: Array


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
    filtered = Moments(np.empty((rows, drives, dimension)), np.empty((rows, drives, dimension, dimension)))
    updates = Updates(
        innovation=np.empty((rows, drives, components)),
        variance=np.empty((rows, drives, components)),
        gain=np.empty((rows, drives, components, dimension)),
    )
    measuring = Measuring(_array(linear.residual), _array(linear.measurement), _array(linear.precision))
    start, moving = Start(_array(linear.start_offset), _array(linear.start_noise)), _moving(linear)
    forward(start, moving, measuring, filtered, updates)
    arrival, smoothed = np.empty_like(filtered.means), np.empty_like(filtered.means)
    reading = np.empty_like(updates.innovation)
    backward(filtered, updates, moving, measuring.by_state, arrival, reading, smoothed)
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.log(np.where(measuring.precision > 0, updates.variance * measuring.precision, 1.0))
        misfit = updates.innovation**2 / updates.variance + excess
    pushes = torch.from_numpy(arrival)
    around = linear.path.states.double()
    return Tracked(
        linearization=linear,
        states=around + torch.from_numpy(filtered.means),
        covariances=torch.from_numpy(filtered.covariances),
        smoothed=around + torch.from_numpy(smoothed),
        noise=(linear.noise * pushes[1:].unsqueeze(-1)).sum(-2),
        arrival=pushes,
        reading=torch.from_numpy(reading),
        log_likelihood=linear.log_scale.sum(0) - 0.5 * torch.from_numpy(misfit).sum((0, 2)),
    )


def _moving(linear: Linearization) -> Moving:
    return Moving(offset=_array(linear.offset), state=_array(linear.state), noise=_array(linear.noise))


def _array(tensor: Tensor) -> Array:
    return tensor.contiguous().numpy(force=True)


@njit(cache=True, error_model="numpy")
def forward(start: Start, moving: Moving, measuring: Measuring, filtered: Moments, updates: Updates) -> None:
    """Kalman (1960), a measurement component at a time. Fills `filtered` and `updates`."""
    rows, trajectories, dimension = filtered.means.shape
    channels = moving.noise.shape[3]
    covariance, half = np.zeros((dimension, dimension)), np.zeros((dimension, dimension))
    mean, moved = np.zeros(dimension), np.zeros(dimension)
    for b in range(trajectories):
        mean[:] = start.mean[b]
        _outer(start.noise[b], covariance)
        for t in range(rows):
            if t > 0:
                step, noise = moving.state[t - 1, b], moving.noise[t - 1, b]
                for i in range(dimension):
                    moved[i] = moving.offset[t - 1, b, i]
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
            _update(
                (measuring.residual[t, b], measuring.by_state[t, b], measuring.precision[t, b]),
                mean,
                covariance,
                (updates.innovation[t, b], updates.variance[t, b], updates.gain[t, b]),
            )
            filtered.means[t, b] = mean
            filtered.covariances[t, b] = covariance


@njit(cache=True, error_model="numpy")
def _update(
    measuring: tuple[Array, Array, Array], mean: Array, covariance: Array, updates: tuple[Array, Array, Array]
) -> None:
    """Condition the mean and the covariance on a row's components, one after the other.

    Args:
        measuring, updates: a row of `Measuring` and of `Updates`; the latter is filled.
        mean, covariance: `(D,)` and `(D, D)`, overwritten.
    """
    residuals, by_states, precisions = measuring
    innovations, variances, gains = updates
    components, dimension = by_states.shape
    for k in range(components):
        gain = gains[k]
        gain[:] = 0.0
        innovations[k] = 0.0
        variances[k] = 1.0
        if precisions[k] == 0.0:
            continue
        by_state = by_states[k]
        variance, innovation = 1.0 / precisions[k], residuals[k]
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
        innovations[k] = innovation
        variances[k] = variance


@njit(cache=True, error_model="numpy")
def _outer(factor: Array, out: Array) -> None:
    """factor factorᵀ."""
    for i in range(factor.shape[0]):
        for j in range(factor.shape[0]):
            out[i, j] = 0.0
            for c in range(factor.shape[1]):
                out[i, j] += factor[i, c] * factor[j, c]


@njit(cache=True, error_model="numpy")
def backward(
    filtered: Moments,
    updates: Updates,
    moving: Moving,
    by_state: Array,
    arrival: Array,
    reading: Array,
    smoothed: Array,
) -> None:
    """The scores of log p(y): its derivatives by a push on the state of every row and by a shift of every measurement.

    De Jong (1989): what is left of later innovations, carried back. Gᵀ arrival is the posterior mean of the noise.

    Args:
        filtered, updates, moving: of `forward`.
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
                smoothed[t, b, i] = filtered.means[t, b, i]
                for j in range(dimension):
                    smoothed[t, b, i] += filtered.covariances[t, b, i, j] * later[j]
            for k in range(components - 1, -1, -1):
                gain = updates.gain[t, b, k]
                score = updates.innovation[t, b, k] / updates.variance[t, b, k]
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
                        moved[j] += moving.state[t - 1, b, i, j] * later[i]
                later[:] = moved


@njit(cache=True, error_model="numpy")
def spread_ahead(
    horizon: int,
    covariances: Array,
    moving: Moving,
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
    channels = moving.noise.shape[3]
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
                    noise, step = moving.noise[back, b], moving.state[back, b]
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
