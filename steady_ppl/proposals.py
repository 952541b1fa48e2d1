"""How a particle filter draws noise: as the program does, or steered towards the later measurements.

Whatever the lookahead is, the filter's estimate of p(y) stays unbiased: each noise is weighted by the ratio of its own
density to that of the mixture which it was drawn from. A fixed share of untwisted draws bounds these ratios by one over
the share.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor

from steady_ppl.lookahead import Lookahead
from steady_ppl.planar_vehicle import wrap
from steady_ppl.sites import Standardised


class Proposal:
    """The program's own noise: the bootstrap filter.

    Attributes:
        looks_ahead: whether weights know of later measurements, at measured rows and at others.
    """

    looks_ahead = False

    def start(self, particles: int) -> tuple[AbstractContextManager[Any], Tensor | float]:
        """A handler that gives `initial` its noise, and log density less log density of the proposal, `(N, B)`."""
        return nullcontext(), 0.0

    def step(self, row: int, state: Tensor) -> tuple[AbstractContextManager[Any], Tensor | float]:
        """The same for the `transition` after a row, from states `(N, B, D)`."""
        return nullcontext(), 0.0

    def log_future(self, row: int, state: Tensor) -> Tensor:
        """What is thought of all measurements after a row, `(N, B)` in double precision."""
        return state.new_zeros(state.shape[:-1], dtype=torch.float64)


class Twist(Proposal):
    """A lookahead as proposals.

    Args:
        lookahead: along any path; the closer to the posterior, the smaller the variance.
        untwisted: probability with which a particle draws one step's noise as the program does. At 100 intervals a
            share of .05 doubles the scatter of log p(y) that .01 has.
    """

    looks_ahead = True

    def __init__(self, lookahead: Lookahead, *, untwisted: float = 0.01) -> None:
        if not 0 <= untwisted < 1:
            raise ValueError(f"the untwisted share is in [0, 1), got {untwisted}")
        self.lookahead, self.untwisted = lookahead, untwisted
        path = lookahead.linearization.path
        self.path, self.dtype = path.states, path.states.dtype
        self.angles = list(lookahead.linearization.angles)
        self.precision = lookahead.precision.to(self.dtype)
        self.information = lookahead.information.to(self.dtype)
        steps = lookahead.steps
        self.shift, self.gain, self.factor = (v.to(self.dtype) for v in (steps.shift, steps.gain, steps.factor))
        self.whitening = _inverse(steps.factor).to(self.dtype)

    def deviation(self, row: int, state: Tensor) -> Tensor:
        """States `(N, B, D)` less the path's, angles on the circle."""
        deviation = state - self.path[row]
        for angle in self.angles:
            deviation[..., angle] = wrap(deviation[..., angle])
        return deviation

    def log_future(self, row: int, state: Tensor) -> Tensor:
        deviation = self.deviation(row, state)
        pulled = self.information[row] - 0.5 * _times(self.precision[row], deviation)
        return self.lookahead.log_scale[row] + (pulled * deviation).sum(-1).double()

    def start(self, particles: int) -> tuple[AbstractContextManager[Any], Tensor | float]:
        ahead = self.lookahead
        starts = ahead.starts
        winding = torch.distributions.Categorical(logits=ahead.winding_masses.t()).sample((particles,))
        trajectory = torch.arange(winding.shape[1], device=winding.device)
        shift = starts.shift[winding, trajectory]
        own = torch.randn_like(shift)
        twisted = shift + (starts.factor[winding, trajectory] @ own.unsqueeze(-1)).squeeze(-1)
        noise = self._mixed(twisted, own)
        whitening = _inverse(starts.factor)
        ratios = [
            ahead.winding_masses[k] + _log_ratio(noise, starts.shift[k], whitening[k])
            for k in range(len(ahead.windings))
        ]
        handler = Standardised(noise.to(self.dtype).unsqueeze(1))
        return handler, -self._mixture(torch.stack(ratios).logsumexp(0))

    def step(self, row: int, state: Tensor) -> tuple[AbstractContextManager[Any], Tensor | float]:
        mean = self.shift[row] - _times(self.gain[row], self.deviation(row, state))
        own = torch.randn_like(mean)
        noise = self._mixed(mean + _times(self.factor[row], own), own)
        handler = Standardised(noise.unsqueeze(1))
        return handler, -self._mixture(_log_ratio(noise, mean, self.whitening[row]).double())

    def _mixed(self, twisted: Tensor, own: Tensor) -> Tensor:
        if self.untwisted == 0:
            return twisted
        stays = torch.rand(own.shape[:-1], dtype=torch.float64, device=own.device) < self.untwisted
        return torch.where(stays.unsqueeze(-1), own, twisted)

    def _mixture(self, log_ratio: Tensor) -> Tensor:
        """log((1 − share) ratio + share)."""
        if self.untwisted == 0:
            return log_ratio
        log_share = math.log(self.untwisted)
        return torch.logaddexp(log_ratio + math.log1p(-self.untwisted), torch.full_like(log_ratio, log_share))


def _log_ratio(noise: Tensor, mean: Tensor, whitening: Tensor) -> Tensor:
    """log N(noise; mean, factor factorᵀ) − log N(noise; 0, I), `(N, B)`."""
    white = _times(whitening, noise - mean)
    log_determinant = whitening.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return 0.5 * (noise.square().sum(-1) - white.square().sum(-1)) + log_determinant


def _inverse(upper: Tensor) -> Tensor:
    unit = torch.eye(upper.shape[-1], dtype=upper.dtype, device=upper.device).expand_as(upper)
    return torch.linalg.solve_triangular(upper, unit, upper=True)


def _times(matrix: Tensor, vectors: Tensor) -> Tensor:
    """`(B, R, D)` times `(N, B, D)`: `(N, B, R)`, one product a trajectory."""
    return (vectors.transpose(0, 1) @ matrix.mT).transpose(0, 1)
