"""Check that `transition` is a consistent and a stable time step."""

import copy
import math
from collections.abc import Callable

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import ProgramError
from steady_ppl.model.handlers import draw_starts, running
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import MAX_SUBSTEPS, Held, advance, with_substeps, within_row
from steady_ppl.utils.random import seeded

MIN_GROWTH = 1.1  # of a deviation over a row, from which it counts
SUBSTEP_FACTOR = 16  # times as many substeps, at which it must not grow nearly as much
ROW_SPACING_FACTOR = 1000.0  # times, by which rows are moved apart to see whether actuators look at time
LONG_STEP_RATIO = 1.5  # times the usual step, from which the message names a row's length
STEP_DIVISOR = 64  # times, by which a step is shortened to see whether its result follows
PROBED_STATES, PROBED_ROWS = 64, 16  # at which a transition is looked at
PROBED_COMMAND_ROWS = 256  # rows of commands, at which actuators are looked at
MAX_SUBSTEPS_AHEAD = 1600  # substeps that a program moves on to see where it comes: of 100 rows where it takes one
_Given = tuple[Tensor, Tensor, Tensor]  # control, time and step


@torch.no_grad()
def divergence(program: Program, data: Trajectories, rows: int | None = None) -> str | None:
    """Say that a program's step is unstable, or return None where it is not.

    A deviation that grows at the program's own step but not in `SUBSTEP_FACTOR` times as many substeps grows because of
    the step. Eigenvalues of a row's derivative in the state say so. They are looked at where drives begin and where the
    program comes from there in fine steps without noise: a drag may be too stiff at speed alone. Of each drive of
    `data`, as returned by `for_program`, the first `rows` are looked at; all when None.
    """
    steps = torch.where(data.transitions, data.steps, 0.0)[:rows]
    if not bool(steps.any()):
        return None
    finer = with_substeps(program, min(MAX_SUBSTEPS, SUBSTEP_FACTOR * program.substeps))
    state, given = _visited(finer, data, steps)
    own, fine = _eigenvalues(program, state, given), _eigenvalues(finer, state, given)
    if own is None or fine is None:
        return None
    growth = (own.abs().amax(-1) / fine.abs().amax(-1).clamp(min=1.0)).flatten()
    worst = int(growth.argmax())
    control, time, step = given
    once = _eigenvalues(with_substeps(program, 1), state, (control, time, step / program.substeps))
    if once is None or float(growth[worst]) <= MIN_GROWTH:
        return None
    there = once.flatten(0, -2)[worst]
    fastest = there[(there - 1).abs().argmax()]
    length = float(step.expand(once.shape[:-1]).flatten()[worst])
    long = f" in a row of {length:.3g} s" if length > LONG_STEP_RATIO * data.median_step else ""
    size = float((1 - fastest).abs()) * program.substeps
    kind = "damping" if float(fastest.imag.abs()) < 0.1 * size else "frequency"
    enough = min(MAX_SUBSTEPS, 2 ** math.ceil(math.log2(max(2.0, 2 * size))))
    return (
        f"the model itself diverges at this step{long}: {kind} · step = {size:.3g}, with {program.substeps} "
        f"substep{'s' if program.substeps > 1 else ''} a row; take more (fit with --substeps {enough})"
    )


def _eigenvalues(program: Program, state: Tensor, given: _Given) -> Tensor | None:
    """Of the row's derivative in the state, `(..., D)` at states `(..., D)`; None where one is no number."""
    program, state = copy.deepcopy(program).double(), state.double()  # of which small differences have digits
    given = (given[0].double(), given[1].double(), given[2].double())
    columns, usual = [], state.abs().flatten(0, -2).amax(0)
    usual = torch.where(usual > 0, usual, 1.0)
    for unit in torch.eye(len(usual)).to(state):
        by = 1e-3 * (usual + state.abs()) * unit
        ends = [_after(program, state + moved, given, 0.0).expand(*state.shape) for moved in (by, -by)]
        columns.append((ends[0] - ends[1]) / (2 * by.sum(-1, keepdim=True)))
    derivative = torch.stack(columns, -1).double()
    return torch.linalg.eigvals(derivative) if bool(derivative.isfinite().all()) else None


def _visited(finer: Program, data: Trajectories, steps: Tensor) -> tuple[Tensor, _Given]:
    """States that a program comes to, `(PROBED_STATES, R, 1, D)`, and control, time and step of these rows.

    The longest row of all is looked at from the start; the others are of the drive that it belongs to.
    """
    drive = int(steps.amax(0).argmax())
    rows = torch.where(steps[:, drive] > 0)[0][: max(1, MAX_SUBSTEPS_AHEAD // finer.substeps)]
    longest = steps[:, drive].argmax().reshape(1)
    states = [_starts(finer, 1)]
    for row in rows[:-1].tolist():
        at = slice(row, row + 1)
        ahead = _after(finer, states[-1], _given(data, drive, at), 0.0)
        if not bool(ahead.isfinite().all()):
            break
        states.append(ahead)
    chosen = torch.linspace(0, len(states) - 1, min(PROBED_ROWS, len(states))).long()
    looked = torch.cat([longest.to(rows), rows[chosen.to(rows.device)]])
    return torch.cat([states[0], *(states[index] for index in chosen.tolist())], 1), _given(data, drive, looked)


@torch.no_grad()
def is_step(program: Program, data: Trajectories) -> bool:
    """Return whether `transition` moves less and less as `step` gets shorter, in rows of data for the program.

    A program that holds something within each step (`-w / step`) or counts rows (`0.8 * state`) does not: in substeps
    it is another program. What is kept of a row, as a mean acceleration, is no part of this.
    """
    if not bool(data.transitions.any()) or counts_rows(program):
        return False
    state, (control, time, step) = _probe_points(program, data)
    own = with_substeps(program, 1)
    changes = []
    for short in (step, step / STEP_DIVISOR):
        with within_row():
            still, pushed = (_after(own, state, (control, time, short), noise) for noise in (0.0, 1.0))
        changes.append((_largest(still - state), _largest(pushed - still)))
    (far, pushed_far), (near, pushed_near) = changes
    moves = near <= 0.5 * far + 1e-6 * _largest(state)
    noise = pushed_near <= 0.1 * pushed_far + 1e-6 * _largest(state)
    of_row = torch.tensor([name in program.kept_names for name in program.state_names], device=state.device)
    return bool((moves & noise | of_row).all())


@torch.no_grad()
def counts_rows(program: Program) -> bool:
    """Return whether `actuators` of one of its classes goes by how many rows there are, not by the time between them.

    A delay that is a number of rows (`control.roll(1, 0)`) is another delay in substeps; play, which goes by the
    commands alone, is the same. Each class that defines `actuators` is looked at, so that a lag on top of such a delay
    does not hide it.
    """
    kinds = [kind for kind in type(program).__mro__ if kind is not Program]
    if not (methods := [vars(kind)["actuators"] for kind in kinds if "actuators" in vars(kind)]):
        return False
    like = next(program.parameters(), torch.zeros(()))
    with seeded("commands"):
        commands = torch.randn(PROBED_COMMAND_ROWS, 1, len(program.controls)).to(like)
    times = program.step * torch.arange(PROBED_COMMAND_ROWS).to(like).unsqueeze(-1)
    twice = 0.5 * program.step * torch.arange(2 * PROBED_COMMAND_ROWS).to(like).unsqueeze(-1)

    def counts(act: Callable[[Program, Tensor, Tensor], Tensor]) -> bool:
        acting = act(program, commands, times)
        if not torch.equal(acting, act(program, commands, ROW_SPACING_FACTOR * times)):
            return False
        return not torch.equal(acting.repeat_interleave(2, 0), act(program, commands.repeat_interleave(2, 0), twice))

    return any(counts(method) for method in methods)


@torch.no_grad()
def can_be_cut(program: Program, data: Trajectories) -> bool:
    """Return whether rows of drives, as returned by `for_program`, can be taken in substeps: `require_convergence`."""
    if not bool(data.transitions.any()):
        return True
    state, given = _probe_points(program, data)
    try:
        require_convergence(program, state, *given)
    except ProgramError:
        return False
    return True


@torch.no_grad()
def require_convergence(program: Program, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> None:
    """Raise ProgramError for a program whose actuators count rows, or whose rows, given as to `advance`, at K and 2 K
    substeps differ more for large K than for small ones."""
    if counts_rows(program):
        what = "actuators counts rows and not seconds, which is another delay in substeps"
        how = "shift commands by `time`, for example with steady_ppl.delayed"
        raise ProgramError(f"model {type(program).__name__}: {what}; {how}", site="actuators")

    def ends(count: int) -> Tensor:
        return _after(with_substeps(program, count), state, (control, time, step), 1.0)

    coarse, fine = (_largest(ends(count) - ends(2 * count)) for count in (8, STEP_DIVISOR))
    beyond = fine - 0.7 * coarse - 1e-4 * _largest(ends(8))
    beyond = torch.where(fine.isfinite(), beyond, torch.inf)
    if bool((beyond > 0).any()):
        component = program.state_names[int(beyond.argmax())]
        what = f"transition is no step in `step`: at K and 2 K substeps {component} goes apart as K grows"
        how = "move the state in proportion to `step`, with noise that does not depend on it"
        raise ProgramError(f"model {type(program).__name__}: {what}; {how}", site="transition")


def _probe_points(program: Program, data: Trajectories) -> tuple[Tensor, _Given]:
    """States from a program's start, `(PROBED_STATES, R, 1, D)`, and what is given in rows of the longest drive."""
    drive = int(data.transitions.sum(0).argmax())
    rows = torch.where(data.transitions[:, drive])[0]
    rows = rows[torch.linspace(0, len(rows) - 1, min(PROBED_ROWS, len(rows)), device=rows.device).long()]
    return _starts(program, len(rows)), _given(data, drive, rows)


def _given(data: Trajectories, drive: int, rows: Tensor | slice) -> _Given:
    return data.controls[:, [drive]][rows], data.elapsed[:, [drive]][rows], data.steps[:, [drive]][rows]


def _starts(program: Program, rows: int) -> Tensor:
    """States from a program's start, `(PROBED_STATES, rows, 1, D)`."""
    with seeded("starts"):
        return draw_starts(program, PROBED_STATES, rows, 1)


def _after(program: Program, state: Tensor, given: _Given, noise: float) -> Tensor:
    """States after a row in which every channel is `noise` scales from its location."""
    with running(*state.shape[:-1]), Held(noise):
        return advance(program, state, *given)


def _largest(change: Tensor) -> Tensor:
    """The largest of every component, `(D,)`; infinite where it is no number."""
    return change.abs().flatten(0, -2).nan_to_num(torch.inf).amax(0)
