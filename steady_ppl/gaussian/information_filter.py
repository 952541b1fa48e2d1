"""Looking ahead: what all later measurements say of a state, exactly for the linearised program.

The backward information filter gives the likelihood of everything after a row, p(y_{t+1}, …, y_T | δ_t), as
exp(c − ½ δᵀ Λ δ + λᵀ δ) in deviations δ from the path. Sampling each step's noise from N(0, I) times that function of
where it leads draws from the posterior, forward in time: the optimal twist of Guarniero, Johansen and Lee (2017) and of
Whiteley and Lee (2014), and with a linear program the smoother itself.

The recursions are compiled, on numpy arrays in double precision, eight trajectories at once, see `lanes`; rows or
intervals first, blocks of trajectories second. A matrix that is not positive definite turns into NaN, which log p(y)
then shows.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.lanes import (
    Array,
    add,
    add_dot,
    add_gram,
    add_outer,
    add_product,
    in_lanes,
    is_some,
    out_of_lanes,
    put,
    set_scaled,
)
from steady_ppl.gaussian.linearize import LinearArrays, Linearization, ReferencePath

ROUNDING = 1e-6  # of log p(y), by which it may be larger than can be


class Potential(NamedTuple):
    """exp(c − ½ δᵀ Λ δ + λᵀ δ) of a state in lanes."""

    precision: Array  # Λ (..., D, D, LANES)
    information: Array  # λ (..., D, 1, LANES)
    log_scale: Array  # c (..., 1, 1, LANES)

    @classmethod
    def zeros(cls, *left: int, lanes: int, dimension: int) -> Potential:
        return cls(*(np.zeros((*left, *shape, lanes)) for shape in ((dimension, dimension), (dimension, 1), (1, 1))))


class Steering(NamedTuple):
    """Noise that leads to the later measurements, ε ~ N(shift − gain δ, factor factorᵀ); tensors, or arrays in lanes,
    whose shift is a matrix of one column."""

    shift: Any  # (..., C)
    gain: Any  # (..., C, D)
    factor: Any  # (..., C, C), upper triangular

    @classmethod
    def in_lanes(cls, *left: int, lanes: int, dimension: int, channels: int) -> Steering:
        """Room for arrays."""
        return cls(*(np.empty((*left, channels, columns, lanes)) for columns in (1, dimension, channels)))

    def tensors(self, like: Tensor) -> Steering:
        """Out of lanes, of as many trajectories as `(..., B, D)` has, on its device."""
        shift, gain, factor = (out_of_lanes(part, like.shape[-2]).to(like.device) for part in self)
        return Steering(shift.squeeze(-1), gain, factor)


@dataclass(frozen=True)
class Lookahead:
    """The likelihood of all later measurements after every row, and the noise that it asks for."""

    linearization: Linearization  # of the program; deviations are from its path
    windings: Tensor  # (W, D), turns from the one nearest to the prior's mean on which the start may lie, none first
    winding_masses: Tensor  # (W, B), log posterior probability of each
    starts: Steering  # of the start's noise, (W, B, ...), its deviation zero
    log_likelihood: Tensor  # log p(y) of the linearised program, (B,), observations tempered as in the linearization
    given: LinearArrays = field(repr=False)  # the linearization in lanes
    futures: Potential = field(repr=False)  # after every row, in lanes
    steering: Steering = field(repr=False)  # of every interval's noise, in lanes

    @property
    def is_broken(self) -> Tensor:
        """Where log p(y) is no number, or above the measurements' density at residuals of zero, `(B,)`: no Gaussian
        reaches that, and the recursions have lost their digits."""
        most = self.linearization.log_scale.sum(0)
        return ~torch.isfinite(self.log_likelihood) | (self.log_likelihood > most + ROUNDING * (1 + most.abs()))

    @cached_property
    def precision(self) -> Tensor:
        """Λ `(T + 1, B, D, D)`."""
        return self._tensor(self.futures.precision)

    @cached_property
    def information(self) -> Tensor:
        """λ `(T + 1, B, D)`."""
        return self._tensor(self.futures.information).squeeze(-1)

    @cached_property
    def log_scale(self) -> Tensor:
        """c `(T + 1, B)`."""
        return self._tensor(self.futures.log_scale).flatten(1)

    @cached_property
    def steps(self) -> Steering:
        """Of every interval's noise, `(T, B, ...)`."""
        return self.steering.tensors(self.linearization.offset)

    def means(self) -> tuple[Tensor, Tensor]:
        """Posterior means of the linearised program, on the path's own turn: states `(T + 1, B, D)` and noise
        `(T, B, C)`."""
        moved, noise = (self._tensor(part).squeeze(-1) for part in self.means_in_lanes())
        return self.linearization.path.states + moved, noise

    def path(self, data: Trajectories) -> ReferencePath:
        """The posterior mean as a path to linearise along."""
        has_tails = self.linearization.path.variance is not None
        return ReferencePath.of_means(*self.means(), data, self.sensed_variance if has_tails else None)

    @cached_property
    def sensed_variance(self) -> Tensor:
        """Posterior variance of what each measurement sees, to first order, `(T + 1, B, K)`; zero if missing."""
        seen = self.linearization.precision > 0
        by_state, states = self.linearization.measurement[seen], self._tensor(self.covariances_in_lanes[0])
        rows, drives, _ = seen.nonzero(as_tuple=True)
        across = (states[rows, drives] @ by_state.unsqueeze(-1)).squeeze(-1)
        return torch.zeros_like(self.linearization.precision).masked_scatter(seen, (across * by_state).sum(-1))

    def means_in_lanes(self) -> tuple[Array, Array]:
        """The means, of the states less the path's: `(T + 1, blocks, D, 1, LANES)`; and `(T, blocks, C, 1, LANES)`."""
        states, noise = self._forward(self.starts.shift[:1], self.steering.shift[None].copy())
        return states[0], noise[0]

    def draws(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Independent draws of the linearised program's posterior: start noise `(M, B, C₀)`, states `(M, T + 1, B, D)`
        and noise `(M, T, B, C)`, the last two on the turn that the start noise asks for."""
        winding, start, _ = self.draw_starts(count)
        turns = self.windings[winding]
        random = torch.randn(count, *self.steps.shift.shape, dtype=start.dtype, device=start.device)
        noise = self.steps.shift + times(self.steps.factor, random)
        rolled = self._forward(start, in_lanes(noise.unsqueeze(-1)), turns)
        states, noise = (self._tensor(part).squeeze(-1) for part in rolled)
        turned = self.linearization.path.states + (turns + self.linearization.start_turn).unsqueeze(1)
        return start, turned + states, noise

    def draw_starts(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Draw which of the `windings` starts lie on, `(M, B)`, their noise, and the standard normal one that it was
        made of, each `(M, B, C₀)`."""
        winding = torch.distributions.Categorical(logits=self.winding_masses.t()).sample((count,))
        trajectory = torch.arange(winding.shape[1], device=winding.device)
        shift, factor = self.starts.shift[winding, trajectory], self.starts.factor[winding, trajectory]
        own = torch.randn_like(shift)
        return winding, shift + times(factor, own), own

    def covariances(self) -> tuple[Tensor, Tensor, Tensor]:
        """Posterior covariances on the path's own turn: of the states, `(T + 1, B, D, D)`, of the noise of each
        interval, `(T, B, C, C)`, and of the state that it moves with it, `(T, B, D, C)`."""
        states, noises, across = (self._tensor(part) for part in self.covariances_in_lanes)
        return states, noises, across

    @cached_property
    def covariances_in_lanes(self) -> tuple[Array, Array, Array]:
        spread = self.linearization.start_noise @ self.starts.factor[0]
        return covariances(self.given, self.steering, in_lanes(spread @ spread.mT))

    def _forward(self, start: Tensor, noise: Array, turns: Tensor | float = 0.0) -> tuple[Array, Array]:
        """States, less the path's, and noise in lanes: what the start's noise `(M, B, C₀)` and each interval's at a
        deviation of zero lead to."""
        linear = self.linearization
        begin = linear.start_offset + times(linear.start_noise, start) - turns
        return roll_deviations(self.given, self.steering.gain, in_lanes(begin.unsqueeze(-1)), noise), noise

    def _tensor(self, blocks: Array) -> Tensor:
        linear = self.linearization
        return out_of_lanes(blocks, linear.offset.shape[1]).to(linear.offset.device)


def look_ahead(linear: Linearization) -> Lookahead:
    """Run the backward information filter."""
    device, (trajectories, dimension, starting) = linear.offset.device, linear.start_noise.shape
    matrices = ("start_noise", "state", "noise", "measurement")
    parts = ((name, getattr(linear, name)) for name in LinearArrays._fields)
    given = LinearArrays(*(in_lanes(part if name in matrices else part.unsqueeze(-1)) for name, part in parts))
    rows, blocks, *_, lanes = given.measurement.shape
    first = Potential.zeros(blocks, lanes=lanes, dimension=dimension)
    futures = Potential.zeros(rows, blocks, lanes=lanes, dimension=dimension)
    steps = Steering.in_lanes(rows - 1, blocks, lanes=lanes, dimension=dimension, channels=linear.noise.shape[-1])
    backward(given, in_lanes(linear.log_scale[..., None, None]), first, futures, steps)
    windings = _windings(linear)
    offsets = linear.start_offset - windings.unsqueeze(1)
    begun = Steering.in_lanes(len(windings), blocks, lanes=lanes, dimension=dimension, channels=starting)
    totals = integrate_starts(given.start_noise, first, in_lanes(offsets.unsqueeze(-1)), begun)
    masses = out_of_lanes(totals, trajectories).flatten(1).to(device)
    starts = begun.tensors(linear.start_offset)
    if len(windings) > 1:
        spread = (linear.start_noise[:, list(linear.angles)] @ starts.factor[0]).square().sum(-1)
        vague = (spread > 1).any(-1)  # the measurements leave an angle open: one turn's integral covers the others
        masses[1:].masked_fill_(vague, -torch.inf)
    log_likelihood = masses.logsumexp(0)
    return Lookahead(
        linearization=linear,
        windings=windings,
        winding_masses=masses - log_likelihood,
        starts=starts,
        log_likelihood=log_likelihood,
        given=given,
        futures=futures,
        steering=steps,
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


def times(matrix: Tensor, vectors: Tensor) -> Tensor:
    """A vector for each matrix, or draws of it in front: these are side by side for the product."""
    if vectors.dim() < matrix.dim():
        return (matrix @ vectors.unsqueeze(-1)).squeeze(-1)
    return (matrix @ vectors.movedim(0, -1)).movedim(-1, 0)


@njit(cache=True, error_model="numpy")
def _room(dimension: int, channels: int, lanes: int) -> tuple[Array, ...]:
    """What `integrate` works in: to allocate takes as long as a product."""
    square, wide, column = (channels, channels, lanes), (channels, dimension, lanes), (channels, 1, lanes)
    pushed, pull, white = np.zeros((dimension, 1, lanes)), np.zeros(column), np.zeros(column)
    by_noise, half, gram, root = np.zeros(wide), np.zeros(wide), np.zeros(square), np.zeros(square)
    return pushed, by_noise, pull, gram, root, half, white


@njit(cache=True, error_model="numpy")
def integrate(ahead: Potential, noise: Array, offset: Array, out: Steering, room: tuple[Array, ...]) -> None:
    """∫ ψ(μ + offset + G ε) N(ε; 0, I) dε as a function of μ, and the noise's conditional given μ; in lanes.

    ψ(x) = exp(c − ½ xᵀ Λ x + λᵀ x). With S = (I + GᵀΛG)⁻¹ and u = λ − Λ offset the integral is again of that form,
    with Λ − ΛGSGᵀΛ and u − ΛGSGᵀu, times a constant; and ε | μ ~ N(S Gᵀ(u − Λμ), S).

    Args:
        ahead: c, Λ and λ, overwritten by those of the integral.
        noise, offset: G `(D, C, LANES)` and `(D, 1, LANES)`.
        out: filled with ε ~ N(shift − gain μ, factor factorᵀ).
    """
    precision, information, log_scale = ahead
    channels = len(out.factor)
    pushed, by_noise, pull, gram, root, half, white = room
    for part in room:
        part[:] = 0.0
    for part in out:
        part[:] = 0.0
    add_gram(log_scale, information, offset, 1.0)
    add_product(pushed, precision, offset, 1.0)
    add_gram(log_scale, pushed, offset, -0.5)
    add(information, pushed, -1.0)
    add_gram(by_noise, noise, precision, 1.0)
    add_product(gram, by_noise, noise, 1.0)
    add_gram(pull, noise, information, 1.0)
    # root rootᵀ = I + GᵀΛG, and factor = root⁻ᵀ
    for a in range(channels):
        for b in range(a):
            add_dot(root, a * channels + b, gram, a * channels, 1, out.factor, b, channels, b + 1, 1.0)
        add_dot(gram, a * channels + a, root, a * channels, 1, root, a * channels, 1, a, -1.0)
        pivot, scale = gram[a, a], out.factor[a, a]
        for lane in range(len(pivot)):
            log_scale[0, 0, lane] -= 0.5 * math.log1p(pivot[lane])
            scale[lane] = 1.0 / math.sqrt(1.0 + pivot[lane])
        for b in range(a):
            add_dot(
                out.factor, b * channels + a, out.factor, b * channels + b, 1, root, a * channels + b, 1, a - b, -1.0
            )
            for lane in range(len(pivot)):
                out.factor[b, a, lane] *= scale[lane]
    # root⁻¹ (GᵀΛ, Gᵀu), and root⁻ᵀ times these
    add_gram(half, out.factor, by_noise, 1.0)
    add_gram(white, out.factor, pull, 1.0)
    add_gram(log_scale, white, white, 0.5)
    add_gram(information, half, white, -1.0)
    add_gram(precision, half, half, -1.0)
    add_product(out.shift, out.factor, white, 1.0)
    add_product(out.gain, out.factor, half, 1.0)


@njit(cache=True, error_model="numpy")
def integrate_starts(noise: Array, ahead: Potential, offset: Array, steering: Steering) -> Array:
    """`integrate` for every start: of each block of trajectories, on each of several turns.

    `ahead` is what all rows' measurements say of the first state. The offsets are `(W, blocks, D, 1, LANES)`. Fills the
    steering, and returns the logarithm of the integral, `(W, blocks, 1, 1, LANES)`.
    """
    total, room = np.empty((*offset.shape[:2], 1, 1, noise.shape[3])), _room(*noise.shape[1:])
    for w in range(offset.shape[0]):
        for k in range(offset.shape[1]):
            out = Steering(steering.shift[w, k], steering.gain[w, k], steering.factor[w, k])
            put(total[w, k], ahead.log_scale[k])
            first = Potential(ahead.precision[k].copy(), ahead.information[k].copy(), total[w, k])
            integrate(first, noise[k], offset[w, k], out, room)
    return total


@njit(cache=True, error_model="numpy")
def backward(given: LinearArrays, log_scale: Array, first: Potential, futures: Potential, steering: Steering) -> None:
    """The backward information filter of δ' = F δ + offset + G ε, for every trajectory.

    It adds to `first`, of zeros, what all measurements say of the first state, and fills what all later ones say of
    each row's, `futures`, and the noise that they ask for in each interval. `log_scale` is of each row's own.
    """
    rows, blocks, components, dimension, lanes = given.measurement.shape
    matrix, column = (components, dimension, lanes), (components, 1, lanes)
    by_state, weighted, apart, pull = np.zeros(matrix), np.zeros(matrix), np.zeros(column), np.zeros(column)
    half, gain = np.zeros((dimension, dimension, lanes)), np.zeros(steering.gain.shape[2:])
    moved, room = np.zeros((dimension, 1, lanes)), _room(dimension, steering.gain.shape[2], lanes)
    for k in range(blocks):
        ahead = Potential(first.precision[k], first.information[k], first.log_scale[k])
        for t in range(rows - 1, -1, -1):
            put(futures.precision[t, k], ahead.precision)
            put(futures.information[t, k], ahead.information)
            put(futures.log_scale[t, k], ahead.log_scale)
            count = 0  # of components that some trajectory of the block has
            for a in range(components):
                precision = given.precision[t, k, a : a + 1]
                if is_some(precision):
                    put(by_state[count], given.measurement[t, k, a])
                    put(apart[count], given.residual[t, k, a])
                    set_scaled(weighted[count : count + 1], given.measurement[t, k, a : a + 1], precision)
                    set_scaled(pull[count : count + 1], given.residual[t, k, a : a + 1], precision)
                    count += 1
            add_gram(ahead.precision, weighted[:count], by_state[:count], 1.0)
            add_gram(ahead.information, by_state[:count], pull[:count], 1.0)
            add_gram(ahead.log_scale, apart[:count], pull[:count], -0.5)
            add(ahead.log_scale, log_scale[t, k], 1.0)
            if t > 0:
                forward = given.state[t - 1, k]
                out = Steering(steering.shift[t - 1, k], gain, steering.factor[t - 1, k])
                integrate(ahead, given.noise[t - 1, k], given.offset[t - 1, k], out, room)
                steering.gain[t - 1, k] = 0.0
                add_product(steering.gain[t - 1, k], gain, forward, 1.0)
                half[:] = 0.0
                put(moved, ahead.information)
                add_product(half, ahead.precision, forward, 1.0)
                ahead.precision[:], ahead.information[:] = 0.0, 0.0
                add_gram(ahead.precision, forward, half, 1.0)
                add_gram(ahead.information, forward, moved, 1.0)


@njit(cache=True, error_model="numpy")
def roll_deviations(given: LinearArrays, gain: Array, begin: Array, noise: Array) -> Array:
    """δ' = F δ + offset + G ε row by row, from the first, `(M, blocks, D, 1, LANES)`.

    `noise` is ε at δ = 0, `(M, T, blocks, C, 1, LANES)`; from it, gain δ is taken off.
    """
    draws, intervals, blocks = noise.shape[:3]
    deviations = np.empty((draws, intervals + 1, *begin.shape[1:]))
    for m in range(draws):
        put(deviations[m, 0], begin[m])
        for t in range(intervals):
            put(deviations[m, t + 1], given.offset[t])
            for k in range(blocks):
                here, there, own = deviations[m, t, k], deviations[m, t + 1, k], noise[m, t, k]
                add_product(own, gain[t, k], here, -1.0)
                add_product(there, given.state[t, k], here, 1.0)
                add_product(there, given.noise[t, k], own, 1.0)
    return deviations


@njit(cache=True, error_model="numpy")
def covariances(given: LinearArrays, steering: Steering, first: Array) -> tuple[Array, Array, Array]:
    """Posterior covariances of δ' = F δ + G ε with ε ~ N(shift − gain δ, factor factorᵀ), as `Lookahead.covariances`
    returns them, in lanes; that of the first state is given."""
    intervals, blocks, dimension, channels, lanes = given.noise.shape
    states = np.zeros((intervals + 1, blocks, dimension, dimension, lanes))
    noises = np.zeros((intervals, blocks, channels, channels, lanes))
    across = np.zeros((intervals, blocks, dimension, channels, lanes))
    moved, spread = np.zeros((dimension, dimension, lanes)), np.zeros((dimension, channels, lanes))
    half = np.zeros((dimension, dimension, lanes))
    put(states[0], first)
    for t in range(intervals):
        for k in range(blocks):
            gain, factor, noise = steering.gain[t, k], steering.factor[t, k], given.noise[t, k]
            add_outer(across[t, k], states[t, k], gain, -1.0)
            add_outer(noises[t, k], factor, factor, 1.0)
            add_product(noises[t, k], gain, across[t, k], -1.0)
            half[:], spread[:] = 0.0, 0.0
            put(moved, given.state[t, k])
            add_product(moved, noise, gain, -1.0)
            add_product(half, moved, states[t, k], 1.0)
            add_product(spread, noise, factor, 1.0)
            _add_symmetric(states[t + 1, k], half, moved)
            _add_symmetric(states[t + 1, k], spread, spread)
    return states, noises, across


@njit(cache=True, error_model="numpy")
def _add_symmetric(out: Array, left: Array, right: Array) -> None:
    """out += left rightᵀ, which is symmetric: to the bit."""
    rows, inner, _ = left.shape
    for i in range(rows):
        for j in range(i + 1):
            add_dot(out, i * rows + j, left, i * inner, 1, right, j * inner, 1, inner, 1.0)
            put(out[j, i], out[i, j])
