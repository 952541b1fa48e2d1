"""Trace a function of a program, compile it, keep it, and check it against torch."""

from __future__ import annotations

import ctypes
import itertools
from collections import ChainMap
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
from llvmlite import binding
from torch import Tensor, fx, nn
from torch.utils._python_dispatch import TorchDispatchMode

from steady_ppl.kernels.codegen import LANES, NAME, source
from steady_ppl.kernels.graph import PARTICLE, TRAJECTORY, NotCompilable, ScalarGraph, jacobian
from steady_ppl.kernels.lowering import Translation, evaluate
from steady_ppl.utils.text import one_line

TRACES = 8  # of one method of one program; each takes some tenths of a second
ROWS_WORTH_COMPILING = 1000  # of all trajectories together
KEEPS_CHANGING = "its settings or tensors change from run to run"
DIFFERENT = "its kernel and its own lines come to different numbers"
Compiled = TypeVar("Compiled")
Array = np.ndarray
Examples = dict[str, Tensor]  # of the arguments of a function
_COMPILED: WeakKeyDictionary[nn.Module, dict[Any, Any]] = WeakKeyDictionary()


class Kernel:
    """A compiled function.

    Args:
        text: its `source`.
        inputs, outputs: how many arrays it takes, and how many numbers a particle it gives.
    """

    def __init__(self, text: str, inputs: int, outputs: int) -> None:
        self.outputs = outputs
        self._engine = _machine_code(text)
        arguments = [ctypes.c_void_p] * (inputs + 4) + [ctypes.c_int64] * 3
        self._call = ctypes.CFUNCTYPE(None, *arguments)(self._engine.get_function_address(NAME))

    def __call__(
        self, parameters: Array, uniform: Array, inputs: Sequence[Array], ancestors: Array | None, out: Array
    ) -> None:
        """Compute `out`.

        Args:
            parameters: `(P,)` what the graph takes of them.
            uniform: `(B, columns)`.
            inputs: each `(elements, B, N)`, N at least `LANES`.
            ancestors: `(B, N)` int64, where the first input is looked up; None: at each particle itself.
            out: `(outputs, B, N)`, overwritten; shares no memory with the inputs.
        """
        _, trajectories, particles = out.shape
        for array in (parameters, uniform, *inputs, out):
            assert array.dtype == np.float32 and array.flags.c_contiguous
        assert len(out) == self.outputs and len(uniform) == trajectories
        assert particles >= LANES and all(array.shape[1:] == out.shape[1:] for array in inputs)
        assert ancestors is None or (ancestors.dtype == np.int64 and ancestors.flags.c_contiguous)
        pointers = [parameters.ctypes.data, uniform.ctypes.data, *(array.ctypes.data for array in inputs)]
        which = None if ancestors is None else ancestors.ctypes.data
        self._call(*pointers, which, out.ctypes.data, trajectories, particles, uniform.shape[1])


def _machine_code(text: str) -> Any:
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    module = binding.parse_assembly(text)
    target = binding.Target.from_default_triple()
    machine = target.create_target_machine(
        cpu=binding.get_host_cpu_name(), features=binding.get_host_cpu_features().flatten(), opt=3
    )
    options = binding.create_pipeline_tuning_options(speed_level=2)
    builder = binding.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    engine = binding.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    return engine


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
        self, function: Callable[..., Any], particle: Examples, trajectory: Examples, *, along: Sequence[str] = ()
    ) -> None:
        try:
            with torch.no_grad():
                self._compile(function, particle, trajectory, along)
        except NotCompilable:
            raise
        except Exception as error:  # whatever torch, the translation or the compiler makes of an unforeseen program
            raise NotCompilable(f"it cannot be compiled: {one_line(error)}") from error

    def _compile(
        self, function: Callable[..., Any], particle: Examples, trajectory: Examples, along: Sequence[str]
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
        text = source(self.graph, tuple(particle), columns)
        self.kernel = _compiled(text, len(particle), len(self.graph.outputs))

    def parameters(self) -> Array:
        """What the kernel takes of the parameters, as they are now."""
        known: dict[fx.Node, Any] = {}
        with torch.no_grad():
            for node in self.by_parameters:
                known[node] = evaluate(node, known)
            parts = [known[node].detach().to(torch.float32).flatten() for node in self.graph.parameters]
            return torch.cat([*parts, torch.zeros(1)]).numpy()


@lru_cache(maxsize=64)
def _compiled(text: str, inputs: int, outputs: int) -> Kernel:
    """The kernel of a source, which programs share that differ in their parameters only."""
    return Kernel(text, inputs, outputs)


def compiled(program: nn.Module, name: str, build: Callable[[], Compiled]) -> Compiled | str:
    """What was compiled of a program under a name, as its settings are now, built once; or why there is none."""
    known = _COMPILED.setdefault(program, {})
    key = (name, signature(program))
    if key not in known and sum(at == name for at, _ in known) >= TRACES:
        return KEEPS_CHANGING
    if key not in known:
        with torch.random.fork_rng(devices=[]):
            try:
                known[key] = build()
            except NotCompilable as reason:
                known[key] = str(reason)
    return known[key]


def discard(program: nn.Module, name: str) -> str:
    """Give up what was compiled under a name."""
    _COMPILED[program][name, signature(program)] = DIFFERENT
    return DIFFERENT


def signature(program: nn.Module) -> tuple[Any, ...]:
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


def on_all_rows(
    program: nn.Module,
    name: str,
    function: Callable[..., Tensor],
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
        return discard(program, name)
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
