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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from steady_ppl.gaussian.linearize import Linearization

Array = np.ndarray[Any, np.dtype[np.float64]]


class Potential(NamedTuple):
    """exp(c − ½ δᵀ Λ δ + λᵀ δ) of every row: Λ `(T + 1, B, D, D)`, λ `(T + 1, B, D)` and c `(T + 1, B)`."""

    precision: Array
    information: Array
    log_scale: Array


class SteeringArrays(NamedTuple):
    """`Steering` as the recursions fill it, `(..., C)`, `(..., C, D)` and `(..., C, C)`."""

    shift: Array
    gain: Array
    factor: Array


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

    @staticmethod
    def empty(noise: Tensor) -> Steering:
        """Room in the host's memory for the steering of noise that enters by `(..., D, C)`."""
        *left, dimension, channels = noise.shape
        shapes = ((channels,), (channels, dimension), (channels, channels))
        return Steering(*(torch.empty(*left, *shape, dtype=noise.dtype) for shape in shapes))

    def arrays(self) -> SteeringArrays:
        return SteeringArrays(_array(self.shift), _array(self.gain), _array(self.factor))

    def to(self, device: torch.device) -> Steering:
        return Steering(self.shift.to(device), self.gain.to(device), self.factor.to(device))


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
        covariances(*given, _arrays(found))  # type: ignore[call-arg]
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
        roll_out(_array(moved), _array(draws), filled.numpy())
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
    state, noise, offset = _arrays((linear.state, linear.noise, linear.offset))
    backward(Potential(*_arrays(seen)), state, noise, offset, Potential(*_arrays(futures)), steps.arrays())
    device = linear.offset.device
    precision, information, log_scale = (part.to(device) for part in futures)
    windings = _windings(linear)
    offsets = linear.start_offset - windings.unsqueeze(1)
    starts = Steering.empty(linear.start_noise.expand(len(windings), *linear.start_noise.shape))
    masses = torch.empty(offsets.shape[:-1], dtype=offsets.dtype)
    ahead = (precision[0] + seen[0][0], information[0] + seen[1][0], log_scale[0] + seen[2][0])
    first = Potential(*_arrays(ahead))
    integrate_starts(first, _array(linear.start_noise), _array(offsets), starts.arrays(), masses.numpy())
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


def _arrays(tensors: Sequence[Tensor]) -> Any:
    return tuple(_array(tensor) for tensor in tensors)


def _array(tensor: Tensor) -> Array:
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


@njit(cache=True, error_model="numpy")
def integrate(
    precision: Array, information: Array, noise: Array, offset: Array, out: tuple[Array, Array, Array]
) -> float:
    """∫ ψ(μ + offset + G ε) N(ε; 0, I) dε as a function of μ, and the noise's conditional given μ.

    ψ(x) = exp(−½ xᵀ Λ x + λᵀ x). With S = (I + GᵀΛG)⁻¹ and u = λ − Λ offset the integral is again of that form, with
    Λ − ΛGSGᵀΛ and u − ΛGSGᵀu, times a constant; and ε | μ ~ N(S Gᵀ(u − Λμ), S).

    Args:
        precision, information: Λ `(D, D)` and λ `(D,)`, overwritten by those of the integral.
        noise, offset: G `(D, C)` and `(D,)`.
        out: shift `(C,)`, gain `(C, D)` and factor `(C, C)` of ε ~ N(shift − gain μ, factor factorᵀ).

    Returns:
        The logarithm of the constant.
    """
    shift, gain, factor = out
    dimension, channels = noise.shape
    by_noise = np.zeros((channels, dimension))
    for c in range(channels):
        for i in range(dimension):
            for j in range(dimension):
                by_noise[c, i] += precision[i, j] * noise[j, c]
    constant = 0.0
    for i in range(dimension):
        pushed = 0.0
        for j in range(dimension):
            pushed += precision[i, j] * offset[j]
        constant += (information[i] - 0.5 * pushed) * offset[i]
        information[i] -= pushed
    root = np.zeros((channels, channels))
    for a in range(channels):
        for b in range(a + 1):
            entry = 1.0 if a == b else 0.0
            for i in range(dimension):
                entry += noise[i, a] * by_noise[b, i]
            for c in range(b):
                entry -= root[a, c] * root[b, c]
            root[a, b] = math.sqrt(entry) if a == b else entry / root[b, b]
        constant -= math.log(root[a, a])
    # forward substitution, in place: half = root⁻¹ (Gᵀu, GᵀΛ)
    half = np.zeros(channels)
    for a in range(channels):
        entry = 0.0
        for i in range(dimension):
            entry += noise[i, a] * information[i]
        for b in range(a):
            entry -= root[a, b] * half[b]
            for i in range(dimension):
                by_noise[a, i] -= root[a, b] * by_noise[b, i]
        half[a] = entry / root[a, a]
        for i in range(dimension):
            by_noise[a, i] /= root[a, a]
        constant += 0.5 * half[a] * half[a]
    for i in range(dimension):
        for a in range(channels):
            information[i] -= by_noise[a, i] * half[a]
            for j in range(dimension):
                precision[i, j] -= by_noise[a, i] * by_noise[a, j]
    # back substitution: root⁻ᵀ (half, I)
    for a in range(channels - 1, -1, -1):
        shift[a] = half[a]
        gain[a] = by_noise[a]
        for c in range(channels):
            factor[a, c] = 1.0 if a == c else 0.0
        for b in range(a + 1, channels):
            shift[a] -= root[b, a] * shift[b]
            for i in range(dimension):
                gain[a, i] -= root[b, a] * gain[b, i]
            for c in range(channels):
                factor[a, c] -= root[b, a] * factor[b, c]
        shift[a] /= root[a, a]
        for i in range(dimension):
            gain[a, i] /= root[a, a]
        for c in range(channels):
            factor[a, c] /= root[a, a]
    return constant


@njit(cache=True, error_model="numpy")
def integrate_starts(ahead: Potential, noise: Array, offset: Array, steering: SteeringArrays, total: Array) -> None:
    """`integrate` for every start: of each trajectory, on each of several turns.

    Args:
        ahead: what all rows' measurements say of the first state: `(B, D, D)`, `(B, D)` and `(B,)`.
        noise, offset: `(B, D, C)` and `(W, B, D)`.
        steering: filled, `(W, B, ...)`.
        total: filled with the logarithm of the integral, `(W, B)`.
    """
    for w in range(offset.shape[0]):
        for b in range(offset.shape[1]):
            out = (steering.shift[w, b], steering.gain[w, b], steering.factor[w, b])
            precision, information = ahead.precision[b].copy(), ahead.information[b].copy()
            total[w, b] = ahead.log_scale[b] + integrate(precision, information, noise[b], offset[w, b], out)


@njit(cache=True, error_model="numpy")
def backward(
    seen: Potential,
    state: Array,
    noise: Array,
    offset: Array,
    futures: Potential,
    steering: SteeringArrays,
) -> None:
    """The backward information filter of δ' = F δ + offset + G ε, for every trajectory.

    Args:
        seen: what each row's own measurements say.
        state, noise, offset: F `(T, B, D, D)`, G `(T, B, D, C)` and `(T, B, D)`.
        futures: filled with what all later rows' measurements say of a row's state.
        steering: filled with the noise that they ask for in each interval, `(T, B, ...)`.
    """
    intervals, trajectories, dimension = offset.shape
    channels = noise.shape[3]
    precision, information = np.zeros((dimension, dimension)), np.zeros(dimension)
    half, row_of_gain = np.zeros((dimension, dimension)), np.zeros(dimension)
    for b in range(trajectories):
        precision[:] = 0.0
        information[:] = 0.0
        scale = 0.0
        futures.precision[intervals, b] = 0.0
        futures.information[intervals, b] = 0.0
        futures.log_scale[intervals, b] = 0.0
        for t in range(intervals - 1, -1, -1):
            precision += seen.precision[t + 1, b]
            information += seen.information[t + 1, b]
            out = (steering.shift[t, b], steering.gain[t, b], steering.factor[t, b])
            scale += seen.log_scale[t + 1, b] + integrate(precision, information, noise[t, b], offset[t, b], out)
            forward = state[t, b]
            for i in range(dimension):
                for j in range(dimension):
                    half[i, j] = 0.0
                    for k in range(dimension):
                        half[i, j] += precision[i, k] * forward[k, j]
            for i in range(dimension):
                futures.information[t, b, i] = 0.0
                for k in range(dimension):
                    futures.information[t, b, i] += forward[k, i] * information[k]
                for j in range(dimension):
                    precision[i, j] = 0.0
                    for k in range(dimension):
                        precision[i, j] += forward[k, i] * half[k, j]
            information[:] = futures.information[t, b]
            for a in range(channels):
                row_of_gain[:] = steering.gain[t, b, a]
                for j in range(dimension):
                    steering.gain[t, b, a, j] = 0.0
                    for k in range(dimension):
                        steering.gain[t, b, a, j] += row_of_gain[k] * forward[k, j]
            futures.precision[t, b] = precision
            futures.log_scale[t, b] = scale


@njit(cache=True, error_model="numpy")
def roll_out(moved: Array, pushed: Array, deviations: Array) -> None:
    """Fill δ' = moved δ + pushed row by row.

    Args:
        moved: `(T, B, D, D)`.
        pushed: `(M, T, B, D)`.
        deviations: `(M, T + 1, B, D)`, its first row given.
    """
    draws, intervals, trajectories, dimension = pushed.shape
    for m in range(draws):
        for t in range(intervals):
            for b in range(trajectories):
                for i in range(dimension):
                    entry = pushed[m, t, b, i]
                    for j in range(dimension):
                        entry += moved[t, b, i, j] * deviations[m, t, b, j]
                    deviations[m, t + 1, b, i] = entry


@njit(cache=True, error_model="numpy")
def covariances(state: Array, noise: Array, gain: Array, factor: Array, found: tuple[Array, Array, Array]) -> None:
    """Posterior covariances of δ' = F δ + G ε with ε ~ N(shift − gain δ, factor factorᵀ).

    Args:
        state, noise: F `(T, B, D, D)` and G `(T, B, D, C)`.
        gain, factor: `(T, B, C, D)` and `(T, B, C, C)`.
        found: of the states, `(T + 1, B, D, D)`, the first given; filled, as are those of the noise with itself,
            `(T, B, C, C)`, and of each state with the noise that moves it, `(T, B, D, C)`.
    """
    states, noises, across = found
    intervals, trajectories, dimension, channels = noise.shape
    moved = np.zeros((dimension, dimension))
    spread = np.zeros((dimension, channels))
    half = np.zeros((dimension, dimension))
    for t in range(intervals):
        for b in range(trajectories):
            now = states[t, b]
            for i in range(dimension):
                for a in range(channels):
                    entry = 0.0
                    for j in range(dimension):
                        entry -= now[i, j] * gain[t, b, a, j]
                    across[t, b, i, a] = entry
            for a in range(channels):
                for c in range(channels):
                    entry = 0.0
                    for k in range(channels):
                        entry += factor[t, b, a, k] * factor[t, b, c, k]
                    for j in range(dimension):
                        entry -= gain[t, b, a, j] * across[t, b, j, c]
                    noises[t, b, a, c] = entry
            for i in range(dimension):
                for j in range(dimension):
                    entry = state[t, b, i, j]
                    for a in range(channels):
                        entry -= noise[t, b, i, a] * gain[t, b, a, j]
                    moved[i, j] = entry
                for k in range(channels):
                    entry = 0.0
                    for a in range(channels):
                        entry += noise[t, b, i, a] * factor[t, b, a, k]
                    spread[i, k] = entry
            for i in range(dimension):
                for j in range(dimension):
                    entry = 0.0
                    for k in range(dimension):
                        entry += moved[i, k] * now[k, j]
                    half[i, j] = entry
            for i in range(dimension):
                for j in range(i + 1):
                    entry = 0.0
                    for k in range(dimension):
                        entry += half[i, k] * moved[j, k]
                    for k in range(channels):
                        entry += spread[i, k] * spread[j, k]
                    states[t + 1, b, i, j] = entry
                    states[t + 1, b, j, i] = entry
