"""What a filter of the program says of given drives: log p(y), and where the vehicle probably was.

A filter that looks ahead needs some hundred particles where the bootstrap filter needs thousands, and finds a start of
which only a broad prior is known; it needs normal noise (see `linearize`).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError, require
from steady_ppl.gaussian.information_filter import Lookahead
from steady_ppl.gaussian.linearize import why_not_linear
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.gaussian.twisted_proposal import Twist
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.smc.filter import particle_filter
from steady_ppl.smc.genealogy import Filtered
from steady_ppl.utils.cores import one_thread


@one_thread()
def run_filter(
    program: Program,
    data: Trajectories,
    *,
    particles: int,
    known_start: bool,
    look_ahead: bool = False,
    keep_history: bool = True,
    kernels: bool | None = None,
) -> Filtered:
    """The particle filter at observation weight 1, bootstrap or looking ahead; settings and errors are those of
    `particle_filter`."""
    proposal = Twist(find_and_smooth(Problem(program, data, known_start))) if look_ahead else None
    more: dict[str, Any] = {"proposal": proposal, "keep_history": keep_history, "kernels": kernels}
    return particle_filter(program, data, particles=particles, known_start=known_start, **more)


@dataclass(frozen=True)
class FilterChoice:
    """Which filter suits a program: the one that looks ahead wherever its noise is normal."""

    particles: int  # N, for each trajectory
    look_ahead: bool
    name: str  # "lookahead", or "bootstrap" and why


def choose_filter(
    program: Program,
    data: Trajectories,
    *,
    known_start: bool,
    particles: int | None = None,
    look_ahead: bool | None = None,
) -> FilterChoice:
    """Settle what is None: the filter by the program's noise, its particles (200 looking ahead, else 5000).
    The arguments are those of `evidence`; fewer than one particle are a UsageError."""
    reason = why_not_linear(program, data, known_start=known_start) if look_ahead is None else "as asked"
    ahead = reason is None if look_ahead is None else look_ahead
    count = (200 if ahead else 5000) if particles is None else particles
    require(count >= 1, "particles", count, "at least 1")
    return FilterChoice(count, ahead, "lookahead" if ahead else f"bootstrap ({reason})")


def neglected(
    program: Program,
    data: Trajectories,
    *,
    known_start: bool,
    particles: int = 200,
    ahead: Lookahead | None = None,
    kernels: bool | None = None,
) -> Tensor:
    """What the linearised program neglects: log p(y) by the filter that looks ahead, less the linearised program's,
    `(B,)` nats, with the filter's Monte-Carlo error.

    Near zero the Gaussian guide draws from the posterior, as far as its path is near the right mode: the filter is
    steered along the same path and cannot tell.

    Args:
        program: with normal noise, or measurements of Student t.
        data: as returned by `for_program`.
        known_start: the first state is certain.
        particles: of the filter, for each trajectory.
        ahead: of these trajectories; found from the measurements when None.
        kernels: see `particle_filter`.
    """
    ahead = ahead or find_and_smooth(Problem(program, data, known_start))
    given: dict[str, Any] = {"particles": particles, "known_start": known_start, "kernels": kernels}
    filtered = particle_filter(program, data, **given, proposal=Twist(ahead), keep_history=False)
    return filtered.log_likelihood - ahead.log_likelihood


def evidence(
    program: Program,
    data: Trajectories,
    *,
    particles: int,
    known_start: bool,
    every: int = 10,
    look_ahead: bool = False,
    kernels: bool | None = None,
) -> tuple[Tensor, Tensor]:
    """Estimate log p(y) of each trajectory, untempered.

    Args:
        program: the state-space model.
        data: as returned by `for_program`.
        particles: N, for each trajectory.
        known_start: start at the true first state.
        every: use the measurements of every n-th row only, the first included (10 turns 10 Hz into 1 Hz).
        look_ahead: propose with a view to the later measurements instead of blindly.
        kernels: see `particle_filter`.

    Returns:
        The estimates, `(B,)`, and `Filtered.scarce`: where it is large they scatter, and are mostly too low.

    Raises:
        DataError: a trajectory has measurements, but none at these rows.
    """
    thinned = data.observed_every(every)
    unseen = data.observed.any(-1).any(0) & ~thinned.observed.any(-1).any(0)
    if bool(unseen.any()):
        label = data.labels[int(unseen.nonzero()[0])]
        raise DataError(
            f"trajectory {label} is measured at none of the rows 1, {1 + every}, {1 + 2 * every}, … of log p(y): "
            "let it begin at a measured row",
            trajectory=label,
        )
    settings: Any = {"known_start": known_start, "look_ahead": look_ahead, "kernels": kernels}
    values, scarce = [], []
    for part in in_parts(thinned, particles, look_ahead=look_ahead):
        filtered = run_filter(program, part, particles=particles, keep_history=False, **settings)
        values.append(filtered.log_likelihood)
        scarce.append(filtered.scarce(part))
    return torch.cat(values), torch.cat(scarce)


@one_thread()
def log_likelihood(program: Program, data: Trajectories, **settings: Any) -> Tensor:
    """The estimate of `evidence`, `(B,)`; settings and errors are its."""
    return evidence(program, data, **settings)[0]


@one_thread()
def smoothed_states(program: Program, data: Trajectories, *, known_start: bool) -> Tensor:
    """Posterior means of the states given all measurements, `(T + 1, B, D)`, of `data` as `for_program` returns them.

    By the iterated smoother, angles on its path's turn; where the program's noise is not normal, from the surviving
    lineages of a bootstrap filter. With a `known_start` the first state is the true one.
    """
    if why_not_linear(program, data, known_start=known_start) is None:
        return find_and_smooth(Problem(program, data, known_start)).path(data).states
    parts = [
        particle_filter(program, part, particles=2000, known_start=known_start).paths(100).states.mean(0)
        for part in in_parts(data, 2000)
    ]
    return torch.cat(parts, 1)


def in_parts(
    data: Trajectories, particles: int, *, look_ahead: bool = False, at_once: int = 200_000
) -> Iterator[Trajectories]:
    """Split into groups of trajectories such that no filter carries more than about `at_once` particles; the search
    for a path to look ahead along uses a thousand itself."""
    particles = max(particles, 1000) if look_ahead else particles
    return map(data.subset, torch.arange(len(data)).split(max(1, at_once // particles)))
