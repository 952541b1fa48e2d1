"""FitTV: a pose from each row's own measurements, its derivative by total variation, and the program fitted to both.

What one does without a model of the motion. Nothing of the trajectories' true states is looked at, not even their
start: the poses are `fixes`, and where a start is to be known theirs is taken (only held-out trajectories have a true
one). Chartrand's total-variation derivative (2011) is pynumdiff's.
"""

import dataclasses
import math
import warnings

import numpy as np
import torch

from steady_ppl import DataError, Fit, Trajectories, UnknownMap, UsageError, fixes, for_program, seeded
from steady_ppl.errors import ComputationError, require

from . import fit_truth

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # that a solver which is not needed here is missing
    from pynumdiff.total_variation_regularization import iterative_velocity


BEYOND = 10  # rows that a series is continued at both ends, turned about them: the solver errs in the first rows


def fit(
    program,
    table: Trajectories,
    valid: Trajectories | None = None,
    *,
    known_start: bool = False,
    regularization: float = 0.1,
    iterations: int = 20,
    steps: int = 500,
    learning_rate: float = 1e-2,
    weight_decay: float = 1.0,
    averaging: float = 0.98,
    validate_every: int = 50,
    validation_particles: int | None = None,
    patience: int = 5,
    seed: int = 0,
    **run,
) -> Fit:
    """Fit `program` to states that are differentiated from the measurements of `table`.

    Args:
        program: the state-space model, changed in place; its measurements tell the pose row by row (see `fixes`).
        table: the training trajectories; true states are not looked at.
        valid: held-out trajectories.
        known_start: the first row's true state is given to the filter of the validation.
        regularization: weight of the derivative's total variation (α in the paper, which has .01).
        iterations: of the derivative's solver.
        steps, learning_rate, weight_decay, averaging, validate_every, validation_particles, patience, run: as in
            `fit_truth`.

    Raises:
        DataError: a trajectory's first or last row does not tell the pose by itself, see `fixes`; rows between that do
            not are interpolated, and the fit's notes say how many.
        UsageError: the program does not say which components are derivatives of which, or learns a map whose frame
            only the true starts would fix.
    """
    settings = {name: value for name, value in locals().items() if name not in ("program", "table", "valid", "run")}
    require(0 < regularization < math.inf, "regularization", regularization, "above 0")
    require(iterations >= 1, "iterations", iterations, "at least 1")
    if isinstance(program, UnknownMap) and not program.surveyed_frame:
        raise UsageError("fit-tv looks at no true start: name two landmarks of the unknown map that are `surveyed`")
    data = for_program(program, table).without_truth()
    with seeded(seed, "fixes"):
        poses = fixes(program, data)
    estimated = dataclasses.replace(data, states=differentiated(program, data, poses, regularization, iterations))
    fitted = fit_truth.supervised(program, estimated, valid, "fit-tv", settings, **run)
    gaps = int((data.rows & poses.isnan().all(-1)).sum())
    if gaps:
        fitted.notes.append(f"of {int(data.rows.sum())} rows {gaps} do not tell the pose: interpolated")
    return fitted


def differentiated(program, data: Trajectories, poses: torch.Tensor, regularization: float, iterations: int):
    """The states `(T + 1, B, D)` of poses and their total-variation derivatives; gaps between poses are interpolated.

    Raises:
        DataError: a trajectory does not begin and end with a pose.
        UsageError: a component is no pose's derivative, or is told by no row.
        ComputationError: a derivative is not finite.
    """
    order = program.state_names
    rates = program.derivatives
    missing = [name for name in order if name not in rates and name not in rates.values()]
    if missing:
        raise UsageError(f"fit-tv: model {type(program).__name__} does not say what {missing[0]} is the derivative of")
    states = torch.full_like(poses, torch.nan)
    for drive, rows in enumerate(data.lengths.tolist()):
        time = data.elapsed[:rows, drive].double().numpy(force=True)
        even = np.linspace(time[0], time[-1], rows)  # which the solver needs
        for position, rate in rates.items():
            values = poses[:rows, drive, order.index(position)].double().numpy(force=True)
            there = np.isfinite(values)
            if not there.any():
                raise UsageError(f"fit-tv: {position} cannot be told from one row's measurements")
            if not (there[0] and there[-1]):
                raise DataError(
                    f"fit-tv: trajectory {data.labels[drive]}: its {'last' if there[0] else 'first'} row does not tell "
                    f"{position} by itself, and nothing says how it moved there: cut the trajectory to rows that do",
                    trajectory=data.labels[drive],
                )
            known = np.unwrap(values[there]) if position in program.angles else values[there]
            series = np.interp(even, time[there], known)
            beyond = min(BEYOND, rows - 1)
            turned = np.pad(series, beyond, mode="reflect", reflect_type="odd")
            smooth, derivative = (
                found[beyond : beyond + rows]
                for found in iterative_velocity(turned, even[1] - even[0], iterations, regularization)
            )
            if not np.isfinite(derivative).all():
                raise ComputationError(
                    f"fit-tv: the derivative of {position} in trajectory {data.labels[drive]} is not finite: try "
                    f"another regularization than {regularization:g}"
                )
            for name, found in ((position, smooth), (rate, derivative)):
                states[:rows, drive, order.index(name)] = torch.from_numpy(np.interp(time, even, found))
    return states
