"""From what torch does in a method to scalars: tensors of values become tensors of scalars' numbers. What it computes
of a program's tensors alone is noted on a tape, to be computed again when they have changed."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partialmethod
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload
from torch.utils._python_dispatch import TorchDispatchMode

from steady_ppl.kernels.graph import NotCompilable, ScalarGraph

aten: Any = torch.ops.aten


def _packets(*names: str) -> dict[Any, str]:
    return {getattr(aten, name): name for name in names}


# what only moves elements works on the scalars' numbers as it does on their values
MOVING = {
    packet: getattr(torch, "reshape" if name in ("view", "_unsafe_view") else name, packet)
    for packet, name in _packets(
        *("view", "_unsafe_view", "reshape", "permute", "transpose", "t", "movedim", "select", "slice", "unsqueeze"),
        *("squeeze", "expand", "unbind", "split", "split_with_sizes", "stack", "cat", "alias", "detach", "clone"),
        *("lift_fresh_copy", "lift_fresh", "flip", "repeat", "diagonal", "contiguous", "select_scatter"),
        "slice_scatter",
    ).items()
}
ELEMENTWISE = _packets(
    *("neg", "abs", "sin", "cos", "tan", "exp", "log", "log1p", "expm1", "sqrt", "rsqrt", "reciprocal", "relu"),
    *("sigmoid", "tanh", "silu", "atan", "asin", "acos", "round", "floor", "ceil", "sign", "square"),
    *("mul", "atan2", "maximum", "minimum", "remainder", "hypot", "gt", "ge", "lt", "le", "eq", "ne"),
    *("logical_not", "logical_and", "logical_or", "where"),
) | {
    aten.__and__: "logical_and",
    aten.bitwise_and: "logical_and",
    aten.__or__: "logical_or",
    aten.bitwise_or: "logical_or",
    aten.bitwise_not: "logical_not",
}
FILLED = {aten.zeros_like: 0.0, aten.new_zeros: 0.0, aten.zeros: 0.0, aten.ones_like: 1.0, aten.new_ones: 1.0}


@dataclass(frozen=True)
class _Place:
    """Where a value is on the tape."""

    number: int


@dataclass(frozen=True)
class _Step:
    """An operation on values at places; what it makes lies at others."""

    operation: OpOverload
    arguments: Sequence[Any]
    keywords: dict[str, Any]
    needs: frozenset[int]
    makes: range

    def run(self, values: list[Tensor]) -> None:
        arguments = [_filled(argument, values) for argument in self.arguments]
        made = self.operation(*arguments, **{name: _filled(value, values) for name, value in self.keywords.items()})
        values[self.makes.start : self.makes.stop] = made if isinstance(made, list | tuple) else [made]


def _filled(argument: Any, values: Sequence[Tensor]) -> Any:
    """An argument with values where it has places."""
    if isinstance(argument, _Place):
        return values[argument.number]
    return [_filled(part, values) for part in argument] if isinstance(argument, list) else argument


def _leaves(*arguments: Any) -> Iterator[Any]:
    """What arguments of an operation hold, or what it made; torch's `tree_leaves` takes ten times as long."""
    for argument in arguments:
        if isinstance(argument, list | tuple):
            yield from _leaves(*argument)
        else:
            yield argument


def _mapped(function: Callable[[Any], Any], argument: Any) -> Any:
    """An argument of an operation with a function of what it holds."""
    if isinstance(argument, list | tuple):
        return [_mapped(function, part) for part in argument]
    return function(argument)


def where(tensor: Tensor) -> tuple[Any, ...]:
    """What tensors have in common that are the same numbers in memory."""
    return tensor.data_ptr(), tensor.shape, tensor.stride(), tensor.dtype


def first_names(tensors: Mapping[str, Tensor]) -> dict[Any, str]:
    """Names of tensors by `where` they are; of several names that are one tensor, the first."""
    names: dict[Any, str] = {}
    for name, tensor in tensors.items():
        if tensor.numel():
            names.setdefault(where(tensor), name)
    return names


class Tape:
    """Values by place: a program's tensors, other tensors, which never change, and what is computed of them.

    It is noted with one program's tensors, by name, and runs for any that has tensors of the same names and shapes.
    """

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        self._names = first_names(tensors)
        self._program: dict[int, str] = {}  # place → name
        self._values: list[Tensor] = []  # a tensor that is kept shares its `id` with no later one
        self._places: dict[int, int] = {}  # id → place
        self._steps: list[_Step] = []
        self._varying: set[int] = set()  # places that depend on the program's tensors; of whole numbers, none changes

    def varies(self, value: Tensor) -> bool:
        """Whether a value changes as the program's parameters do."""
        return self.place(value) in self._varying

    def place(self, value: Tensor) -> int:
        """Where a value is; one that is new there is the program's, or never changes."""
        if id(value) not in self._places:
            name = self._names.get(where(value))
            if name is not None:
                self._program[len(self._values)] = name
                if value.dtype.is_floating_point:
                    self._varying.add(len(self._values))
            self._add(value)
        return self._places[id(value)]

    def _add(self, value: Tensor) -> None:
        self._places[id(value)] = len(self._values)
        self._values.append(value)

    def note(self, operation: OpOverload, arguments: Sequence[Any], keywords: dict[str, Any], made: Any) -> None:
        """Note an operation on values that are here, and what it made; refuse one that writes into a tensor, whose
        views and earlier values the tape would lose."""
        if operation._schema.is_mutable:
            raise NotCompilable(f"{operation} writes into a tensor that does not depend on the state")

        def placed(leaf: Any) -> Any:
            return _Place(self.place(leaf)) if isinstance(leaf, Tensor) else leaf

        arguments = _mapped(placed, arguments)
        keywords = {name: _mapped(placed, value) for name, value in keywords.items()}
        leaves = _leaves(*arguments, *keywords.values())
        needs = frozenset(leaf.number for leaf in leaves if isinstance(leaf, _Place))
        first = len(self._values)
        for value in _leaves(made):
            self._add(value)
        makes = range(first, len(self._values))
        if not needs.isdisjoint(self._varying):
            self._varying.update(makes)
        self._steps.append(_Step(operation, arguments, keywords, needs, makes))

    def cut(self, wanted: Iterable[int]) -> None:
        """End the noting, and leave out what these places do not need."""
        needed, steps = set(wanted), list[_Step]()
        for step in reversed(self._steps):
            if not needed.isdisjoint(step.makes):
                needed |= step.needs
                steps.append(step)
        self._steps = steps[::-1]
        self._places.clear()
        made = {place for step in self._steps for place in step.makes}
        for place in range(len(self._values)):  # these come from the program and from steps, or nothing takes them
            if place in made or place in self._program or place not in needed:
                self._values[place] = torch.empty(0)

    def takes(self, name: str) -> bool:
        """Whether one of the program's tensors is on it."""
        return name in self._program.values()

    def run(self, tensors: Mapping[str, Tensor]) -> list[Tensor]:
        """Values by place, for a program's tensors as they are now."""
        values = [
            tensors[self._program[place]] if place in self._program else v for place, v in enumerate(self._values)
        ]
        for step in self._steps:
            step.run(values)
        return values

    def run_again(self, values: Sequence[Tensor], name: str, tensor: Tensor) -> list[Tensor]:
        """What `run` returned, where one of the program's tensors is another."""
        changed = {place for place, known in self._program.items() if known == name}
        found = [tensor if place in changed else value for place, value in enumerate(values)]
        for step in self._steps:
            if not changed.isdisjoint(step.needs):
                step.run(found)
                changed.update(step.makes)
        return found


class Translation(TorchDispatchMode):
    """Notes what torch does meanwhile: tensors of values become tensors of scalars' numbers, of the same shape.

    It is given the arguments of what is traced, what each of them differs between, and the program's tensors, by name.
    """

    def __init__(self, inputs: Mapping[str, Tensor], levels: dict[str, int], tensors: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.graph, self.tape = ScalarGraph(levels), Tape(tensors)
        self._kept: list[Tensor] = []  # a tensor that is kept shares its `id` with no later one
        self._numbers: dict[int, Tensor] = {}
        self._places: dict[int, Tensor] = {}  # of values on the tape that a kernel takes: place → scalars' numbers
        self._offset = 0
        for name, example in inputs.items():
            elements = [self.graph.scalar("input", name, k) for k in range(example.numel())]
            self._keep(example, torch.tensor(elements, dtype=torch.int64).view(example.shape))

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # or torch would load its compiler, a second, to leave this alone

    def _keep(self, value: Tensor, numbers: Tensor) -> None:
        self._kept.append(value)
        self._numbers[id(value)] = numbers

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func is aten._local_scalar_dense.default:
            raise NotCompilable("it reads a number out of a tensor (float(), .item(), if)")
        if torch.Tag.nondeterministic_seeded in func.tags:
            raise NotCompilable(f"{func} draws random numbers of its own")
        made = func(*args, **kwargs)
        if not any(id(leaf) in self._numbers for leaf in _leaves(*args, *kwargs.values())):
            self.tape.note(func, args, kwargs, made)
            return made
        numbers = self._translate(func, args, kwargs, made)
        for value, own in zip(_leaves(made), _leaves(numbers), strict=True):
            self._keep(value, own)
        return made

    def end(self, outputs: Sequence[Tensor]) -> None:
        """What was traced returned these."""
        for value in outputs:
            self.graph.outputs += self._number(value).flatten().tolist()
        self.tape.cut(self.graph.parameters)
        self._kept.clear()
        self._numbers.clear()

    def _number(self, value: Any) -> Any:
        """The scalars' numbers of a tensor; parameters become inputs of the kernel when they are first needed."""
        if not isinstance(value, Tensor):
            return value
        if id(value) in self._numbers:
            return self._numbers[id(value)]
        place = self.tape.place(value)
        if place not in self._places:
            elements = [self.graph.scalar("parameter", self._offset + k) for k in range(value.numel())]
            self._places[place] = torch.tensor(elements, dtype=torch.int64).view(value.shape)
            self.graph.parameters.append(place)
            self._offset += value.numel()
        return self._places[place]

    def _translate(self, func: Any, args: Any, kwargs: Any, made: Any) -> Any:
        packet = func.overloadpacket
        self._check_kind(packet, args, kwargs, made)
        if packet in (aten.index, aten.index_select):
            return self._at_known(func, args)
        arguments = _mapped(self._number, args)
        keywords = {name: _mapped(self._number, value) for name, value in kwargs.items()}
        if packet in MOVING:
            return MOVING[packet](*arguments, **keywords)
        if packet in ELEMENTWISE and not keywords:
            return self._each(ELEMENTWISE[packet], *arguments)
        if packet in FILLED:
            return torch.full(made.shape, self.graph.constant(FILLED[packet]), dtype=torch.int64)
        special = getattr(self, f"_{packet.__name__.lstrip('_')}", None)
        if special is None:
            raise NotCompilable(f"no kernel for {func}")
        return special(*arguments, **keywords)

    def _check_kind(self, packet: Any, args: Any, kwargs: Any, made: Any) -> None:
        """Kernels compute in single precision and with truth values."""
        first, name = next(_leaves(made)).dtype, packet.__name__
        if first not in (torch.float32, torch.bool):
            raise NotCompilable(f"it computes in {str(first).removeprefix('torch.')}")
        if first == torch.bool and name in ("add", "mul", "maximum", "minimum"):
            raise NotCompilable("arithmetic with truth values")
        taken = [leaf for leaf in _leaves(*args, *kwargs.values()) if isinstance(leaf, Tensor)]
        for value in taken[:1] if "index" in name else taken:
            if value.dtype not in (torch.float32, torch.bool):
                raise NotCompilable(f"it computes with {str(value.dtype).removeprefix('torch.')}")

    def _each(self, operation: str, *operands: Any) -> Tensor:
        """An elementwise operation on operands that broadcast; numbers of Python are constants."""
        numbers = (one if isinstance(one, Tensor) else torch.tensor(self.graph.constant(one)) for one in operands)
        tensors = torch.broadcast_tensors(*numbers)
        elements = self.graph.each(operation, *(tensor.flatten().tolist() for tensor in tensors))
        return torch.tensor(elements, dtype=torch.int64).view(tensors[0].shape)

    def _at_known(self, func: Any, args: Any) -> Tensor:
        """Elements at places that are known now."""
        value, *rest = args
        if any(id(leaf) in self._numbers for leaf in _leaves(rest)):
            raise NotCompilable("it looks elements up at places that depend on the state")
        if any(isinstance(leaf, Tensor) and self.tape.varies(leaf) for leaf in _leaves(rest)):
            raise NotCompilable("it looks elements up at places that depend on parameters")
        return func(self._number(value), *rest)

    def _copy(self, value: Tensor, other: Tensor, non_blocking: bool = False) -> Tensor:
        return other.broadcast_to(value.shape)

    def _scaled(self, operation: str, left: Any, right: Any, *, alpha: float = 1) -> Tensor:
        return self._each(operation, left, right if alpha == 1 else self._each("mul", right, alpha))

    _add, _sub = partialmethod(_scaled, "add"), partialmethod(_scaled, "sub")

    def _rsub(self, left: Any, right: Any, alpha: float = 1) -> Tensor:
        return self._sub(right, left, alpha=alpha)

    def _div(self, left: Any, right: Any, *, rounding_mode: str | None = None) -> Tensor:
        if rounding_mode is not None:
            raise NotCompilable(f"no kernel for a division with rounding_mode={rounding_mode!r}")
        return self._each("div", left, right)

    def _pow(self, base: Any, exponent: Any) -> Tensor:
        if isinstance(exponent, Tensor):
            return self._each("pow", base, exponent)
        if float(exponent).is_integer() and 0 < abs(exponent) <= 16:
            power = base
            for _ in range(abs(int(exponent)) - 1):
                power = self._each("mul", power, base)
            return power if exponent > 0 else self._each("reciprocal", power)
        if float(exponent).is_integer() and exponent:
            raise NotCompilable(f"a power of {exponent}")
        named = {0.5: "sqrt", -0.5: "rsqrt"}.get(exponent)
        return self._each(named, base) if named else self._each("pow", base, exponent)

    def _softplus(self, value: Tensor, beta: float = 1, threshold: float = 20) -> Tensor:
        if beta != 1 or threshold < 20:
            raise NotCompilable("no kernel for softplus with beta or threshold")
        return self._each("softplus", value)

    def _clamp(self, value: Tensor, low: Any = None, high: Any = None, *, min: Any = None, max: Any = None) -> Tensor:
        low, high = (min if low is None else low), (max if high is None else high)
        if low is not None:  # at the bound the value passes, as does its derivative
            value = self._each("where", self._each("lt", value, low), low, value)
        return value if high is None else self._each("where", self._each("gt", value, high), high, value)

    _clamp_min = _clamp

    def _clamp_max(self, value: Tensor, high: Any) -> Tensor:
        return self._clamp(value, high=high)

    def _masked_fill(self, value: Tensor, mask: Tensor, other: Any) -> Tensor:
        return self._each("where", mask, other, value)

    def _sum(self, value: Tensor, dims: Sequence[int] | None = None, keepdim: bool = False) -> Tensor:
        dims = [d % value.dim() for d in (dims or range(value.dim()))]
        kept = [d for d in range(value.dim()) if d not in dims]
        rows = value.permute(*kept, *dims).reshape(*[value.shape[d] for d in kept], -1)
        totals = [self.graph.total(row) for row in rows.reshape(-1, rows.shape[-1]).tolist()]
        shape = [1 if d in dims else n for d, n in enumerate(value.shape)] if keepdim else rows.shape[:-1]
        return torch.tensor(totals, dtype=torch.int64).view(torch.Size(shape))

    def _mean(self, value: Tensor, dims: Sequence[int] | None = None, keepdim: bool = False) -> Tensor:
        total = self._sum(value, dims, keepdim)
        return self._each("mul", total, total.numel() / value.numel())

    def _linalg_vector_norm(
        self, value: Tensor, order: float = 2, dims: Sequence[int] | None = None, keepdim: bool = False
    ) -> Tensor:
        if order != 2:
            raise NotCompilable(f"no kernel for a norm of order {order}")
        return self._each("sqrt", self._sum(self._each("mul", value, value), dims, keepdim))

    def _mm(self, left: Tensor, right: Tensor) -> Tensor:
        return self._addmm(None, left, right)

    def _addmm(self, bias: Tensor | None, left: Tensor, right: Tensor) -> Tensor:
        shape = torch.Size((left.shape[0], right.shape[1]))
        biases = None if bias is None else bias.broadcast_to(shape)
        if shape[0] == 1:  # a row vector times a matrix
            own = None if biases is None else biases.flatten().tolist()
            return torch.tensor(self.graph.product(right.t(), left[0].tolist(), own)).view(shape)
        columns = [
            self.graph.product(left, column.tolist(), None if biases is None else biases[:, j].tolist())
            for j, column in enumerate(right.unbind(1))
        ]
        return torch.tensor(columns).t()

    def _mv(self, matrix: Tensor, vector: Tensor) -> Tensor:
        return self._addmm(None, matrix, vector.unsqueeze(1)).squeeze(1)

    def _dot(self, left: Tensor, right: Tensor) -> Tensor:
        return self._sum(self._each("mul", left, right))

    def _bmm(self, left: Tensor, right: Tensor) -> Tensor:
        return torch.stack([self._mm(one, other) for one, other in zip(left, right, strict=True)])

    def _leaky_relu(self, value: Tensor, slope: float = 0.01) -> Tensor:
        return self._each("where", self._each("gt", value, 0.0), value, self._each("mul", value, slope))

    def _to_copy(self, value: Tensor, *, dtype: torch.dtype | None = None, **keywords: Any) -> Tensor:
        if dtype not in (None, torch.float32):
            raise NotCompilable(f"it converts to {str(dtype).removeprefix('torch.')}")
        return self._each("number", value)
