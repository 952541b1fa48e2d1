"""Posterior means and variances of standardised deviations, of channels and of measurements; compiled, see `lanes`.

Beside each stand three points of the state, for expectations of what the deviation multiplies: see `likelihood.scores`.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.information_filter import Lookahead, Steering
from steady_ppl.gaussian.lanes import Array, add_outer, add_product, out_of_lanes, set_scaled
from steady_ppl.gaussian.linearize import LinearArrays


class Moments(NamedTuple):
    """Deviations of one kind, with the components first."""

    mean: Array  # (C, rows, B), posterior means
    variance: Array  # (C, rows, B), posterior variances
    points: Array  # x̂, x̂ + v and x̂ − v for each component, v = Cov(x, z), (D, 1 + 2 C, rows, B)

    def tensors(self, device: torch.device) -> dict[str, Tensor]:
        """By name, with the components last."""
        return {name: torch.from_numpy(part).movedim(0, -1).to(device) for name, part in self._asdict().items()}


class Posterior(NamedTuple):
    """Moments of a linearised program's posterior."""

    states: Tensor  # means x̂ (T + 1, B, D), the first row's past a trajectory's end
    channels: Moments
    measurements: Moments
    lag: Array  # covariances of each channel's deviation with its last one, (C, T, B), zero at the first


def posterior_moments(ahead: Lookahead, data: Trajectories) -> Posterior:
    """The moments in double precision, or in single as the data are: programs read the points as such."""
    linear = ahead.linearization
    (rows, drives, components, dimension), channels = linear.measurement.shape, linear.noise.shape[-1]
    number = torch.empty(0, dtype=data.controls.dtype).numpy().dtype

    def empty(rows: int, count: int) -> Moments:
        shapes = (count, rows, drives), (count, rows, drives), (dimension, 1 + 2 * count, rows, drives)
        return Moments(*(np.empty(shape, number) for shape in shapes))

    moved, noise = ahead.means_in_lanes()
    device = linear.offset.device
    states = linear.path.states + out_of_lanes(moved, drives).squeeze(-1).to(device)
    states = torch.where(data.rows.unsqueeze(-1), states, states[:1])
    means = states.movedim(-1, 0).contiguous().numpy(force=True)
    lag = np.zeros((channels, rows - 1, drives))
    found = Posterior(states, empty(rows - 1, channels), empty(rows, components), lag)
    fill_moments(ahead.given, ahead.steering, (moved, noise), ahead.covariances_in_lanes(), means, *found[1:])
    return found


@njit(cache=True, error_model="numpy")
def fill_moments(
    given: LinearArrays,
    steering: Steering,
    posterior: tuple[Array, Array],
    covariances: tuple[Array, Array, Array],
    states: Array,
    channels: Moments,
    measurements: Moments,
    lag: Array,
) -> None:
    """`posterior_moments` from means and covariances in lanes; `states` are x̂ `(D, T + 1, B)`."""
    (deviations, noise), (spread, every, sway) = posterior, covariances
    rows, blocks, count, dimension, lanes = given.measurement.shape
    drives, driven = states.shape[2], noise.shape[2]
    then, shift = np.zeros((dimension, driven, lanes)), np.zeros((driven, driven, lanes))
    weight, apart = np.zeros((count, 1, lanes)), np.zeros((count, 1, lanes))
    by_state = np.zeros((count, dimension, lanes))
    across, variance = np.zeros((dimension, count, lanes)), np.zeros((count, count, lanes))
    for t in range(rows):
        for k in range(blocks):
            few = min(lanes, drives - k * lanes)
            for a in range(count):
                for lane in range(lanes):
                    weight[a, 0, lane] = math.sqrt(given.precision[t, k, a, 0, lane])
            set_scaled(apart, given.residual[t, k], weight)
            set_scaled(by_state, given.measurement[t, k], weight)
            across[:], variance[:] = 0.0, 0.0
            add_product(apart, by_state, deviations[t, k], -1.0)
            add_outer(across, spread[t, k], by_state, -1.0)
            add_product(variance, by_state, across, -1.0)
            _fill_row(measurements, t, k * lanes, few, apart, variance, states, across)
            if t + 1 < rows:
                _fill_row(channels, t, k * lanes, few, noise[t, k], every[t, k], states, sway[t, k])
            if t + 2 < rows:
                then[:], shift[:] = 0.0, 0.0
                add_product(then, given.state[t, k], sway[t, k], 1.0)
                add_product(then, given.noise[t, k], every[t, k], 1.0)
                add_product(shift, steering.gain[t + 1, k], then, -1.0)
                for c in range(driven):
                    for lane in range(few):
                        lag[c, t + 1, k * lanes + lane] = shift[c, c, lane]


@njit(cache=True, error_model="numpy")
def _fill_row(
    out: Moments, t: int, first: int, few: int, mean: Array, variance: Array, states: Array, across: Array
) -> None:
    """One row of one block of trajectories, of which `first` is the first."""
    count = len(mean)
    for c in range(count):
        for lane in range(few):
            out.mean[c, t, first + lane] = mean[c, 0, lane]
            out.variance[c, t, first + lane] = variance[c, c, lane]
    for i in range(len(states)):
        for lane in range(few):
            out.points[i, 0, t, first + lane] = states[i, t, first + lane]
        for c in range(count):
            for lane in range(few):
                here, push = states[i, t, first + lane], across[i, c, lane]
                out.points[i, 1 + c, t, first + lane] = here + push
                out.points[i, 1 + count + c, t, first + lane] = here - push
