"""Posterior trajectories and forecasts as ArviZ InferenceData; states as files, for which ArviZ is not loaded."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
import xarray
from torch import Tensor

from steady_ppl.data.table import refuse_long
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError, UsageError
from steady_ppl.gaussian.predict import on_a_circle
from steady_ppl.likelihood.evidence import choose_filter, in_parts, run_filter
from steady_ppl.model.handlers import as_vector
from steady_ppl.model.program import Program, for_program
from steady_ppl.smc.simulate import measure
from steady_ppl.utils.angles import draws_on_one_turn, paths_on_one_turn
from steady_ppl.utils.cores import one_thread
from steady_ppl.utils.files import whole_file
from steady_ppl.utils.progress import stages
from steady_ppl.utils.random import seeded

if TYPE_CHECKING:
    import arviz

OF_ROW = ("trajectory", "row")
DIMENSIONS = ("chain", "draw", *OF_ROW)
Variable = tuple[tuple[str, ...], np.ndarray, dict[str, Any]]
"""Dimensions, values and attributes."""
Groups = Mapping[str, xarray.Dataset]
"""Those of ArviZ's InferenceData, which is such a mapping itself."""
INTERVAL_QUANTILES = (0.05, 0.5, 0.95)
STATES_SUFFIXES = (".csv", ".parquet", ".nc")


def posterior(program: Program, data: Trajectories, **settings: Any) -> arviz.InferenceData:
    """What `drawn_states` returns, for ArviZ; settings are its."""
    return _for_arviz(drawn_states(program, data, **settings))


@one_thread()
def drawn_states(
    program: Program,
    data: Trajectories,
    *,
    draws: int = 100,
    particles: int | None = None,
    every: int = 1,
    known_start: bool = False,
    seed: int = 0,
) -> dict[str, xarray.Dataset]:
    """Draw whole trajectories given all of their measurements.

    Args:
        draws: equally weighted paths for each trajectory, resampled from all surviving lineages.
        particles: N of the filter, for each trajectory; None: see `choose_filter`.
        every: use the measurements of every n-th row only.
        known_start: start at the true first state.
        seed: the same seed gives the same draws.

    Returns:
        `posterior`: one variable a state component and one a noise site, over (chain, draw, trajectory, row), NaN past
        a trajectory's end (the noise of row t acts from t to t + 1); an angle whose start is not known is on one turn
        in all draws, beginning between −π and π in the first; `sample_stats`: how many particles the filter had
        in effect in each row, and how many of the first row's have descendants; `observed_data`: the measurements
        used; `constant_data`: time, controls and, where known, the true states. Attributes say the units.
    """
    run = for_program(program, data).observed_every(every)
    refuse_long(run)
    found, noise = list[tuple[Tensor, ...]](), dict[str, list[Tensor]]()
    with seeded(seed, "posterior"):
        choice = choose_filter(program, run, known_start=known_start, particles=particles)
        settings: dict[str, Any] = {"particles": choice.particles, "look_ahead": choice.look_ahead}
        groups = list(in_parts(run, **settings))
        with stages(*(("drawing states", len(part)) for part in groups)) as begin:
            for part in groups:
                begin()
                filtered = run_filter(program, part, known_start=known_start, **settings)
                paths = filtered.paths(draws)
                found.append((paths.states, filtered.log_likelihood, filtered.effective_sizes, filtered.roots))
                for site, value in paths.noise.items():
                    noise.setdefault(site, []).append(as_vector(value, paths.event_dims[site]))
    states, evidence, sizes, roots = zip(*found, strict=True)
    coordinates: dict[str, Any] = {"chain": [0], "draw": np.arange(draws)}
    coordinates |= {"trajectory": list(run.labels), "row": np.arange(run.time.shape[0])}
    inside = run.rows.t().numpy(force=True)
    variables: dict[str, Variable] = {}
    path = _draws(torch.cat(states, 2))
    for index in () if known_start else program.angle_indices:
        path[0, ..., index] = paths_on_one_turn(path[0, ..., index], inside)
    for index, (name, unit) in enumerate(zip(program.state_names, program.state_units, strict=True)):
        variables[name] = (DIMENSIONS, np.where(inside, path[..., index], np.nan), {"units": unit})
    for site, parts in noise.items():
        values = np.pad(_draws(torch.cat(parts, 2)), [(0, 0)] * 3 + [(0, 1), (0, 0)], constant_values=np.nan)
        values[:, :, ~np.roll(inside, -1, 1) | ~inside] = np.nan
        dimension, labels = f"{site}_channel", program.channel_names
        known = len(labels) == values.shape[-1]
        coordinates[dimension] = list(labels) if known else [f"{site}_{i}" for i in range(values.shape[-1])]
        attributes = {"units": list(program.channel_units)} if known else {}
        variables[site if site not in variables else f"{site}_noise"] = ((*DIMENSIONS, dimension), values, attributes)
    measured = torch.where(run.observed, run.measurements, torch.nan)
    observed = _columns("measured_", program.measurement_names, program.measurement_units, measured)
    effective = torch.where(run.rows, torch.cat(sizes, 1).double(), torch.nan).t().numpy(force=True)
    survivors = torch.cat(roots).double().numpy(force=True)
    stats = {
        "effective_size": (("chain", *OF_ROW), effective[None], {"units": "particles"}),
        "roots": (("chain", "trajectory"), survivors[None], {"units": "particles"}),
    }
    constants = _columns("", ("time",), ("s",), run.elapsed.unsqueeze(-1))
    constants["log_likelihood"] = ("trajectory",), torch.cat(evidence).numpy(force=True), {"units": "nat"}
    constants |= _columns("control_", program.control_names, program.control_units, run.controls)
    if run.states is not None:
        constants |= _columns("true_", program.state_names, program.state_units, run.states)
    about = {"program": type(program).__name__, "particles": choice.particles, "filter": choice.name}
    return {
        "posterior": xarray.Dataset(variables, coordinates, about),
        "sample_stats": _dataset(stats, coordinates, ("chain", *OF_ROW)),
        "observed_data": _dataset(observed, coordinates, OF_ROW),
        "constant_data": _dataset(constants, coordinates, OF_ROW),
    }


def _for_arviz(groups: Groups) -> arviz.InferenceData:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # an advertisement of arviz 1, once a day
        import arviz  # with matplotlib and scipy.stats, 1.2 s
    given: dict[str, Any] = dict(groups)
    return arviz.InferenceData(**given)


def _draws(values: Tensor) -> np.ndarray:
    """`(M, rows, B, ·)` to `(1, M, B, rows, ·)`."""
    return values.transpose(1, 2).unsqueeze(0).numpy(force=True).copy()


def _columns(prefix: str, names: Sequence[str], units: Sequence[str], values: Tensor) -> dict[str, Variable]:
    """Variables over trajectories and rows of the components of `(rows, B, ·)`."""
    columns = values.transpose(0, 1).double().numpy(force=True).copy()
    return {
        f"{prefix}{name}": (OF_ROW, columns[..., index], {"units": unit})
        for index, (name, unit) in enumerate(zip(names, units, strict=True))
    }


def _dataset(variables: Mapping[str, Variable], coordinates: Mapping[Any, Any], names: Sequence[str]) -> xarray.Dataset:
    return xarray.Dataset(variables, {name: coordinates[name] for name in names})


def states_frame(posterior: Groups) -> pd.DataFrame:
    """Median and 90 % interval of every state of `Fit.posterior` or `drawn_states`, a row a trajectory and time step.

    Returns:
        Columns `trajectory`, `time` (s) and for each state component `name`, `name_low`, `name_high`, in its unit.
    """
    states = posterior["posterior"]
    time = posterior["constant_data"]["time"]
    plain = [name for name, values in states.data_vars.items() if values.dims == ("chain", "draw", *time.dims)]
    inside = np.isfinite(states[plain[0]].values[0, 0])
    labels = np.repeat(time["trajectory"].values, inside.sum(1))
    columns: dict[str, np.ndarray] = {"trajectory": labels, "time": time.values[inside]}
    for name in plain:
        low, middle, high = np.quantile(states[name].values[0][:, inside], INTERVAL_QUANTILES, axis=0)
        columns |= {str(name): middle, f"{name}_low": low, f"{name}_high": high}
    return pd.DataFrame(columns)


def require_states_file(path: Path) -> None:
    """Raise UsageError for another suffix than those of a table or of netCDF."""
    if path.suffix.lower() not in STATES_SUFFIXES:
        raise UsageError(f"{path}: states are written as {', '.join(STATES_SUFFIXES)}")


def write_states(posterior: Groups, path: Path) -> None:
    """Write a posterior whole or not at all: a table of medians and intervals, or all draws as netCDF. UsageError:
    another suffix, or the file cannot be written."""
    require_states_file(path)
    with whole_file(path) as beside:
        if path.suffix.lower() == ".nc":
            beside.write_bytes(netcdf(posterior))
        elif path.suffix.lower() == ".csv":
            states_frame(posterior).to_csv(beside, index=False)
        else:
            states_frame(posterior).to_parquet(beside, index=False)


def netcdf(draws: Groups) -> memoryview:
    """The bytes of a netCDF file. HDF5 is kept away from disks: on one that is full it prints pages and may crash."""
    return xarray.DataTree.from_dict(dict(draws)).to_netcdf(None, engine="h5netcdf")


@one_thread()
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
        data: trajectories with the program's columns; rows after the last measurement hold what is planned.
        controls: more of it, `(H, U)` or `(H, B, U)`, see `Trajectories.continued`.
        after: s since each trajectory's start; later measurements are not used. Each trajectory's last measured row
            when None.
        step: s between the rows of `controls`.
        draws: equally weighted futures of each trajectory; parameters are those of the program, without their doubt.
        particles: N of the filter, for each trajectory; None: see `choose_filter`.
        known_start: start at the true first state.
        seed: the same seed gives the same draws.

    Returns:
        What `posterior` returns, and with it `predictions`: one variable a state component and one `measured_…` a
        measurement, noise included, over (chain, draw, trajectory, row), NaN but in the rows after that moment, angles
        within half a turn of their mean; and `predictions_constant_data` with these rows' times and what the table has
        measured in them, `measured_…`, of which nothing was used.

    Raises:
        DataError: a trajectory has no row after that moment, or a moment before its first row.
    """
    table = data if controls is None else data.continued(controls, step)
    run = for_program(program, table)
    measured_until = torch.where(run.observed.any(-1), run.elapsed, 0.0).amax(0)
    last = measured_until if after is None else torch.full_like(measured_until, after)
    future = (run.elapsed > last + 0.01 * run.median_step) & run.rows  # decimal seconds are not binary ones
    for drive, label in enumerate(run.labels):
        if not bool(future[:, drive].any()):
            how = "give planned `controls`, or an earlier `after`, or add rows with controls and empty y. cells"
            raise DataError(f"trajectory {label} has no row after {float(last[drive]):g} s: {how}", trajectory=label)
        if bool(future[0, drive]):
            raise DataError(f"trajectory {label} begins after {float(last[drive]):g} s", trajectory=label)
    known = replace(table, observed=table.observed & ~future[..., None].to(table.observed.device))
    found = drawn_states(program, known, draws=draws, particles=particles, known_start=known_start, seed=seed)
    states = np.stack([found["posterior"][name].values[0] for name in program.state_names], -1)
    path = torch.from_numpy(states).to(run.controls).nan_to_num(0.0).transpose(1, 2)
    with seeded(seed, "forecast"):
        measured = measure(program, path).transpose(1, 2).numpy(force=True)
    there = future.t().numpy(force=True)
    later = torch.where(run.observed & future[..., None], run.measurements, torch.nan)
    constants = _columns("", ("time",), ("s",), torch.where(future, run.elapsed, torch.nan).unsqueeze(-1))
    constants |= _columns("measured_", program.measurement_names, program.measurement_units, later)
    variables: dict[str, Variable] = {}
    for index, (name, unit) in enumerate(zip(program.state_names, program.state_units, strict=True)):
        variables[name] = (DIMENSIONS, np.where(there, states[None, ..., index], np.nan), {"units": unit})
    circular = on_a_circle(program, run, path[0]).tolist()
    for index, (name, unit) in enumerate(zip(program.measurement_names, program.measurement_units, strict=True)):
        values = draws_on_one_turn(measured[..., index]) if circular[index] else measured[..., index]
        about = {"units": unit, "circular": int(circular[index])}
        variables[f"measured_{name}"] = (DIMENSIONS, np.where(there, values[None], np.nan), about)
    coordinates = found["posterior"].coords
    found["predictions"] = _dataset(variables, coordinates, DIMENSIONS)
    found["predictions_constant_data"] = _dataset(constants, coordinates, OF_ROW)
    return _for_arviz(found)
