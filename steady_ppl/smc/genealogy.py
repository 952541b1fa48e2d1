"""Whole trajectories: equally weighted draws, and the genealogy of a filter that they are traced back through."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
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


@dataclass(frozen=True)
class Filtered:
    """What a filter leaves behind. The particles' history has a tensor a row, and is empty when it was not kept.

    Attributes:
        log_likelihood: `(B,)` the estimate of log p(y), whose exponential is unbiased at observation weight 1.
        log_weights: `(N, B)` of the last row's particles, normalised.
        effective_sizes: `(T + 1, B)` ESS after each observed row (each row when looking ahead), or N.
        roots: `(B,)` how many of the first row's particles still have descendants at the end.
        blown_up: `(B,)` how many weights were not numbers, summed over rows; they count as zero.
        states: history, `(N, B, D)` each.
        start: value of each site of `initial`, `(N, B, ...)`.
        noise: history of each site of `transition`, `(N, B, ...)` each.
        ancestors: history, `(N, B)` each; None where each particle moved on.
        event_dims: event dimension of each site, and of "states".
        in_plain_torch: why no kernels served; None where they did or were not asked for.
        channels: where `noise` is standardised, its sites' values, of states `(M, T + 1, B, D)` and their noise.
    """

    log_likelihood: Tensor
    log_weights: Tensor
    effective_sizes: Tensor
    roots: Tensor
    blown_up: Tensor
    states: list[Tensor]
    start: dict[str, Tensor]
    noise: dict[str, list[Tensor]]
    ancestors: list[Tensor | None]
    event_dims: dict[str, int]
    in_plain_torch: str | None = None
    channels: Callable[[Tensor, dict[str, Tensor]], dict[str, Tensor]] | None = None

    def scarce(self, data: Trajectories) -> Tensor:
        """Share of a trajectory's measured rows after which fewer than `MIN_EFFECTIVE_SIZE` were in effect, `(B,)`."""
        measured = data.observed.any(-1)
        return ((self.effective_sizes < MIN_EFFECTIVE_SIZE) & measured).sum(0) / measured.sum(0).clamp(min=1)

    def paths(self, draws: int) -> Paths:
        """Equally weighted paths, resampled systematically from all surviving lineages and traced back."""
        index = systematic(self.log_weights.exp(), draws)
        states, noise = [take(self.states[-1], index)], {site: list[Tensor]() for site in self.noise}
        for row in range(len(self.states) - 2, -1, -1):
            for site, values in self.noise.items():
                noise[site].append(take(values[row], index))
            ancestors = self.ancestors[row]
            if ancestors is not None:
                index = take(ancestors, index)
            states.append(take(self.states[row], index))
        path = torch.stack(states[::-1], 1)
        along = {site: torch.stack(values[::-1], 1) for site, values in noise.items()}
        return Paths(
            states=path,
            start={site: take(value, index).unsqueeze(1) for site, value in self.start.items()},
            noise=along if self.channels is None else self.channels(path, along),
            event_dims=self.event_dims,
        )


def degeneracy_note(roots: float) -> str | None:
    """What is to be said where so many of the particles' starts survive a drive: all paths begin alike."""
    return (
        f"of the particles' starts {roots:.0f} survive a drive: raise particles" if roots < MIN_EFFECTIVE_SIZE else None
    )
