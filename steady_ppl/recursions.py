"""The smoother's recursions on given arrays, compiled: arithmetic without any model.

Arrays are numpy, double precision; rows or intervals first, trajectories second. A matrix that is not positive definite
turns into NaN, which log p(y) then shows.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

Array = np.ndarray[Any, np.dtype[np.float64]]


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
def integrate_starts(
    ahead: tuple[Array, Array, Array], noise: Array, offset: Array, steering: tuple[Array, Array, Array], total: Array
) -> None:
    """`integrate` for every start: of each trajectory, on each of several turns.

    Args:
        ahead: what all rows' measurements say of the first state: `(B, D, D)`, `(B, D)` and `(B,)`.
        noise, offset: `(B, D, C)` and `(W, B, D)`.
        steering: filled: `(W, B, C)`, `(W, B, C, D)` and `(W, B, C, C)`.
        total: filled with the logarithm of the integral, `(W, B)`.
    """
    for w in range(offset.shape[0]):
        for b in range(offset.shape[1]):
            out = (steering[0][w, b], steering[1][w, b], steering[2][w, b])
            precision, information = ahead[0][b].copy(), ahead[1][b].copy()
            total[w, b] = ahead[2][b] + integrate(precision, information, noise[b], offset[w, b], out)


@njit(cache=True, error_model="numpy")
def backward(
    seen: tuple[Array, Array, Array],
    state: Array,
    noise: Array,
    offset: Array,
    futures: tuple[Array, Array, Array],
    steering: tuple[Array, Array, Array],
) -> None:
    """The backward information filter of δ' = F δ + offset + G ε, for every trajectory.

    Args:
        seen: what each row's own measurements say: Λ `(T + 1, B, D, D)`, λ `(T + 1, B, D)` and c `(T + 1, B)`.
        state, noise, offset: F `(T, B, D, D)`, G `(T, B, D, C)` and `(T, B, D)`.
        futures: filled with what all later rows' measurements say of a row's state, as `seen`.
        steering: filled with the noise that they ask for, ε ~ N(shift − gain δ, factor factorᵀ): `(T, B, C)`,
            `(T, B, C, D)` and `(T, B, C, C)`.
    """
    intervals, trajectories, dimension = offset.shape
    channels = noise.shape[3]
    precision, information = np.zeros((dimension, dimension)), np.zeros(dimension)
    half, row_of_gain = np.zeros((dimension, dimension)), np.zeros(dimension)
    for b in range(trajectories):
        precision[:] = 0.0
        information[:] = 0.0
        scale = 0.0
        futures[0][intervals, b] = 0.0
        futures[1][intervals, b] = 0.0
        futures[2][intervals, b] = 0.0
        for t in range(intervals - 1, -1, -1):
            precision += seen[0][t + 1, b]
            information += seen[1][t + 1, b]
            out = (steering[0][t, b], steering[1][t, b], steering[2][t, b])
            scale += seen[2][t + 1, b] + integrate(precision, information, noise[t, b], offset[t, b], out)
            forward = state[t, b]
            for i in range(dimension):
                for j in range(dimension):
                    half[i, j] = 0.0
                    for k in range(dimension):
                        half[i, j] += precision[i, k] * forward[k, j]
            for i in range(dimension):
                futures[1][t, b, i] = 0.0
                for k in range(dimension):
                    futures[1][t, b, i] += forward[k, i] * information[k]
                for j in range(dimension):
                    precision[i, j] = 0.0
                    for k in range(dimension):
                        precision[i, j] += forward[k, i] * half[k, j]
            information[:] = futures[1][t, b]
            for a in range(channels):
                row_of_gain[:] = steering[1][t, b, a]
                for j in range(dimension):
                    steering[1][t, b, a, j] = 0.0
                    for k in range(dimension):
                        steering[1][t, b, a, j] += row_of_gain[k] * forward[k, j]
            futures[0][t, b] = precision
            futures[2][t, b] = scale


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
