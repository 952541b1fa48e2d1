"""Fixes: the pose that one row's bearings tell, without the rows around it and without the true states."""

from __future__ import annotations

import sys
from dataclasses import replace

import pytest
import torch
from examples import drives, example
from small import simulated

from steady_ppl import DataError, fixes, for_program, seeded
from steady_ppl.runs.recipes import recipe_folder
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


def test_fit_tv_differentiates_what_it_finds() -> None:
    """Sharp bearings of a smooth drive: velocities within what a second of thrust changes."""
    fit_tv = load_recipe("fit_tv")
    program = example("hovercraft")
    program.bearing_sd = 1e-3
    data = drives(program, 2, 41)
    states = fit_tv.differentiated(program, data, found(program, data), 1e-3, 100)
    away = states - data.states
    away[..., 2] = wrap(away[..., 2])
    assert bool(states.isfinite().all())
    assert float(away[..., :2].abs().median()) < 0.02 and float(away[..., 3:5].abs().median()) < 0.1


def test_fit_tv_bridges_gaps_and_uneven_steps() -> None:
    """Poses of a steady motion, at uneven times, some of them missing: its velocity everywhere."""
    program = example("hovercraft")
    data = drives(program, 2, 41, gaps=True)
    poses = torch.full((*data.time.shape, 6), torch.nan, dtype=torch.float64)
    for column, velocity in enumerate((2.0, -1.0, 3.0)):  # it turns half a dozen times over the circle's end
        poses[..., column] = velocity * data.elapsed
    poses[..., 2] = wrap(poses[..., 2])
    missing = torch.rand(data.time.shape, generator=torch.Generator().manual_seed(0)) < 0.2
    missing[0], missing[38:] = False, False  # nothing is known of the motion before the first pose and after the last
    poses[missing | ~data.rows] = torch.nan
    states = load_recipe("fit_tv").differentiated(program, data, poses, 1e-3, 100)
    found = states[..., 3:][data.rows]
    torch.testing.assert_close(found, torch.tensor([2.0, -1.0, 3.0]).double().expand(len(found), -1), rtol=0, atol=0.2)


@pytest.mark.parametrize(("row", "end"), [(0, "first"), (40, "last")])
def test_fit_tv_invents_no_motion_before_the_first_pose_and_after_the_last(row: int, end: str) -> None:
    program = example("hovercraft")
    data = drives(program, 2, 41)
    poses = torch.where(data.states[..., :1] == data.states[row, 1, 0], torch.nan, data.states)
    with pytest.raises(DataError, match=f"trajectory 2: its {end} row does not tell x by itself"):
        load_recipe("fit_tv").differentiated(program, data, poses, 1e-3, 10)


def test_fit_tv_says_how_many_rows_it_interpolated() -> None:
    program, data = example("hovercraft"), drives(example("hovercraft"), 2, 9)
    observed = data.observed.clone()
    observed[3:5, 1] = False
    fit = load_recipe("fit_tv").fit
    assert "of 18 rows 2 do not tell the pose: interpolated" in (
        fit(program, replace(data, observed=observed), steps=1, progress=False).notes
    )
    assert not any("interpolated" in note for note in fit(program, data, steps=1, progress=False).notes)


def load_recipe(name: str):
    from steady_ppl.model.loading import run_file

    return run_file(recipe_folder() / f"{name}.py")
