"""Derivatives of a scalar graph, forward: for every output and input another scalar of the same graph.

Derivatives that are zero are never written, so that a kernel of the Jacobian costs as much as what depends on what.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from steady_ppl.scalar_graph import Each, NotCompilable, Product, ScalarGraph

FLAT = (
    *("round", "floor", "ceil", "sign", "gt", "ge", "lt", "le", "eq", "ne"),
    *("logical_and", "logical_or", "logical_not"),
)
Values = list[int]  # a scalar, or the elements of a vector


class Tangents:
    """Derivatives along one input.

    Args:
        graph: is added to.
        along: the input's number.
    """

    def __init__(self, graph: ScalarGraph, along: int) -> None:
        self.graph, self.along = graph, along
        self.of_scalars: dict[int, int | None] = {}
        self.of_vectors: dict[int, Values | None] = {}

    def of(self, number: int) -> int | None:
        """The derivative of a scalar; None where it is zero."""
        if number not in self.of_scalars:
            operation, arguments = self.graph.scalars[number]
            if operation == "element":
                vector = self._of_vector(arguments[0])
                found = None if vector is None else vector[arguments[1]]
            elif operation in ("input", "parameter", "constant"):
                found = self.graph.constant(1.0) if number == self.along else None
            else:
                tangents = [self.of(n) for n in arguments]
                lists = [None if tangent is None else [tangent] for tangent in tangents]
                result = self._rule(operation, [[n] for n in arguments], lists, [number])
                found = None if result is None else result[0]
            self.of_scalars[number] = found
        return self.of_scalars[number]

    def _of_vector(self, vector: int) -> Values | None:
        if vector not in self.of_vectors:
            what = self.graph.vectors[vector]
            self.of_vectors[vector] = (
                self._of_product(what) if isinstance(what, Product) else self._of_each(vector, what)
            )
        return self.of_vectors[vector]

    def _of_product(self, product: Product) -> Values | None:
        whole = self.graph.whole_vector(product.x)
        tangents = self._of_vector(whole) if whole is not None else [self.of(n) for n in product.x]
        if product.bias and any(self.of(n) is not None for n in product.bias):
            raise NotCompilable("a bias that differs between particles")
        if tangents is None or all(tangent is None for tangent in tangents):
            return None
        x = tuple(self.graph.constant(0.0) if tangent is None else tangent for tangent in tangents)
        return self.graph.vector(Product(product.length, product.at, product.rows, product.columns, None, x))

    def _of_each(self, vector: int, what: Each) -> Values | None:
        graph = self.graph
        operands: list[Values] = []
        tangents: list[Values | None] = []
        for kind, n in what.operands:
            if kind == "vector":
                operands.append([graph.scalar("element", n, k) for k in range(what.length)])
                tangents.append(self._of_vector(n))
            elif kind == "scalar":
                tangent = self.of(n)
                operands.append([n] * what.length)
                tangents.append(None if tangent is None else [tangent] * what.length)
            else:
                operands.append([graph.scalar("parameter", n + k) for k in range(what.length)])
                tangents.append(None)
        own = [graph.scalar("element", vector, k) for k in range(what.length)]
        return self._rule(what.operation, operands, tangents, own)

    def _rule(
        self, operation: str, operands: Sequence[Values], tangents: Sequence[Values | None], value: Values
    ) -> Values | None:
        """The chain rule, for scalars and for all elements of vectors."""
        if operation in FLAT or all(tangent is None for tangent in tangents):
            return None
        if operation in CHOICES:
            condition, yes, no = CHOICES[operation](self, operands, tangents)
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
        total = terms[0]
        for term in terms[1:]:
            total = self.do("add", total, term)
        return total

    def _times(self, partial: Values, tangent: Values) -> Values:
        one = self.graph.constant(1.0)
        if all(number == one for number in tangent):
            return partial
        return self.do("mul", partial, tangent)

    def constants(self, number: float, like: Values) -> Values:
        return [self.graph.constant(number)] * len(like)

    def do(self, operation: str, *operands: Values | float) -> Values:
        """An operation on each element."""
        length = max(len(operand) for operand in operands if isinstance(operand, list))
        lists = [o if isinstance(o, list) else [self.graph.constant(o)] * length for o in operands]
        return self.graph.each(operation, *lists)


Partial = Callable[..., tuple[Values | None, ...]]


def _over(d: Tangents, value: Values, x: Values) -> Values:
    return d.do("div", value, x)


def _silu(d: Tangents, value: Values, x: Values) -> tuple[Values, ...]:
    share = d.do("sigmoid", x)
    return (d.do("add", share, d.do("mul", value, d.do("sub", 1.0, share))),)


def _atan2(d: Tangents, value: Values, y: Values, x: Values) -> tuple[Values, ...]:
    square = d.do("add", d.do("mul", x, x), d.do("mul", y, y))
    return d.do("div", x, square), d.do("neg", d.do("div", y, square))


def _leg(d: Tangents, x: Values) -> Values:
    return d.do("rsqrt", d.do("sub", 1.0, d.do("mul", x, x)))


# what an operation's result changes by with each operand; None is one
PARTIALS: dict[str, Partial] = {
    "add": lambda d, value, x, y: (None, None),
    "sub": lambda d, value, x, y: (None, d.constants(-1.0, value)),
    "mul": lambda d, value, x, y: (y, x),
    "div": lambda d, value, x, y: (d.do("reciprocal", y), d.do("neg", _over(d, value, y))),
    "neg": lambda d, value, x: (d.constants(-1.0, value),),
    "number": lambda d, value, x: (None,),
    "abs": lambda d, value, x: (d.do("sign", x),),
    "square": lambda d, value, x: (d.do("mul", x, 2.0),),
    "sqrt": lambda d, value, x: (_over(d, d.constants(0.5, value), value),),
    "rsqrt": lambda d, value, x: (d.do("mul", _over(d, value, x), -0.5),),
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
    "asin": lambda d, value, x: (_leg(d, x),),
    "acos": lambda d, value, x: (d.do("neg", _leg(d, x)),),
    "atan2": _atan2,
    "hypot": lambda d, value, x, y: (_over(d, x, value), _over(d, y, value)),
    "pow": lambda d, value, x, y: (
        d.do("mul", y, d.do("pow", x, d.do("sub", y, 1.0))),
        d.do("mul", value, d.do("log", x)),
    ),
    "remainder": lambda d, value, x, y: (None, d.do("neg", d.do("floor", d.do("div", x, y)))),
}

# those that pass one operand on: which, and the derivatives that are passed on with it
CHOICES: dict[str, Callable[[Tangents, Any, Any], Any]] = {
    "where": lambda d, operands, tangents: (operands[0], tangents[1], tangents[2]),
    "relu": lambda d, operands, tangents: (d.do("gt", operands[0], 0.0), tangents[0], None),
    "maximum": lambda d, operands, tangents: (d.do("gt", *operands), *tangents),
    "minimum": lambda d, operands, tangents: (d.do("lt", *operands), *tangents),
}


def jacobian(graph: ScalarGraph, outputs: Sequence[int], inputs: Sequence[int]) -> list[int]:
    """The derivative of every output in every input, the outputs' rows one after the other."""
    by_input = [Tangents(graph, number) for number in inputs]
    for number in range(max(outputs) + 1):  # in their order, so that no recursion gets deep
        for tangents in by_input:
            tangents.of(number)
    zero = graph.constant(0.0)
    found = [[tangents.of(output) for tangents in by_input] for output in outputs]
    return [zero if derivative is None else derivative for row in found for derivative in row]
