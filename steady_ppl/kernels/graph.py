"""A traced method of a program, element by element, and its forward derivatives.

A method is traced for a single particle of a single trajectory, so that every dimension of every tensor is known and
whatever only moves elements about (`view`, `select`, `stack`, …) costs nothing. What depends on parameters alone stays
with torch and is handed to the kernel as numbers. Long vectors, a network's hidden layer, stay vectors.

Derivatives that are zero are never written, so that a kernel of the Jacobian costs as much as what depends on what.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor

from steady_ppl.errors import SteadyError

PARAMETERS_ALONE, TRAJECTORY, PARTICLE = range(3)  # what a value depends on
LEAVES = ("input", "parameter", "constant", "element")
MAX_UNROLLED_ELEMENTS = 48  # of the largest matrix whose product is written out element by element
MAX_OPERATIONS = 12_000  # scalar operations: compiling so many takes as long as four passes over 2,400 rows without
ZERO_DERIVATIVE = {"round", "floor", "ceil", "sign", "gt", "ge", "lt", "le", "eq", "ne"}  # their derivatives are zero
ZERO_DERIVATIVE |= {"logical_and", "logical_or", "logical_not"}
Values = list[int]  # a scalar, or the elements of a vector


class NotCompilable(SteadyError):
    """A method uses what kernels cannot; the message says what."""


class Scalar(NamedTuple):
    """One operation on scalars. The leaves are "input" (name, element), "parameter" (offset), "constant" (value) and
    "element" (vector, index)."""

    operation: str
    arguments: tuple[Any, ...]  # other scalars' numbers, or a leaf's own


@dataclass(frozen=True)
class Product:
    """A matrix of parameters times a vector: element k is bias[k] + Σ p[at + k·rows + i·columns] x[i]."""

    length: int
    at: int
    rows: int
    columns: int
    bias: tuple[int, ...] | None  # one scalar an element
    x: tuple[int, ...]  # the vector's elements


@dataclass(frozen=True)
class Elementwise:
    """An operation on each element of vectors."""

    length: int
    operation: str
    operands: tuple[tuple[str, int], ...]  # ("vector", number), ("parameters", offset) or ("scalar", number)


@dataclass
class ScalarGraph:
    """Scalars and vectors in the order in which they can be computed."""

    levels_of_inputs: dict[str, int]
    scalars: list[Scalar] = field(default_factory=list)
    levels: list[int] = field(default_factory=list)  # what each scalar depends on
    vectors: list[Product | Elementwise] = field(default_factory=list)
    outputs: list[int] = field(default_factory=list)  # the scalars to be returned, in order
    parameters: list[int] = field(default_factory=list)  # places on the tape whose values the kernel takes, in order
    numbers: dict[Scalar, int] = field(default_factory=dict)  # where each is in `scalars`
    operations: int = 0

    def scalar(self, operation: str, *arguments: Any) -> int:
        """The number of an operation's result; the same operation twice is computed once."""
        scalar = Scalar(operation, arguments)
        if scalar not in self.numbers:
            self.operations += operation not in LEAVES
            if self.operations > MAX_OPERATIONS:
                raise NotCompilable(f"more than {MAX_OPERATIONS} operations a particle")
            match operation:
                case "input":
                    level = self.levels_of_inputs[arguments[0]]
                case "parameter" | "constant":
                    level = PARAMETERS_ALONE
                case "element":
                    level = PARTICLE
                case _:
                    level = max(self.levels[argument] for argument in arguments)
            self.numbers[scalar] = len(self.scalars)
            self.scalars.append(scalar)
            self.levels.append(level)
        return self.numbers[scalar]

    def constant(self, value: float) -> int:
        return self.scalar("constant", float(value))

    def vector(self, vector: Product | Elementwise) -> list[int]:
        """The elements of a new vector."""
        self.vectors.append(vector)
        return self.elements("vector", len(self.vectors) - 1, vector.length)

    def elements(self, kind: str, number: int, length: int) -> list[int]:
        """The scalars of an operand, as in `Elementwise`."""
        if kind == "scalar":
            return [number] * length
        if kind == "parameters":
            return [self.scalar("parameter", number + k) for k in range(length)]
        return [self.scalar("element", number, k) for k in range(length)]

    def each(self, operation: str, *operands: Sequence[int]) -> list[int]:
        """An operation on each element of operands of one length."""
        length = len(operands[0])
        kinds = [self._as_whole(operand) for operand in operands]
        if length > 16 and all(kinds) and any(kind and kind[0] == "vector" for kind in kinds):
            return self.vector(Elementwise(length, operation, tuple(kind for kind in kinds if kind)))
        return [self.scalar(operation, *elements) for elements in zip(*operands, strict=True)]

    def _as_whole(self, operand: Sequence[int]) -> tuple[str, int] | None:
        """An operand as a vector, a run of parameters or one repeated scalar, if it is one."""
        if len(set(operand)) == 1:
            return "scalar", operand[0]
        vector, run = self.whole_vector(operand), self.run_of_parameters(operand)
        if vector is not None:
            return "vector", vector
        return None if run is None else ("parameters", run)

    def whole_vector(self, operand: Sequence[int]) -> int | None:
        """The vector whose elements these are, all of them and in order."""
        if self.scalars[operand[0]].operation != "element":
            return None
        vector = self.scalars[operand[0]].arguments[0]
        same = self.vectors[vector].length == len(operand) and all(
            self.scalars[number] == Scalar("element", (vector, k)) for k, number in enumerate(operand)
        )
        return vector if same else None

    def run_of_parameters(self, operand: Sequence[int] | None) -> int | None:
        """The offset of parameters that lie one after the other."""
        if not operand or self.scalars[operand[0]].operation != "parameter":
            return None
        at = self.scalars[operand[0]].arguments[0]
        same = all(self.scalars[number] == Scalar("parameter", (at + k,)) for k, number in enumerate(operand))
        return at if same else None

    def total(self, terms: Sequence[int]) -> int:
        """The sum of scalars, those that fewer things depend on first."""
        return reduce(partial(self.scalar, "add"), sorted(terms, key=lambda term: self.levels[term]))

    def product(self, matrix: Tensor, x: Sequence[int], bias: Sequence[int] | None) -> list[int]:
        """A matrix `(O, I)` of scalars' numbers times the vector x, plus a bias."""
        rows, columns = matrix.shape
        whole = self._strided(matrix)
        if rows * columns > MAX_UNROLLED_ELEMENTS and whole is not None:
            return self.vector(Product(rows, *whole, tuple(bias) if bias else None, tuple(x)))
        result = []
        for k, row in enumerate(matrix.tolist()):
            terms = [self.scalar("mul", weight, element) for weight, element in zip(row, x, strict=True)]
            result.append(self.total([*([bias[k]] if bias else []), *terms]))
        return result

    def _strided(self, matrix: Tensor) -> tuple[int, int, int] | None:
        """Offset and strides of a matrix of parameters."""
        leaves = [self.scalars[number] for number in matrix.flatten().tolist()]
        if any(leaf.operation != "parameter" for leaf in leaves):
            return None
        at = torch.tensor([leaf.arguments[0] for leaf in leaves]).view(matrix.shape)
        rows = int(at[1, 0] - at[0, 0]) if matrix.shape[0] > 1 else 0
        columns = int(at[0, 1] - at[0, 0]) if matrix.shape[1] > 1 else 0
        regular = at[0, 0] + rows * torch.arange(matrix.shape[0])[:, None] + columns * torch.arange(matrix.shape[1])
        return (int(at[0, 0]), rows, columns) if bool((at == regular).all()) else None

    def uses(self) -> tuple[set[int], set[int]]:
        """The scalars and the vectors that the outputs need."""
        found: dict[str, set[int]] = {"scalar": set(), "vector": set()}
        left = [("scalar", number) for number in self.outputs]
        while left:
            kind, number = left.pop()
            if kind in found and number not in found[kind]:
                found[kind].add(number)
                left += self._operands(kind, number)
        return found["scalar"], found["vector"]

    def dependents(self, leaf: int) -> set[int]:
        """A leaf and the scalars that it may change. Parameters are not followed into vectors, see `Method`."""
        found = {"scalar": {leaf}, "vector": set[int](), "parameters": set[int]()}
        for number, (operation, arguments) in enumerate(self.scalars):
            if operation == "element":
                vector, k = arguments
                if k == 0 and any(one in found[kind] for kind, one in self._operands("vector", vector)):
                    found["vector"].add(vector)
                moved = vector in found["vector"]
            else:
                moved = operation not in LEAVES and not found["scalar"].isdisjoint(arguments)
            if moved:
                found["scalar"].add(number)
        return found["scalar"]

    def _operands(self, kind: str, number: int) -> list[tuple[str, int]]:
        """What one scalar or vector is computed from, as in `Elementwise`."""
        if kind == "scalar":
            operation, arguments = self.scalars[number]
            if operation == "element":
                return [("vector", arguments[0])]
            return [] if operation in LEAVES else [("scalar", argument) for argument in arguments]
        vector = self.vectors[number]
        if isinstance(vector, Elementwise):
            return list(vector.operands)
        whole, run = self.whole_vector(vector.x), self.run_of_parameters(vector.bias)
        x = [("scalar", n) for n in vector.x] if whole is None else [("vector", whole)]
        return x + [("scalar", n) for n in vector.bias or () if run is None]


class Tangents:
    """Derivatives along one input, given by its number; they are added to the graph."""

    def __init__(self, graph: ScalarGraph, along: int) -> None:
        self.graph, self.along = graph, along
        self.moved = graph.dependents(along)
        self.known: dict[int, int | None] = {}

    def of(self, number: int) -> int | None:
        """The derivative of a scalar; None where it is zero."""
        if number not in self.moved:
            return None
        if number not in self.known:
            operation, arguments = self.graph.scalars[number]
            if operation == "element":
                self._of_elements(arguments[0])
            elif number == self.along:
                self.known[number] = self.graph.constant(1.0)
            else:
                found = self._rule(operation, [[n] for n in arguments], [number])
                self.known[number] = found[0] if found else None
        return self.known[number]

    def _of_elements(self, vector: int) -> None:
        graph, what = self.graph, self.graph.vectors[vector]
        elements = graph.elements("vector", vector, what.length)
        if isinstance(what, Elementwise):
            operands = [graph.elements(kind, n, what.length) for kind, n in what.operands]
            found = self._rule(what.operation, operands, elements)
        elif self._of_all(what.bias or ()) is not None:
            raise NotCompilable("a bias that differs between particles")
        else:
            x = self._of_all(what.x)
            found = None if x is None else graph.vector(replace(what, bias=None, x=tuple(x)))
        for k, element in enumerate(elements):
            self.known[element] = found[k] if found else None

    def _of_all(self, numbers: Sequence[int]) -> Values | None:
        """The derivatives of several scalars; None where all are zero."""
        tangents = [self.of(number) for number in numbers]
        if all(tangent is None for tangent in tangents):
            return None
        return [self.graph.constant(0.0) if tangent is None else tangent for tangent in tangents]

    def _rule(self, operation: str, operands: Sequence[Values], value: Values) -> Values | None:
        """The chain rule, for scalars and for all elements of vectors."""
        tangents = [self._of_all(operand) for operand in operands]
        if operation in ZERO_DERIVATIVE or all(tangent is None for tangent in tangents):
            return None
        if operation in SELECTIONS:
            condition, yes, no = SELECTIONS[operation](self, operands, tangents)
            zero = self.constants(0.0, value)
            return self.do("where", condition, zero if yes is None else yes, zero if no is None else no)
        if operation not in PARTIALS:
            raise NotCompilable(f"no derivative of {operation}")
        partials = PARTIALS[operation](self, value, *operands)
        terms = [
            tangent if partial is None else self._times(partial, tangent)
            for partial, tangent in zip(partials, tangents, strict=True)
            if tangent is not None
        ]
        return reduce(partial(self.do, "add"), terms)

    def _times(self, partial: Values, tangent: Values) -> Values:
        ones = self.constants(1.0, tangent)
        return partial if tangent == ones else self.do("mul", partial, tangent)

    def constants(self, number: float, like: Values) -> Values:
        return [self.graph.constant(number)] * len(like)

    def do(self, operation: str, *operands: Values | float) -> Values:
        """An operation on each element."""
        length = max(len(operand) for operand in operands if isinstance(operand, list))
        lists = [o if isinstance(o, list) else [self.graph.constant(o)] * length for o in operands]
        return self.graph.each(operation, *lists)


def _silu(d: Tangents, value: Values, x: Values) -> tuple[Values, ...]:
    share = d.do("sigmoid", x)
    return (d.do("add", share, d.do("mul", value, d.do("sub", 1.0, share))),)


def _atan2(d: Tangents, value: Values, y: Values, x: Values) -> tuple[Values, ...]:
    square = d.do("add", d.do("mul", x, x), d.do("mul", y, y))
    return d.do("div", x, square), d.do("neg", d.do("div", y, square))


def _asin_slope(d: Tangents, x: Values) -> Values:
    return d.do("rsqrt", d.do("sub", 1.0, d.do("mul", x, x)))


# what an operation's result changes by with each operand; None is one
PARTIALS: dict[str, Callable[..., tuple[Values | None, ...]]] = {
    "add": lambda d, value, x, y: (None, None),
    "sub": lambda d, value, x, y: (None, d.constants(-1.0, value)),
    "mul": lambda d, value, x, y: (y, x),
    "div": lambda d, value, x, y: (d.do("reciprocal", y), d.do("neg", d.do("div", value, y))),
    "neg": lambda d, value, x: (d.constants(-1.0, value),),
    "number": lambda d, value, x: (None,),
    "abs": lambda d, value, x: (d.do("sign", x),),
    "square": lambda d, value, x: (d.do("mul", x, 2.0),),
    "sqrt": lambda d, value, x: (d.do("div", 0.5, value),),
    "rsqrt": lambda d, value, x: (d.do("mul", d.do("div", value, x), -0.5),),
    "reciprocal": lambda d, value, x: (d.do("neg", d.do("mul", value, value)),),
    "sin": lambda d, value, x: (d.do("cos", x),),
    "cos": lambda d, value, x: (d.do("neg", d.do("sin", x)),),
    "tan": lambda d, value, x: (d.do("add", d.do("mul", value, value), 1.0),),
    "exp": lambda d, value, x: (value,),
    "expm1": lambda d, value, x: (d.do("add", value, 1.0),),
    "log": lambda d, value, x: (d.do("reciprocal", x),),
    "log1p": lambda d, value, x: (d.do("reciprocal", d.do("add", x, 1.0)),),
    "softplus": lambda d, value, x: (d.do("sigmoid", x),),
    "sigmoid": lambda d, value, x: (d.do("mul", value, d.do("sub", 1.0, value)),),
    "tanh": lambda d, value, x: (d.do("sub", 1.0, d.do("mul", value, value)),),
    "silu": _silu,
    "atan": lambda d, value, x: (d.do("reciprocal", d.do("add", d.do("mul", x, x), 1.0)),),
    "asin": lambda d, value, x: (_asin_slope(d, x),),
    "acos": lambda d, value, x: (d.do("neg", _asin_slope(d, x)),),
    "atan2": _atan2,
    "hypot": lambda d, value, x, y: (d.do("div", x, value), d.do("div", y, value)),
    "pow": lambda d, value, x, y: (
        d.do("mul", y, d.do("pow", x, d.do("sub", y, 1.0))),
        d.do("mul", value, d.do("log", x)),
    ),
    "remainder": lambda d, value, x, y: (None, d.do("neg", d.do("floor", d.do("div", x, y)))),
}

# those that pass one operand on: which, and the derivatives that are passed on with it
SELECTIONS: dict[str, Callable[[Tangents, Any, Any], Any]] = {
    "where": lambda d, operands, tangents: (operands[0], tangents[1], tangents[2]),
    "relu": lambda d, operands, tangents: (d.do("gt", operands[0], 0.0), tangents[0], None),
    "maximum": lambda d, operands, tangents: (d.do("gt", *operands), *tangents),
    "minimum": lambda d, operands, tangents: (d.do("lt", *operands), *tangents),
}


def derivatives(graph: ScalarGraph, outputs: Sequence[int], inputs: Sequence[int]) -> list[list[int | None]]:
    """The derivatives of every output in every input, None where they are zero."""
    by_input = [Tangents(graph, number) for number in inputs]
    for number in range(max(outputs) + 1):  # in their order, so that no recursion gets deep
        for tangents in by_input:
            if number in tangents.moved:
                tangents.of(number)
    return [[tangents.of(output) for tangents in by_input] for output in outputs]
