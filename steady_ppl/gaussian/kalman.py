"""Kalman filter and smoother of the linearised program, and how log p(y) changes by row.

The scores are the derivatives of log p(y) by a push on the state of any row and by a shift of any measurement (de Jong
1989; Harvey and Koopman 1992 call them auxiliary residuals). Their sums over rows test for anything that pushes or
shifts. They are no estimates: the smoother has believed the program, so that a missing effect appears in them a tenth
of its size.

The recursions are compiled, on numpy arrays in double precision; rows or intervals first, trajectories second. Products
of small matrices are written out: NumPy's own call BLAS, which at six rows takes longer than the product.

The notation is that of `linearize`: δ' = F δ + offset + G ε, and a measurement's residual r̄ − H δ with the given
precision, zero where it is missing.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.lanes import Array, array, put
from steady_ppl.gaussian.linearize import LinearArrays, Linearization, ReferencePath, linearize
from steady_ppl.model.problem import Problem


class FilteredMoments(NamedTuple):
    """The states given the measurements up to each row, and what each measured component changes, given those before
    it; zero, one and zero where it is missing."""

    means: Array  # (T + 1, B, D)
    covariances: Array  # (T + 1, B, D, D)
    innovation: Array  # (T + 1, B, K)
    variance: Array  # (T + 1, B, K)
    gain: Array  # (T + 1, B, K, D)


@dataclass(frozen=True)
class Tracked:
    """The Kalman filter and smoother of a linearised program, in double precision."""

    linearization: Linearization  # of the program, along the path that the last pass began with
    states: Tensor  # (T + 1, B, D), given the measurements up to each row
    covariances: Tensor  # (T + 1, B, D, D), of these
    smoothed: Tensor  # (T + 1, B, D), the states given all measurements
    noise: Tensor  # (T, B, C), E[ε | y]: also the score of a push by each channel, per standard deviation of it
    arrival: Tensor  # (T + 1, B, D), the score of a push on the state that each row begins with
    reading: Tensor  # (T + 1, B, K), the score of a shift of each measurement; zero where it is missing
    log_likelihood: Tensor  # (B,), log p(y)

    def path(self, data: Trajectories) -> ReferencePath:
        """The posterior mean as a path to linearise along."""
        return ReferencePath.of_means(self.smoothed, self.noise, data, self.linearization.path.variance)

    def variances_ahead(self, horizon: int) -> Tensor:
        """Variances of measurements predicted `horizon` rows ahead, `(T + 1 − horizon, B, K)`; NaN where missing."""
        return torch.from_numpy(spread_ahead(self.linearization.arrays(), array(self.covariances), horizon))


def track(problem: Problem, path: ReferencePath, *, passes: int = 2, kernels: bool | None = None) -> Tracked:
    """Linearise along a path near the posterior's mode, filter and smooth, and again along what was smoothed, in so
    many passes; `kernels` is that of `linearize`."""
    tracked = filter_and_smooth(linearize(problem, path, kernels=kernels))
    for _ in range(passes - 1):
        tracked = filter_and_smooth(linearize(problem, tracked.path(problem.data), kernels=kernels))
    return tracked


def filter_and_smooth(linear: Linearization) -> Tracked:
    """Run the recursions along a linearization."""
    rows, drives, components, dimension = linear.measurement.shape
    shapes = (dimension,), (dimension, dimension), (components,), (components,), (components, dimension)
    given, filtered = linear.arrays(), FilteredMoments(*(np.empty((rows, drives, *shape)) for shape in shapes))
    forward(given, filtered)
    arrival, smoothed = np.empty_like(filtered.means), np.empty_like(filtered.means)
    reading = np.empty_like(filtered.innovation)
    backward(given, filtered, arrival, reading, smoothed)
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.log(np.where(given.precision > 0, filtered.variance * given.precision, 1.0))
        misfit = filtered.innovation**2 / filtered.variance + excess
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


@njit(cache=True, error_model="numpy")
def forward(given: LinearArrays, filtered: FilteredMoments) -> None:
    """Kalman (1960), a measurement component at a time. Fills `filtered`."""
    rows, trajectories, _ = filtered.means.shape
    for t in range(rows):  # outside, as the arrays lie in memory
        for b in range(trajectories):
            mean, covariance = filtered.means[t, b], filtered.covariances[t, b]
            if t == 0:
                put(mean, given.start_offset[b])
                set_product(covariance, given.start_noise[b], given.start_noise[b].T)
            else:
                put(mean, given.offset[t - 1, b])
                add_times(mean, given.state[t - 1, b], filtered.means[t - 1, b])
                before = filtered.covariances[t - 1, b]
                propagate(covariance, before, given.state[t - 1, b], given.noise[t - 1, b])
            _update(given, filtered, t, b)


@njit(cache=True, error_model="numpy")
def _update(given: LinearArrays, filtered: FilteredMoments, t: int, b: int) -> None:
    """Condition the mean and the covariance, in place, on a row's components, one after the other."""
    components, dimension = given.measurement.shape[2:]
    mean, covariance = filtered.means[t, b], filtered.covariances[t, b]
    for k in range(components):
        gain, by_state, precision = filtered.gain[t, b, k], given.measurement[t, b, k], given.precision[t, b, k]
        gain[:] = 0.0
        variance, innovation = 1.0, 0.0
        if precision != 0.0:
            variance, innovation = 1.0 / precision, given.residual[t, b, k]
            add_times(gain, covariance, by_state)
            for i in range(dimension):
                innovation -= by_state[i] * mean[i]
                variance += by_state[i] * gain[i]
            for i in range(dimension):
                gain[i] /= variance
                mean[i] += gain[i] * innovation
            for i in range(dimension):
                for j in range(dimension):
                    covariance[i, j] -= gain[i] * gain[j] * variance
        filtered.innovation[t, b, k], filtered.variance[t, b, k] = innovation, variance


@njit(cache=True, error_model="numpy")
def backward(given: LinearArrays, filtered: FilteredMoments, arrival: Array, reading: Array, smoothed: Array) -> None:
    """Fill the scores of log p(y), `arrival` and `reading`, and the posterior means `smoothed`; see `Tracked`.

    De Jong (1989): what is left of later innovations, carried back. Gᵀ arrival is the posterior mean of the noise.
    """
    rows, trajectories, components, dimension = given.measurement.shape
    for t in range(rows - 1, -1, -1):
        for b in range(trajectories):
            later = arrival[t, b]
            later[:] = 0.0
            if t < rows - 1:
                add_times(later, given.state[t, b].T, arrival[t + 1, b])
            put(smoothed[t, b], filtered.means[t, b])
            add_times(smoothed[t, b], filtered.covariances[t, b], later)
            for k in range(components - 1, -1, -1):
                gain, by_state = filtered.gain[t, b, k], given.measurement[t, b, k]
                score = filtered.innovation[t, b, k] / filtered.variance[t, b, k]
                for i in range(dimension):
                    score -= gain[i] * later[i]
                for i in range(dimension):
                    later[i] += by_state[i] * score
                reading[t, b, k] = score


@njit(cache=True, error_model="numpy")
def spread_ahead(given: LinearArrays, covariances: Array, horizon: int) -> Array:
    """Variances of measurements `horizon` rows ahead, `(T + 1 − horizon, B, K)`, their own noise included; NaN where
    one is missing. Covariances are of the states given all up to a row, `(T + 1, B, D, D)`."""
    rows, trajectories, components, dimension = given.measurement.shape
    variances = np.empty((rows - horizon, trajectories, components))
    along, moved = np.zeros((components, dimension)), np.zeros((components, dimension))
    pushed = np.zeros((components, given.noise.shape[3]))
    for b in range(trajectories):
        for t in range(rows - horizon):
            put(along, given.measurement[t + horizon, b])
            variance = variances[t, b]
            for k in range(components):
                precision = given.precision[t + horizon, b, k]
                variance[k] = 1.0 / precision if precision != 0.0 else np.nan
            for back in range(t + horizon - 1, t - 1, -1):
                set_product(pushed, along, given.noise[back, b])
                for k in range(components):
                    for push in pushed[k]:
                        variance[k] += push * push
                set_product(moved, along, given.state[back, b])
                put(along, moved)
            for k in range(components):
                for i in range(dimension):
                    for j in range(dimension):
                        variance[k] += along[k, i] * covariances[t, b, i, j] * along[k, j]
    return variances


@njit(cache=True, error_model="numpy", inline="always")
def set_product(out: Array, left: Array, right: Array) -> None:
    """out = left right, of matrices."""
    out[:] = 0.0
    for i in range(out.shape[0]):
        for k in range(left.shape[1]):
            weight = left[i, k]
            for j in range(out.shape[1]):
                out[i, j] += weight * right[k, j]


@njit(cache=True, error_model="numpy", inline="always")
def add_times(out: Array, matrix: Array, vector: Array) -> None:
    """out += matrix vector."""
    for i in range(out.shape[0]):
        entry = out[i]
        for k in range(matrix.shape[1]):
            entry += matrix[i, k] * vector[k]
        out[i] = entry


@njit(cache=True, error_model="numpy", inline="always")
def propagate(out: Array, covariance: Array, moved: Array, spread: Array) -> None:
    """out = moved covariance movedᵀ + spread spreadᵀ, symmetric to the bit; `out` may be the covariance itself."""
    half = np.empty_like(covariance)
    set_product(half, moved, covariance)
    for i in range(out.shape[0]):
        for j in range(i + 1):
            entry = 0.0
            for k in range(moved.shape[1]):
                entry += half[i, k] * moved[j, k]
            for c in range(spread.shape[1]):
                entry += spread[i, c] * spread[j, c]
            out[i, j] = entry
            out[j, i] = entry
