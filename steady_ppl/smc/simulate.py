"""Run a program forward in time without measurements."""

import math
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace

import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import ProgramError, SteadyError, require
from steady_ppl.model.handlers import Recording, joined, running
from steady_ppl.model.program import Program, for_program
from steady_ppl.model.stability import counts_rows, is_step
from steady_ppl.model.starts import draw_first_states
from steady_ppl.model.substeps import MAX_SUBSTEPS, advance, row_inputs, with_substeps
from steady_ppl.utils.cores import one_thread
from steady_ppl.utils.progress import stages
from steady_ppl.utils.random import seeded
from steady_ppl.utils.text import one_line


@one_thread()
@torch.no_grad()
def simulate(
    program: Program,
    trajectories: int | None = None,
    *,
    seed: int = 0,
    like: Trajectories | None = None,
    substeps: int | None = None,
) -> Trajectories:
    """Simulate trajectories of a program in fine steps, with measurements and the true states.

    Controls and noise are held over a row. A row is cut into substeps that are no longer than the program's
    `simulated_step`, 5 ms unless it says otherwise; where `transition` is no step in `step`, into the program's own.

    Args:
        program: what moves and what is measured.
        trajectories: how many; the program's `duration`, `step` and `example_controls` apply.
        seed: the same seed gives the same table.
        like: take time, controls and gaps in the measurements from these trajectories instead.
        substeps: of a row, instead.

    Raises:
        ProgramError: a state is not finite.
        UsageError: `trajectories` is below 1.
    """
    require(trajectories is None or trajectories > 0, "trajectories", trajectories, "at least 1")
    with seeded(seed, "simulate"):
        measured = like is not None
        if like is None:
            rows, drives = round(program.duration / program.step) + 1, 1 if trajectories is None else trajectories
            time = (torch.arange(rows, dtype=torch.float64) * program.step)[:, None].repeat(1, drives)
            measurements = time.new_zeros((rows, drives, len(program.measurements)))
            like = Trajectories(
                time=time,
                controls=_example_controls(program, time),
                measurements=measurements,
                observed=torch.ones_like(measurements, dtype=torch.bool),
                lengths=torch.full((drives,), rows),
                control_names=program.control_names,
                measurement_names=program.measurement_names,
                state_names=program.state_names,
            )
        run = for_program(program, like)
        program = with_substeps(program, simulated_substeps(program, run) if substeps is None else substeps)
        rows, drives = run.time.shape
        states = [draw_first_states(program, run if measured else None, 1, drives)]
        inputs = (values.unsqueeze(1) for values in row_inputs(program, run))
        with stages(*[("", 1)] * (rows - 1)) as begin:
            for state in roll_out(program, states[0], *inputs):
                begin()
                states.append(state)
        path = torch.cat(states)
        for row, drive in (~path.isfinite().all(-1) & run.rows).nonzero()[:1].tolist():
            where = f"trajectory {run.labels[drive]}, row {row + 1}"
            what = f"model {type(program).__name__} diverges: in {where}, its states are not finite"
            raise ProgramError(what, site="transition")
        measurements = measure(program, path)
    return replace(
        run,
        time=like.time,
        controls=run.controls.double(),
        measurements=torch.where(run.observed, measurements, 0.0).double(),
        states=torch.where(run.rows[..., None], path, torch.nan).double(),
        state_names=program.state_names,
    )


@torch.no_grad()
def roll_out(
    program: Program,
    state: Tensor,
    controls: Tensor,
    elapsed: Tensor,
    steps: Tensor,
    *,
    handler: Messenger | None = None,
) -> Iterator[Tensor]:
    """Run the program forward from given states; yields the state after each step.

    Args:
        state: `(draws, 1 or R, B, D)`; rows R are starts of a roll-out of their own.
        controls: `(H, 1 or R, B, U)`.
        elapsed, steps: `(H, 1 or R, B)` s.
        handler: acts on the channel noise, for example `AtMean()` for a roll-out without noise.
    """
    for control, time, step in zip(controls, elapsed, steps, strict=True):
        with running(*state.shape[:-1]), handler or nullcontext():
            state = advance(program, state, control, time, step)
        yield state


def simulated_substeps(program: Program, data: Trajectories) -> int:
    """Return in how many substeps a row of drives, as returned by `for_program`, is simulated."""
    longest = _usual_step(data)
    wanted = min(MAX_SUBSTEPS, math.ceil(longest / program.simulated_step - 1e-6))
    return max(program.substeps, wanted) if wanted > program.substeps and is_step(program, data) else program.substeps


def simulated_in(program: Program, drives: Trajectories, substeps: int | None = None) -> str:
    """Say in which steps drives were simulated."""
    run = for_program(program, drives)
    count = simulated_substeps(program, run) if substeps is None else substeps
    if count == program.substeps and substeps is None and not math.isinf(program.simulated_step):
        longest = _usual_step(run)
        if longest / count > 1.001 * program.simulated_step:
            why = "actuators counts rows" if counts_rows(program) else "transition is no step in `step`"
            return f"simulated row by row: {why}, so that rows cannot be cut ({count} a row)"
    said = f"simulated in steps of {1000 * run.median_step / count:.3g} ms, {count} a row"
    pause = float(run.steps[run.transitions].max())
    if pause > 2 * max(run.median_step, count * program.simulated_step):
        said += f", but those of the longest row ({pause:.3g} s) of {1000 * pause / count:.3g} ms"
    return said


def _usual_step(data: Trajectories) -> float:
    """The step that 95 % of rows do not exceed, s: a pause in a log must not make every row fine."""
    return float(data.steps[data.transitions].double().quantile(0.95)) if bool(data.transitions.any()) else 0.0


def measure(program: Program, states: Tensor) -> Tensor:
    """A draw of what the program measures in these states, `(..., K)` of `(..., D)`."""
    with running(*states.shape[:-1]), Recording() as seen:
        program.observe(states)
    return joined(seen.values, seen.distributions, states.shape[:-1])


def _example_controls(program: Program, time: Tensor) -> Tensor:
    """What the program's own method gives, `(rows, trajectories, controls)`, checked."""
    about, site = f"model {type(program).__name__}: example_controls", "example_controls"
    expected = (*time.shape, len(program.controls))
    try:
        controls = program.example_controls(time)
    except SteadyError:
        raise
    except Exception as error:  # a user's own code
        raise ProgramError(f"{about} failed: {one_line(error)}", site=site) from error
    if not isinstance(controls, Tensor) or tuple(controls.shape) != expected:
        came = f"shape {tuple(controls.shape)}" if isinstance(controls, Tensor) else type(controls).__name__
        raise ProgramError(f"{about} gave {came}, expected a tensor of shape {expected}", site=site)
    if not controls.isfinite().all():
        raise ProgramError(f"{about} gave a control that is not finite")
    return controls
