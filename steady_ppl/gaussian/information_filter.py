"""Looking ahead: what all later measurements say of a state, exactly for the linearised program.

The backward information filter gives the likelihood of everything after a row, p(y_{t+1}, …, y_T | δ_t), as
exp(c − ½ δᵀ Λ δ + λᵀ δ) in deviations δ from the path. Sampling each step's noise from N(0, I) times that function of
where it leads draws from the posterior, forward in time: the optimal twist of Guarniero, Johansen and Lee (2017) and of
Whiteley and Lee (2014), and with a linear program the smoother itself.

The recursions are compiled, on numpy arrays in double precision; rows or intervals first, trajectories second. A
matrix that is not positive definite turns into NaN, which log p(y) then shows.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from steady_ppl.gaussian.linearize import LinearArrays, Linearization
from steady_ppl.gaussian.matrices import Array, add_product, add_times, array, arrays, propagate, set_product, set_times


class Potential(NamedTuple):
    """exp(c − ½ δᵀ Λ δ + λᵀ δ) of every row: Λ `(T + 1, B, D, D)`, λ `(T + 1, B, D)` and c `(T + 1, B)`."""

    precision: Array
    information: Array
    log_scale: Array


class Steering(NamedTuple):
    """Noise that leads to the later measurements, ε ~ N(shift − gain δ, factor factorᵀ); tensors or arrays.

    Attributes:
        shift: `(..., C)`.
        gain: `(..., C, D)`.
        factor: `(..., C, C)`, upper triangular.
    """

    shift: Any
    gain: Any
    factor: Any

    @classmethod
    def empty(cls, noise: Tensor) -> Steering:
        """Room in the host's memory for the steering of noise that enters by `(..., D, C)`."""
        *left, dimension, channels = noise.shape
        shapes = ((channels,), (channels, dimension), (channels, channels))
        return cls(*(torch.empty(*left, *shape, dtype=noise.dtype) for shape in shapes))

    def to(self, device: torch.device) -> Steering:
        return Steering(*(part.to(device) for part in self))


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
        shapes = ((rows, dimension, dimension), (rows - 1, channels, channels), (rows - 1, dimension, channels))
        found = [linear.offset.new_empty((shape[0], trajectories, *shape[1:]), device="cpu") for shape in shapes]
        found[0][0] = spread @ spread.mT
        covariances(linear.arrays(), array(steps.gain), array(steps.factor), arrays(*found))
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
        roll_out(array(moved), array(draws), filled.numpy())
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
    futures, steps = tuple(torch.empty_like(part, device="cpu") for part in seen), Steering.empty(linear.noise)
    given = linear.arrays()
    backward(given, Potential(*arrays(*seen)), Potential(*arrays(*futures)), Steering(*arrays(*steps)))
    device = linear.offset.device
    precision, information, log_scale = (part.to(device) for part in futures)
    windings = _windings(linear)
    offsets = linear.start_offset - windings.unsqueeze(1)
    starts = Steering.empty(linear.start_noise.expand(len(windings), *linear.start_noise.shape))
    masses = torch.empty(offsets.shape[:-1], dtype=offsets.dtype)
    ahead = (precision[0] + seen[0][0], information[0] + seen[1][0], log_scale[0] + seen[2][0])
    first, filled = Potential(*arrays(*ahead)), Steering(*arrays(*starts))
    integrate_starts(given, first, array(offsets), filled, masses.numpy())
    spread = (linear.start_noise @ starts.factor[0].to(device)).square().sum(-1)[:, list(linear.angles)]
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
        starts=starts.to(device),
        steps=steps.to(device),
        log_likelihood=log_likelihood.to(device),
    )


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


@njit(cache=True, error_model="numpy")
def integrate(precision: Array, information: Array, noise: Array, offset: Array, out: Steering) -> float:
    """∫ ψ(μ + offset + G ε) N(ε; 0, I) dε as a function of μ, and the noise's conditional given μ.

    ψ(x) = exp(−½ xᵀ Λ x + λᵀ x). With S = (I + GᵀΛG)⁻¹ and u = λ − Λ offset the integral is again of that form, with
    Λ − ΛGSGᵀΛ and u − ΛGSGᵀu, times a constant; and ε | μ ~ N(S Gᵀ(u − Λμ), S).

    Args:
        precision, information: Λ `(D, D)` and λ `(D,)`, overwritten by those of the integral.
        noise, offset: G `(D, C)` and `(D,)`.
        out: filled with ε ~ N(shift − gain μ, factor factorᵀ).

    Returns:
        The logarithm of the constant.
    """
    dimension, channels = noise.shape
    constant = 0.0
    pushed = np.zeros(dimension)
    add_times(pushed, precision, offset)
    for i in range(dimension):
        constant += (information[i] - 0.5 * pushed[i]) * offset[i]
        information[i] -= pushed[i]
    # root rootᵀ = I + GᵀΛG; the columns of `half` are root⁻¹ (Gᵀu, GᵀΛ), by forward substitution
    half, root = np.zeros((channels, 1 + dimension)), np.eye(channels)
    by_noise = half[:, 1:]
    add_product(by_noise, noise.T, precision.T)
    add_product(root, noise.T, by_noise.T)
    add_times(half[:, 0], noise.T, information)
    for a in range(channels):
        for b in range(a):
            for c in range(b):
                root[a, b] -= root[a, c] * root[b, c]
            root[a, b] /= root[b, b]
        for c in range(a):
            root[a, a] -= root[a, c] * root[a, c]
        root[a, a] = math.sqrt(root[a, a])
        constant -= math.log(root[a, a])
    for a in range(channels):
        for i in range(1 + dimension):
            for b in range(a):
                half[a, i] -= root[a, b] * half[b, i]
            half[a, i] /= root[a, a]
        constant += 0.5 * half[a, 0] * half[a, 0]
    add_times(information, by_noise.T, half[:, 0], -1.0)
    add_product(precision, by_noise.T, by_noise, -1.0)
    # back substitution: root⁻ᵀ (half, I)
    out.shift[:], out.gain[:], out.factor[:] = half[:, 0], by_noise, np.eye(channels)
    for a in range(channels - 1, -1, -1):
        for b in range(a + 1, channels):
            out.shift[a] -= root[b, a] * out.shift[b]
            for i in range(dimension):
                out.gain[a, i] -= root[b, a] * out.gain[b, i]
            for c in range(channels):
                out.factor[a, c] -= root[b, a] * out.factor[b, c]
        out.shift[a] /= root[a, a]
        for i in range(dimension):
            out.gain[a, i] /= root[a, a]
        for c in range(channels):
            out.factor[a, c] /= root[a, a]
    return constant


@njit(cache=True, error_model="numpy")
def integrate_starts(given: LinearArrays, ahead: Potential, offset: Array, steering: Steering, total: Array) -> None:
    """`integrate` for every start: of each trajectory `(B, ...)`, on each of several turns.

    `ahead` is what all rows' measurements say of the first state. The offsets are `(W, B, D)`. Fills the steering and
    the logarithm of the integral, `(W, B)`.
    """
    for w in range(offset.shape[0]):
        for b in range(offset.shape[1]):
            out = Steering(steering.shift[w, b], steering.gain[w, b], steering.factor[w, b])
            precision, information = ahead.precision[b].copy(), ahead.information[b].copy()
            total[w, b] = ahead.log_scale[b] + integrate(
                precision, information, given.start_noise[b], offset[w, b], out
            )


@njit(cache=True, error_model="numpy")
def backward(given: LinearArrays, seen: Potential, futures: Potential, steering: Steering) -> None:
    """The backward information filter of δ' = F δ + offset + G ε, for every trajectory.

    From what each row's own measurements say, `seen`, it fills what all later ones say of a row's state, `futures`, and
    the noise that they ask for in each interval.
    """
    intervals, trajectories, dimension = given.offset.shape
    precision, information = np.zeros((dimension, dimension)), np.zeros(dimension)
    half, gain = np.zeros((dimension, dimension)), np.zeros(steering.gain.shape[2:])
    for b in range(trajectories):
        precision[:], information[:], scale = 0.0, 0.0, 0.0
        for t in range(intervals, -1, -1):
            futures.precision[t, b], futures.information[t, b], futures.log_scale[t, b] = precision, information, scale
            if t > 0:
                precision += seen.precision[t, b]
                information += seen.information[t, b]
                out = Steering(steering.shift[t - 1, b], gain, steering.factor[t - 1, b])
                noise, offset, forward = given.noise[t - 1, b], given.offset[t - 1, b], given.state[t - 1, b]
                scale += seen.log_scale[t, b] + integrate(precision, information, noise, offset, out)
                set_product(steering.gain[t - 1, b], gain, forward)
                set_product(half, precision, forward)
                set_product(precision, forward.T, half)
                futures.information[t - 1, b] = information
                set_times(information, forward.T, futures.information[t - 1, b])


@njit(cache=True, error_model="numpy")
def roll_out(moved: Array, pushed: Array, deviations: Array) -> None:
    """Fill δ' = moved δ + pushed row by row: `(T, B, D, D)`, `(M, T, B, D)` and δ `(M, T + 1, B, D)`, its first row
    given."""
    draws, intervals, trajectories, _ = pushed.shape
    for m in range(draws):
        for t in range(intervals):
            deviations[m, t + 1] = pushed[m, t]
            for b in range(trajectories):
                add_times(deviations[m, t + 1, b], moved[t, b], deviations[m, t, b])


@njit(cache=True, error_model="numpy")
def covariances(given: LinearArrays, gain: Array, factor: Array, found: tuple[Array, Array, Array]) -> None:
    """Fill the posterior covariances of δ' = F δ + G ε with ε ~ N(shift − gain δ, factor factorᵀ), as
    `Lookahead.covariances` returns them, that of the first state given."""
    states, noises, across = found
    intervals, trajectories, dimension, channels = given.noise.shape
    moved, spread = np.zeros((dimension, dimension)), np.zeros((dimension, channels))
    for t in range(intervals):
        for b in range(trajectories):
            across[t, b] = 0.0
            add_product(across[t, b], states[t, b], gain[t, b].T, -1.0)
            set_product(noises[t, b], factor[t, b], factor[t, b].T)
            add_product(noises[t, b], gain[t, b], across[t, b], -1.0)
            moved[:] = given.state[t, b]
            add_product(moved, given.noise[t, b], gain[t, b], -1.0)
            set_product(spread, given.noise[t, b], factor[t, b])
            propagate(states[t + 1, b], states[t, b], moved, spread)
