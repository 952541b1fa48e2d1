"""How a particle filter draws noise: as the program does, or steered towards the later measurements.

Whatever the lookahead is, the filter's estimate of p(y) stays unbiased: each noise is weighted by the ratio of its own
density to that of the mixture which it was drawn from. A fixed share of untwisted draws bounds these ratios by one over
the share.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from steady_ppl import twisting
from steady_ppl.lookahead import Lookahead, look_ahead
from steady_ppl.twisting import inverse


class Proposal:
    """The program's own noise: the bootstrap filter.

    Attributes:
        looks_ahead: whether weights know of later measurements, at measured rows and at others.
    """

    looks_ahead = False

    def start(self, particles: int) -> tuple[Tensor | None, Tensor | float]:
        """The standard normal noise of `initial`, `(N, B, C)`, and its log density less that of the proposal, `(N, B)`;
        None lets the program draw."""
        return None, 0.0

    def step(self, row: int, state: Tensor) -> tuple[Tensor | None, Tensor | float]:
        """The same for the `transition` after a row, from states `(N, B, D)`."""
        return None, 0.0

    def log_future(self, row: int, state: Tensor) -> Tensor:
        """What is thought of all measurements after a row, `(N, B)` in double precision."""
        return state.new_zeros(state.shape[:-1], dtype=torch.float64)


class Twist(Proposal):
    """A lookahead as proposals.

    Args:
        lookahead: along any path; the closer to the posterior, the smaller the variance.
        untwisted: probability with which a particle draws one step's noise as the program does. At 100 intervals a
            share of .05 doubles the scatter of log p(y) that .01 has.
        tempered: weight of the later measurements as the twist sees them, relative to their own; less than 1 guards
            against a twist that is narrower than the posterior.
    """

    looks_ahead = True

    def __init__(self, lookahead: Lookahead, *, untwisted: float = 0.01, tempered: float = 1.0) -> None:
        if not 0 <= untwisted < 1:
            raise ValueError(f"the untwisted share is in [0, 1), got {untwisted}")
        if not 0 < tempered <= 1:
            raise ValueError(f"the weight of the tempered measurements is in (0, 1], got {tempered}")
        if tempered < 1:
            seen = lookahead.linearization
            weighted = replace(seen, precision=tempered * seen.precision, log_scale=tempered * seen.log_scale)
            lookahead = look_ahead(weighted)
        self.lookahead, self.untwisted = lookahead, untwisted
        path, steps = lookahead.linearization.path.states, lookahead.steps
        self.dtype, self.path = path.dtype, path.double()
        self.angles = torch.zeros(path.shape[-1], dtype=torch.bool, device=path.device)
        self.angles[list(lookahead.linearization.angles)] = True
        self.steering = (steps.shift, steps.gain, steps.factor, inverse(steps.factor))

    def log_future(self, row: int, state: Tensor) -> Tensor:
        ahead = self.lookahead
        future = twisting.log_future if state.device.type == "cpu" else twisting.log_future_in_parallel
        parts = (self.path[row], self.angles, ahead.precision[row], ahead.information[row], ahead.log_scale[row])
        return future(state, *parts)

    def start(self, particles: int) -> tuple[Tensor | None, Tensor | float]:
        ahead = self.lookahead
        starts = ahead.starts
        winding = torch.distributions.Categorical(logits=ahead.winding_masses.t()).sample((particles,))
        trajectory = torch.arange(winding.shape[1], device=winding.device)
        shift = starts.shift[winding, trajectory]
        own = torch.randn_like(shift)
        twisted = shift + (starts.factor[winding, trajectory] @ own.unsqueeze(-1)).squeeze(-1)
        stays = torch.rand(own.shape[:-1], dtype=torch.float64, device=own.device) < self.untwisted
        noise = torch.where(stays.unsqueeze(-1), own, twisted)
        whitening = inverse(starts.factor)
        ratios = [
            ahead.winding_masses[k] + twisting.log_ratio(noise, starts.shift[k], whitening[k])
            for k in range(len(ahead.windings))
        ]
        return noise.to(self.dtype), -twisting.mixture(torch.stack(ratios).logsumexp(0), self.untwisted)

    def step(self, row: int, state: Tensor) -> tuple[Tensor | None, Tensor | float]:
        particles, trajectories = state.shape[:2]
        kind: Any = {"device": state.device, "dtype": self.dtype}
        own = torch.randn(self.steering[0].shape[-1], trajectories, particles, **kind).permute(2, 1, 0)
        stays = torch.zeros(trajectories, particles, dtype=torch.bool, device=state.device).t()
        if self.untwisted:
            stays = torch.rand(trajectories, particles, **kind).t() < self.untwisted
        steer = twisting.steer if state.device.type == "cpu" else twisting.steer_in_parallel
        shift, gain, factor, whitening = (part[row] for part in self.steering)
        steering = shift, gain, factor, whitening
        return steer(state, self.path[row], self.angles, steering, own, stays, self.untwisted)
