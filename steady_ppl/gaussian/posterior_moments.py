"""Posterior means and variances of standardised deviations, of channels and of measurements; compiled, see `lanes`.

Beside each stand three points of the state, for expectations of what the deviation multiplies: see `likelihood.scores`.
Of measurements there are points only where something was measured: of many sensors most may see nothing in a row.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.information_filter import Lookahead, Steering
from steady_ppl.gaussian.lanes import Array, add_outer, add_product, is_some, out_of_lanes, set_scaled
from steady_ppl.gaussian.linearize import LinearArrays

Places = np.ndarray[Any, np.dtype[np.int64]]


class Moments(NamedTuple):
    """Deviations of one kind, with the components first."""

    mean: Array  # (C, rows, B), posterior means
    variance: Array  # (C, rows, B), posterior variances
    points: Array  # x̂, x̂ + v and x̂ − v for each component, v = Cov(x, z), (D, 1 + 2 C, rows, B) of channels

    def tensors(self, device: torch.device) -> dict[str, Tensor]:
        """By name, with the components last."""
        return {name: torch.from_numpy(part).movedim(0, -1).to(device) for name, part in self._asdict().items()}


class Cells(NamedTuple):
    """Where something was measured: M cells, component by component and row by row, in V rows of all trajectories.

    A cell has three of the V + 2 M points: x̂ of its row, one for all its cells, x̂ + v and x̂ − v.
    """

    rows: Tensor  # (V,), each counted through all trajectories: row · B + trajectory
    component: Tensor  # (M,)
    row: Tensor  # (M,), as in `rows`
    points: Tensor  # (3, M)
    ends: list[int]  # (K + 1,), how many cells the components before each one have

    @classmethod
    def of(cls, present: Tensor) -> Cells:
        """The cells `(T + 1, B, K)` that are present."""
        by_row = present.flatten(0, 1)
        seen = by_row.any(-1)
        rows = seen.nonzero().flatten()
        component, row = by_row.t().nonzero().unbind(-1)
        here, own = seen.cumsum(0)[row] - 1, torch.arange(len(row), device=row.device)
        points = torch.stack([here, len(rows) + own, len(rows) + len(row) + own])
        return cls(rows, component, row, points, [0, *by_row.sum(0).cumsum(0).tolist()])

    def of_component(self, index: int) -> slice:
        """Which cells are those of one component."""
        return slice(self.ends[index], self.ends[index + 1])

    def of_components(self, components: Tensor) -> tuple[Tensor, Tensor]:
        """The cells of `components`, one after another: the place of each in these, and which it is, `(N,)`."""
        ends = torch.tensor(self.ends, device=components.device)
        first, count = ends[components], ends[components + 1] - ends[components]
        place = torch.repeat_interleave(count)
        return place, first[place] + torch.arange(len(place), device=place.device) - (count.cumsum(0) - count)[place]

    @property
    def total(self) -> int:
        """How many points there are."""
        return len(self.rows) + 2 * len(self.row)


class Posterior(NamedTuple):
    """Moments of a linearised program's posterior."""

    states: Tensor  # means x̂ (T + 1, B, D), the first row's past a trajectory's end
    channels: Moments
    measurements: Moments  # zero where nothing was measured; points (D, N) in the order of `cells`
    cells: Cells
    lag: Array  # covariances of each channel's deviation with its last one, (C, T, B), zero at the first


def posterior_moments(ahead: Lookahead, data: Trajectories) -> Posterior:
    """The moments in double precision, or in single as the data are: programs read the points as such."""
    linear = ahead.linearization
    (rows, drives, components, dimension), channels = linear.measurement.shape, linear.noise.shape[-1]
    number = torch.empty(0, dtype=data.controls.dtype).numpy().dtype

    along = (channels, rows - 1, drives)
    driven = Moments(*(np.empty(s, number) for s in (along, along, (dimension, 1 + 2 * channels, *along[1:]))))
    cells, seen = Cells.of(linear.precision > 0), (components, rows, drives)
    measured = Moments(np.zeros(seen, number), np.zeros(seen, number), np.empty((dimension, cells.total), number))
    places = np.full((components, rows * drives), -1, np.int64)
    places[cells.component.numpy(force=True), cells.row.numpy(force=True)] = cells.points[1].numpy(force=True)
    moved, noise = ahead.means_in_lanes()
    device = linear.offset.device
    states = linear.path.states + out_of_lanes(moved, drives).squeeze(-1).to(device)
    states = torch.where(data.rows.unsqueeze(-1), states, states[:1])
    means = states.movedim(-1, 0).contiguous().numpy(force=True)
    lag, spread = np.zeros(along), ahead.covariances_in_lanes
    measured.points[:, : len(cells.rows)] = means.reshape(dimension, -1)[:, cells.rows.numpy(force=True)]
    below = len(cells.row)  # from x̂ + v to x̂ − v
    fill_moments(ahead.given, ahead.steering, (moved, noise), spread, means, driven, measured, places, below, lag)
    return Posterior(states, driven, measured, cells, lag)


@njit(cache=True, error_model="numpy")
def fill_moments(
    given: LinearArrays,
    steering: Steering,
    posterior: tuple[Array, Array],
    covariances: tuple[Array, Array, Array],
    states: Array,
    channels: Moments,
    measurements: Moments,
    places: Places,
    below: int,
    lag: Array,
) -> None:
    """`posterior_moments` from means and covariances in lanes.

    `states` are x̂ `(D, T + 1, B)`, `places` `(K, (T + 1) B)` are the points x̂ + v of cells or −1, and x̂ − v come
    `below` after these.
    """
    (deviations, noise), (spread, every, sway) = posterior, covariances
    rows, blocks, count, dimension, lanes = given.measurement.shape
    drives, driven = states.shape[2], noise.shape[2]
    then, shift = np.zeros((dimension, driven, lanes)), np.zeros((driven, driven, lanes))
    weight, apart, variance = np.zeros((1, 1, lanes)), np.zeros((1, 1, lanes)), np.zeros((1, 1, lanes))
    by_state, across = np.zeros((1, dimension, lanes)), np.zeros((dimension, 1, lanes))
    for t in range(rows):
        for k in range(blocks):
            few = min(lanes, drives - k * lanes)
            for a in range(count):
                precision = given.precision[t, k, a : a + 1]
                if not is_some(precision):
                    continue
                for lane in range(lanes):
                    weight[0, 0, lane] = math.sqrt(precision[0, 0, lane])
                set_scaled(apart, given.residual[t, k, a : a + 1], weight)
                set_scaled(by_state, given.measurement[t, k, a : a + 1], weight)
                across[:], variance[:] = 0.0, 0.0
                add_product(apart, by_state, deviations[t, k], -1.0)
                add_outer(across, spread[t, k], by_state, -1.0)
                add_product(variance, by_state, across, -1.0)
                for lane in range(few):
                    drive = k * lanes + lane
                    place = places[a, t * drives + drive]
                    if place >= 0:
                        measurements.mean[a, t, drive] = apart[0, 0, lane]
                        measurements.variance[a, t, drive] = variance[0, 0, lane]
                        for i in range(dimension):
                            measurements.points[i, place] = states[i, t, drive] + across[i, 0, lane]
                            measurements.points[i, place + below] = states[i, t, drive] - across[i, 0, lane]
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
