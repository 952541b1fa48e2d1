"""Run a program forward in time without measurements."""

from __future__ import annotations

import torch
from torch import Tensor

from steady_ppl.data import Trajectories
from steady_ppl.errors import ProgramError, SteadyError, one_line
from steady_ppl.particles import roll_out
from steady_ppl.program import Program, acting_controls, for_program, names
from steady_ppl.progress import stages
from steady_ppl.seeding import seeded
from steady_ppl.sites import Recording, as_vector, broadcast_event, running


@torch.no_grad()
def simulate(
    program: Program, trajectories: int | None = None, *, seed: int = 0, like: Trajectories | None = None
) -> Trajectories:
    """Drives of a program, with measurements and the true states.

    Args:
        program: what moves and what is measured.
        trajectories: how many; the program's `duration`, `step` and `example_controls` apply.
        seed: the same seed gives the same table.
        like: take time, controls and gaps in the measurements from these drives instead.

    Raises:
        ProgramError: a state is not finite.
    """
    with seeded(seed, "simulate"):
        if like is None:
            rows = round(program.duration / program.step) + 1
            time = (torch.arange(rows, dtype=torch.float64) * program.step)[:, None].repeat(1, trajectories or 1)
            controls = _example_controls(program, time)
            data = Trajectories(
                time=time,
                controls=controls,
                measurements=time.new_zeros((*time.shape, len(program.measurements))),
                observed=torch.ones((*time.shape, len(program.measurements)), dtype=torch.bool),
                lengths=torch.full((time.shape[1],), rows),
                labels=tuple(str(i + 1) for i in range(time.shape[1])),
                control_names=names(program.controls),
                measurement_names=names(program.measurements),
                state_names=names(program.states),
            )
        else:
            data = like
        run = for_program(program, data)
        rows, drives = run.time.shape
        with running(1, drives):
            start = broadcast_event(program.initial(), torch.Size((1, drives)), 1)
        states = [start]
        controls_over_time = acting_controls(program, run)[:-1].unsqueeze(1)
        with stages(*[("", 1)] * (rows - 1)) as begin:
            for state in roll_out(
                program, start, controls_over_time, run.elapsed[:-1].unsqueeze(1), run.steps.unsqueeze(1)
            ):
                begin()
                states.append(state)
        path = torch.cat(states)
        _require_finite(program, path, run)
        measurements = measure(program, path)
    nothing = path.new_full((), torch.nan)
    return Trajectories(
        time=data.time,
        controls=run.controls.double(),
        measurements=torch.where(run.observed, measurements, 0.0).double(),
        observed=run.observed,
        lengths=run.lengths,
        states=torch.where(run.rows[..., None], path, nothing).double(),
        labels=run.labels,
        control_names=run.control_names,
        measurement_names=run.measurement_names,
        state_names=names(program.states),
    )


def measure(program: Program, states: Tensor) -> Tensor:
    """A draw of what the program measures in these states, `(..., K)` of `(..., D)`."""
    seen = Recording()
    with running(*states.shape[:-1]), seen:
        program.observe(states)
    return torch.cat([as_vector(value, seen.distributions[site].event_dim) for site, value in seen.values.items()], -1)


def _require_finite(program: Program, path: Tensor, data: Trajectories) -> None:
    broken = (~path.isfinite().all(-1) & data.rows).nonzero()
    if len(broken):
        row, drive = broken[0].tolist()
        raise ProgramError(
            f"program {type(program).__name__} blows up: in trajectory {data.labels[drive]}, row {row + 1}, its states "
            "are not finite",
            site="transition",
        )


def _example_controls(program: Program, time: torch.Tensor) -> torch.Tensor:
    """What the program's own method gives: `(rows, trajectories, controls)`.

    Raises:
        ProgramError: it fails, or what it gives has another shape or is not finite.
    """
    name, expected = type(program).__name__, (*time.shape, len(program.controls))
    try:
        controls = program.example_controls(time)
    except SteadyError:
        raise
    except Exception as error:  # a user's own code
        raise ProgramError(
            f"program {name}: example_controls failed: {one_line(error)}", site="example_controls"
        ) from error
    if not isinstance(controls, torch.Tensor) or tuple(controls.shape) != expected:
        came = f"shape {tuple(controls.shape)}" if isinstance(controls, torch.Tensor) else type(controls).__name__
        raise ProgramError(
            f"program {name}: example_controls gave {came}, expected a tensor of shape {expected}",
            site="example_controls",
        )
    if not controls.isfinite().all():
        raise ProgramError(f"program {name}: example_controls gave a control that is not finite")
    return controls
