"""Stretches of a table that nobody measured: found to the row, left out when asked, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from examples import example

import steady_ppl as st
from steady_ppl.data.frozen_sensors import MIN_STRETCH_ROWS, frozen_stretches, without_stretches


def table(rows: int = 61) -> st.Trajectories:
    program = example("hovercraft.py:HovercraftTruth")
    program.duration = (rows - 1) * program.step
    return st.simulate(program, 3, seed=4)


def interpolated(values: torch.Tensor, first: int, last: int) -> torch.Tensor:
    """A drive's column with a straight line between two rows."""
    share = torch.linspace(0, 1, last - first + 1, dtype=values.dtype)
    values = values.clone()
    values[first : last + 1] = values[first] + share * (values[last] - values[first])
    return values


def test_a_simulation_has_none() -> None:
    assert frozen_stretches(table()) == []


def test_a_gap_filled_by_interpolation_is_found_to_the_row() -> None:
    data = table()
    states = data.states.clone()
    for component in (0, 1):
        states[:, 1, component] = interpolated(states[:, 1, component], 20, 41)
    (found,) = frozen_stretches(replace(data, states=states))
    assert (found.drive, found.label, found.rows) == (1, data.labels[1], (20, 41))
    assert found.columns == ("x.x", "x.y") and found.seconds == pytest.approx((2.0, 4.1))
    assert "trajectory 2 between 2.00 and 4.10 s: x.x, x.y" in str(found)


def test_a_sensor_that_hangs_is_found_and_a_short_rest_is_not() -> None:
    data = table()
    measurements = data.measurements.clone()
    measurements[10 : 10 + MIN_STRETCH_ROWS, 0, 2] = measurements[10, 0, 2]
    measurements[30 : 30 + MIN_STRETCH_ROWS - 2, 2, 1] = measurements[30, 2, 1]
    (found,) = frozen_stretches(replace(data, measurements=measurements))
    assert (found.drive, found.rows, found.columns) == (0, (10, 10 + MIN_STRETCH_ROWS - 1), ("y.bearing_2",))


def test_overlapping_stretches_of_a_drive_are_one_and_a_column_that_never_scatters_is_none() -> None:
    data = table()
    states = data.states.clone()
    states[:, 0, 0] = interpolated(states[:, 0, 0], 10, 30)
    states[:, 0, 1] = interpolated(states[:, 0, 1], 25, 45)
    states[..., 3] = 0.2
    (found,) = frozen_stretches(replace(data, states=states))
    assert found.rows == (10, 45) and found.columns == ("x.x", "x.y")


def test_masking_takes_measurements_and_states_of_the_stretch_alone() -> None:
    data = table()
    states = data.states.clone()
    states[:, 1, 0] = interpolated(states[:, 1, 0], 0, 21)
    there = replace(data, states=states)
    kept = without_stretches(there, frozen_stretches(there))
    assert not kept.observed[:22, 1].any() and kept.observed[22:, 1].all() and kept.observed[:, [0, 2]].all()
    assert torch.isfinite(kept.states[0]).all()  # a known start stays
    assert kept.states[1:22, 1].isnan().all() and torch.equal(kept.states[22:, 1], there.states[22:, 1])
    assert frozen_stretches(kept) == []


def test_a_vehicle_at_rest_is_left_alone_and_a_sensor_that_hangs_meanwhile_is_masked_alone() -> None:
    data = table()
    states, measurements = data.states.clone(), data.measurements.clone()
    states[20:50, 0] = states[20, 0]
    assert frozen_stretches(replace(data, states=states)) == []
    measurements[30:45, 0, 2] = measurements[30, 0, 2]
    there = replace(data, states=states, measurements=measurements)
    (found,) = frozen_stretches(there)
    assert found.rows == (30, 44) and found.columns == ("y.bearing_2",)
    kept = without_stretches(there, [found])
    assert not kept.observed[30:45, 0, 2].any() and int((~kept.observed).sum()) == 15
    assert torch.equal(kept.states, there.states)


def test_an_angle_that_comes_round_is_on_a_line() -> None:
    data = table()
    states = data.states.clone()
    states[10:40, 1, 2] = st.wrap(torch.linspace(2.5, 4.5, 30, dtype=states.dtype))
    (found,) = frozen_stretches(replace(data, states=states))
    assert found.rows == (10, 39) and found.columns == ("x.heading",)


def test_interpolation_goes_with_the_time() -> None:
    data = table()
    time = data.time + 0.04 * torch.sin(torch.arange(len(data.time), dtype=torch.float64))[:, None]
    states = data.states.clone()
    share = (time[10:41, 1] - time[10, 1]) / (time[40, 1] - time[10, 1])
    states[10:41, 1, 0] = 1.0 + 3.0 * share
    (found,) = frozen_stretches(replace(data, time=time, states=states))
    assert found.rows == (10, 40) and found.columns == ("x.x",)
