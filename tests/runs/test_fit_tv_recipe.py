"""The recipe `fit-tv` differentiates the poses that it finds, bridges gaps and invents no motion."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from examples import drives, example

from steady_ppl import DataError, fixes, seeded
from steady_ppl.model.loading import run_file
from steady_ppl.runs.recipes import recipe_file
from steady_ppl.utils.angles import wrap

FIT_TV = recipe_file("fit-tv")


@pytest.mark.exhaustive
def test_fit_tv_differentiates_what_it_finds() -> None:
    """Sharp bearings of a smooth drive: velocities within what a second of thrust changes."""
    program = example("hovercraft")
    program.bearing_sd = 1e-3
    data = drives(program, 2, 41)
    with seeded(1):
        poses = fixes(program, data)
    states = run_file(FIT_TV).differentiated(program, data, poses, 1e-3, 100)
    away = states - data.states
    away[..., 2] = wrap(away[..., 2])
    assert bool(states.isfinite().all())
    assert float(away[..., :2].abs().median()) < 0.02 and float(away[..., 3:5].abs().median()) < 0.1


@pytest.mark.slow
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
    states = run_file(FIT_TV).differentiated(program, data, poses, 1e-3, 100)
    found = states[..., 3:][data.rows]
    torch.testing.assert_close(found, torch.tensor([2.0, -1.0, 3.0]).double().expand(len(found), -1), rtol=0, atol=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(("row", "end"), [(0, "first"), (40, "last")])
def test_fit_tv_invents_no_motion_before_the_first_pose_and_after_the_last(row: int, end: str) -> None:
    program = example("hovercraft")
    data = drives(program, 2, 41)
    poses = torch.where(data.states[..., :1] == data.states[row, 1, 0], torch.nan, data.states)
    with pytest.raises(DataError, match=f"trajectory 2: its {end} row does not tell x by itself"):
        run_file(FIT_TV).differentiated(program, data, poses, 1e-3, 10)


@pytest.mark.slow
def test_fit_tv_says_how_many_rows_it_interpolated() -> None:
    program, data = example("hovercraft"), drives(example("hovercraft"), 2, 9)
    observed = data.observed.clone()
    observed[3:5, 1] = False
    fit = run_file(FIT_TV).fit
    assert "of 18 rows 2 do not tell the pose: interpolated" in (
        fit(program, replace(data, observed=observed), steps=1, progress=False).notes
    )
    assert not any("interpolated" in note for note in fit(program, data, steps=1, progress=False).notes)
