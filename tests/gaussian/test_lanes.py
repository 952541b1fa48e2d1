"""Trajectories that share a block of lanes have nothing to do with one another."""

from __future__ import annotations

import math

import pytest
import torch
from examples import drives, example
from paths import anywhere
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.information_filter import look_ahead
from steady_ppl.gaussian.linearize import ReferencePath, linearize
from steady_ppl.gaussian.posterior_moments import posterior_moments
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program


def found(program: Program, data: Trajectories, path: ReferencePath) -> list[Tensor]:
    """What the recursions come to, trajectories first."""
    ahead = look_ahead(linearize(Problem(program, data), path))
    moments = posterior_moments(ahead, data)
    of_rows = (ahead.precision, ahead.information, *ahead.means(), *ahead.covariances())
    arrays = (moments.lag, *moments.channels, *moments.measurements)
    last = (torch.from_numpy(array).movedim(-1, 0) for array in arrays)
    return [ahead.log_likelihood, *(part.movedim(1, 0) for part in of_rows), *last]


@pytest.mark.parametrize("name", ["linear_gaussian", "pendulum", "hovercraft"])
@pytest.mark.parametrize("count", [3, 8, 9, 17])
def test_each_trajectory_is_as_it_is_alone(name: str, count: int) -> None:
    program = example(name)
    data = drives(program, count, 3)
    path = anywhere(program, data)
    together = found(program, data, path)
    for index in {0, 7 % count, count - 1}:
        own = ReferencePath(*(part[:, index : index + 1] for part in (path.states, path.noise)))
        for part, alone in zip(together, found(program, data.subset(torch.tensor([index])), own), strict=True):
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
