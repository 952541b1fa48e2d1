"""Fixes: the pose that one row's bearings tell, without the rows around it and without the true states."""

from __future__ import annotations

import sys
from dataclasses import replace

import pytest
import torch
from examples import drives, example
from small import simulated

from steady_ppl import DataError, fixes, for_program, seeded
from steady_ppl.utils.angles import wrap


def found(program, data):
    with seeded(1):
        return fixes(program, data)


def test_sharp_bearings_tell_the_pose() -> None:
    program = example("hovercraft")
    program.bearing_sd = 1e-4
    data = drives(program, 3, 21)
    states = found(program, data)
    away = (states - data.states)[..., :3]
    away[..., 2] = wrap(away[..., 2])
    assert float(away.abs().max()) < 0.02  # a tenth of a milliradian, ten metres away, at bad angles
    assert bool(states[..., 3:].isnan().all())


def test_what_does_not_tell_it_is_left_open() -> None:
    program = example("hovercraft")
    data = drives(program, 2, 21, gaps=True)
    states = found(program, data)
    enough = (data.observed.sum(-1) >= 3) & data.rows
    assert bool(enough.any()) and not bool(enough[data.rows].all())
    assert torch.equal(states[..., :3].isfinite().all(-1), enough)
    program.landmarks = program.landmarks[:2]
    with pytest.raises(DataError, match="measurements enough, 3, to tell x, y, heading"):
        found(program, for_program(program, simulated(rows=21)))


def test_how_the_program_moves_says_nothing_of_a_row() -> None:
    """The same measurements in reverse order have the same fixes."""
    program = example("hovercraft")
    data = drives(program, 3, 21)
    first = found(program, data)
    turned = replace(data, measurements=data.measurements.flip(0), observed=data.observed.flip(0))
    again = found(program, turned).flip(0)
    away = (again - first)[..., :3]
    away[..., 2] = wrap(away[..., 2])
    assert float(away.abs().max()) < 1e-3


def test_no_measurement_at_all_is_said() -> None:
    program = example("hovercraft")
    data = drives(program, 2, 11)
    with pytest.raises(DataError, match="nothing is measured"):
        found(program, replace(data, observed=torch.zeros_like(data.observed)))


def test_many_drives_go_in_parts(monkeypatch) -> None:
    program = example("hovercraft")
    data = drives(program, 5, 11)
    whole = found(program, data)
    monkeypatch.setattr(sys.modules[fixes.__module__], "MAX_ROWS_OF_BATCH", 2 * 32 * 11)
    torch.testing.assert_close(found(program, data), whole, equal_nan=True)


def test_a_pendulums_angle_is_told_by_its_encoder() -> None:
    program = example("pendulum")
    data = drives(program, 2, 11)
    states = found(program, data)
    assert float((states[..., 0] - data.measurements[..., 0]).abs().max()) < 0.2 and bool(states[..., 1].isnan().all())


def test_true_states_are_not_looked_at() -> None:
    program = example("hovercraft")
    data = drives(program, 2, 11)
    lies = replace(data, states=torch.full_like(data.states, 7.0))
    assert torch.equal(found(program, data).nan_to_num(), found(program, lies).nan_to_num())
    assert torch.equal(found(program, data).nan_to_num(), found(program, data.without_truth()).nan_to_num())
