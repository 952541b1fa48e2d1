"""A fix, as navigators call it: what a row's measurements say of the state without any others.

Where there are as many of them as components that they depend on, the most probable state of each row is found by
itself, by Levenberg and Marquardt's method from several places at once. The prior is where the program would take the
vehicle, unobserved, from its `initial`; no true state is looked at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from steady_ppl.data import Trajectories
from steady_ppl.errors import DataError
from steady_ppl.linearization import Path, linearize
from steady_ppl.predictions import simulate_again
from steady_ppl.probe import step_size
from steady_ppl.program import Program, names
from steady_ppl.sites import broadcast_event, running

DAMPING = 1e-2  # of the first step, relative to the curvature


@torch.no_grad()
def fixes(program: Program, data: Trajectories, *, places: int = 32, passes: int = 20) -> Tensor:
    """The most probable state of each row given its own measurements.

    Args:
        program: with normal measurement noise; see `linearize`.
        data: as returned by `for_program`; true states are not looked at.
        places: from which the search begins, drawn from the prior.
        passes: linearisations.

    Returns:
        `(T + 1, B, D)`, angles anywhere on the circle; NaN in components on which no measurement depends, and in rows
        with fewer measurements than components that they do depend on.

    Raises:
        DataError: fewer than two rows of a drive have enough measurements.
    """
    data = data.without_truth()
    left = torch.Size((places, len(data)))
    with running(*left):
        starts = broadcast_event(program.initial(), left, 1)
    _, guesses = simulate_again(program, data, starts, step_size(program))
    copies = data.subset(torch.arange(len(data)).repeat(places))
    prior = _Prior.of(guesses.states.unflatten(1, left), [names(program.states).index(name) for name in program.angles])

    def judged(states: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The states, the cost there, and its negative gradient and curvature."""
        seen = linearize(program, copies, Path(states, guesses.noise))
        weighted = seen.measurement.mT * seen.precision.unsqueeze(-2)
        apart = (prior.mean - states.unflatten(1, left)).flatten(1, 2)
        precision = prior.precision.repeat(1, places, 1)
        cost = (seen.precision * seen.residual.square()).sum(-1) / 2 - seen.log_scale
        cost = cost + (precision * apart.square()).sum(-1) / 2
        downhill = (weighted @ seen.residual.unsqueeze(-1)).squeeze(-1) + precision * apart
        return states, cost, downhill, weighted @ seen.measurement + torch.diag_embed(precision)

    best = judged(guesses.states)
    told = (linearize(program, copies, guesses).measurement != 0).flatten(0, 2).any(0)
    damping = torch.full_like(best[1], DAMPING)
    for _ in range(passes):
        states, cost, downhill, curvature = best
        damped = curvature + torch.diag_embed(damping.unsqueeze(-1) * curvature.diagonal(dim1=-2, dim2=-1) + 1e-9)
        tried = judged(states + torch.where(told, torch.linalg.solve(damped, downhill), 0.0).to(states))
        better = tried[1] < cost
        damping = torch.where(better, damping / 5, damping * 5).clamp(1e-9, 1e9)
        best = tuple(_where(better, new, old) for new, old in zip(tried, best, strict=True))  # type: ignore[assignment]
    states, cost = (part.unflatten(1, left) for part in best[:2])
    chosen = cost.nan_to_num(torch.inf).argmin(1)
    states = states.take_along_dim(chosen[:, None, :, None], 1).squeeze(1)
    enough = (data.observed.sum(-1) >= told.sum()) & data.rows
    poor = ~(enough.sum(0) >= 2)
    if bool(poor.any()):
        label = data.labels[int(poor.nonzero()[0])]
        dependent = ", ".join(name for name, tells in zip(names(program.states), told.tolist(), strict=True) if tells)
        raise DataError(
            f"trajectory {label}: in fewer than two rows there are measurements enough, {int(told.sum())}, to tell "
            f"{dependent} from that row alone",
            trajectory=label,
        )
    return torch.where(enough[..., None] & told, states, torch.nan)


@dataclass(frozen=True)
class _Prior:
    """Normal, of each row and drive by itself, flat over angles.

    Attributes:
        mean, precision: `(T + 1, 1, B, D)` and `(T + 1, B, D)`.
    """

    mean: Tensor
    precision: Tensor

    @classmethod
    def of(cls, drawn: Tensor, angles: Sequence[int]) -> _Prior:
        """Of states `(T + 1, S, B, D)`."""
        precision = 1 / drawn.double().var(1).clamp(min=1e-12)
        precision[..., list(angles)] = 0.0
        return cls(drawn.double().mean(1, keepdim=True), precision)


def _where(which: Tensor, one: Tensor, other: Tensor) -> Tensor:
    """By rows and drives, `(T + 1, B)`, whatever is on the right."""
    return torch.where(which.reshape(*which.shape, *[1] * (one.dim() - 2)), one, other)
