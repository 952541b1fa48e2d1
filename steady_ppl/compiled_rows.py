"""Functions of a program, and their Jacobians, as kernels for all rows of all trajectories in one call."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from steady_ppl.kernel_writer import LANES
from steady_ppl.method import Method, close, compiled, distrust
from steady_ppl.model.program import Program

ROWS_WORTH_COMPILING = 1000  # of all trajectories together
Function = Callable[..., Tensor]


def on_all_rows(
    program: Program,
    name: str,
    function: Function,
    arguments: dict[str, Tensor],
    along: Sequence[str] = (),
    kernels: bool | None = None,
) -> tuple[Tensor, list[Tensor]] | str | None:
    """A function's value and its Jacobians.

    Args:
        program: what the function belongs to.
        name: of the function, by which its kernel is kept.
        function: of one row of one trajectory or of many; it returns `(..., V)`.
        arguments: its arguments in order, each `(rows, B)` or `(rows, B, ·)`.
        along: those in which to differentiate, the first ones.
        kernels: whether a kernel is worth compiling; None: if there are `ROWS_WORTH_COMPILING`.

    Returns:
        The value `(rows, B, V)` and the Jacobians `(rows, B, V, ·)`; why there is no kernel; None where it is not
        worth one.
    """
    first = next(iter(arguments.values()))
    rows, trajectories = first.shape[:2]
    if kernels is None:
        kernels = rows * trajectories >= ROWS_WORTH_COMPILING
    if not kernels:
        return None
    if first.device.type != "cpu" or first.dtype != torch.float32:
        return f"{str(first.dtype).removeprefix('torch.')} on {first.device.type}"
    name = f"{name} on all rows"
    examples = {at: value[:1, :1].unsqueeze(0).clone() for at, value in arguments.items()}
    method = compiled(program, name, lambda: Method(lambda *values: (function(*values),), examples, {}, along=along))
    if isinstance(method, str):
        return method
    found = _run(method, arguments, rows, trajectories)
    values, rest = found[..., : method.values], found[..., method.values :]
    plain = function(*(_a_few(value) for value in arguments.values()))
    if not close(_a_few(values), plain):
        return distrust(program, name)
    widths = [arguments[at].shape[-1] for at in along]
    return values, list(rest.unflatten(-1, (method.values, sum(widths))).split(widths, -1)) if along else []


def _a_few(values: Tensor) -> Tensor:
    """Some sixteen of all rows, `(1, ·, ·)`."""
    return values.flatten(0, 1)[None, :: max(1, values.shape[0] * values.shape[1] // LANES)]


def _run(method: Method, arguments: dict[str, Tensor], rows: int, trajectories: int) -> Tensor:
    """Everything that the kernel computes, `(rows, B, ·)`."""
    cells = rows * trajectories
    inputs = [value.float().reshape(cells, 1, -1).permute(2, 1, 0).contiguous().numpy() for value in arguments.values()]
    out = torch.empty(len(method.graph.outputs), 1, cells)
    method.kernel(method.parameters(), np.zeros((1, 0), np.float32), inputs, None, out.numpy())
    return out.squeeze(1).t().reshape(rows, trajectories, -1)
