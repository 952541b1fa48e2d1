"""A function of a program, traced by torch for one particle and compiled."""

from __future__ import annotations

import itertools
from collections import ChainMap
from collections.abc import Callable, Sequence
from functools import lru_cache
from operator import attrgetter
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor, fx, nn
from torch.utils._python_dispatch import TorchDispatchMode

from steady_ppl.kernel_writer import source
from steady_ppl.kernels import Kernel
from steady_ppl.model.program import Program
from steady_ppl.scalar_graph import PARTICLE, TRAJECTORY, NotCompilable, ScalarGraph
from steady_ppl.tangents import jacobian
from steady_ppl.translation import Translation, evaluate
from steady_ppl.utils.text import one_line

TRACES = 8  # of one method of one program; each takes some tenths of a second
RESTLESS = "its settings or tensors change from run to run"
DIFFERENT = "its kernel and its own lines come to different numbers"
Compiled = TypeVar("Compiled")
_COMPILED: WeakKeyDictionary[Program, dict[Any, Any]] = WeakKeyDictionary()


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


def compiled(program: Program, name: str, build: Callable[[], Compiled]) -> Compiled | str:
    """What was compiled of a program under a name, as its settings are now, built once; or why there is none."""
    known = _COMPILED.setdefault(program, {})
    key = (name, signature(program))
    if key not in known and sum(at == name for at, _ in known) >= TRACES:
        return RESTLESS
    if key not in known:
        with torch.random.fork_rng(devices=[]):
            try:
                known[key] = build()
            except NotCompilable as reason:
                known[key] = str(reason)
    return known[key]


def distrust(program: Program, name: str) -> str:
    """Give up what was compiled under a name."""
    _COMPILED[program][name, signature(program)] = DIFFERENT
    return DIFFERENT


def signature(program: Program) -> tuple[Any, ...]:
    """What a trace takes as given: which tensors a program has, and its settings."""
    tensors = (*program.named_parameters(), *program.named_buffers())
    settings = [
        (at, name, id(value) if isinstance(value, Tensor) else repr(value))
        for at, module in program.named_modules()
        for name, value in _settings(module).items()
        if isinstance(value, bool | int | float | str | tuple | list | Tensor)
    ]
    return tuple((name, id(tensor)) for name, tensor in tensors), tuple(settings)


def _settings(module: nn.Module) -> dict[str, Any]:
    """A module's attributes: its own, its class's and its bases'."""
    own = itertools.takewhile(lambda base: base is not nn.Module, type(module).__mro__)
    return dict(ChainMap(vars(module), *(dict(vars(base)) for base in own if not base.__module__.startswith("torch."))))


def close(mine: Tensor, theirs: Tensor) -> bool:
    """Equal but for rounding, in each component's own scale, and for the few that stand at a jump."""
    if mine.shape != theirs.shape or mine.dtype != theirs.dtype:
        return False
    scale = torch.where(torch.isfinite(theirs), theirs, 0.0).abs().flatten(0, -2).amax(0)
    same = ((mine - theirs).abs() <= 1e-4 * (theirs.abs() + scale) + 1e-7) | (mine == theirs)
    return float((same | (mine.isnan() & theirs.isnan())).float().mean()) > 0.98
