"""What a filter of the program says of given drives: log p(y), and where the vehicle probably was."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from steady_ppl.data import Trajectories
from steady_ppl.errors import DataError
from steady_ppl.particles import particle_filter
from steady_ppl.program import Program


def log_likelihood(
    program: Program, data: Trajectories, *, particles: int, known_start: bool, every: int = 10
) -> Tensor:
    """Estimate log p(y) of each trajectory, untempered.

    Args:
        program: the state-space model.
        data: as returned by `for_program`.
        particles: N, for each trajectory.
        known_start: start at the true first state.
        every: use the measurements of every n-th row only, the first included (10 turns 10 Hz into 1 Hz).

    Returns:
        `(B,)`.

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
    parts = [
        particle_filter(program, part, particles=particles, known_start=known_start, keep_history=False).log_likelihood
        for part in in_parts(thinned, particles)
    ]
    return torch.cat(parts)


def smoothed_states(program: Program, data: Trajectories, *, known_start: bool, particles: int = 2000) -> Tensor:
    """Posterior means of the states given all measurements, from the surviving lineages of a filter.

    Args:
        program: the state-space model.
        data: as returned by `for_program`.
        particles: N, for each trajectory.
        known_start: start at the true first state.

    Returns:
        `(T + 1, B, D)`.
    """
    parts = [
        particle_filter(program, part, particles=particles, known_start=known_start).paths(100).states.mean(0)
        for part in in_parts(data, particles)
    ]
    return torch.cat(parts, 1)


def in_parts(data: Trajectories, particles: int, at_once: int = 200_000) -> Iterator[Trajectories]:
    """Split into groups of trajectories such that no filter carries more than about `at_once` particles."""
    size = max(1, at_once // particles)
    for first in range(0, len(data), size):
        yield data.subset(range(first, min(first + size, len(data))))
