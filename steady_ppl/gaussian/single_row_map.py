"""A fix, as navigators call it: what a row's measurements say of the state without any others.

Where there are as many of them as components that they depend on, the most probable state of each row is found by
itself, by Levenberg and Marquardt's method from several places at once. The prior is one for all rows: the region that
the program would visit, unobserved, from its `initial`. How it moves there says nothing; no true state is looked at.
"""

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError
from steady_ppl.gaussian.linearize import linearize_sensors
from steady_ppl.gaussian.predict import simulate_again
from steady_ppl.model.program import Program
from steady_ppl.model.starts import draw_first_states
from steady_ppl.model.validate import noise_size
from steady_ppl.utils.cores import one_thread

MIN_SHARE_OF_VARIANCE = 1e-12  # of the largest square, where the prior knows a component
MIN_CURVATURE = 1e-9  # of the cost, in the prior's own
DAMPING = 1e-2  # of the first step, relative to the curvature
MAX_ROWS_OF_BATCH = 50_000  # rows of all places and drives


@one_thread()
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
        DataError: nothing is measured, or fewer than two rows of a trajectory have enough measurements.
    """
    data = data.without_truth()
    _, made_up = simulate_again(program, data, draw_first_states(program, data, places, len(data)), noise_size(program))
    guesses = made_up.states.unflatten(1, (places, len(data)))  # (T + 1, S, B, D)
    told = (linearize_sensors(program, data, guesses[:, 0]).measurement != 0).flatten(0, 2).any(0)
    enough = (data.observed.sum(-1) >= told.sum()) & data.rows
    _require_enough(program, data, told, enough)
    drawn = guesses[data.rows[:, None].expand(guesses.shape[:3])].double()
    variance = torch.maximum(drawn.var(0), MIN_SHARE_OF_VARIANCE * drawn.square().amax(0))
    usual = torch.where(variance > 0, 1 / variance, 1 / MIN_SHARE_OF_VARIANCE)
    precision = usual.clone()
    precision[list(program.angle_indices)] = 0.0  # normal, flat over angles
    prior = drawn.mean(0), precision, MIN_CURVATURE * usual
    drives = max(1, MAX_ROWS_OF_BATCH // (places * len(data.time)))
    parts = torch.arange(len(data)).split(drives)
    states = [_found(program, data.subset(part), guesses[:, :, part], told, prior, passes) for part in parts]
    return torch.where(enough[..., None] & told, torch.cat(states, 1), torch.nan)


def _require_enough(program: Program, data: Trajectories, told: Tensor, enough: Tensor) -> None:
    """Refuse drives without two rows of `enough` measurements, `(T + 1, B)`, for the components `told`, `(D,)`."""
    if not bool(data.observed.any()):
        raise DataError("nothing is measured: every y. cell of the table is empty")
    for (drive,) in (enough.sum(0) < 2).nonzero()[:1].tolist():
        label = data.labels[drive]
        dependent = ", ".join(name for name, tells in zip(program.state_names, told.tolist(), strict=True) if tells)
        few = f"in fewer than two rows there are measurements enough, {int(told.sum())}"
        what = f"{few}, to tell {dependent} from that row alone; leave such trajectories out"
        raise DataError(f"trajectory {label}: {what}", trajectory=label)


def _found(
    program: Program, data: Trajectories, guesses: Tensor, told: Tensor, prior: tuple[Tensor, ...], passes: int
) -> Tensor:
    """The most probable states `(T + 1, B, D)` of some drives, from guesses `(T + 1, S, B, D)` under a prior's mean and
    precision, with the least curvature that a component is taken to have, each `(D,)`."""
    mean, precision, least = prior
    left = guesses.shape[1:3]
    copies = data.subset(torch.arange(len(data)).repeat(left[0]))

    def judged(states: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The states, the cost there, and its negative gradient and curvature."""
        seen = linearize_sensors(program, copies, states)
        weighted = seen.measurement.mT * seen.precision.unsqueeze(-2)
        apart = mean - states
        cost = (seen.precision * seen.residual.square()).sum(-1) / 2 - seen.log_scale
        cost = cost + (precision * apart.square()).sum(-1) / 2
        downhill = (weighted @ seen.residual.unsqueeze(-1)).squeeze(-1) + precision * apart
        return states, cost, downhill, weighted @ seen.measurement + torch.diag_embed(precision)

    best = judged(guesses.flatten(1, 2))
    damping = torch.full_like(best[1], DAMPING)
    for _ in range(passes):
        states, cost, downhill, curvature = best
        own = curvature.diagonal(dim1=-2, dim2=-1)
        damped = curvature + torch.diag_embed(damping.unsqueeze(-1) * own + least)
        tried = judged(states + torch.where(told, torch.linalg.solve(damped, downhill), 0.0).to(states))
        better = tried[1] < cost
        damping = torch.where(better, damping / 5, damping * 5).clamp(1e-9, 1e9)
        cells = [better[..., None], better, better[..., None], better[..., None, None]]
        best = tuple(map(torch.where, cells, tried, best))  # type: ignore[assignment]
    states, cost = (part.unflatten(1, left) for part in best[:2])
    chosen = cost.nan_to_num(torch.inf).argmin(1)
    return states.take_along_dim(chosen[:, None, :, None], 1).squeeze(1)
