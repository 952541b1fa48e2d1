"""Looking ahead: what all later measurements say of a state, exactly for the linearised program.

The backward information filter gives ψ_t(δ) = p(y_t, …, y_T | δ) as exp(c_t − ½ δᵀ Λ_t δ + λ_tᵀ δ) in deviations δ from
the path. Sampling each step's noise from N(0, I) · ψ_{t+1} then draws from the posterior, forward in time: this is the
optimal twist of Guarniero, Johansen and Lee (2017) and of Whiteley and Lee (2014), and with a linear program the
smoother itself.
"""

from __future__ import annotations

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
        factor: `(..., C, C)`.
    """

    shift: Tensor
    gain: Tensor
    factor: Tensor


@dataclass(frozen=True)
class Lookahead:
    """ψ of every row, and the noise that it asks for.

    Attributes:
        linearization: of the program; deviations are from its path.
        precision: Λ `(T + 1, B, D, D)`.
        information: λ `(T + 1, B, D)`.
        log_scale: c `(T + 1, B)`.
        start: of the start's noise, `(B, ...)`; the gain is of no use there.
        steps: of every interval's noise, `(T, B, ...)`.
        log_likelihood: log p(y) of the linearised program, `(B,)`, observations tempered as in the linearization.
    """

    linearization: Linearization
    precision: Tensor
    information: Tensor
    log_scale: Tensor
    start: Steering
    steps: Steering
    log_likelihood: Tensor

    def log_twist(self, row: int, deviation: Tensor) -> Tensor:
        """log ψ of a row at deviations `(..., B, D)`: `(..., B)`."""
        pulled = self.information[row] - 0.5 * (self.precision[row] @ deviation.unsqueeze(-1)).squeeze(-1)
        return self.log_scale[row] + (pulled * deviation).sum(-1)

    def means(self) -> tuple[Tensor, Tensor, Tensor]:
        """Posterior means of the linearised program: start noise `(B, C₀)`, states `(T + 1, B, D)` and noise
        `(T, B, C)`."""
        return self._forward(None)

    def draws(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Independent draws of the linearised program's posterior: start noise `(M, B, C₀)`, states
        `(M, T + 1, B, D)` and noise `(M, T, B, C)`."""
        return self._forward(count)

    def covariances(self) -> Tensor:
        """Posterior covariances of the states, `(T + 1, B, D, D)`."""
        linear = self.linearization
        spread = linear.start_noise @ self.start.factor
        covariance = spread @ spread.mT
        all_rows = [covariance]
        for row in range(len(linear.offset)):
            moved = linear.state[row] - linear.noise[row] @ self.steps.gain[row]
            spread = linear.noise[row] @ self.steps.factor[row]
            covariance = moved @ covariance @ moved.mT + spread @ spread.mT
            all_rows.append(covariance)
        return torch.stack(all_rows)

    def _forward(self, count: int | None) -> tuple[Tensor, Tensor, Tensor]:
        linear, steps = self.linearization, self.steps
        left = () if count is None else (count,)

        def spread(steering_factor: Tensor) -> Tensor | float:
            if count is None:
                return 0.0
            normal = torch.randn(*left, *steering_factor.shape[:-1], dtype=steering_factor.dtype).to(steering_factor)
            return (steering_factor @ normal.unsqueeze(-1)).squeeze(-1)

        start = (self.start.shift + spread(self.start.factor)).expand(*left, *self.start.shift.shape)
        deviation = linear.start_offset + (linear.start_noise @ start.unsqueeze(-1)).squeeze(-1)
        random = steps.shift + spread(steps.factor)
        # δ' = moved δ + pushed, with everything random in `pushed`
        moved = linear.state - linear.noise @ steps.gain
        pushed = linear.offset + (linear.noise @ random.unsqueeze(-1)).squeeze(-1)
        deviations = [deviation]
        for row in range(len(linear.offset)):
            deviation = (moved[row] @ deviation.unsqueeze(-1)).squeeze(-1) + pushed[..., row, :, :]
            deviations.append(deviation)
        all_rows = torch.stack(deviations, -3)
        noise = random - (steps.gain @ all_rows[..., :-1, :, :].unsqueeze(-1)).squeeze(-1)
        return start, linear.path.states + all_rows, noise


@torch.no_grad()
def look_ahead(linear: Linearization) -> Lookahead:
    """Run the backward information filter."""
    weighted = linear.measurement * linear.precision.unsqueeze(-1)
    measured_precision = weighted.mT @ linear.measurement
    measured = (weighted.mT @ linear.residual.unsqueeze(-1)).squeeze(-1)
    log_scale = linear.log_scale - 0.5 * (linear.precision * linear.residual.square()).sum(-1)
    precision, information, scale = measured_precision[-1], measured[-1], log_scale[-1]
    precisions, informations, scales, steerings = [precision], [information], [scale], []
    for row in range(len(linear.offset) - 1, -1, -1):
        steering, precision, information, scale = _integrate(
            precision, information, scale, linear.noise[row], linear.offset[row]
        )
        forward = linear.state[row]
        steerings.append(Steering(steering.shift, steering.gain @ forward, steering.factor))
        precision = measured_precision[row] + forward.mT @ precision @ forward
        information = measured[row] + (forward.mT @ information.unsqueeze(-1)).squeeze(-1)
        scale = log_scale[row] + scale
        precisions.append(precision)
        informations.append(information)
        scales.append(scale)
    start, _, _, log_likelihood = _integrate(precision, information, scale, linear.start_noise, linear.start_offset)
    steps = Steering(
        *(torch.stack([getattr(s, name) for s in steerings[::-1]]) for name in ("shift", "gain", "factor"))
    )
    return Lookahead(
        linearization=linear,
        precision=torch.stack(precisions[::-1]),
        information=torch.stack(informations[::-1]),
        log_scale=torch.stack(scales[::-1]),
        start=start,
        steps=steps,
        log_likelihood=log_likelihood,
    )


def _integrate(
    precision: Tensor, information: Tensor, scale: Tensor, noise: Tensor, offset: Tensor
) -> tuple[Steering, Tensor, Tensor, Tensor]:
    """∫ ψ(μ + offset + G ε) N(ε; 0, I) dε as a function of μ, again (Λ, λ, c), and the noise's conditional given μ.

    With S = (I + GᵀΛG)⁻¹:  Λ̃ = Λ − ΛGSGᵀΛ,  λ̃ = (I − ΛGSGᵀ)(λ − Λ offset) and ε | μ ~ N(S Gᵀ(λ − Λ(μ + offset)), S).
    """
    by_noise = precision @ noise
    pushed = (precision @ offset.unsqueeze(-1)).squeeze(-1)
    pulled = information - pushed
    channels, dimension = noise.shape[-1], noise.shape[-2]
    unit = torch.eye(channels, dtype=noise.dtype, device=noise.device).expand(*noise.shape[:-2], channels, channels)
    root = torch.linalg.cholesky(noise.mT @ by_noise + unit)
    right = torch.cat([noise.mT @ pulled.unsqueeze(-1), by_noise.mT], -1)
    half = torch.linalg.solve_triangular(root, right, upper=False)
    whole = torch.linalg.solve_triangular(root.mT, torch.cat([half, unit], -1), upper=True)
    half_shift, half_gain = half[..., 0], half[..., 1:]
    scale = (
        scale
        + ((information - 0.5 * pushed) * offset).sum(-1)
        + 0.5 * half_shift.square().sum(-1)
        - root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    )
    return (
        Steering(whole[..., 0], whole[..., 1 : 1 + dimension], whole[..., 1 + dimension :]),
        precision - half_gain.mT @ half_gain,
        pulled - (half_gain.mT @ half_shift.unsqueeze(-1)).squeeze(-1),
        scale,
    )
