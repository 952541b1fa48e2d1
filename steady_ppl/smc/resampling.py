"""Resampling: pure functions of weights. Particles are the first dimension, trajectories the second.

Chopin and Papaspiliopoulos (2020), chapter 9, compare the three resamplers. All give particle i `draws · w_i` offspring
on average. Systematic resampling takes one uniform a trajectory, stratified one a stratum, multinomial one a draw.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from steady_ppl.smc.loops import choose_systematically

Resampler = Callable[[Tensor, int], Tensor]
"""Of normalised weights `(N, B)` and a number of draws: indices `(draws, B)` in 0 … N − 1, in ascending order."""


def normalise(log_weights: Tensor) -> tuple[Tensor, Tensor]:
    """Weights that sum to one, of log-weights `(N, B)`, and the log of their sum, `(B,)`."""
    largest = log_weights.amax(0)
    largest = torch.where(largest == -math.inf, 0.0, largest)
    weights = (log_weights - largest).exp_()
    total = weights.sum(0)
    return weights / total, largest + total.log()


def effective_sample_size(weights: Tensor) -> Tensor:
    """1 / Σ w² of normalised weights `(N, B)`: `(B,)`, between 1 and N (Kong, Liu and Wong 1994)."""
    return weights.square().sum(0).reciprocal()


def systematic(weights: Tensor, draws: int, uniform: Tensor | None = None) -> Tensor:
    """Systematic resampling in O(N): particle i is drawn floor or ceiling of `draws · w_i` times.

    The number of offspring up to particle i is ⌈draws · (w_1 + … + w_i) − u⌉, one u a trajectory
    (Kitagawa 1996; Chopin and Papaspiliopoulos 2020, section 9.6). Sums are taken in double precision.

    `uniform` is `(B,)` in [0, 1), and drawn when not given. See `Resampler` for the other shapes.
    """
    if uniform is None:
        uniform = torch.rand(weights.shape[1], dtype=torch.float64, device=weights.device)
    by_trajectory = weights.t().to(torch.float64)
    if weights.device.type != "cpu":
        return systematic_in_parallel(by_trajectory, draws, uniform).t()
    chosen = torch.empty(weights.shape[1], draws, dtype=torch.int64)
    choose_systematically(by_trajectory.contiguous().numpy(), uniform.contiguous().numpy(), chosen.numpy())
    return chosen.t()


def systematic_in_parallel(weights: Tensor, draws: int, uniform: Tensor) -> Tensor:
    """`systematic` without a loop over particles, for a device: `(B, N)` weights to `(B, draws)` indices."""
    trajectories, particles = weights.shape
    cumulative = _shares(weights)
    born = (cumulative * draws - uniform[:, None]).ceil().long().clamp(0, draws)
    born.masked_fill_(cumulative >= 1, draws)
    born[:, -1] = draws
    offspring = torch.diff(born, dim=1, prepend=born.new_zeros((trajectories, 1)))
    index = torch.arange(particles, device=weights.device).repeat(trajectories)
    chosen = torch.repeat_interleave(index, offspring.flatten(), output_size=trajectories * draws)
    return chosen.view(trajectories, draws)


def stratified(weights: Tensor, draws: int) -> Tensor:
    """Stratified resampling: an independent uniform point in each of `draws` equal parts of [0, 1) (Kitagawa 1996).

    The number of offspring of particle i is less than two off `draws · w_i`. See `Resampler` for shapes.
    """
    within = torch.rand(weights.shape[1], draws, dtype=torch.float64, device=weights.device)
    return _at(weights, (torch.arange(draws, device=weights.device) + within) / draws)


def multinomial(weights: Tensor, draws: int) -> Tensor:
    """Multinomial resampling: independent draws, sorted (Gordon, Salmond and Smith 1993).

    The number of offspring of particle i is binomial. See `Resampler` for shapes.
    """
    points = torch.rand(weights.shape[1], draws, dtype=torch.float64, device=weights.device)
    return _at(weights, points.sort(1).values)


def _at(weights: Tensor, points: Tensor) -> Tensor:
    """The particles at ascending points `(B, draws)` of the weights' cumulative sum, `(draws, B)`."""
    points = points.clamp(max=1 - 2.0**-53)  # a sum may round to one
    index = torch.searchsorted(_shares(weights.t().to(torch.float64)), points, right=True)
    return index.clamp_(max=len(weights) - 1).t()  # where a weight is not a number: the filter says so at its end


def _shares(weights: Tensor) -> Tensor:
    """Cumulative sums of `(B, N)` weights over their total, ascending."""
    cumulative = weights.cumsum(1)
    cumulative = cumulative / cumulative[:, -1:]
    return cumulative.cummax(1).values  # a parallel sum may round one of its terms below the one before


def take(values: Tensor, index: Tensor) -> Tensor:
    """The particles `index`, `(M, B)`, of each trajectory's `values`, `(N, B, ...)`, stored component by component."""
    components = values.flatten(2).permute(2, 1, 0) if values.dim() > 2 else values.t().unsqueeze(0)
    taken = components.gather(2, index.t().expand(len(components), -1, -1))
    return taken.permute(2, 1, 0).reshape(*index.shape, *values.shape[2:])


def by_component(state: Tensor) -> Tensor:
    """`(N, B, D)` as contiguous `(D, B, N)`: without copying where a kernel has made it."""
    return state.permute(2, 1, 0).contiguous()
