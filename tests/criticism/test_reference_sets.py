"""Sets of simulated drives: in blocks as at once, and those that blow up are left out and counted."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from examples import drives, example
from oracles import assert_mean

import steady_ppl.criticism.reference_sets as simulated
from steady_ppl import FilterError
from steady_ppl.criticism.perturbations import directions
from steady_ppl.gaussian.predict import simulate_again
from steady_ppl.gaussian.smoother import smooth
from steady_ppl.kernels import rows as rows_by_kernels
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import for_program
from steady_ppl.utils import cores
from steady_ppl.utils.cores import one_core
from steady_ppl.utils.random import seeded


def made(program, data, starts, known_start: bool = True):
    with seeded(0, "sets"):
        return simulated.simulate_sets(Problem(program, data, known_start), starts, 1, [1, 5])


def arrays(sets) -> dict[str, np.ndarray]:
    """Every figure with one row a set."""
    found = {"values": sets.residuals.values, "there": sets.residuals.there, **sets.residuals.variables}
    found |= {f"floor {horizon}": value for horizon, value in sets.floor.items()}
    return found | {one.name: one.scores.view(sets.sets, -1).numpy() for one in sets.directions}


@pytest.fixture
def starts(cart, even):
    return for_program(cart, even).known_start.expand(40, -1, -1).clone()


def test_blocks_are_the_sets_they_are_made_of(cart, even, starts, monkeypatch):
    data = for_program(cart, even)
    few = arrays(made(cart, data, starts[:25]))
    at_once = made(cart, data, starts)
    monkeypatch.setattr(simulated, "MAX_ROWS_OF_BLOCK", 25 * data.time.numel())
    blocks = made(cart, data, starts)
    assert blocks.sets == at_once.sets == 40
    found = arrays(blocks)
    assert found.keys() == few.keys() == arrays(at_once).keys()
    for name, value in found.items():
        assert len(value) == 40
        assert np.array_equal(value[:25], few[name], equal_nan=True), name
    first, rest = blocks.residuals.values[:15], blocks.residuals.values[25:]
    assert not np.array_equal(first, rest)
    assert_mean(torch.as_tensor(found["floor 1"][:, 0] - arrays(at_once)["floor 1"][:, 0]), 0.0)


def test_sets_that_blow_up_are_left_out_and_counted(cart, even, starts):
    data = for_program(cart, even)
    starts[[3, 20], 0] = torch.inf
    found = made(cart, data, starts, known_start=False)
    assert found.sets == 38
    assert all(len(value) == 38 for value in arrays(found).values())
    assert np.isfinite(found.residuals.values).all()
    assert all(torch.isfinite(one.scores).all() for one in found.directions)


def test_too_few_that_did_not_blow_up_is_an_error(cart, even, starts, monkeypatch):
    data = for_program(cart, even)
    monkeypatch.setattr(simulated, "MAX_ROWS_OF_BLOCK", 10 * data.time.numel())
    starts[:21] = torch.inf
    with pytest.raises(FilterError, match="21 of 40 simulated sets blew up"):
        made(cart, data, starts, known_start=False)


def test_sets_do_not_depend_on_how_many_cores_there_are(cart, even, starts, monkeypatch):
    data = for_program(cart, even)
    monkeypatch.setattr(simulated, "MAX_ROWS_OF_BLOCK", 7 * data.time.numel())
    monkeypatch.setattr(cores, "_cores", lambda: 3)
    several = arrays(made(cart, data, starts))
    with one_core():
        for name, value in arrays(made(cart, data, starts)).items():
            assert np.array_equal(value, several[name], equal_nan=True), name


@pytest.mark.parametrize("known_start", [True, False])
def test_paths_are_those_of_more_linearisations(known_start):
    """Of drives of two lengths, one of which passes a landmark by some centimetres."""
    program = example("hovercraft.py:HovercraftTruth", torch.float32)
    program.landmarks = (*program.landmarks[:3], (0.7, 1.1))
    data = drives(program, 6, 41)
    data.lengths[2] = 23
    with seeded(1, "again"):
        again, truth = simulate_again(program, data, data.known_start.expand(4, -1, -1), 3)
    _, tracked = simulated._tracked(Problem(program, again, known_start), truth)
    rested = smooth(Problem(program, again, known_start), truth, passes=simulated.MAX_LINEARISATIONS)
    means, noise = rested.means()
    inside = again.transitions[..., None]
    torch.testing.assert_close(tracked.noise * inside, noise * inside, rtol=0, atol=3 * simulated.REST_TOLERANCE)
    apart = (tracked.smoothed - means).abs().amax(-1)[again.rows]
    assert float(apart.max()) < 0.05


def test_scores_of_parameters_by_kernels_are_those_by_differences(monkeypatch):
    program = example("hovercraft.py:HovercraftTruth", torch.float32)
    data = drives(program, 5, 41)
    with seeded(1, "again"):
        again, truth = simulate_again(program, data, data.known_start.expand(2, -1, -1), 3)
    _, tracked = simulated._tracked(Problem(program, again, known_start=True), truth)
    found = []
    for rows in (1, 10**9):
        monkeypatch.setattr(rows_by_kernels, "ROWS_WORTH_COMPILING", rows)
        found.append({one.name: one.scores for one in directions(program, again, tracked)})
    assert found[0].keys() == found[1].keys() and {"mass", "inertia", "drag[2]"} <= found[0].keys()
    for name, scores in found[0].items():
        size = float(found[1][name].abs().max())
        torch.testing.assert_close(scores, found[1][name], rtol=0.01, atol=0.01 * size, msg=name)
