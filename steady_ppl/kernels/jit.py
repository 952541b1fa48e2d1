"""Trace a function of a program, compile it, keep it, and check it against torch."""

import ctypes
import hashlib
import itertools
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor, nn

from steady_ppl.kernels.codegen import KERNEL_NAME, SIMD_LANES, source
from steady_ppl.kernels.graph import PARTICLE, TRAJECTORY, NotCompilable, ScalarGraph, derivatives
from steady_ppl.kernels.lowering import Translation, first_names, where
from steady_ppl.kernels.store import machine_code
from steady_ppl.utils.text import one_line

TRACES = 32  # of one method of programs of one class; each takes some hundredths of a second
KERNELS = 256  # that are kept in memory
MAX_NUMBERS_READ = 1000  # numbers of a tensor that are looked at one by one
KEEPS_CHANGING = "its settings or tensors change from run to run"
RESULTS_DIFFER = "its kernel and its own lines come to different numbers"
SETTING_KINDS = (bool, int, float, str, tuple, list, dict, np.ndarray, Tensor)
TORCH_ATTRIBUTES = vars(nn.Module()).keys() - {"training"}  # where torch keeps parameters, buffers and hooks
Value = TypeVar("Value")
Array = np.ndarray
Examples = dict[str, Tensor]  # of the arguments of a function
_COMPILED: WeakKeyDictionary[type[nn.Module], dict[Any, Any]] = WeakKeyDictionary()
_NAMES: WeakKeyDictionary[type[nn.Module], list[tuple[int, list[str]]]] = WeakKeyDictionary()
_DISCARDED: WeakKeyDictionary[nn.Module, set[Hashable]] = WeakKeyDictionary()  # names of what a program gave up
_READ: WeakKeyDictionary[nn.Module, dict[Any, Any]] = WeakKeyDictionary()  # of programs that are `unchanged` for now


class Kernel:
    """A compiled function of so many `inputs`, arrays, that gives so many `outputs` a particle.

    `text` writes its `source`; `key` is a digest of what that is made of.
    """

    def __init__(self, key: str, text: Callable[[], str], inputs: int, outputs: int) -> None:
        self.outputs = outputs
        self._engine = machine_code(key, text)
        arguments = [ctypes.c_void_p] * (inputs + 4) + [ctypes.c_int64] * 3
        self.address = self._engine.get_function_address(KERNEL_NAME)
        self._call = ctypes.CFUNCTYPE(None, *arguments)(self.address)

    def __call__(
        self, parameters: Array, uniform: Array, inputs: Sequence[Array], ancestors: Array | None, out: Array
    ) -> None:
        """Compute `out`.

        Args:
            parameters: `(P,)` what the graph takes of them.
            uniform: `(B, columns)`.
            inputs: each `(elements, B, N)`, N at least `SIMD_LANES`.
            ancestors: `(B, N)` int64, where the first input is looked up; None: at each particle itself.
            out: `(outputs, B, N)`, overwritten; shares no memory with the inputs.
        """
        _, trajectories, particles = out.shape
        for array in (parameters, uniform, *inputs, out):
            assert array.dtype == np.float32 and array.flags.c_contiguous
        assert len(out) == self.outputs and len(uniform) == trajectories
        assert particles >= SIMD_LANES and all(array.shape[1:] == out.shape[1:] for array in inputs)
        assert ancestors is None or (ancestors.dtype == np.int64 and ancestors.flags.c_contiguous)
        pointers = [parameters.ctypes.data, uniform.ctypes.data, *(array.ctypes.data for array in inputs)]
        which = None if ancestors is None else ancestors.ctypes.data
        self._call(*pointers, which, out.ctypes.data, trajectories, particles, uniform.shape[1])


@contextmanager
def _compiling() -> Iterator[None]:
    """Say of whatever torch, the translation or the compiler makes of an unforeseen program that it has no kernel."""
    try:
        with torch.no_grad():
            yield
    except NotCompilable:
        raise
    except Exception as error:
        raise NotCompilable(f"it cannot be compiled: {one_line(error)}") from error


@dataclass(frozen=True, eq=False)
class Number:
    """One learnable number."""

    parameter: Tensor
    index: int  # in its flat form
    step: float  # by which finite differences move it


class Method:
    """A function of a program as a kernel, for all programs that are alike, see `signature`.

    Args:
        program: what the function belongs to.
        function: of one particle of one trajectory, `(1, 1, 1, ·)`; returns tensors.
        particle: examples of the arguments that differ between particles, the first ones.
        trajectory: examples of those that differ between trajectories only.
        along: the arguments in which to differentiate; the Jacobian's rows follow the values.
        outputs: of how many of the first values there are such rows; None: of all.
        by_parameters: differentiate in the parameters that the kernel takes; these derivatives come last.

    Raises:
        NotCompilable: it cannot be traced, or what it does has no kernel.
    """

    @_compiling()
    def __init__(
        self,
        program: nn.Module,
        function: Callable[..., Any],
        particle: Examples,
        trajectory: Examples,
        *,
        along: Sequence[str] = (),
        outputs: int | None = None,
        by_parameters: bool = False,
    ) -> None:
        levels = dict.fromkeys(particle, PARTICLE) | dict.fromkeys(trajectory, TRAJECTORY)
        translation = Translation(particle | trajectory, levels, _tensors(program))
        with translation:
            made = torch.func.functionalize(function)(*particle.values(), *trajectory.values())
        translation.end(made)
        self.tape, self.graph = translation.tape, translation.graph
        values = list(self.graph.outputs)
        self.values = len(values)  # how many numbers the function returns
        self.slopes: list[tuple[int, int]] = []  # value and parameter of each derivative that `by_parameters` adds
        if along:
            inputs = [self.graph.scalar("input", name, k) for name in along for k in range(particle[name].numel())]
            zero, rows = self.graph.constant(0.0), derivatives(self.graph, values[:outputs], inputs)
            self.graph.outputs += [zero if derivative is None else derivative for row in rows for derivative in row]
        if by_parameters:
            self._add_slopes(values)
        columns, at = {}, 0
        for name, example in trajectory.items():
            columns[name], at = at, at + example.numel()
        self.kernel = _kernel(self.graph, tuple(particle), columns)

    def _add_slopes(self, values: Sequence[int]) -> None:
        if self.graph.vectors:
            raise NotCompilable("no derivatives in the weights of a network")
        count = sum(operation == "parameter" for operation, _ in self.graph.scalars)
        parameters = [self.graph.scalar("parameter", k) for k in range(count)]
        for value, row in enumerate(derivatives(self.graph, values, parameters)):
            for parameter, derivative in enumerate(row):
                if derivative is not None:
                    self.graph.outputs.append(derivative)
                    self.slopes.append((value, parameter))

    @torch.no_grad()
    def parameters(self, program: nn.Module) -> Array:
        """What the kernel takes of a program's parameters, as they are now."""
        return _read(program, self, lambda: self._taken(self.tape.run(_tensors(program))).numpy())

    def _taken(self, values: Sequence[Tensor]) -> Tensor:
        parts = [values[place].detach().to(torch.float32).flatten() for place in self.graph.parameters]
        return torch.cat([*parts, torch.zeros(1)])

    @torch.no_grad()
    def by_number(self, program: nn.Module, numbers: Sequence[Number]) -> Tensor:
        """What the kernel's parameters change by with each of a program's learnable numbers, `(Q, P)`."""
        tensors = _tensors(program)
        names = first_names(tensors)
        values = self.tape.run(tensors)
        columns, here = [], self._taken(values)
        for number in numbers:
            name = names[where(number.parameter)]
            if not self.tape.takes(name):
                columns.append(torch.zeros_like(here, dtype=torch.float64))
                continue
            moved = []
            for by in (number.step, -number.step):
                other = number.parameter.detach().clone()
                other.view(-1)[number.index] += by
                moved.append(self._taken(self.tape.run_again(values, name, other)))
            columns.append((moved[0] - moved[1]).double() / (2 * number.step))
        return torch.stack(columns, -1)


_KERNELS: OrderedDict[str, Kernel] = OrderedDict()


def _kernel(graph: ScalarGraph, inputs: tuple[str, ...], columns: dict[str, int]) -> Kernel:
    """The kernel of a graph, which programs share that differ in their parameters only."""
    told = repr((graph.scalars, graph.levels, graph.vectors, graph.outputs, inputs, columns))
    key = hashlib.sha256(told.encode()).hexdigest()
    if key not in _KERNELS:
        _KERNELS[key] = Kernel(key, lambda: source(graph, inputs, columns), len(inputs), len(graph.outputs))
        if len(_KERNELS) > KERNELS:
            _KERNELS.popitem(last=False)
    _KERNELS.move_to_end(key)
    return _KERNELS[key]


def compiled(program: nn.Module, name: Hashable, build: Callable[[], Value]) -> Value | str:
    """What was compiled under a name for programs like this one, built once; or why there is none."""
    if name in _DISCARDED.get(program, ()):
        return RESULTS_DIFFER
    known = _COMPILED.setdefault(type(program), {})
    key = (name, signature(program))
    if key in known:
        return known[key]
    if sum(at == name for at, _ in known) >= TRACES:
        return KEEPS_CHANGING
    with torch.random.fork_rng(devices=[]):
        try:
            known[key] = build()
        except NotCompilable as reason:
            known[key] = str(reason)
    return known[key]


def discard(program: nn.Module, name: Hashable) -> str:
    """Give up what was compiled under a name, for this very program: a copy of it in another process knows nothing of
    this, nor does this one of what that gives up."""
    _DISCARDED.setdefault(program, set()).add(name)
    return RESULTS_DIFFER


def _tensors(program: nn.Module) -> dict[str, Tensor]:
    """A program's parameters and buffers, and the tensors among its settings."""
    found = dict(itertools.chain(program.named_parameters(), program.named_buffers()))
    for at, module in program.named_modules():
        for name, value in _settings(module):
            held = value.values() if isinstance(value, dict) else value if isinstance(value, tuple | list) else [value]
            for index, part in enumerate(held):
                if isinstance(part, Tensor):
                    found[f"{at}.{name}[{index}] among the settings"] = part
    return found


@contextmanager
def unchanged(program: nn.Module) -> Iterator[None]:
    """What kernels take of a program is read once: nothing of it changes meanwhile."""
    outer = program in _READ
    _READ.setdefault(program, {})
    try:
        yield
    finally:
        if not outer:
            del _READ[program]


def _read(program: nn.Module, what: Any, read: Callable[[], Value]) -> Value:
    known = _READ.get(program)
    if known is None:
        return read()
    if what not in known:
        known[what] = read()
    return known[what]


def signature(program: nn.Module) -> tuple[Any, ...]:
    """What a trace takes as given: the shapes of a program's tensors, which of them are one, and its settings."""
    return _read(program, signature, lambda: _signature(program))


def _signature(program: nn.Module) -> tuple[Any, ...]:
    settings = [
        (at, name, _content(value))
        for at, module in program.named_modules()
        for name, value in _settings(module)
        if isinstance(value, SETTING_KINDS)
    ]
    tensors = _tensors(program)
    names = first_names(tensors)
    shapes = [(name, names.get(where(one)), one.shape, one.dtype) for name, one in tensors.items()]
    whole = [(name, _content(one)) for name, one in program.named_buffers() if not one.dtype.is_floating_point]
    return tuple(shapes), tuple(whole), tuple(settings)


def _content(value: Any) -> Any:
    """What a setting tells; of a tensor the numbers, or their digest if there are many."""
    if isinstance(value, dict):
        return tuple((repr(name), _content(part)) for name, part in value.items() if isinstance(part, SETTING_KINDS))
    if isinstance(value, tuple | list):
        return type(value).__name__, *map(_content, value)
    if isinstance(value, np.ndarray):
        return str(value.dtype), value.shape, value.tobytes()
    if not isinstance(value, Tensor):
        return repr(value)
    if value.numel() <= MAX_NUMBERS_READ:
        return tuple(value.shape), *value.flatten().tolist()
    return tuple(value.shape), str(value.dtype), hashlib.sha256(value.detach().numpy(force=True).tobytes()).digest()


def _settings(module: nn.Module) -> Iterator[tuple[str, Any]]:
    """A module's attributes: its own, its class's and its bases'."""
    own = vars(module)
    yield from ((name, value) for name, value in own.items() if name not in TORCH_ATTRIBUTES)
    kind = type(module)
    if kind not in _NAMES:
        _NAMES[kind] = _names_of(kind)
    for at, names in _NAMES[kind]:
        given = vars(kind.__mro__[at])
        yield from ((name, given[name]) for name in names if name not in own and name in given)


def _names_of(kind: type[nn.Module]) -> list[tuple[int, list[str]]]:
    """The settings among the attributes of a class, each in the first of its bases that has it, by their order: a base
    itself would keep the class, which is the first of them, for ever."""
    found, known = [], set[str]()
    for at, base in enumerate(itertools.takewhile(lambda base: base is not nn.Module, kind.__mro__)):
        names = [name for name in vars(base) if name not in known and not name.startswith("__")]
        known.update(names)
        if not base.__module__.startswith("torch."):
            found.append((at, [name for name in names if not callable(vars(base)[name])]))
    return found


def diverged(mine: Tensor, theirs: Tensor) -> Tensor:
    """Rows, `(..., 1)` bool, that tell nothing of a kernel: some component overflows both ways, and may do so otherwise
    in another order of operations."""
    large = torch.finfo(theirs.dtype).max ** 0.5
    both = ~(mine.abs() <= large) & ~(theirs.abs() <= large)  # also no number
    return (both & ~(mine.isnan() & theirs.isnan())).any(-1, keepdim=True)


def close(mine: Tensor, theirs: Tensor) -> bool:
    """Equal but for rounding, in each component's own scale, and for the few that stand at a jump; rows that have
    `diverged` are not compared. Both are `(..., components)`."""
    if mine.shape != theirs.shape or mine.dtype != theirs.dtype:
        return False
    tells = ~diverged(mine, theirs).squeeze(-1)
    mine, theirs = mine[tells], theirs[tells]
    if not mine.numel():
        return True
    finite = torch.isfinite(theirs)
    scale = torch.where(finite, theirs, 0.0).abs().amax(0)
    same = finite & ((mine - theirs).abs() <= 1e-4 * (theirs.abs() + scale) + 1e-7)
    return float((same | (mine.isnan() & theirs.isnan())).float().mean()) > 0.98
