"""Maximum likelihood (with priors, the posterior's mode) of a linearised program by scoring steps.

Steps solve the information matrix against the score. It begins as the cross products of the drives' scores (Berndt,
Hall, Hall and Hausman 1974) unless it is known, and learns on the way (Broyden, Fletcher, Goldfarb and Shanno).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from steady_ppl.data import Trajectories
from steady_ppl.elements import Element, elements, moved, set_values, values_of
from steady_ppl.errors import FilterError
from steady_ppl.gaussian_smoother import find_path, require_found, resting_path, smooth
from steady_ppl.journal import Piece, piece
from steady_ppl.linearization import Path
from steady_ppl.lookahead import Lookahead
from steady_ppl.program import Program
from steady_ppl.progress import stages
from steady_ppl.scores import parameter_scores, smoothed

PASSES, TOLERANCE = 3, 0.03  # linearisations a step, and when paths are at rest, in standard deviations of the noise
PATIENT = 30  # linearisations a step once no share of a step was accepted: some path swings about its mode
REACH = 150  # steps of differences, 1.5 of a logarithm: the most that a number moves at once
FEWER = 0.8  # share of fits that take one step more, by which the time left is told
GIVES_WAY = 0.3  # nats by which an objective may fall: paths are at rest but for the tolerance


@dataclass(frozen=True)
class Maximum:
    """A program at its maximum.

    Attributes:
        log_likelihood: `(B,)` log p(y) of the linearised program.
        objective: their sum and the log prior.
        path: the posterior means of the drives, along which it is linearised.
        names: of the learnable numbers.
        information: `(P, P)` in the unconstrained space.
        steps: scoring steps taken.
        decrement: what another step would still gain, nats; None where nobody has looked.
        gained: objective above that at the parameters from which it began, nats.
    """

    log_likelihood: Tensor
    objective: float
    path: Path
    names: tuple[str, ...]
    information: Tensor
    steps: int
    decrement: float | None
    gained: float

    @property
    def converged(self) -> bool:
        """Whether a step would gain less than a tenth of a nat."""
        return self.decrement is None or self.decrement < 0.1


@torch.no_grad()
def maximise(
    program: Program,
    data: Trajectories,
    path: Path | None = None,
    *,
    known_start: bool = False,
    information: Tensor | None = None,
    steps: int = 25,
    precision: float = 0.02,
    hopeless: float = -math.inf,
) -> Maximum:
    """Move a program's parameters, in place, to where log p(y) of the linearised program plus the log prior is largest.

    Args:
        program: with normal noise; see `linearize`.
        data: as returned by `for_program`.
        path: of the drives, near their posterior means; found from the measurements when None.
        known_start: the first state is certain.
        information: `(P, P)` of the learnable numbers, where it is known.
        steps: scoring steps at most.
        precision: stop when another step would gain less, nats.
        hopeless: give up where a few steps have not brought log p(y) above this.

    Raises:
        FilterError: the program cannot be smoothed at its initial parameters.
    """
    return kept_maximum(
        program, lambda: _climb(program, data, path, known_start, information, steps, precision, hopeless)
    )


def kept_maximum(program: Program, climb: Callable[[], Maximum]) -> Maximum:
    """A maximum as a piece of a journal: what `climb` returns, with the program moved there."""

    def compute() -> Piece:
        found = climb()
        tensors = {name: getattr(found, name) for name in ("log_likelihood", "information")}
        tensors |= {"states": found.path.states, "noise": found.path.noise}
        tensors |= {f"program/{name}": value for name, value in program.state_dict().items()}
        return tensors, {name: getattr(found, name) for name in ("objective", "names", "steps", "decrement", "gained")}

    tensors, values = piece(compute)
    program.load_state_dict({name: tensors[f"program/{name}"] for name in program.state_dict()})
    path = Path(tensors["states"], tensors["noise"])
    values = {**values, "names": tuple(values["names"])}
    return Maximum(log_likelihood=tensors["log_likelihood"], information=tensors["information"], path=path, **values)


def _climb(
    program: Program,
    data: Trajectories,
    path: Path | None,
    known_start: bool,
    information: Tensor | None,
    steps: int,
    precision: float,
    hopeless: float,
) -> Maximum:
    parts = elements(program)
    here = _look(program, data, path or find_path(program, data, known_start=known_start), known_start, parts)
    require_found(here.ahead, program, data)
    began, reach = here.objective, torch.tensor([REACH * part.step for part in parts], dtype=torch.float64)
    information = _firm(_of_drives(here) if information is None else information)
    taken, decrement, passes = 0, 0.0, PASSES
    with stages(*(("", FEWER**step) for step in range(steps + 1))) as begin:
        for taken in range(steps + 1):
            begin()
            move, singular = torch.linalg.solve_ex(information, here.gradient)
            if singular:
                raise FilterError(
                    "the likeliest parameters cannot be found: the drives do not tell them apart (singular)"
                )
            decrement = 0.5 * float(here.gradient @ move)
            behind = taken >= 6 and float(here.ahead.log_likelihood.sum()) < hopeless
            if decrement < precision or taken == steps or behind:
                break
            move = move * min(1.0, 1 / max(1e-9, float((move.abs() / reach).max())))
            share, there = _searched(program, data, here, move, known_start, parts, passes)
            if there is not None:
                information = _updated(information, share * move, here.gradient - there.gradient)
                here = there
            elif passes == PATIENT:
                break
            else:
                passes = PATIENT
                here = _look(program, data, here.path, known_start, parts, passes)
                information = _firm(_of_drives(here))
    return _maximum(here, parts, information, taken, decrement, began)


def _searched(
    program: Program,
    data: Trajectories,
    here: _Here,
    move: Tensor,
    known_start: bool,
    parts: list[Element],
    passes: int,
) -> tuple[float, _Here | None]:
    """The share of a move that does not fall, and where it leads; None where none does and nothing is moved."""
    share, before = 1.0 if bool(torch.isfinite(move).all()) else 0.0, values_of(parts)
    while share > 0.01:
        set_values(parts, before + share * move)
        there = _try(program, data, here.path, known_start, parts, passes)
        if there is not None and there.objective >= here.objective - GIVES_WAY:
            return share, there
        share /= 3
    set_values(parts, before)
    return 0.0, None


def _of_drives(here: _Here) -> Tensor:
    by_drive = here.scores - here.scores.mean(0)
    information = by_drive.T @ by_drive
    return information + 0.1 * torch.diag(information.diagonal())


def _firm(information: Tensor) -> Tensor:
    return information + 1e-6 * torch.diag(information.diagonal()) + 1e-3 * torch.eye(len(information)).double()


@dataclass(frozen=True)
class _Here:
    ahead: Lookahead
    path: Path
    scores: Tensor
    gradient: Tensor
    objective: float


def _look(
    program: Program, data: Trajectories, path: Path, known_start: bool, parts: list[Element], passes: int = PASSES
) -> _Here:
    ahead = smooth(program, data, path, known_start=known_start, passes=passes, tolerance=TOLERANCE, kernels=False)
    scores = parameter_scores(program, data, smoothed(ahead, data), parts)
    prior, slope = _prior(program, parts)
    return _Here(
        ahead=ahead,
        path=resting_path(ahead, data),
        scores=scores,
        gradient=scores.sum(0) + slope,
        objective=float(ahead.log_likelihood.sum()) + prior,
    )


def posterior_score(program: Program, data: Trajectories, path: Path, known_start: bool) -> Tensor:
    """The slope of log p(y) and the log prior where the program is, `(P,)`, along the best path near `path`.

    Raises:
        FilterError: the program blows up there.
    """
    return _look(program, data, path, known_start, elements(program), PATIENT).gradient


def _try(
    program: Program, data: Trajectories, path: Path, known_start: bool, parts: list[Element], passes: int
) -> _Here | None:
    """None where the step went too far: the program blows up there."""
    try:
        here = _look(program, data, path, known_start, parts, passes)
    except FilterError:
        return None
    finite = bool(torch.isfinite(here.ahead.log_likelihood).all()) and bool(torch.isfinite(here.gradient).all())
    return here if finite else None


def _prior(program: Program, parts: list[Element]) -> tuple[float, Tensor]:
    """The log prior and its slope in the unconstrained space, without the Jacobian: for the parameter's own mode."""

    slope = torch.zeros(len(parts), dtype=torch.float64)
    if not program.priors:
        return 0.0, slope
    for index, part in enumerate(parts):
        if part.name.split("[")[0] in program.priors:
            with moved(part, part.step):
                up = log_prior(program)
            with moved(part, -part.step):
                slope[index] = (up - log_prior(program)) / (2 * part.step)
    return log_prior(program), slope


def log_prior(program: Program) -> float:
    """Of the parameters that have one, of their own values."""
    return sum(float(prior.log_prob(getattr(program, name)).sum()) for name, prior in program.priors.items())


def _updated(information: Tensor, step: Tensor, fall: Tensor) -> Tensor:
    """The BFGS update with `fall` of the score along `step`, damped where no positive curvature is seen (Powell)."""
    through = information @ step
    expected = float(step @ through)
    seen = float(step @ fall)
    if seen < 0.2 * expected:
        share = 0.8 * expected / (expected - seen)
        fall = share * fall + (1 - share) * through
        seen = float(step @ fall)
    return information - torch.outer(through, through) / expected + torch.outer(fall, fall) / seen


def _maximum(
    here: _Here, parts: list[Element], information: Tensor, taken: int, decrement: float, began: float
) -> Maximum:
    return Maximum(
        log_likelihood=here.ahead.log_likelihood,
        objective=here.objective,
        path=here.path,
        names=tuple(part.name for part in parts),
        information=information,
        steps=taken,
        decrement=decrement,
        gained=here.objective - began,
    )
