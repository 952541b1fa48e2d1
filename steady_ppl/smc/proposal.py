"""Where a particle filter's noise comes from."""

from __future__ import annotations

import torch
from torch import Tensor


class Proposal:
    """The program's own noise: the bootstrap filter (Gordon, Salmond and Smith 1993).

    A subclass draws the noise itself. Its log ratios enter the weights, and it may resample at every row.

    Attributes:
        looks_ahead: whether weights know of later measurements, at measured rows and at others.
    """

    looks_ahead = False

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
