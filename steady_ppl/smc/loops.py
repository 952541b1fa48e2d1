"""Loops over particles and rows that numba compiles.

They stand in one file: numba's cache of a loop does not see that another file changes. A loop fills the arrays that
its caller gives for results. All arrays are contiguous.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

Array = np.ndarray[Any, Any]
_intrinsic: Any = intrinsic  # whose annotations count the typing context among the arguments of a call


@_intrinsic
def _call(typing, address, arguments):  # type: ignore[no-untyped-def]
    """Call a kernel at an address with whole numbers, addresses of arrays among them."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        given = cgutils.unpack_tuple(builder, values[1])
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in given])
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), given)
        return context.get_dummy_value()

    return types.void(address, arguments), generate


@njit(cache=True, error_model="numpy")
def choose_systematically(weights: Array, uniform: Array, chosen: Array) -> None:
    """See `smc.resampling.systematic`: weights `(B, N)`, `(B,)` and indices `(B, draws)`, which are filled."""
    first = np.empty(chosen.shape[1] + 1, np.int64)
    for b in range(len(weights)):
        _choose(weights[b], uniform[b], first, chosen[b])


@njit(cache=True, error_model="numpy")
def _choose(weights: Array, uniform: float, first: Array, chosen: Array) -> None:
    """The same of one trajectory, whose weights need not sum to one; `first` is room for one index more."""
    particles, draws = len(weights), len(chosen)
    first[:] = 0  # the particle whose offspring begin at a draw; 0 within offspring
    total = 0.0
    for i in range(particles):
        total += weights[i]
    cumulative, born = 0.0, 0
    for i in range(particles):
        first[born] = i  # the next particle takes the place where this one has no offspring: no branch
        cumulative += weights[i]
        share = cumulative / total  # where it is one all are born, also for u within rounding of one
        until = math.ceil(share * draws - uniform) if share < 1 else draws
        born = max(born, until)
    if born < draws:  # where a weight is not a number: the filter says so at its end
        first[born] = particles - 1
    parent = 0
    for j in range(draws):
        parent = max(parent, first[j])
        chosen[j] = parent


@njit(cache=True)
def draw(generator: Array, out: Array) -> None:
    """Fill `out`, a multiple of `STREAMS`, with uniform numbers in [0, 1) by xoshiro128+ (Blackman and Vigna 2021),
    whose upper 24 bits are taken."""
    a, b, c, d = generator[0], generator[1], generator[2], generator[3]
    for first in range(0, len(out), len(a)):
        numbers = out[first : first + len(a)]
        for i in range(len(a)):
            numbers[i] = np.float32(np.int32(np.uint32(a[i] + d[i]) >> np.uint32(8))) * np.float32(2.0**-24)
            shifted = np.uint32(b[i] << np.uint32(9))
            c[i] ^= a[i]
            d[i] ^= b[i]
            b[i] ^= c[i]
            a[i] ^= d[i]
            c[i] ^= shifted
            d[i] = np.uint32(d[i] << np.uint32(11)) | np.uint32(d[i] >> np.uint32(21))


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def exponentiate(values: Array, powers: Array) -> None:
    """eˣ of numbers at most 0, in their place: 2ⁿ eʳ with |r| ≤ log(2) / 2, a series to r¹³. `powers` is room for
    whole numbers. There is no branch, so that several are computed at once."""
    for i in range(len(values)):
        x = max(values[i], -708.0)
        whole = np.int32(x * 1.4426950408889634 - 0.5)
        n = np.float64(whole)
        r = (x - n * 0.6931471803691238) - n * 1.9082149292705877e-10
        p = (r * (1 / 6227020800) + 1 / 479001600) * r + 1 / 39916800
        p = ((p * r + 1 / 3628800) * r + 1 / 362880) * r + 1 / 40320
        p = ((p * r + 1 / 5040) * r + 1 / 720) * r + 1 / 120
        p = ((p * r + 1 / 24) * r + 1 / 6) * r + 1 / 2
        powers[i] = (np.int64(whole) + 1023) << 52 if values[i] > -708.0 else 0
        values[i] = (p * r + 1) * r + 1
    scales = powers.view(np.float64)
    for i in range(len(values)):
        values[i] *= scales[i]


@njit(cache=True, error_model="numpy", fastmath={"nnan", "nsz"})
def _largest(values: Array) -> float:
    largest = -np.inf
    for i in range(len(values)):
        largest = max(largest, values[i])
    return largest


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _sums(values: Array) -> tuple[float, float]:
    """Of numbers and of their squares."""
    total, squares = 0.0, 0.0
    for i in range(len(values)):
        total += values[i]
        squares += values[i] * values[i]
    return total, squares


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _weigh(
    log_weights: Array, density: Array, future: Array, weights: Array, powers: Array
) -> tuple[float, float, float]:
    """Weigh a trajectory's particles: `log_weights` change, of which `weights` and the future's are the exponentials
    but for a factor. Returns the evidence, the effective sample size and how many particles have blown up."""
    broken = 0
    for n in range(len(weights)):
        own = log_weights[n] + density[n]
        expected = own + future[n]
        bad = expected != expected  # explains no measurement
        broken += bad
        log_weights[n] = -np.inf if bad else own
        weights[n] = -np.inf if bad else expected
    largest = _largest(weights)
    if largest == -np.inf:
        weights[:] = 0.0
        log_weights[:] = np.nan
        return -np.inf, np.nan, broken
    for n in range(len(weights)):
        weights[n] -= largest
    exponentiate(weights, powers)
    total, squares = _sums(weights)
    evidence = largest + math.log(total)
    for n in range(len(weights)):
        log_weights[n] -= evidence
    return evidence, total * total / squares, broken


@njit(cache=True, error_model="numpy")
def filter_rows(
    addresses: tuple[int, int],
    constants: tuple[Array, Array],
    tables: tuple[Array, Array, Array, Array],
    settings: tuple[int, int, float, bool],
    random: tuple[Array, Array, Array],
    state: tuple[Array, Array, Array],
    block: tuple[Array, Array, Array],
    weighed: Array,
    figures: Array,
) -> None:
    """Take particles through a block's rows; what `tables` holds begins at the table's first row.

    Arrays are copied by loops: an assignment to a slice takes numba seconds to compile.
    """
    measured, moved, observed, inside = tables
    first_row, end, threshold, looks_ahead = settings
    generator, uniform, thresholds = random
    begin, log_weights, roots = state
    out, ancestors, resampled = block
    trajectories, particles = log_weights.shape
    seen = np.zeros((2, trajectories, particles), np.float32)
    weights, before = np.empty((trajectories, particles)), np.empty(particles, np.int64)
    powers, first = np.empty(particles, np.int64), np.empty(particles + 1, np.int64)
    even, nothing, here = -math.log(particles), np.zeros(particles, np.float32), begin.ctypes.data
    for row in range(first_row, end):
        r, any_exhausted = row - first_row, False
        weighs = looks_ahead or observed[row]
        if weighs:
            given = (constants[0].ctypes.data, measured[row].ctypes.data, here, np.uintp(0), seen.ctypes.data)
            _call(addresses[0], (*given, trajectories, particles, measured.shape[2]))
        for b in range(trajectories):
            figures[0, row, b], figures[1, row, b], figures[2, row, b] = 0.0, particles, 0.0
            if weighs:
                future = seen[1, b] if inside[row, b] else nothing
                found = _weigh(log_weights[b], seen[0, b], future, weights[b], powers)
                figures[0, row, b], figures[1, row, b], figures[2, row, b] = found
                any_exhausted |= found[1] < threshold
        if len(weighed):
            for b in range(trajectories):
                for n in range(particles):
                    weighed[b, n] = log_weights[b, n]
        if row == len(moved):
            break
        resampled[r] = any_exhausted
        if any_exhausted:
            for b in range(trajectories):
                chosen = ancestors[r, b]
                if figures[1, row, b] < threshold:
                    _choose(weights[b], thresholds[r, b], first, chosen)
                    for n in range(particles):
                        before[n] = roots[b, n]
                    for n in range(particles):
                        roots[b, n] = before[chosen[n]]
                        log_weights[b, n] = even - (seen[1, b, chosen[n]] if inside[row, b] else 0.0)
                else:
                    for n in range(particles):
                        chosen[n] = n
        came_from = ancestors[r].ctypes.data if any_exhausted else np.uintp(0)
        draw(generator, uniform)
        inputs = (constants[1].ctypes.data, moved[row].ctypes.data, here, uniform.ctypes.data)
        _call(addresses[1], (*inputs, came_from, out[r].ctypes.data, trajectories, particles, moved.shape[2]))
        for b in range(trajectories):
            if inside[row + 1, b]:
                for n in range(particles):
                    log_weights[b, n] += out[r, -1, b, n]
        here = out[r].ctypes.data
