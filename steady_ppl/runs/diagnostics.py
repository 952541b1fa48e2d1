"""What a fit and its drives give reason to doubt, in words."""

import math
from collections.abc import Mapping
from pathlib import Path

from pyro.distributions import constraints
from torch import Tensor

from steady_ppl.data.doctor import Examination, examine
from steady_ppl.data.suspicions import are_degrees
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.model.program import Program, parameter_name
from steady_ppl.runs.fit import Fit

LOG_RATIO_TO_ZERO = math.log(20.0)  # log ratio by which a positive number falls to next to nothing
LOG_RATIO_OF_GUESS = math.log(1e3)  # the same of a guess, such as noise
HIDDEN = (
    "these trajectories hardly depend on it as the model stands; a missing effect may hide it (`steady "
    "discover`), or commands are swapped, or a heading counts the other way"
)
COLLAPSED = "another part of the model takes its place; reset it in the model's file and fit again before any test"


def diagnose_fit(fit: Fit, declared: Mapping[str, Tensor]) -> list[str]:
    """That it had not converged, or that it has all but taken away what the program `declared`: a copy of its
    `state_dict()` before."""
    found, trained = [], fit.trained
    if trained is not None and trained.still_rising is not None:
        steps = fit.settings.get("steps")
        more = f"more steps (--steps {4 * steps})" if isinstance(steps, int) else "more steps"
        found.append(
            f"not converged: held-out log p(y) rose by {trained.still_rising:.1f} nats a trajectory over the last "
            f"quarter. Fit again with {more}, or a mechanistic model by --recipe likelihood, which takes seconds"
        )
    for name, before in declared.items():
        short = parameter_name(name)
        if not _is_positive(fit.program, short):
            continue
        guessed = short.startswith(tuple(fit.program.guesses))
        most, why = (LOG_RATIO_OF_GUESS, COLLAPSED) if guessed else (LOG_RATIO_TO_ZERO, HIDDEN)
        now = fit.program.state_dict()[name]
        for index, (then, value) in enumerate(zip(before.flatten().tolist(), now.flatten().tolist(), strict=True)):
            if then - value > most:
                label = f"{short}[{index}]" if before.numel() > 1 else short
                found.append(f"{label} fell from {math.exp(then):.3g} to {math.exp(value):.2g}: {why}")
    return found


def doctor(table: str | Path | Trajectories, program: Program | None = None) -> Examination:
    """What is suspicious in a table, before anything is fitted, and the line that mends it.

    Looked for are codes for missing values, degrees, headings that count otherwise, swapped axes, times that are no
    seconds, dates, text, frozen and interpolated stretches, outliers, constant and copied columns, gaps, and
    trajectories of one row, in several places or that overlap.

    Args:
        table: a `.csv` or `.parquet` file, or what `read_table` returned.
        program: whose units and step are known; without it the names of columns say what is an angle.

    Raises:
        DataError: the file cannot be read, or has no trajectory or time.
    """
    if program is None:
        return examine(table)
    angles = {f"x.{name}": "rad" if name in program.angles else "" for name in program.state_names}
    seen = zip(program.measurement_names, program.measurement_units, strict=True)
    given = zip(program.control_names, program.control_units, strict=True)
    units = {f"y.{name}": unit for name, unit in seen} | {f"u.{name}": unit for name, unit in given} | angles
    return examine(table, units, program.step)


def diagnose_units(program: Program, data: Trajectories) -> list[str]:
    """What is read as radians and looks like degrees: beyond several turns, and all within a circle's degrees.

    Of measurements all are looked at, of known angles those of the first rows alone, since later ones may have counted
    turns, and of the controls of a program with a heading those that are angles or turn rates; `data` are as
    `for_program` returns them.
    """
    found = []
    for index, (name, unit) in enumerate(zip(program.measurement_names, program.measurement_units, strict=True)):
        if unit == "rad":
            found += _degrees(f"y.{name}", unit, data.measurements[..., index][data.observed[..., index]])
    for index, (name, unit) in enumerate(zip(program.control_names, program.control_units, strict=True)):
        if unit == "rad" or (unit == "rad/s" and program.angles):
            found += _degrees(f"u.{name}", unit, data.controls[..., index][data.rows])
    for index, name in enumerate(program.state_names):
        if data.states is not None and name in program.angles:
            start = data.states[0, :, index]
            found += _degrees(f"x.{name}", "rad", start[start.isfinite()])
    return found


def _degrees(column: str, unit: str, seen: Tensor) -> list[str]:
    if not are_degrees(seen.numpy()):
        return []
    between = f"{float(seen.min()):.4g} and {float(seen.max()):.4g}"
    read = "radians" if unit == "rad" else "radians a second"
    return [f"{column} is between {between} and the model reads {read}: are these degrees?"]


def _is_positive(program: Program, name: str) -> bool:
    """Whether a parameter is learned as its logarithm."""
    path, _, name = name.rpartition(".")
    owner = program.get_submodule(path)
    constraint = getattr(owner, "_pyro_params", {}).get(name, (None,))[0]  # a copy's is not the same object
    return isinstance(constraint, type(constraints.positive)) and constraint.lower_bound == 0
