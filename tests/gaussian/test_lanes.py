"""Trajectories that share a block of lanes have nothing to do with one another."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from examples import drives, example
from paths import anywhere
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.information_filter import look_ahead
from steady_ppl.gaussian.lanes import Array, in_lanes, out_of_lanes
from steady_ppl.gaussian.linearize import ReferencePath, linearize
from steady_ppl.gaussian.posterior_moments import Posterior, posterior_moments
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program


def found(program: Program, data: Trajectories, path: ReferencePath) -> list[Tensor]:
    """What the recursions come to, trajectories first."""
    ahead = look_ahead(linearize(Problem(program, data), path))
    moments = posterior_moments(ahead, data)
    of_rows = (ahead.precision, ahead.information, *ahead.means(), *ahead.covariances())
    arrays = (moments.lag, *moments.channels, *moments.measurements[:2])
    last = (torch.from_numpy(array).movedim(-1, 0) for array in (*arrays, points_by_trajectory(moments)))
    return [ahead.log_likelihood, *(part.movedim(1, 0) for part in of_rows), *last]


def points_by_trajectory(moments: Posterior) -> Array:
    """The measurements' points, `(D, 3, K, rows, B)`, zero where nothing was measured."""
    count, rows, drives = moments.measurements.mean.shape
    points, cells = moments.measurements.points, moments.cells
    found = np.zeros((len(points), 3, count, rows * drives), points.dtype)
    found[:, :, cells.component, cells.row] = points[:, cells.points]
    return found.reshape(*found.shape[:3], rows, drives)


def test_points_are_where_something_is_measured() -> None:
    """Three of a cell, of which the one at the mean is that of all cells of a row."""
    program = example("gps_boat")
    data = drives(program, 9, 12, gaps=True)
    seen = data.observed
    moments = posterior_moments(look_ahead(linearize(Problem(program, data), anywhere(program, data))), data)
    cells = moments.cells
    assert 0 < int(seen.sum()) < seen.numel()
    assert cells.total == moments.measurements.points.shape[1] == int(seen.any(-1).sum() + 2 * seen.sum())
    assert torch.equal(torch.stack([cells.row, cells.component], -1), _sorted_by_component(seen))
    middle = torch.from_numpy(moments.measurements.points).t()[cells.points[0]]
    assert torch.equal(middle, moments.states.flatten(0, 1)[cells.row].to(middle))
    for index in range(seen.shape[-1]):
        assert bool((cells.component[cells.of_component(index)] == index).all())


def _sorted_by_component(seen: Tensor) -> Tensor:
    return seen.flatten(0, 1).t().nonzero().flip(-1)


@pytest.mark.parametrize("name", ["linear_gaussian", "pendulum", "hovercraft"])
@pytest.mark.parametrize("count", [3, 8, 9, 17])
def test_each_trajectory_is_as_it_is_alone(name: str, count: int) -> None:
    program = example(name)
    data = drives(program, count, 3)
    path = anywhere(program, data)
    together = found(program, data, path)
    for index in {0, 7 % count, count - 1}:
        for part, alone in zip(
            together, found(program, data.subset(torch.tensor([index])), path.subset([index])), strict=True
        ):
            torch.testing.assert_close(part[index], alone[0], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("count", [2, 5, 9])
def test_one_that_is_no_number_leaves_the_others_as_they_are(count: int, value: float) -> None:
    program = example("hovercraft")
    data = drives(program, count, 3)
    path = anywhere(program, data)
    before = found(program, data, path)
    path.states[1, 1] = value
    after = found(program, data, path)
    assert not bool(after[0][1].isfinite())
    others = torch.arange(count) != 1
    for part, expected in zip(after, before, strict=True):
        assert torch.equal(part[others], expected[others])


@pytest.mark.parametrize("drives", [1, 2, 3, 8, 9, 16])
def test_lanes_hold_what_they_are_given_and_zeros_beyond(drives: int) -> None:
    given = torch.randn(4, drives, 3, 2, dtype=torch.float64)
    blocks = in_lanes(given)
    assert blocks.flags.c_contiguous
    assert torch.equal(out_of_lanes(blocks, drives), given)
    assert not torch.from_numpy(blocks).movedim(-1, 2).flatten(1, 2)[:, drives:].any()
