"""A function of a program, traced by torch for one particle and compiled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from operator import attrgetter
from typing import Any

import numpy as np
import torch
from torch import Tensor, fx
from torch.utils._python_dispatch import TorchDispatchMode

from steady_ppl.kernel_writer import source
from steady_ppl.kernels import Kernel
from steady_ppl.program import Program, one_line
from steady_ppl.scalar_graph import PARTICLE, TRAJECTORY, NotCompilable, ScalarGraph
from steady_ppl.tangents import jacobian
from steady_ppl.translation import Translation, evaluate

TRACES = 8  # of one method of one program; each takes some tenths of a second
RESTLESS = "its settings or tensors change from run to run"


class _ReadsNumbers(TorchDispatchMode):
    """Refuses to trace what a number read from a tensor decides: it would be the same for ever."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.ops.aten._local_scalar_dense.default:
            raise NotCompilable("it reads a number out of a tensor (float(), .item(), if)")
        return func(*args, **(kwargs or {}))


class Method:
    """A function of a program as a kernel.

    Args:
        function: of one particle of one trajectory, `(1, 1, 1, ·)`; returns tensors.
        particle: examples of the arguments that differ between particles, the first ones.
        trajectory: examples of those that differ between trajectories only.
        along: the arguments in which to differentiate; the Jacobian's rows follow the values.

    Attributes:
        values: how many numbers the function returns.

    Raises:
        NotCompilable: it cannot be traced, or what it does has no kernel.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        particle: dict[str, Tensor],
        trajectory: dict[str, Tensor],
        *,
        along: Sequence[str] = (),
    ) -> None:
        try:
            with torch.no_grad():
                self._compile(function, particle, trajectory, along)
        except NotCompilable:
            raise
        except Exception as error:  # whatever torch, the translation or the compiler makes of an unforeseen program
            raise NotCompilable(f"it cannot be compiled: {one_line(error)}") from error

    def _compile(
        self,
        function: Callable[..., Any],
        particle: dict[str, Tensor],
        trajectory: dict[str, Tensor],
        along: Sequence[str],
    ) -> None:
        from torch.fx.experimental.proxy_tensor import make_fx  # takes a second to import

        with _ReadsNumbers():
            self.traced = make_fx(torch.func.functionalize(function))(*particle.values(), *trajectory.values())
        levels = dict.fromkeys(particle, PARTICLE) | dict.fromkeys(trajectory, TRAJECTORY)
        translation = Translation(self.traced, levels)
        self.graph: ScalarGraph = translation.run()
        self.values = len(self.graph.outputs)
        if along:
            inputs = [self.graph.scalar("input", name, k) for name in along for k in range(particle[name].numel())]
            self.graph.outputs += jacobian(self.graph, self.graph.outputs, inputs)
        self.by_parameters = [node for node in self.traced.graph.nodes if node in translation.known]
        columns, at = {}, 0
        for name, example in trajectory.items():
            columns[name], at = at, at + example.numel()
        self.kernel = _kernel(self.graph, tuple(particle), columns)

    def parameters(self) -> np.ndarray:
        """What the kernel takes of the parameters, as they are now."""
        known: dict[fx.Node, Any] = {}
        with torch.no_grad():
            for node in self.by_parameters:
                known[node] = (
                    attrgetter(str(node.target))(self.traced) if node.op == "get_attr" else evaluate(node, known)
                )
            parts = [known[node].detach().to(torch.float32).flatten() for node in self.graph.parameters]
            return torch.cat([*parts, torch.zeros(1)]).numpy()


@lru_cache(maxsize=64)
def _compiled(text: str, inputs: int, outputs: int) -> Kernel:
    return Kernel(text, inputs, outputs)


def _kernel(graph: ScalarGraph, inputs: Sequence[str], columns: dict[str, int]) -> Kernel:
    """The kernel of a graph; programs that differ in their parameters only share one."""
    return _compiled(source(graph, inputs, columns), len(inputs), len(graph.outputs))


def signature(program: Program) -> tuple[Any, ...]:
    """What a trace takes as given: which tensors a program has, and its settings."""
    tensors = (*program.named_parameters(), *program.named_buffers())
    settings = [
        (at, name, id(value) if isinstance(value, Tensor) else repr(value))
        for at, module in program.named_modules()
        for name, value in (vars(type(module)) | vars(module)).items()
        if isinstance(value, bool | int | float | str | tuple | list | Tensor)
    ]
    return tuple((name, id(tensor)) for name, tensor in tensors), tuple(settings)


def close(mine: Tensor, theirs: Tensor) -> bool:
    """Equal but for rounding, and for the few that stand at a jump."""
    if mine.shape != theirs.shape or mine.dtype != theirs.dtype:
        return False
    same = torch.isclose(mine, theirs, rtol=1e-4, atol=1e-4, equal_nan=True)
    return float(same.float().mean()) > 0.98
