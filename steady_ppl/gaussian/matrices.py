"""Products of small matrices in compiled recursions, each sum taken term by term in the order of the indices.

NumPy's own products call BLAS, which at six rows takes longer than the product. numba's cache of the recursions does
not see what changes here: remove `__pycache__` after an edit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from torch import Tensor

Array = np.ndarray[Any, np.dtype[np.float64]]


def array(tensor: Tensor) -> Array:
    """A C-contiguous array; of a contiguous tensor in the host's memory it is that memory."""
    return tensor.contiguous().numpy(force=True)


@njit(cache=True, error_model="numpy", inline="always")
def add_product(out: Array, left: Array, right: Array, sign: float = 1.0) -> None:
    """out += sign · left right, of matrices."""
    for i in range(out.shape[0]):
        for k in range(left.shape[1]):
            weight = sign * left[i, k]
            for j in range(out.shape[1]):
                out[i, j] += weight * right[k, j]


@njit(cache=True, error_model="numpy", inline="always")
def set_product(out: Array, left: Array, right: Array) -> None:
    """out = left right, of matrices."""
    out[:] = 0.0
    add_product(out, left, right)


@njit(cache=True, error_model="numpy", inline="always")
def add_times(out: Array, matrix: Array, vector: Array, sign: float = 1.0) -> None:
    """out += sign · matrix vector."""
    for i in range(out.shape[0]):
        entry = out[i]
        for k in range(matrix.shape[1]):
            entry += sign * matrix[i, k] * vector[k]
        out[i] = entry


@njit(cache=True, error_model="numpy", inline="always")
def set_times(out: Array, matrix: Array, vector: Array) -> None:
    """out = matrix vector."""
    out[:] = 0.0
    add_times(out, matrix, vector)


@njit(cache=True, error_model="numpy", inline="always")
def propagate(out: Array, covariance: Array, moved: Array, spread: Array) -> None:
    """out = moved covariance movedᵀ + spread spreadᵀ, symmetric to the bit; `out` may be the covariance itself."""
    half = np.zeros_like(covariance)
    add_product(half, moved, covariance)
    for i in range(out.shape[0]):
        for j in range(i + 1):
            entry = 0.0
            for k in range(moved.shape[1]):
                entry += half[i, k] * moved[j, k]
            for c in range(spread.shape[1]):
                entry += spread[i, c] * spread[j, c]
            out[i, j] = entry
            out[j, i] = entry
