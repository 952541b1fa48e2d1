"""Sets of simulated drives: in blocks as at once, and those that blow up are left out and counted."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from oracles import assert_mean

import steady_ppl.criticism.reference_sets as simulated
from steady_ppl import FilterError
from steady_ppl.model.program import for_program
from steady_ppl.utils.random import seeded


def made(program, data, starts, known_start: bool = True):
    with seeded(0, "sets"):
        return simulated.simulate_sets(program, data, starts, 1, [1, 5], known_start=known_start)


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
