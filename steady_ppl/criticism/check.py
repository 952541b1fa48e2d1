"""Compare a fitted program with measurements: where, when and in which regime it fails, and who is at fault.

Nothing here needs the truth. Whatever is computed of the drives is computed in the same way of drives that the fitted
program makes of the same controls, so that every figure has a band.
"""

import itertools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from steady_ppl.criticism.attribution import SCATTER, attribute, scored
from steady_ppl.criticism.baselines import constant_velocity, last_measurement
from steady_ppl.criticism.perturbations import directions
from steady_ppl.criticism.reference_sets import MIN_BAND_SETS, SimulatedSets, residuals, simulate_sets
from steady_ppl.criticism.residual_maps import Residuals, misfit_of
from steady_ppl.criticism.result import Check
from steady_ppl.criticism.step_size import check_step
from steady_ppl.data.frozen_sensors import frozen_stretches
from steady_ppl.data.horizons import named_horizons
from steady_ppl.data.table import refuse_long
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError, FilterError, UsageError
from steady_ppl.gaussian.kalman import track
from steady_ppl.gaussian.linearize import require_linear
from steady_ppl.gaussian.predict import predict, suited_horizons
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.kernels.rows import fallback_notes, kernel_failures
from steady_ppl.likelihood.information import ParameterInformation
from steady_ppl.likelihood.outliers import find_outliers
from steady_ppl.likelihood.parameter_posterior import undetermined
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.runs.diagnostics import diagnose_units
from steady_ppl.runs.fit import Fit
from steady_ppl.utils.cores import one_thread
from steady_ppl.utils.progress import stages
from steady_ppl.utils.random import seeded

CHECK_HORIZONS = 2  # times ahead, besides one step
MAX_ROWS_OF_DRAWS = 60_000  # rows times draws of the parameters, each of which is simulated by itself
BANDS_HOLD = (
    "these trajectories are not those of the fit: bands hold what the fit's own leave open of its parameters as well"
)
TAKEN_AS_EXACT = "parameters are taken as exact: the fit does not say how well its trajectories determine them"
BANDS_HOLD_NOT = (
    "parameters are taken as exact: within what the fit's trajectories leave open of them the model diverges"
)
MAX_RESIDUAL_SD = 4.0  # of a single residual; beside a landmark the linearised program knows no more


@one_thread()
@torch.no_grad()
def check(
    fit: Fit,
    data: Trajectories,
    *,
    simulations: int = 100,
    horizons: Sequence[float] = (),
    has_seen: bool | None = None,
    seed: int = 0,
) -> Check:
    """Compare a fitted program with measurements.

    Args:
        fit: the program, its noise normal; with its `known_start` the trajectories' first x. columns are used, nothing
            else of the truth ever is, but to see whether the table itself has stretches that nobody measured.
        data: trajectories, best those that were not used for the fit.
        simulations: sets of trajectories to simulate for the bands.
        horizons: seconds ahead, besides one step; those that suit the trajectories where none is given, see
            `data.horizons`.
        has_seen: whether the fit is of these trajectories, so that its parameters' uncertainty does not count; None: if
            it is of trajectories on which the same was measured.
        seed: of the simulation.

    Raises:
        UsageError: the program's noise is not normal, or there are too few simulations.
        DataError: nothing to compare, a trajectory that is too long (`refuse_long`), or no known start.
        FilterError: the linearised program broke down.

    Example:
        >>> import steady_ppl as st  # doctest: +SKIP
        >>> print(st.check(st.Fit.load("runs/learned"), st.read_table("test.csv")))  # doctest: +SKIP
    """
    program = fit.program
    problem = Problem.of_table(program, data, fit.known_start)
    run = problem.data
    if simulations < MIN_BAND_SETS:
        raise UsageError(f"got {simulations} simulations: bands need at least {MIN_BAND_SETS}, and 100 are better")
    if run.time.shape[0] < 2 or not bool(run.observed[1:].any()):
        raise DataError("nothing to compare: no trajectory has a measurement after its first row")
    refuse_long(run)
    require_linear(problem, "check needs a model that can be linearised")
    known = fit.information if fit.information is not None and fit.information.suits(program) else None
    ahead_by = named_horizons(run, CHECK_HORIZONS, horizons) if horizons else {}  # a wrong one is refused at once
    if has_seen is None:
        has_seen = known is not None and known.has_seen(run)
    parts = (("finding paths", 1), ("comparing time steps", 1), ("simulating trajectories", 2), ("judging", 2))
    with stages(*parts) as begin:
        begin()
        with seeded(seed, "check"), kernel_failures() as uncompiled:
            ahead = find_and_smooth(problem)
            outliers = find_outliers(problem, ahead.linearization.path)
            if outliers.found:
                run = outliers.left
                problem = replace(problem, data=run)
                ahead = find_and_smooth(problem)
            path = ahead.linearization.path
            ahead_by = ahead_by or suited_horizons(program, run, CHECK_HORIZONS, ())
            real = track(problem, path, passes=1)
            _, drawn, _ = ahead.draws(simulations)
            starts = run.known_start.expand(simulations, -1, -1) if fit.known_start else drawn[:, 0]
            begin()
            step = check_step(program, run, path, known_start=fit.known_start)
            begin()
            rows = list(ahead_by.values())
            made, is_open = _reference_sets(problem, starts, real.noise.shape[-1], rows, None if has_seen else known)
        begin()
        predictions = predict(program, run, real, rows)
        ours = replace(residuals(program, run, real, predictions[1], 1), raw=predictions[1].error.numpy(force=True))
        ours, theirs = _in_own_spreads(ours, made.residuals)
        scores, parameters = scored(directions(program, run, real), made.directions, made.sets)
        time, dispersion = run.elapsed[:-1].numpy(force=True), scores.dispersion.mean(-1)
        acting = run.controls[:-1]
        controls = {name: acting[..., i].double().numpy(force=True) for i, name in enumerate(program.control_names)}
        both = Residuals.concatenated([ours, theirs])
        misfit = misfit_of(both, time, controls, _pairs(program, ours), dispersion)
    notes = [] if made.sets == simulations else [f"{simulations - made.sets} of {simulations} simulated sets blew up"]
    if known is not None and not has_seen:
        seen = len(known.drives.intersection(problem.data.digests))
        notes.append(BANDS_HOLD if is_open else BANDS_HOLD_NOT)
        notes += [f"{seen} of these trajectories are the fit's own, and count as others here"] if seen else []
    elif known is None and not has_seen and fit.recipe != "hand":
        notes.append(TAKEN_AS_EXACT)
    notes += fallback_notes(uncompiled) + run.uneven_steps + diagnose_units(program, run)
    notes += [outliers.note] if outliers.note else []
    notes += [f"refitted to these trajectories, {step.note}"] if step.note else []
    notes += [step.uncompared] if step.uncompared else []
    if parameters.names:
        notes += undetermined(problem, path)
    else:
        notes.append("the model's own parameters were not looked at one by one: it has none, or a network's")
    return Check(
        program=program,
        data=run,
        path=path,
        horizons=ahead_by,
        predictions=predictions,
        floor=made.floor,
        reference=constant_velocity(problem, real, rows),
        held=last_measurement(problem, real.smoothed, rows),
        step=step,
        misfit=misfit,
        blame=attribute(scores, parameters, _scatter(both), misfit.p_values),
        residuals=list(ours.names),
        standardised=ours,
        stuck=frozen_stretches(data),
        outliers=outliers,
        information=known,
        is_open=is_open,
        notes=notes,
    )


def _reference_sets(
    problem: Problem, starts: Tensor, channels: int, rows: Sequence[int], known: ParameterInformation | None
) -> tuple[SimulatedSets, bool]:
    """Sets under draws of the parameters, where that much is `known`, or else as they are; and whether by draws."""
    if known is not None:
        draws = min(len(starts), max(MIN_BAND_SETS, MAX_ROWS_OF_DRAWS // problem.data.time.shape[0]))
        values = known.draws(problem.program, draws).repeat_interleave(-(-len(starts) // draws), 0)[: len(starts)]
        with suppress(FilterError):  # numbers that the fit's drives hardly tell lead anywhere
            return simulate_sets(problem, starts, channels, rows, values), True
    return simulate_sets(problem, starts, channels, rows), False


def _in_own_spreads(real: Residuals, simulated: Residuals) -> tuple[Residuals, Residuals]:
    """Divide every residual by the root mean square, at its interval and drive, of all sets: a score is small where few
    measurements follow, however wrong the program is. The real set is one of them, or its tails would be heavier than
    those of the sets that its scale was taken from."""
    count = real.there.sum(0) + simulated.there.sum(0)
    scale = np.sqrt(((real.values**2).sum(0) + (simulated.values**2).sum(0)) / np.maximum(count, 1))
    told = (scale > 0.05 * np.sqrt((scale**2).mean((0, 1)))) & (count > 1)
    scale = np.where(told, scale, 1.0)

    def scaled(part: Residuals) -> Residuals:
        there = part.there & told
        values = np.where(there, part.values / scale, 0.0).clip(-MAX_RESIDUAL_SD, MAX_RESIDUAL_SD)
        return replace(part, values=values, there=there)

    return scaled(real), scaled(simulated)


def _pairs(program: Program, residuals: Residuals) -> list[tuple[str, str]]:
    """Pairs of variables that make a map: error groups of two, velocities in the channels' frame, phase planes."""
    groups = [tuple(group) for group in program.error_groups.values() if len(group) == 2]
    moving = [name for name in residuals.variables if name.endswith(" velocity")]
    phases = [tuple(pair) for pair in program.motion.values()]
    if len(program.state_names) <= 3 and not groups + phases:
        phases = list(itertools.combinations(program.state_names, 2))
    chosen: Sequence[Any] = groups + list(itertools.combinations(moving, 2)) + phases
    return [pair for pair in dict.fromkeys(chosen) if all(name in residuals.variables for name in pair)]


def _scatter(both: Residuals) -> dict[str, np.ndarray]:
    """Mean squares of every residual, and the fourth power of the measurements' as a sign of tails; of every set."""
    squares, count = both.mean_squares, np.maximum(both.there.sum((1, 2)), 1)
    told = {i: name for i, name in enumerate(both.names) if both.there[0, ..., i].any()}
    tails = np.log((both.values**4).sum((1, 2)) / count / np.maximum(squares, 1e-12) ** 2 + 1e-12)
    found = {f"{SCATTER}{name}": squares[:, i] for i, name in told.items()}
    return found | {f"tails of {name}": tails[:, i] for i, name in told.items()}
