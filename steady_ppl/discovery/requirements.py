"""What a search for missing effects needs of a program and its drives."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from steady_ppl.data.table import refuse_long
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError, UsageError
from steady_ppl.gaussian.linearize import why_not_linear
from steady_ppl.likelihood.parameters import elements
from steady_ppl.model.program import Program, names

FEWEST_DRIVES, FEWEST_SETS = 5, 50


def require(program: Program, train: Trajectories, valid: Trajectories, known_start: bool, simulations: int) -> None:
    """Refuse what cannot be searched.

    Raises:
        UsageError: a network, a program that cannot be linearised, or too few simulations.
        DataError: too few drives, one that is too long, no known start, nothing measured, or controls that never
            change.
    """
    if simulations < FEWEST_SETS:
        raise UsageError(f"got {simulations} simulations: the calibration needs at least {FEWEST_SETS}, 200 are better")
    elements(program)
    if not names(program.channels):
        raise UsageError("the program declares no noise channels, through which effects act")
    for name, drives in (("training", train), ("validation", valid)):
        if len(drives) < FEWEST_DRIVES:
            raise DataError(
                f"{len(drives)} {name} drives are too few: each half needs at least {FEWEST_DRIVES}, because the unit "
                "that is resampled is the drive"
            )
        if drives.time.shape[0] < 3 or not bool(drives.observed[1:].any()):
            raise DataError(f"the {name} drives have no measurements after their first rows")
        refuse_long(drives)
        if known_start:
            _ = drives.known_start
    both = shared(train, valid)
    if both:
        raise UsageError(
            f"{len(both)} of the validation drives are training drives as well ({_few(both)}): nothing could be judged "
            "by them"
        )
    why = why_not_linear(program, train, known_start=known_start)
    if why is not None:
        raise UsageError(f"discover needs a program that can be linearised: {why.split(': looking')[0]}")
    constant = unexcited(program, train)
    if constant and len(constant) == len(names(program.controls)):
        raise DataError(
            f"the controls never change ({', '.join(constant)}): these drives cannot tell what the controls do from "
            "what happens anyway, and no verdict is given; record drives with changing controls"
        )


def shared(one: Trajectories, other: Trajectories) -> list[str]:
    """Labels of those of the second drives whose measurements are also among the first."""
    known = {_measured(one, index) for index in range(len(one))}
    return [other.labels[index] for index in range(len(other)) if _measured(other, index) in known]


def _measured(data: Trajectories, index: int) -> bytes:
    rows = int(data.lengths[index])
    seen = data.observed[:rows, index]
    return torch.where(seen, data.measurements[:rows, index], 0.0).numpy().tobytes() + seen.numpy().tobytes()


def _few(labels: Sequence[str]) -> str:
    return ", ".join(labels[:3]) + (" …" if len(labels) > 3 else "")


def unexcited(program: Program, data: Trajectories) -> list[str]:
    """Controls that have one value everywhere."""
    controls = data.controls[:-1][data.transitions]
    same = (controls == controls[:1]).all(0) if len(controls) else torch.ones(data.controls.shape[-1], dtype=torch.bool)
    return [name for name, constant in zip(names(program.controls), same.tolist(), strict=True) if constant]
