"""Resampling: pure functions of weights. Particles are the first dimension, trajectories the second."""

from __future__ import annotations

import torch
from torch import Tensor


def normalise(log_weights: Tensor) -> tuple[Tensor, Tensor]:
    """Log-weights `(N, B)` that sum to one, and the log of their sum, `(B,)`."""
    log_sum = torch.logsumexp(log_weights, 0)
    return log_weights - log_sum, log_sum


def effective_sample_size(log_weights: Tensor) -> Tensor:
    """1 / Σ w² of normalised log-weights `(N, B)`: `(B,)`, between 1 and N (Kong, Liu and Wong 1994)."""
    return torch.exp(-torch.logsumexp(2 * log_weights, 0))


def systematic(log_weights: Tensor, draws: int, uniform: Tensor | None = None) -> Tensor:
    """Systematic resampling in O(N): particle i is drawn floor or ceiling of `draws · w_i` times.

    The number of offspring up to particle i is ⌈draws · (w_1 + … + w_i) − u⌉, one u a trajectory
    (Kitagawa 1996; Chopin and Papaspiliopoulos 2020, section 9.6). Sums are taken in double precision.

    Args:
        log_weights: `(N, B)`, normalised.
        draws: how many to draw for each trajectory.
        uniform: `(B,)` in [0, 1); drawn when not given.

    Returns:
        `(draws, B)` indices in 0 … N − 1, in ascending order.
    """
    particles, trajectories = log_weights.shape
    device = log_weights.device
    if uniform is None:
        uniform = torch.rand(trajectories, dtype=torch.float64, device=device)
    cumulative = log_weights.t().to(torch.float64).exp().cumsum(1)
    cumulative = cumulative / cumulative[:, -1:]
    born = (cumulative * draws - uniform[:, None]).ceil().long().clamp(0, draws)
    born.masked_fill_(cumulative >= 1, draws)  # a uniform within rounding of 1 leaves nothing to weights of zero
    born[:, -1] = draws  # also where a weight is not a number: the filter says so at its end
    if device.type != "cpu":
        born = born.cummax(1).values  # a parallel sum may round one of its terms below the one before
    offspring = torch.diff(born, dim=1, prepend=born.new_zeros((trajectories, 1)))
    index = torch.arange(particles, device=device).repeat(trajectories)
    chosen = torch.repeat_interleave(index, offspring.flatten(), output_size=trajectories * draws)
    return chosen.view(trajectories, draws).t()


def take(values: Tensor, index: Tensor) -> Tensor:
    """The particles `index` of each trajectory, component by component: states from `stack` are laid out that way.

    Args:
        values: `(N, B)` or `(N, B, D)`.
        index: `(M, B)` in 0 … N − 1.

    Returns:
        `(M, B)` or `(M, B, D)`.
    """
    particles, trajectories = values.shape[:2]
    flat = (index * trajectories + torch.arange(trajectories, device=index.device)).flatten()
    components = values.reshape(particles, trajectories, -1).movedim(-1, 0)
    taken = components.reshape(-1, particles * trajectories).index_select(1, flat)
    return taken.view(-1, *index.shape).movedim(0, -1).reshape(*index.shape, *values.shape[2:])
