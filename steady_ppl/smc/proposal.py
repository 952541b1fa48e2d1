"""Where a particle filter's noise comes from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


class Proposal:
    """The program's own noise: the bootstrap filter (Gordon, Salmond and Smith 1993).

    A subclass draws the noise itself. Its log ratios enter the weights, and it may resample at every row.
    """

    looks_ahead = False  # whether weights know of later measurements, at measured rows and at others

    def start(self, particles: int) -> tuple[Tensor | None, Tensor | float]:
        """The standard normal noise of `initial`, `(N, B, C)`, and its log density less that of the proposal, `(N, B)`;
        None lets the program draw."""
        return None, 0.0

    def step(self, row: int, state: Tensor) -> tuple[Tensor | None, Tensor | float]:
        """The same for the `transition` after a row, from the states that it moves, `(N, B, D)`, already resampled."""
        return None, 0.0

    def log_future(self, row: int, state: Tensor) -> Tensor:
        """What is thought of all measurements after a row, `(N, B)` in double precision."""
        return state.new_zeros(state.shape[:-1], dtype=torch.float64)

    # The same as functions of one particle `(..., D)`, for kernels; what differs between rows and trajectories is given

    rows: Sequence[Tensor] = ()  # what `future` takes of each, (T + 1, B, ...)
    intervals: Sequence[Tensor] = ()  # what `steered` takes of each, (T, B, ...)

    def future(self, state: Tensor, *given: Tensor) -> Tensor:
        """`log_future` `(...)`, but for a number of the trajectory: no weight needs it."""
        return torch.zeros_like(state[..., 0])

    def steered(self, state: Tensor, own: Tensor, chance: Tensor, *given: Tensor) -> tuple[Tensor, Tensor]:
        """What `step` draws, of standard normal numbers `(..., C)` and a uniform one `(..., 1)`."""
        return own, torch.zeros_like(state[..., 0])


class Steered(Proposal):
    """A proposal that looks ahead, by its functions `future` and `steered` of one particle."""

    looks_ahead = True
    channels: int  # C

    def log_future(self, row: int, state: Tensor) -> Tensor:
        return self.future(state, *(given[row] for given in self.rows))

    def step(self, row: int, state: Tensor) -> tuple[Tensor | None, Tensor | float]:
        kind: Any = {"device": state.device, "dtype": state.dtype}
        own = torch.randn(self.channels, *state.shape[1::-1], **kind).permute(2, 1, 0)
        chance = torch.rand(1, *state.shape[1::-1], **kind).permute(2, 1, 0)
        noise, ratio = self.steered(state, own, chance, *(given[row] for given in self.intervals))
        return noise.to(state.dtype), ratio
