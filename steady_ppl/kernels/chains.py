"""A function as steps one after the other, each by a kernel: what is too long to be compiled whole.

Each step moves the first argument on. All are given the second one, which is held, and their own further arguments.
Derivatives follow by the chain rule, in a compiled loop in double precision.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor, nn

from steady_ppl.kernels.jit import Method, Number, compiled, discard

Array = np.ndarray[Any, Any]
BLOCK = 64  # rows that are differentiated at a time


class Step(NamedTuple):
    """One step of a chain."""

    name: str  # steps of one name are the same function
    function: Callable[..., Tensor]  # of the moved, the held and the given arguments; returns where it leads
    given: Mapping[str, Tensor]  # its further arguments, (rows, B) or (rows, B, ·)


class Chain(NamedTuple):
    """Steps and the arguments that are moved and held, by name, each `(rows, B, ·)`."""

    steps: Sequence[Step]
    moved: tuple[str, Tensor]
    held: tuple[str, Tensor]


class Chained(NamedTuple):
    """What a chain comes to, components first."""

    values: Tensor  # where it ends, (D, cells)
    slopes: Tensor  # in the moved and the held, (D, D + C, cells), or in learnable numbers, (D, Q, cells)


def run_chain(
    program: nn.Module, name: str, chain: Chain, *, differentiate: bool = False, numbers: Sequence[Number] | None = None
) -> Chained | str:
    """Run a chain by kernels, or say why there is none; it is differentiated in its start and what is held, or in a
    program's learnable numbers."""
    (_, moved), (_, held) = chain.moved, chain.held
    derivatives: dict[str, Any] = {}
    if differentiate:
        derivatives = {"along": (chain.moved[0], chain.held[0])}
    elif numbers is not None:
        derivatives = {"along": (chain.moved[0],), "by_parameters": True}
    methods: dict[str, Method] = {}
    for step in chain.steps:
        if step.name not in methods:
            given = {chain.moved[0]: moved, chain.held[0]: held, **step.given}
            examples = {at: value[:1, :1].unsqueeze(0).clone() for at, value in given.items()}
            build = partial(Method, program, _alone(step.function), examples, {}, **derivatives)
            method = compiled(program, chained_as(name, step), build)
            if isinstance(method, str):
                return method
            methods[step.name] = method
    size, width, cells = moved.shape[-1], held.shape[-1], moved[..., 0].numel()
    start, constant = _columns(moved), _columns(held)
    slopes = np.zeros((size, len(numbers or ()), cells))
    if differentiate:
        slopes = np.zeros((size, size + width, cells))
        slopes[range(size), range(size)] = 1.0
    rules = {}
    if derivatives:
        rules = {at: _Rule.of(method, program, size, width, numbers) for at, method in methods.items()}
    columns: dict[int, Array] = {}
    for step in chain.steps:
        for value in step.given.values():
            if id(value) not in columns:
                columns[id(value)] = _columns(value)
        method = methods[step.name]
        out = np.empty((len(method.graph.outputs), 1, cells), np.float32)
        inputs = [start, constant, *(columns[id(value)] for value in step.given.values())]
        method.kernel(method.parameters(program), np.zeros((1, 0), np.float32), inputs, None, out)
        if derivatives:
            follow(slopes, out[:, 0], *rules[step.name])
        start = np.ascontiguousarray(out[:size])
    return Chained(torch.from_numpy(start[:, 0]), torch.from_numpy(slopes))


def chained_as(name: str, step: Step) -> str:
    """The name under which a step's kernel is kept."""
    return f"{name}, {step.name}"


def discard_chain(program: nn.Module, name: str, chain: Chain) -> str:
    """Give up the kernels of a chain, see `discard`."""
    return [discard(program, chained_as(name, step)) for step in chain.steps][-1]


def _alone(function: Callable[..., Tensor]) -> Callable[..., tuple[Tensor]]:
    return lambda *given: (function(*given),)


def _columns(values: Tensor) -> Array:
    """Arguments `(rows, B)` or `(rows, B, ·)` as a kernel takes them, `(·, 1, cells)`."""
    cells = values.shape[0] * values.shape[1]
    return values.detach().float().reshape(cells, 1, -1).permute(2, 1, 0).contiguous().numpy()


class _Rule(NamedTuple):
    """Where a step's derivatives lie in what its kernel returns."""

    by_moved: Array  # (D, D), −1 where one is zero
    component: Array  # of each derivative in what else is asked for, (N,)
    at: Array  # (N,)
    weight: Array  # what these add to each column of the slopes, (N, W)

    @classmethod
    def of(cls, method: Method, program: nn.Module, size: int, width: int, numbers: Sequence[Number] | None) -> "_Rule":
        graph, first = method.graph, method.values
        zero = graph.constant(0.0)
        across = size + width if numbers is None else size  # in the arguments that it is differentiated in
        places = first + across * np.arange(size)[:, None] + np.arange(across)
        places = np.where(np.array(graph.outputs)[places] == zero, -1, places)
        if numbers is None:
            component, column = np.nonzero(places[:, size:] >= 0)
            weight = np.zeros((len(component), size + width))
            weight[range(len(component)), size + column] = 1.0
            return cls(places[:, :size], component, places[component, size + column], weight)
        slopes = [(k, value, parameter) for k, (value, parameter) in enumerate(method.slopes) if value < size]
        order, component, parameter = np.array(slopes, np.int64).reshape(-1, 3).T
        at = len(graph.outputs) - len(method.slopes) + order
        weight = method.by_number(program, numbers).numpy()[parameter]
        return cls(places, np.ascontiguousarray(component), at, np.ascontiguousarray(weight))


@njit(cache=True, error_model="numpy")
def follow(slopes: Array, out: Array, by_moved: Array, component: Array, at: Array, weight: Array) -> None:
    """The chain rule: slopes `(D, W, cells)` behind a step, in place, from those before it and the step's own."""
    size, width, cells = slopes.shape
    room = np.empty((size, width, BLOCK))
    for first in range(0, cells, BLOCK):
        few = min(BLOCK, cells - first)
        room[:] = 0.0
        for i in range(size):
            for k in range(size):
                place = by_moved[i, k]
                if place >= 0:
                    for j in range(width):
                        for n in range(few):
                            room[i, j, n] += out[place, first + n] * slopes[k, j, first + n]
        for m in range(len(at)):
            for j in range(width):
                share = weight[m, j]
                if share != 0.0:
                    for n in range(few):
                        room[component[m], j, n] += share * out[at[m], first + n]
        for i in range(size):
            for j in range(width):
                for n in range(few):
                    slopes[i, j, first + n] = room[i, j, n]
