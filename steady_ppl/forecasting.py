"""Forecasts: drives go on under given controls after the last measurement that is used."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
import xarray
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError
from steady_ppl.gaussian.predict import on_a_circle
from steady_ppl.model.program import Program, for_program, names, units
from steady_ppl.posterior import DIMENSIONS, posterior
from steady_ppl.smc.simulate import measure
from steady_ppl.utils.angles import draws_on_one_turn
from steady_ppl.utils.random import seeded

if TYPE_CHECKING:
    import arviz


@torch.no_grad()
def forecast(
    program: Program,
    data: Trajectories,
    *,
    controls: Tensor | None = None,
    after: float | None = None,
    step: float | None = None,
    draws: int = 200,
    particles: int | None = None,
    known_start: bool = False,
    seed: int = 0,
) -> arviz.InferenceData:
    """Draw what happens, and what is measured, after a moment up to which measurements are used.

    Args:
        program: the state-space model.
        data: drives with the program's columns; rows after the last measurement hold what is planned.
        controls: more of it, `(H, U)` or `(H, B, U)`, see `Trajectories.continued`.
        after: s since each drive's start; later measurements are not used. Each drive's last measured row when None.
        step: s between the rows of `controls`.
        draws: equally weighted futures of each drive; parameters are those of the program, without their doubt.
        particles: N of the filter, for each trajectory; None: see `choose_filter`.
        known_start: start at the true first state.
        seed: the same seed gives the same draws.

    Returns:
        What `posterior` returns, and with it `predictions`: one variable a state component and one `measured_…` a
        measurement, noise included, over (chain, draw, trajectory, row), NaN but in the rows after that moment, angles
        within half a turn of their mean; and `predictions_constant_data` with these rows' times and what the table has
        measured in them, `measured_…`, of which nothing was used.

    Raises:
        DataError: a drive has no row after that moment, or a moment before its first row.
    """
    table = data if controls is None else data.continued(controls, step)
    run = for_program(program, table)
    last = _last_measured(run) if after is None else run.elapsed.new_full((len(run),), after)
    future = (run.elapsed > last + 0.01 * run.median_step) & run.rows  # decimal seconds are not binary ones
    for drive, label in enumerate(run.labels):
        if not bool(future[:, drive].any()):
            raise DataError(
                f"trajectory {label} has no row after {float(last[drive]):g} s: give planned `controls`, or an earlier "
                "`after`, or add rows with controls and empty y. cells",
                trajectory=label,
            )
        if bool(future[0, drive]):
            raise DataError(f"trajectory {label} begins after {float(last[drive]):g} s", trajectory=label)
    known = replace(table, observed=table.observed & ~future[..., None].to(table.observed.device))
    found = posterior(program, known, draws=draws, particles=particles, known_start=known_start, seed=seed)
    states = np.stack([found["posterior"][name].values[0] for name in names(program.states)], -1)
    path = torch.from_numpy(states).to(run.controls).nan_to_num(0.0).transpose(1, 2)
    with seeded(seed, "forecast"):
        measured = measure(program, path).transpose(1, 2).numpy(force=True)
    there = future.t().numpy(force=True)
    later = torch.where(run.observed & future[..., None], run.measurements, torch.nan).transpose(0, 1)
    of_row = ("trajectory", "row")
    time = np.where(there, run.elapsed.double().t().numpy(force=True), np.nan)
    constants: dict[str, tuple] = {"time": (of_row, time, {"units": "s"})}
    variables: dict[str, tuple] = {}
    for index, (name, unit) in enumerate(zip(names(program.states), units(program.states), strict=True)):
        variables[name] = (DIMENSIONS, np.where(there, states[None, ..., index], np.nan), {"units": unit})
    circular = on_a_circle(program, run, path[0]).tolist()
    for index, (name, unit) in enumerate(zip(names(program.measurements), units(program.measurements), strict=True)):
        values = draws_on_one_turn(measured[..., index]) if circular[index] else measured[..., index]
        about = {"units": unit, "circular": int(circular[index])}
        variables[f"measured_{name}"] = (DIMENSIONS, np.where(there, values[None], np.nan), about)
        constants[f"measured_{name}"] = (of_row, later[..., index].double().numpy(force=True), {"units": unit})
    coordinates = found["posterior"].coords
    shown = {name: coordinates[name] for name in of_row}
    found.add_groups(
        predictions=xarray.Dataset(variables, {name: coordinates[name] for name in DIMENSIONS}),
        predictions_constant_data=xarray.Dataset(constants, shown),
    )
    return found


def _last_measured(data: Trajectories) -> Tensor:
    """When each drive was last measured, s; zero where it never was."""
    return torch.where(data.observed.any(-1), data.elapsed, 0.0).amax(0)
