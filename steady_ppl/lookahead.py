"""Looking ahead: what all later measurements say of a state, exactly for the linearised program.

The backward information filter gives the likelihood of everything after a row, p(y_{t+1}, …, y_T | δ_t), as
exp(c − ½ δᵀ Λ δ + λᵀ δ) in deviations δ from the path. Sampling each step's noise from N(0, I) times that function of
where it leads draws from the posterior, forward in time: the optimal twist of Guarniero, Johansen and Lee (2017) and of
Whiteley and Lee (2014), and with a linear program the smoother itself.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from steady_ppl import recursions
from steady_ppl.linearization import Linearization


@dataclass(frozen=True)
class Steering:
    """Noise that leads to the later measurements, ε ~ N(shift − gain δ, factor factorᵀ).

    Attributes:
        shift: `(..., C)`.
        gain: `(..., C, D)`.
        factor: `(..., C, C)`, upper triangular.
    """

    shift: Tensor
    gain: Tensor
    factor: Tensor


@dataclass(frozen=True)
class Lookahead:
    """The likelihood of all later measurements after every row, and the noise that it asks for.

    Attributes:
        linearization: of the program; deviations are from its path.
        precision: Λ `(T + 1, B, D, D)`.
        information: λ `(T + 1, B, D)`.
        log_scale: c `(T + 1, B)`.
        windings: `(W, D)` whole turns from the one nearest to the prior's mean on which the start may lie, none first.
        winding_masses: `(W, B)` log posterior probability of each.
        starts: steering of the start's noise, `(W, B, ...)`, its deviation zero.
        steps: of every interval's noise, `(T, B, ...)`.
        log_likelihood: log p(y) of the linearised program, `(B,)`, observations tempered as in the linearization.
    """

    linearization: Linearization
    precision: Tensor
    information: Tensor
    log_scale: Tensor
    windings: Tensor
    winding_masses: Tensor
    starts: Steering
    steps: Steering
    log_likelihood: Tensor

    def means(self) -> tuple[Tensor, Tensor]:
        """Posterior means of the linearised program, on the path's own turn: states `(T + 1, B, D)` and noise
        `(T, B, C)`."""
        return self._forward(self.starts.shift[0], torch.zeros_like(self.steps.shift))

    def draws(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Independent draws of the linearised program's posterior.

        Returns:
            Start noise `(M, B, C₀)`, states `(M, T + 1, B, D)` and noise `(M, T, B, C)`, the last two on the turn that
            the start noise asks for.
        """
        winding = torch.distributions.Categorical(logits=self.winding_masses.t()).sample((count,))
        trajectory = torch.arange(winding.shape[1], device=winding.device)
        starts = self.starts
        shift, factor = starts.shift[winding, trajectory], starts.factor[winding, trajectory]
        start = shift + _times(factor, torch.randn_like(shift))
        turns = self.windings[winding]
        random = torch.randn(count, *self.steps.shift.shape, dtype=shift.dtype, device=shift.device)
        states, noise = self._forward(start, _times(self.steps.factor, random), turns)
        return start, states + (turns + self.linearization.start_turn).unsqueeze(1), noise

    def covariances(self) -> tuple[Tensor, Tensor, Tensor]:
        """Posterior covariances on the path's own turn: of the states, `(T + 1, B, D, D)`, of the noise of each
        interval, `(T, B, C, C)`, and of the state that it moves with it, `(T, B, D, C)`."""
        linear, steps = self.linearization, self.steps
        spread = linear.start_noise @ self.starts.factor[0]
        rows, (trajectories, dimension, channels) = len(linear.offset) + 1, linear.noise.shape[1:]
        shapes = ((dimension, dimension), (channels, channels), (dimension, channels))
        lengths = (rows, rows - 1, rows - 1)
        found = [
            torch.empty(length, trajectories, *shape, dtype=linear.offset.dtype)
            for length, shape in zip(lengths, shapes, strict=True)
        ]
        found[0][0] = spread @ spread.mT
        given = _arrays((linear.state, linear.noise, steps.gain, steps.factor))
        recursions.covariances(*given, _arrays(found))  # type: ignore[call-arg]
        states, noises, across = (part.to(linear.offset.device) for part in found)
        return states, noises, across

    def _forward(self, start: Tensor, random: Tensor, turns: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
        """States and noise of the linearised program for standard normals; `start` is the start's noise itself."""
        linear, steps = self.linearization, self.steps
        begin = linear.start_offset + _times(linear.start_noise, start) - turns
        random = steps.shift + random
        moved = linear.state - linear.noise @ steps.gain  # δ' = moved δ + pushed
        pushed = linear.offset + _times(linear.noise, random)
        deviations = begin.new_empty((*pushed.shape[:-3], len(moved) + 1, *begin.shape[-2:]), device="cpu")
        deviations[..., 0, :, :] = begin
        draws, filled = (values.reshape(-1, *values.shape[-3:]) for values in (pushed, deviations))
        recursions.roll_out(_array(moved), _array(draws), filled.numpy())
        deviations = deviations.to(begin.device)
        return linear.path.states + deviations, random - _times(steps.gain, deviations[..., :-1, :, :])


def look_ahead(linear: Linearization) -> Lookahead:
    """Run the backward information filter."""
    weighted = linear.measurement * linear.precision.unsqueeze(-1)
    seen = (
        weighted.mT @ linear.measurement,
        _times(weighted.mT, linear.residual),
        linear.log_scale - 0.5 * (linear.precision * linear.residual.square()).sum(-1),
    )
    futures, steps = tuple(torch.empty_like(part, device="cpu") for part in seen), _steering(linear.noise)
    state, noise, offset = _arrays((linear.state, linear.noise, linear.offset))
    recursions.backward(_arrays(seen), state, noise, offset, _arrays(futures), _arrays(steps))
    device = linear.offset.device
    precision, information, log_scale = (part.to(device) for part in futures)
    windings = _windings(linear)
    offsets = linear.start_offset - windings.unsqueeze(1)
    starts = _steering(linear.start_noise.expand(len(windings), *linear.start_noise.shape))
    masses = torch.empty(offsets.shape[:-1], dtype=offsets.dtype)
    ahead = (precision[0] + seen[0][0], information[0] + seen[1][0], log_scale[0] + seen[2][0])
    recursions.integrate_starts(
        _arrays(ahead), _array(linear.start_noise), _array(offsets), _arrays(starts), masses.numpy()
    )
    spread = (linear.start_noise @ starts[2][0].to(device)).square().sum(-1)[:, list(linear.angles)]
    vague = (spread > 1).any(-1).cpu()  # the measurements leave an angle open: one turn's integral covers the others
    masses[1:, vague] = -torch.inf
    log_likelihood = masses.logsumexp(0)
    return Lookahead(
        linearization=linear,
        precision=precision,
        information=information,
        log_scale=log_scale,
        windings=windings,
        winding_masses=(masses - log_likelihood).to(device),
        starts=Steering(*(part.to(device) for part in starts)),
        steps=Steering(*(part.to(device) for part in steps)),
        log_likelihood=log_likelihood.to(device),
    )


def _steering(noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Room for the steering of noise that enters by `(..., D, C)`."""
    *left, dimension, channels = noise.shape
    shapes = ((channels,), (channels, dimension), (channels, channels))
    return tuple(torch.empty(*left, *shape, dtype=noise.dtype) for shape in shapes)  # type: ignore[return-value]


def _arrays(tensors: Sequence[Tensor]) -> Any:
    return tuple(_array(tensor) for tensor in tensors)


def _array(tensor: Tensor) -> recursions.Array:
    """A C-contiguous array; of a contiguous tensor in the host's memory it is that memory."""
    return tensor.contiguous().numpy(force=True)


def _windings(linear: Linearization) -> Tensor:
    """A broad start covers several turns of an angle, on which the measurements are equally likely: those that begin
    within four of the start's standard deviations, none first."""
    spread = linear.start_noise.norm(dim=-1).amax(0).nan_to_num(nan=0.0, posinf=0.0)  # a log p(y) that says so follows
    choices: list[tuple[int, ...]] = [(0,)] * len(spread)
    for angle in linear.angles:
        most = int((math.pi + 4 * float(spread[angle])) / (2 * math.pi))
        choices[angle] = tuple(sorted(range(-most, most + 1), key=abs))
    return 2 * math.pi * linear.start_offset.new_tensor(list(itertools.product(*choices)))


def _times(matrix: Tensor, vectors: Tensor) -> Tensor:
    """A vector for each matrix, or draws of it in front: these are side by side for the product."""
    if vectors.dim() < matrix.dim():
        return (matrix @ vectors.unsqueeze(-1)).squeeze(-1)
    return (matrix @ vectors.movedim(0, -1)).movedim(-1, 0)
