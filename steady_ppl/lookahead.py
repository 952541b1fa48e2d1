"""Looking ahead: what all later measurements say of a state, exactly for the linearised program.

The backward information filter gives the likelihood of everything after a row, p(y_{t+1}, …, y_T | δ_t), as
exp(c − ½ δᵀ Λ δ + λᵀ δ) in deviations δ from the path. Sampling each step's noise from N(0, I) times that function of
where it leads draws from the posterior, forward in time: the optimal twist of Guarniero, Johansen and Lee (2017) and of
Whiteley and Lee (2014), and with a linear program the smoother itself.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

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
        windings: `(W, D)` whole turns by which the start may differ from the path's, none first.
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
        states, noise = self._forward(self.starts.shift[0], torch.zeros_like(self.steps.shift))
        return states, noise

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
        return start, states + turns.unsqueeze(1), noise

    def covariances(self) -> Tensor:
        """Posterior covariances of the states on the path's own turn, `(T + 1, B, D, D)`."""
        linear, steps = self.linearization, self.steps
        spread = linear.start_noise @ self.starts.factor[0]
        covariances = [spread @ spread.mT]
        for forward, noise, gain, factor in zip(linear.state, linear.noise, steps.gain, steps.factor, strict=True):
            moved, spread = forward - noise @ gain, noise @ factor
            covariances.append(moved @ covariances[-1] @ moved.mT + spread @ spread.mT)
        return torch.stack(covariances)

    def _forward(self, start: Tensor, random: Tensor, turns: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
        linear, steps = self.linearization, self.steps
        deviation = linear.start_offset + _times(linear.start_noise, start) - turns
        random = steps.shift + random
        moved = linear.state - linear.noise @ steps.gain  # δ' = moved δ + pushed
        pushed = linear.offset + _times(linear.noise, random)
        deviations = [deviation]
        for row in range(len(moved)):
            deviation = _times(moved[row], deviation) + pushed[..., row, :, :]
            deviations.append(deviation)
        all_rows = torch.stack(deviations, -3)
        return linear.path.states + all_rows, random - _times(steps.gain, all_rows[..., :-1, :, :])


def look_ahead(linear: Linearization) -> Lookahead:
    """Run the backward information filter."""
    weighted = linear.measurement * linear.precision.unsqueeze(-1)
    seen_precision = weighted.mT @ linear.measurement
    seen = _times(weighted.mT, linear.residual)
    seen_scale = linear.log_scale - 0.5 * (linear.precision * linear.residual.square()).sum(-1)
    precision, information = torch.zeros_like(seen_precision[-1]), torch.zeros_like(seen[-1])
    scale = torch.zeros_like(seen_scale[-1])
    futures, steerings = [(precision, information, scale)], []
    for row in range(len(linear.offset) - 1, -1, -1):
        steering, precision, information, scale = _integrate(
            precision + seen_precision[row + 1],
            information + seen[row + 1],
            scale + seen_scale[row + 1],
            linear.noise[row],
            linear.offset[row],
        )
        forward = linear.state[row]
        steerings.append((steering.shift, steering.gain @ forward, steering.factor))
        precision, information = forward.mT @ precision @ forward, _times(forward.mT, information)
        futures.append((precision, information, scale))
    windings = _windings(linear)
    starts, _, _, masses = _integrate(
        precision + seen_precision[0],
        information + seen[0],
        scale + seen_scale[0],
        linear.start_noise,
        linear.start_offset - windings.unsqueeze(1),
    )
    precisions, informations, scales = (torch.stack(values[::-1]) for values in zip(*futures, strict=True))
    log_likelihood = masses.logsumexp(0)
    return Lookahead(
        linearization=linear,
        precision=precisions,
        information=informations,
        log_scale=scales,
        windings=windings,
        winding_masses=masses - log_likelihood,
        starts=starts,
        steps=Steering(*(torch.stack(values[::-1]) for values in zip(*steerings, strict=True))),
        log_likelihood=log_likelihood,
    )


def _windings(linear: Linearization) -> Tensor:
    """A broad start covers an angle's neighbouring turns, on which the measurements are equally likely."""
    dimension = linear.start_offset.shape[-1]
    turns = [linear.start_offset.new_zeros(dimension)]
    angles = linear.angles if bool(linear.start_noise.any()) else ()
    for choice in itertools.product((0, -1, 1), repeat=len(angles)):
        if any(choice):
            turn = torch.zeros_like(turns[0])
            turn[list(angles)] = 2 * math.pi * turn.new_tensor(choice)
            turns.append(turn)
    return torch.stack(turns)


def _integrate(
    precision: Tensor, information: Tensor, scale: Tensor, noise: Tensor, offset: Tensor
) -> tuple[Steering, Tensor, Tensor, Tensor]:
    """∫ ψ(μ + offset + G ε) N(ε; 0, I) dε as a function of μ, again (Λ, λ, c), and the noise's conditional given μ.

    With S = (I + GᵀΛG)⁻¹ and u = λ − Λ offset:  Λ̃ = Λ − ΛGSGᵀΛ,  λ̃ = u − ΛGSGᵀu,  ε | μ ~ N(S Gᵀ(u − Λμ), S).
    """
    channels, dimension = noise.shape[-1], noise.shape[-2]
    by_noise = precision @ noise
    pushed = _times(precision, offset)
    pulled = information - pushed
    unit = torch.eye(channels, dtype=noise.dtype, device=noise.device)
    root, failed = torch.linalg.cholesky_ex(noise.mT @ by_noise + unit)
    root = torch.where((failed > 0)[..., None, None], torch.nan, root)  # log p(y) says so
    towards = _times(noise.mT, pulled).unsqueeze(-1)
    left = towards.shape[:-2]
    right = torch.cat([towards, by_noise.mT.expand(*left, channels, dimension)], -1)
    half = torch.linalg.solve_triangular(root, right, upper=False)
    half_shift, half_gain = half[..., 0], half[..., 1:]
    identity = unit.expand(*left, channels, channels)
    whole = torch.linalg.solve_triangular(root.mT, torch.cat([half, identity], -1), upper=True)
    scale = (
        scale
        + ((information - 0.5 * pushed) * offset).sum(-1)
        + 0.5 * half_shift.square().sum(-1)
        - root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    )
    return (
        Steering(whole[..., 0], whole[..., 1 : 1 + dimension], whole[..., 1 + dimension :]),
        precision - half_gain.mT @ half_gain,
        pulled - _times(half_gain.mT, half_shift),
        scale,
    )


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
