"""A traced method of a program, element by element: what a kernel has to compute for one particle.

A method is traced for a single particle of a single trajectory, so that every dimension of every tensor is known and
whatever only moves elements about (`view`, `select`, `stack`, …) costs nothing. What depends on parameters alone stays
with torch and is handed to the kernel as numbers. Long vectors, a network's hidden layer, stay vectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor, fx

from steady_ppl.errors import SteadyError

PARAMETERS, TRAJECTORY, PARTICLE = range(3)  # what a value depends on
LEAVES = ("input", "parameter", "constant", "element")
UNROLLED = 48  # the largest matrix whose product is written out element by element
TOO_LONG = 3000  # scalar operations; compiling more takes longer than a fit


class NotCompilable(SteadyError):
    """A method uses what kernels cannot; the message says what."""


class Scalar(NamedTuple):
    """One operation on scalars; `arguments` are other scalars' numbers, or the operation's own constants."""

    operation: str
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Product:
    """A matrix of parameters times a vector: element k is bias[k] + Σ p[at + k·rows + i·columns] x[i].

    Attributes:
        bias: one scalar an element, or None.
        x: the vector's elements.
    """

    length: int
    at: int
    rows: int
    columns: int
    bias: tuple[int, ...] | None
    x: tuple[int, ...]


@dataclass(frozen=True)
class Each:
    """An operation on each element of vectors: operands are ("vector", number), ("parameters", offset) or
    ("scalar", number)."""

    length: int
    operation: str
    operands: tuple[tuple[str, int], ...]


@dataclass
class ScalarGraph:
    """Scalars and vectors in the order in which they can be computed.

    Attributes:
        scalars: all operations; "input" (name, element), "parameter" (offset), "constant" (value), "element" (vector,
            index) are the leaves.
        levels: for each scalar, what it depends on.
        vectors: products and elementwise operations on long vectors.
        outputs: the scalars to be returned, in order.
        parameters: nodes of the traced graph whose values the kernel takes, one after the other.
    """

    levels_of_inputs: dict[str, int]
    scalars: list[Scalar] = field(default_factory=list)
    levels: list[int] = field(default_factory=list)
    vectors: list[Product | Each] = field(default_factory=list)
    outputs: list[int] = field(default_factory=list)
    parameters: list[fx.Node] = field(default_factory=list)
    numbers: dict[Scalar, int] = field(default_factory=dict)
    operations: int = 0

    def scalar(self, operation: str, *arguments: Any) -> int:
        """The number of an operation's result; the same operation twice is computed once."""
        scalar = Scalar(operation, arguments)
        if scalar not in self.numbers:
            self.operations += operation not in LEAVES
            if self.operations > TOO_LONG:
                raise NotCompilable(f"more than {TOO_LONG} operations a particle")
            match operation:
                case "input":
                    level = self.levels_of_inputs[arguments[0]]
                case "parameter" | "constant":
                    level = PARAMETERS
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

    def vector(self, vector: Product | Each) -> list[int]:
        """The elements of a new vector."""
        self.vectors.append(vector)
        number = len(self.vectors) - 1
        return [self.scalar("element", number, k) for k in range(vector.length)]

    def each(self, operation: str, *operands: Sequence[int]) -> list[int]:
        """An operation on each element of operands of one length."""
        length = len(operands[0])
        kinds = [self._as_whole(operand) for operand in operands]
        if length > 16 and all(kinds) and any(kind and kind[0] == "vector" for kind in kinds):
            return self.vector(Each(length, operation, tuple(kind for kind in kinds if kind)))
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
        first = self.scalars[operand[0]]
        if first.operation != "element":
            return None
        vector = first.arguments[0]
        same = self.vectors[vector].length == len(operand) and all(
            self.scalars[number] == Scalar("element", (vector, k)) for k, number in enumerate(operand)
        )
        return vector if same else None

    def run_of_parameters(self, operand: Sequence[int] | None) -> int | None:
        """The offset of parameters that lie one after the other."""
        first = self.scalars[operand[0]] if operand else None
        if operand is None or first is None or first.operation != "parameter":
            return None
        at = first.arguments[0]
        same = all(self.scalars[number] == Scalar("parameter", (at + k,)) for k, number in enumerate(operand))
        return at if same else None

    def total(self, terms: Sequence[int]) -> int:
        """The sum of scalars, those that fewer things depend on first."""
        ordered = sorted(terms, key=lambda term: self.levels[term])
        total = ordered[0]
        for term in ordered[1:]:
            total = self.scalar("add", total, term)
        return total

    def product(self, matrix: Tensor, x: Sequence[int], bias: Sequence[int] | None) -> list[int]:
        """A matrix `(O, I)` of scalars' numbers times the vector x, plus a bias."""
        rows, columns = matrix.shape
        whole = self._strided(matrix)
        if rows * columns > UNROLLED and whole is not None:
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

    def _operands(self, kind: str, number: int) -> list[tuple[str, int]]:
        """What one scalar or vector is computed from, as in `Each`."""
        if kind == "scalar":
            operation, arguments = self.scalars[number]
            if operation == "element":
                return [("vector", arguments[0])]
            return [] if operation in LEAVES else [("scalar", argument) for argument in arguments]
        vector = self.vectors[number]
        if isinstance(vector, Each):
            return list(vector.operands)
        whole, run = self.whole_vector(vector.x), self.run_of_parameters(vector.bias)
        x = [("scalar", n) for n in vector.x] if whole is None else [("vector", whole)]
        return x + [("scalar", n) for n in vector.bias or () if run is None]
