"""Posterior trajectories as ArviZ InferenceData, with named coordinates and units."""

from __future__ import annotations

import warnings

import numpy as np
import torch
import xarray
from torch import Tensor

from steady_ppl.data.table import refuse_long
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.filtering import choose_filter, in_parts, run_filter
from steady_ppl.model.handlers import as_vector
from steady_ppl.model.program import Program, for_program, names, units
from steady_ppl.utils.angles import paths_on_one_turn
from steady_ppl.utils.progress import stages
from steady_ppl.utils.random import seeded

with warnings.catch_warnings():
    warnings.simplefilter("ignore", FutureWarning)  # an advertisement of arviz 1, once a day
    import arviz

DIMENSIONS = ("chain", "draw", "trajectory", "row")


def posterior(
    program: Program,
    data: Trajectories,
    *,
    draws: int = 100,
    particles: int | None = None,
    every: int = 1,
    known_start: bool = False,
    seed: int = 0,
) -> arviz.InferenceData:
    """Draw whole trajectories given all of their measurements.

    Args:
        program: the state-space model.
        data: drives with the program's columns.
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
        used; `constant_data`: time, controls and, where known, the true states. Units are in each variable's
        attributes.
    """
    run = for_program(program, data).observed_every(every)
    refuse_long(run)
    states: list[Tensor] = []
    noise: dict[str, list[Tensor]] = {}
    evidence: list[Tensor] = []
    sizes: list[Tensor] = []
    roots: list[Tensor] = []
    with seeded(seed, "posterior"):
        choice = choose_filter(program, run, known_start=known_start, particles=particles)
        groups = list(in_parts(run, choice.particles, look_ahead=choice.look_ahead))
        with stages(*(("drawing states", len(part)) for part in groups)) as begin:
            for part in groups:
                begin()
                filtered = run_filter(
                    program,
                    part,
                    particles=choice.particles,
                    known_start=known_start,
                    look_ahead=choice.look_ahead,
                )
                paths = filtered.paths(draws)
                states.append(paths.states)
                evidence.append(filtered.log_likelihood)
                sizes.append(filtered.effective_sizes)
                roots.append(filtered.roots)
                for site, value in paths.noise.items():
                    noise.setdefault(site, []).append(as_vector(value, paths.event_dims[site]))
    coordinates: dict[str, list | np.ndarray] = {
        "chain": [0],
        "draw": np.arange(draws),
        "trajectory": list(run.labels),
        "row": np.arange(run.time.shape[0]),
    }
    inside = run.rows.t().numpy(force=True)
    variables: dict[str, tuple] = {}
    path = _draws(torch.cat(states, 2))
    for index in () if known_start else (names(program.states).index(angle) for angle in program.angles):
        path[0, ..., index] = paths_on_one_turn(path[0, ..., index], inside)
    for index, (name, unit) in enumerate(zip(names(program.states), units(program.states), strict=True)):
        values = np.where(inside, path[..., index], np.nan)
        variables[name] = (DIMENSIONS, values, {"units": unit})
    for site, parts in noise.items():
        values = _draws(torch.cat(parts, 2))
        missing = np.full((*values.shape[:3], 1, values.shape[-1]), np.nan, values.dtype)
        values = np.concatenate([values, missing], 3)
        values[:, :, ~np.roll(inside, -1, 1) | ~inside] = np.nan
        dimension = f"{site}_channel"
        labels = names(program.channels)
        known = len(labels) == values.shape[-1]
        coordinates[dimension] = list(labels) if known else [f"{site}_{i}" for i in range(values.shape[-1])]
        attributes = {"units": list(units(program.channels))} if known else {}
        variables[site if site not in variables else f"{site}_noise"] = ((*DIMENSIONS, dimension), values, attributes)
    about = {"program": type(program).__name__, "particles": choice.particles, "filter": choice.name}
    return arviz.InferenceData(
        posterior=xarray.Dataset(variables, coordinates, about),
        sample_stats=_health(run, coordinates, torch.cat(sizes, 1), torch.cat(roots)),
        observed_data=_observed(program, run, coordinates),
        constant_data=_constants(program, run, coordinates, torch.cat(evidence)),
    )


def _draws(values: Tensor) -> np.ndarray:
    """`(M, rows, B, ·)` to `(1, M, B, rows, ·)`."""
    return values.transpose(1, 2).unsqueeze(0).numpy(force=True).copy()


def _by_trajectory(values: Tensor) -> np.ndarray:
    return values.t().double().numpy(force=True).copy()


def _health(data: Trajectories, coordinates: dict, sizes: Tensor, roots: Tensor) -> xarray.Dataset:
    """Of the filter, over the one chain."""
    inside = torch.where(data.rows, sizes.to(torch.float64), torch.nan)
    return xarray.Dataset(
        {
            "effective_size": (("chain", "trajectory", "row"), _by_trajectory(inside)[None], {"units": "particles"}),
            "roots": (("chain", "trajectory"), roots.double().numpy(force=True)[None], {"units": "particles"}),
        },
        {name: coordinates[name] for name in ("chain", "trajectory", "row")},
    )


def _observed(program: Program, data: Trajectories, coordinates: dict) -> xarray.Dataset:
    shown = {name: coordinates[name] for name in ("trajectory", "row")}
    measured = torch.where(data.observed, data.measurements, torch.nan)
    return xarray.Dataset(
        {
            f"measured_{name}": (("trajectory", "row"), _by_trajectory(measured[..., index]), {"units": unit})
            for index, (name, unit) in enumerate(
                zip(names(program.measurements), units(program.measurements), strict=True)
            )
        },
        shown,
    )


def _constants(program: Program, data: Trajectories, coordinates: dict, evidence: Tensor) -> xarray.Dataset:
    shown = {name: coordinates[name] for name in ("trajectory", "row")}
    both = ("trajectory", "row")
    variables = {
        "time": (both, _by_trajectory(data.elapsed), {"units": "s"}),
        "log_likelihood": (("trajectory",), evidence.numpy(force=True), {"units": "nat"}),
    }
    for index, (name, unit) in enumerate(zip(names(program.controls), units(program.controls), strict=True)):
        variables[f"control_{name}"] = (both, _by_trajectory(data.controls[..., index]), {"units": unit})
    if data.states is not None:
        for index, (name, unit) in enumerate(zip(names(program.states), units(program.states), strict=True)):
            variables[f"true_{name}"] = (both, _by_trajectory(data.states[..., index]), {"units": unit})
    return xarray.Dataset(variables, shown)
