"""Particles steered by a lookahead, whatever the program: plain lines of torch, which kernels compile."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from steady_ppl.errors import require
from steady_ppl.gaussian.information_filter import Lookahead, look_ahead
from steady_ppl.smc.proposal import Steered


def _log_ratio(noise: Tensor, white: Tensor, whitening: Tensor) -> Tensor:
    """log N(noise; mean, factor factorᵀ) − log N(noise; 0, I), `(N, B)`, where `white` is whitening (noise − mean)."""
    log_determinant = whitening.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return 0.5 * (noise.square().sum(-1) - white.square().sum(-1)) + log_determinant


def mixture(log_ratio: Tensor, untwisted: Tensor | float) -> Tensor:
    """log((1 − share) ratio + share)."""
    larger = log_ratio.clamp(min=0.0)
    return larger + ((1 - untwisted) * (log_ratio - larger).exp() + untwisted * (-larger).exp()).log()


def inverse(upper: Tensor) -> Tensor:
    """Of upper triangular matrices."""
    return torch.linalg.solve_triangular(upper, torch.eye(upper.shape[-1]).to(upper), upper=True)


def _deviation(state: Tensor, path: Tensor, turn: Tensor) -> Tensor:
    deviation = state.to(path.dtype) - path
    return deviation - turn * (deviation / (2 * math.pi)).round()


def _times(matrix: Tensor, vectors: Tensor) -> Tensor:
    """`(..., B, R, D)` times `(N, ..., B, D)`: `(N, ..., B, R)`, one product a trajectory."""
    return (vectors.movedim(0, -2) @ matrix.mT).movedim(-2, 0)


class Twist(Steered):
    """A lookahead as proposals.

    Whatever the lookahead is, the filter's estimate of p(y) stays unbiased: each noise is weighted by the ratio of its
    own density to that of the mixture which it was drawn from. A share of untwisted draws bounds these ratios by one
    over the share.

    Args:
        lookahead: along any path; the closer to the posterior, the smaller the variance.
        untwisted: probability with which a particle draws one step's noise as the program does. At 100 intervals a
            share of .05 doubles the scatter of log p(y) that .01 has.
        tempered: weight of the later measurements as the twist sees them, relative to their own; less than 1 guards
            against a twist that is narrower than the posterior.

    Raises:
        UsageError: `untwisted` is not in [0, 1), or `tempered` not in (0, 1].
    """

    def __init__(self, lookahead: Lookahead, *, untwisted: float = 0.01, tempered: float = 1.0) -> None:
        require(0 <= untwisted < 1, "untwisted", untwisted, "in [0, 1)")
        require(0 < tempered <= 1, "tempered", tempered, "in (0, 1]")
        if tempered < 1:
            seen = lookahead.linearization
            weighted = replace(seen, precision=tempered * seen.precision, log_scale=tempered * seen.log_scale)
            lookahead = look_ahead(weighted)
        self.lookahead, self.untwisted = lookahead, untwisted
        path, steps = lookahead.linearization.path.states, lookahead.steps
        self.channels, self.path = steps.shift.shape[-1], path.double()
        turn = 2 * math.pi * lookahead.linearization.circular.double()  # of angles; no other component has turns
        whitening = inverse(steps.factor)
        # Λ = RᵀR and λ = Rᵀz; where rounding has left Λ no root, its diagonal serves: any future leaves p(y) unbiased
        own = lookahead.precision.diagonal(dim1=-2, dim2=-1).clamp(min=1e-30)
        lower, failed = torch.linalg.cholesky_ex(lookahead.precision + torch.diag_embed(1e-13 * own))
        lower = torch.where((failed > 0)[..., None, None], torch.diag_embed(own.sqrt()), lower)
        self.root, information = lower.mT, lookahead.information.unsqueeze(-1)
        self.target = torch.linalg.solve_triangular(lower, information, upper=False).squeeze(-1)

        turns = turn.expand_as(self.path)
        share = self.path.new_tensor([untwisted]).expand(*steps.shift.shape[:2], 1)
        steering = (steps.shift, steps.gain, steps.factor, whitening)
        self.rows = (self.path, turns, self.root, self.target)  # path, turns, root and target, see `future`
        self.intervals = (self.path[:-1], turns[:-1], *steering, share)  # and steering, and the share not steered

    def future(self, state: Tensor, *given: Tensor) -> Tensor:
        """−½ |R δ − z|² of every particle's deviation δ from the path: log p(y_{row+1}, …, y_T | state) of the
        linearised program less its maximum. A sum of squares is never rounded to something likely."""
        path, turn, root, target = given
        return -0.5 * (_times(root, _deviation(state, path, turn)) - target).square().sum(-1)

    def steered(self, state: Tensor, own: Tensor, chance: Tensor, *given: Tensor) -> tuple[Tensor, Tensor]:
        """Every particle's noise: its `own`, standard normal, with the probability `untwisted`, else steered; and its
        log density less that of the mixture that it was drawn from."""
        path, turn, shift, gain, factor, whitening, untwisted = given
        own, stays = own.to(path.dtype), chance < untwisted
        mean = shift - _times(gain, _deviation(state, path, turn))
        noise = torch.where(stays, own, mean + _times(factor, own))
        white = torch.where(stays, _times(whitening, own - mean), own)
        return noise, -mixture(_log_ratio(noise, white, whitening), untwisted.squeeze(-1))

    def log_future(self, row: int, state: Tensor) -> Tensor:
        """log p(y_{row+1}, …, y_T | state) of the linearised program, see `Proposal`."""
        most = self.lookahead.log_scale[row] + 0.5 * self.target[row].square().sum(-1)
        return most + super().log_future(row, state)

    def start(self, particles: int) -> tuple[Tensor | None, Tensor | float]:
        """Steer the start's noise, of the mixture of all `windings`, see `Proposal`."""
        ahead, starts = self.lookahead, self.lookahead.starts
        _, twisted, own = ahead.draw_starts(particles)
        stays = torch.rand(own.shape[:-1], dtype=torch.float64, device=own.device) < self.untwisted
        noise = torch.where(stays.unsqueeze(-1), own, twisted)
        windings = zip(ahead.winding_masses, starts.shift, inverse(starts.factor), strict=True)
        ratios = [mass + _log_ratio(noise, _times(of, noise - mean), of) for mass, mean, of in windings]
        return noise, -mixture(torch.stack(ratios).logsumexp(0), self.untwisted)
