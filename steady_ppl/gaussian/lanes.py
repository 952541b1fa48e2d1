"""Small matrices of eight trajectories at once, for compiled recursions: an entry is a vector of eight numbers.

A processor multiplies all eight in one or two instructions; one trajectory's matrix is too small for that. Arrays are
`(..., rows, columns, LANES)` and contiguous in C's order; a vector is a matrix of one column. numba's cache of the
recursions does not see what changes here: remove `__pycache__` after an edit.
"""

from typing import Any

import numpy as np
import torch
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from torch import Tensor

Array = np.ndarray[Any, np.dtype[np.float64]]
LANES = 8
_intrinsic: Any = intrinsic  # whose annotations count the typing context among the arguments of a call


def array(tensor: Tensor) -> Array:
    """A C-contiguous array; of a contiguous tensor in the host's memory it is that memory."""
    return tensor.contiguous().numpy(force=True)


def in_lanes(matrices: Tensor) -> Array:
    """`(..., B, R, C)` as `(..., blocks, R, C, LANES)` in the host's memory, the last block filled with zeros."""
    lanes = LANES if matrices.shape[-3] > 2 else 1  # blocks of mostly zeros would be no faster
    *left, count, rows, columns = matrices.shape
    full, rest = divmod(count, lanes)
    whole = matrices[..., : full * lanes, :, :].unflatten(-3, (full, lanes)).movedim(-3, -1)
    if not rest:
        return whole.contiguous().numpy(force=True)
    blocks = matrices.new_empty((*left, full + 1, rows, columns, lanes))
    blocks[..., :full, :, :, :] = whole
    blocks[..., full, :, :, :rest] = matrices[..., full * lanes :, :, :].movedim(-3, -1)
    blocks[..., full, :, :, rest:] = 0.0
    return blocks.numpy(force=True)


def out_of_lanes(blocks: Array, trajectories: int) -> Tensor:
    """What `in_lanes` was given, of so many trajectories."""
    return torch.from_numpy(blocks).movedim(-1, -3).flatten(-4, -3)[..., :trajectories, :, :].contiguous()


def _add_dot(context: Any, builder: Any, kinds: Any, arguments: Any, lanes: int) -> None:
    """The instructions of `add_dot`, for arrays of so many lanes."""
    out, at, left, first, step, right, start, stride, count, sign = arguments
    vector = ir.VectorType(ir.DoubleType(), lanes)

    def entry(kind: Any, array: Any, index: Any) -> Any:
        data = context.make_array(kind)(context, builder, array).data
        return builder.gep(builder.bitcast(data, vector.as_pointer()), [index])

    def factor(kind: Any, array: Any, begin: Any, apart: Any, k: Any) -> Any:
        return builder.load(entry(kind, array, builder.add(begin, builder.mul(k, apart))), align=8)

    total = cgutils.alloca_once_value(builder, ir.Constant(vector, [0.0] * lanes))
    builder.store(ir.Constant(vector, [0.0] * lanes), total)
    with cgutils.for_range(builder, count) as loop:
        one = factor(kinds[2], left, first, step, loop.index)
        other = factor(kinds[5], right, start, stride, loop.index)
        builder.store(builder.fadd(builder.load(total), builder.fmul(one, other)), total)
    signs = ir.Constant(vector, ir.Undefined)
    for lane in range(lanes):
        signs = builder.insert_element(signs, sign, ir.IntType(32)(lane))
    place = entry(kinds[0], out, at)
    change = builder.fmul(signs, builder.load(total))
    builder.store(builder.fadd(builder.load(place, align=8), change), place, align=8)


@_intrinsic
def add_dot(typing, out, at, left, first, step, right, start, stride, count, sign):  # type: ignore[no-untyped-def]
    """out[at] += sign · Σₖ left[first + k step] right[start + k stride], of `count` products in every lane.

    Entries are counted through the array, whatever its dimensions. LLVM's own vectoriser leaves such loops alone: it
    does not know that the arrays are apart.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes = builder.extract_value(context.make_array(signature.args[0])(context, builder, arguments[0]).shape, 2)
        with builder.if_else(builder.icmp_signed("==", lanes, lanes.type(LANES))) as (wide, single):
            with wide:
                _add_dot(context, builder, signature.args, arguments, LANES)
            with single:
                _add_dot(context, builder, signature.args, arguments, 1)
        return context.get_dummy_value()

    n = types.intp
    return types.void(out, n, left, n, n, right, n, n, n, types.float64), generate


@njit(cache=True, error_model="numpy")
def put(out: Array, values: Array) -> None:
    """out = values, contiguous and of one shape. `out[:] = values` takes numba seconds to compile."""
    for i in range(values.size):
        out.flat[i] = values.flat[i]


@njit(cache=True, error_model="numpy")
def add(out: Array, values: Array, sign: float) -> None:
    """out += sign · values, contiguous and of one shape."""
    for i in range(values.size):
        out.flat[i] += sign * values.flat[i]


@njit(cache=True, error_model="numpy")
def add_product(out: Array, left: Array, right: Array, sign: float) -> None:
    """out += sign · left right."""
    (rows, columns, _), inner = out.shape, left.shape[1]
    for i in range(rows):
        for j in range(columns):
            add_dot(out, i * columns + j, left, i * inner, 1, right, j, columns, inner, sign)


@njit(cache=True, error_model="numpy")
def add_gram(out: Array, left: Array, right: Array, sign: float) -> None:
    """out += sign · leftᵀ right."""
    (rows, columns, _), inner = out.shape, left.shape[0]
    for i in range(rows):
        for j in range(columns):
            add_dot(out, i * columns + j, left, i, rows, right, j, columns, inner, sign)


@njit(cache=True, error_model="numpy")
def add_outer(out: Array, left: Array, right: Array, sign: float) -> None:
    """out += sign · left rightᵀ."""
    (rows, columns, _), inner = out.shape, left.shape[1]
    for i in range(rows):
        for j in range(columns):
            add_dot(out, i * columns + j, left, i * inner, 1, right, j * inner, 1, inner, sign)


@njit(cache=True, error_model="numpy")
def set_scaled(out: Array, matrix: Array, scale: Array) -> None:
    """Each row of a matrix times its entry of a vector."""
    rows, columns, lanes = matrix.shape
    for i in range(rows):
        for j in range(columns):
            for lane in range(lanes):
                out[i, j, lane] = matrix[i, j, lane] * scale[i, 0, lane]


@njit(cache=True, error_model="numpy")
def is_some(values: Array) -> bool:
    """Whether some value is not zero."""
    for i in range(values.size):  # noqa: SIM110
        if values.flat[i] != 0.0:
            return True
    return False
