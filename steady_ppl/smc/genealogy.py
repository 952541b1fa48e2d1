"""Whole trajectories: equally weighted draws, and the genealogy of a filter that they are traced back through."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import UsageError
from steady_ppl.model.handlers import Recording, Replaying, running
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import row_inputs, sample_channels
from steady_ppl.smc.resampling import systematic, take

MIN_EFFECTIVE_SIZE = 10  # particles in effect: with fewer, what a filter says hangs on a handful of draws


def event_dims(*seen: Recording) -> dict[str, int]:
    """Event dimension of every site that was met."""
    return {site: fn.event_dim for recording in seen for site, fn in recording.distributions.items()}


@dataclass(frozen=True)
class Paths:
    """Equally weighted draws of whole trajectories, with everything that the joint density needs.

    Attributes:
        states: `(M, T + 1, B, D)`.
        start: value of each site of `initial`, `(M, 1, B, ...)`.
        noise: value of each site of `transition`, `(M, T, B, ...)`.
        event_dims: event dimension of each of these sites, and of "states".
        in_plain_torch: why no kernels served in drawing them; None where they did or were not needed.
    """

    states: Tensor
    start: dict[str, Tensor]
    noise: dict[str, Tensor]
    event_dims: dict[str, int]
    in_plain_torch: str | None = None

    def channels(self, program: Program, data: Trajectories) -> dict[str, Any]:
        """Each channel's distribution along the paths of `data`, given the noise of those before it."""
        states = self.states[:, :-1]
        with running(*states.shape[:-1]), Recording() as seen, Replaying(self.noise):
            sample_channels(program, states, *row_inputs(program, data))
        return seen.distributions

    def within(self, data: Trajectories) -> Paths:
        """Fill the rows past each trajectory's end with its first row, where the program is known to be finite: what
        is masked there would still spoil a gradient if it blew up."""
        if bool(data.rows.all()):
            return self

        def fill(value: Tensor, inside: Tensor) -> Tensor:
            mask = inside.reshape(*inside.shape, *[1] * (value.dim() - 3))
            return torch.where(mask, value, value[:, :1])

        noise = {site: fill(value, data.transitions) for site, value in self.noise.items()}
        return replace(self, states=fill(self.states, data.rows), noise=noise)


class FilterState(NamedTuple):
    """The particles that have come to a row, whose measurements they have yet to meet; at the end, the last row's."""

    states: Tensor  # (N, B, D)
    log_weights: Tensor  # (N, B) double; their exponentials sum to one until a proposal's ratio enters
    roots: Tensor  # (N, B), the first row's particle that each descends from


@dataclass(frozen=True)
class History:
    """Where a filter's particles were, what moved them, and from which they descend.

    Attributes:
        start: the first row's states, `(N, B, D)`.
        intervals: states that each leads to and noise of all channels, `(≥ D + C, B, N)`.
        parents: which particles moved on in each, `(B, N)`; None: each.
        sizes: how many channels each site of `transition` has.
        event_dims: event dimension of each.
    """

    start: Tensor
    intervals: list[Tensor]
    parents: list[Tensor | None]
    sizes: dict[str, int]
    event_dims: dict[str, int]

    def trace(self, index: Tensor) -> tuple[Tensor, dict[str, Tensor], Tensor]:
        """Follow particles `(M, B)` of the last row back: states `(M, T + 1, B, D)`, noise `(M, T, B, ...)` of each
        site, and the first row's particles, `(M, B)`."""
        at, found = index.t(), list[Tensor]()
        for interval, parents in zip(reversed(self.intervals), reversed(self.parents), strict=True):
            found.append(interval.gather(2, at.expand(len(interval), -1, -1)))
            at = at if parents is None else parents.gather(1, at)
        start = take(self.start, at.t()).unsqueeze(1)
        if not found:
            return start, {}, at.t()
        path = torch.stack(found[::-1]).permute(3, 0, 2, 1)
        return torch.cat([start, path[..., : start.shape[-1]]], 1), self.by_site(path), at.t()

    def by_site(self, interval: Tensor) -> dict[str, Tensor]:
        """Noise of each site, `(..., C)` or `(...)`, of states and noise of all channels in the last dimension."""
        first, found = self.start.shape[-1], {}
        for site, size in self.sizes.items():
            values = interval[..., first : first + size]
            found[site], first = values if self.event_dims[site] else values.squeeze(-1), first + size
        return found


class Run(NamedTuple):
    """What a filter does from the first row to the last."""

    end: FilterState
    evidence: Tensor  # (T + 1, B), log p(y_t | y_0 … y_{t-1}); looking ahead they telescope
    effective_sizes: Tensor  # (T + 1, B)
    blown_up: Tensor  # (T + 1, B)
    history: History | None


@dataclass(frozen=True)
class Filtered:
    """What a filter leaves behind.

    Attributes:
        log_likelihood: `(B,)` the estimate of log p(y), whose exponential is unbiased at observation weight 1.
        log_weights: `(N, B)` of the last row's particles, normalised.
        effective_sizes: `(T + 1, B)` ESS after each observed row (each row when looking ahead), or N.
        roots: `(B,)` how many of the first row's particles still have descendants at the end.
        blown_up: `(B,)` how many weights were not numbers, summed over rows; they count as zero.
        start: value of each site of `initial`, `(N, B, ...)`.
        event_dims: event dimension of each site, and of "states".
        history: of the particles; None when it was not kept.
        in_plain_torch: why no kernels served; None where they did or were not asked for.
        channels: where noise is standardised, its sites' values, of states `(M, T + 1, B, D)` and their noise.
    """

    log_likelihood: Tensor
    log_weights: Tensor
    effective_sizes: Tensor
    roots: Tensor
    blown_up: Tensor
    start: dict[str, Tensor]
    event_dims: dict[str, int]
    history: History | None
    in_plain_torch: str | None = None
    channels: Callable[[Tensor, dict[str, Tensor]], dict[str, Tensor]] | None = None

    @cached_property
    def states(self) -> list[Tensor]:
        """The history's states, `(N, B, D)` a row; empty when it was not kept, as those below."""
        if self.history is None:
            return []
        start = self.history.start
        return [start, *(one[: start.shape[-1]].permute(2, 1, 0) for one in self.history.intervals)]

    @cached_property
    def noise(self) -> dict[str, list[Tensor]]:
        """The history's noise: of each site of `transition` values `(N, B, ...)`, an interval each."""
        if self.history is None:
            return {}
        parts = [self.history.by_site(one.permute(2, 1, 0)) for one in self.history.intervals]
        return {site: [part[site] for part in parts] for site in self.history.sizes}

    @cached_property
    def ancestors(self) -> list[Tensor | None]:
        """The history's ancestors, `(N, B)` an interval; None where each particle moved on."""
        return [] if self.history is None else [None if one is None else one.t() for one in self.history.parents]

    def scarce(self, data: Trajectories) -> Tensor:
        """Share of a trajectory's measured rows after which fewer than `MIN_EFFECTIVE_SIZE` were in effect, `(B,)`."""
        measured = data.observed.any(-1)
        return ((self.effective_sizes < MIN_EFFECTIVE_SIZE) & measured).sum(0) / measured.sum(0).clamp(min=1)

    def paths(self, draws: int) -> Paths:
        """Equally weighted paths, resampled systematically from all surviving lineages and traced back.

        Raises:
            UsageError: the filter kept no history.
        """
        if self.history is None:
            raise UsageError("paths need the particles' history: filter with keep_history=True")
        states, noise, index = self.history.trace(systematic(self.log_weights.exp(), draws))
        return Paths(
            states=states,
            start={site: take(value, index).unsqueeze(1) for site, value in self.start.items()},
            noise=noise if self.channels is None else self.channels(states, noise),
            event_dims=self.event_dims,
        )


def degeneracy_note(roots: float) -> str | None:
    """What is to be said where so many of the particles' starts survive a drive: all paths begin alike."""
    few = f"of the particles' starts {roots:.0f} survive a trajectory: raise particles"
    return few if roots < MIN_EFFECTIVE_SIZE else None
