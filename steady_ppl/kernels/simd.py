"""Arithmetic and elementary functions on vectors of particles while a kernel is written."""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass
from functools import partialmethod
from operator import methodcaller
from typing import Any

from llvmlite import ir

FLOAT, INTEGER = ir.FloatType(), ir.IntType(32)
FAST_MATH_FLAGS = ("contract", "nsz")


@dataclass(frozen=True)
class Lanes:
    """A value of the kernel: one number, or one a lane."""

    builder: Any
    value: Any

    @property
    def type(self) -> Any:
        return self.value.type

    @property
    def lanes(self) -> int:
        """How many; none of one number."""
        return self.type.count if isinstance(self.type, ir.VectorType) else 0

    @property
    def element(self) -> Any:
        """The type of one number."""
        return self.type.element if self.lanes else self.type

    def shaped(self, kind: Any) -> Any:
        """The type of as many numbers of another kind."""
        return ir.VectorType(kind, self.lanes) if self.lanes else kind

    def like(self, number: float | int, kind: Any = FLOAT) -> Lanes:
        """A constant of this value's shape."""
        return Lanes(self.builder, ir.Constant(self.shaped(kind), [number] * self.lanes if self.lanes else number))

    def spread(self, lanes: int) -> Lanes:
        """One number in every lane."""
        if self.lanes or not lanes:
            return self
        kind = ir.VectorType(self.type, lanes)
        first = self.builder.insert_element(ir.Constant(kind, ir.Undefined), self.value, ir.Constant(INTEGER, 0))
        mask = ir.Constant(ir.VectorType(INTEGER, lanes), [0] * lanes)
        return Lanes(self.builder, self.builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), mask))

    def pair(self, other: Any) -> tuple[Lanes, Lanes]:
        """This value and another one or a number, both in as many lanes."""
        other = other if isinstance(other, Lanes) else self.like(other, self.element)
        lanes = max(self.lanes, other.lanes)
        return self.spread(lanes), other.spread(lanes)

    def _do(self, name: str, other: Any) -> Lanes:
        left, right = number(self).pair(number(other) if isinstance(other, Lanes) else other)
        return Lanes(self.builder, getattr(self.builder, name)(left.value, right.value, flags=FAST_MATH_FLAGS))

    def compare(self, how: str, other: Any) -> Lanes:
        """A truth value; false where either is not a number, except for "!="."""
        left, right = number(self).pair(number(other) if isinstance(other, Lanes) else other)
        make = self.builder.fcmp_unordered if how == "!=" else self.builder.fcmp_ordered
        return Lanes(self.builder, make(how, left.value, right.value))

    __add__, __sub__ = partialmethod(_do, "fadd"), partialmethod(_do, "fsub")
    __mul__, __truediv__ = partialmethod(_do, "fmul"), partialmethod(_do, "fdiv")
    __lt__, __le__ = partialmethod(compare, "<"), partialmethod(compare, "<=")
    __gt__, __ge__ = partialmethod(compare, ">"), partialmethod(compare, ">=")

    def __rsub__(self, other: Any) -> Lanes:
        return self.like(other) - self

    def __rtruediv__(self, other: Any) -> Lanes:
        return self.like(other) / self

    def __neg__(self) -> Lanes:
        return Lanes(self.builder, self.builder.fneg(self.value))

    def __abs__(self) -> Lanes:
        return self.call("fabs")

    def where(self, yes: Any, no: Any) -> Lanes:
        """`yes` where this truth value holds, else `no`."""
        yes, no = (yes if isinstance(yes, Lanes) else no.like(yes)).pair(no)
        lanes = max(self.lanes, yes.lanes)
        condition, yes, no = (value.spread(lanes) for value in (self, yes, no))
        return Lanes(self.builder, self.builder.select(condition.value, yes.value, no.value))

    def logical(self, name: str, other: Lanes) -> Lanes:
        left, right = self.pair(other)
        return Lanes(self.builder, getattr(self.builder, name)(left.value, right.value))

    def call(self, name: str) -> Lanes:
        """A function of the processor, such as `sqrt`, `floor`, `fabs` or `rint`."""
        name, module = f"llvm.{name}.{f'v{self.lanes}f32' if self.lanes else 'f32'}", self.builder.module
        declared = module.globals.get(name) or ir.Function(module, ir.FunctionType(self.type, [self.type]), name)
        return Lanes(self.builder, self.builder.call(declared, [self.value]))

    def converted(self, how: str, kind: Any) -> Lanes:
        """Numbers of another kind: `fptosi` and `sitofp` round, `bitcast` keeps the bits."""
        return Lanes(self.builder, getattr(self.builder, how)(self.value, self.shaped(kind)))

    def on_integers(self, name: str, number: int) -> Lanes:
        return Lanes(self.builder, getattr(self.builder, name)(self.value, self.like(number, INTEGER).value))

    def has_bit(self, bit: int) -> Lanes:
        """Whether an integer has a bit."""
        masked, zero = self.on_integers("and_", bit), self.like(0, INTEGER)
        return Lanes(self.builder, self.builder.icmp_signed("!=", masked.value, zero.value))


def truth(x: Lanes) -> Lanes:
    """Whether a number is not zero."""
    return x if x.element == ir.IntType(1) else x.compare("!=", 0.0)


def number(x: Lanes) -> Lanes:
    """A truth value as 1 or 0."""
    return x if x.element == FLOAT else x.converted("uitofp", FLOAT)


def polynomial(x: Lanes, *coefficients: float) -> Lanes:
    """Horner's scheme, the highest power first."""
    value = x * coefficients[0] + coefficients[1]
    for coefficient in coefficients[2:]:
        value = value * x + coefficient
    return value


def _turned(x: Lanes, quarters: int) -> Lanes:
    """sin(x + quarters · π/2), for |x| up to some thousands."""
    n = (x * (2 / math.pi) + 0.5).call("floor")
    r = ((x - n * 1.5703125) - n * 4.837512969970703125e-4) - n * 7.54978995489188216e-8
    s = r * r
    sine = polynomial(s, -1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1) * s * r + r
    cosine = polynomial(s, 2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2) * s * s - s * 0.5 + 1.0
    turn = n.converted("fptosi", INTEGER).on_integers("add", quarters)
    value = turn.has_bit(1).where(cosine, sine)
    return turn.has_bit(2).where(-value, value)


def exp(x: Lanes) -> Lanes:
    """The exponential."""
    low, high = x < -87.33654, x > 88.72283
    clipped = low.where(-87.33654, high.where(88.72283, x))
    n = (clipped * (1 / math.log(2)) + 0.5).call("floor")
    r = (clipped - n * 0.693359375) - n * -2.12194440e-4
    p = polynomial(
        r, 1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1
    )
    value = p * r * r + r + 1.0
    half = n.converted("fptosi", INTEGER).on_integers("ashr", 1)  # 2ⁿ in two factors: 2¹²⁸ alone is no float
    rest = Lanes(x.builder, x.builder.sub(n.converted("fptosi", INTEGER).value, half.value))
    for exponent in (half, rest):
        value = value * exponent.on_integers("add", 127).on_integers("shl", 23).converted("bitcast", FLOAT)
    return low.where(0.0, high.where(math.inf, value))


def log(x: Lanes) -> Lanes:
    """The natural logarithm; not a number below zero."""
    bits = x.converted("bitcast", INTEGER)
    mantissa = bits.on_integers("and_", 0x007FFFFF).on_integers("or_", 0x3F000000)
    mantissa = mantissa.converted("bitcast", FLOAT)  # in [0.5, 1)
    exponent = bits.on_integers("ashr", 23).on_integers("sub", 126).converted("sitofp", FLOAT)
    small = mantissa < math.sqrt(0.5)
    exponent = small.where(exponent - 1.0, exponent)
    m = small.where(mantissa + mantissa, mantissa) - 1.0
    s = m * m
    p = polynomial(
        m,
        *(7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1),
        *(-1.6668057665e-1, 2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1),
    )
    value = m * s * p + exponent * -2.12194440e-4 - s * 0.5 + m + exponent * 0.693359375
    value = (x < math.inf).where(value, x)  # infinity and what is not a number
    value = (x > 0.0).where(value, (x < 0.0).where(math.nan, value))
    return x.compare("==", 0.0).where(-math.inf, value)


def log1p(x: Lanes) -> Lanes:
    """log(1 + x), exact near zero."""
    u = x + 1.0
    logarithm = log(u)
    finite = (u > 0.0).logical("and_", u < math.inf)
    return finite.where(logarithm + (x - (u - 1.0)) / u, logarithm)


def sigmoid(x: Lanes) -> Lanes:
    """1 / (1 + e⁻ˣ)."""
    e = exp(-abs(x))
    share = 1.0 / (e + 1.0)
    return (x < 0.0).where(e * share, share)


def tanh(x: Lanes) -> Lanes:
    """The hyperbolic tangent."""
    size, s = abs(x), x * x
    small = polynomial(s, -5.70498872745e-3, 2.06390887954e-2, -5.37397155531e-2, 1.33314422036e-1, -3.33332819422e-1)
    large = 1.0 - 2.0 / (exp(size + size) + 1.0)
    return (size < 0.625).where(small * s * x + x, (x < 0.0).where(-large, large))


def atan2(y: Lanes, x: Lanes) -> Lanes:
    """The angle of (x, y) against the first axis, in (−π, π]."""
    y, x = y.pair(x)
    a, b = abs(y), abs(x)
    steep = a > b
    larger, smaller = steep.where(a, b), steep.where(b, a)
    t = smaller / (larger > 0.0).where(larger, larger.like(1.0))  # in [0, 1]
    big = t > math.tan(math.pi / 8)
    u = big.where((t - 1.0) / (t + 1.0), t)
    s = u * u
    angle = polynomial(s, 8.05374449538e-2, -1.38776856032e-1, 1.99777106478e-1, -3.33329491539e-1) * s * u + u
    angle = big.where(angle + math.pi / 4, angle)
    angle = steep.where(math.pi / 2 - angle, angle)
    angle = (x < 0.0).where(math.pi - angle, angle)
    return (y + x).compare("!=", y + x).where(y + x, (y < 0.0).where(-angle, angle))


def maximum(x: Lanes, y: Lanes) -> Lanes:
    """The larger of two; not a number where either is none."""
    return (x > y).where(x, x.compare("!=", x).where(x, y))


def minimum(x: Lanes, y: Lanes) -> Lanes:
    """The smaller of two; not a number where either is none."""
    return (x < y).where(x, x.compare("!=", x).where(x, y))


def expm1(x: Lanes) -> Lanes:
    """eˣ − 1, exact near zero."""
    half = tanh(x * 0.5)
    return (abs(x) < 0.5).where(half * 2.0 / (1.0 - half), exp(x) - 1.0)


def remainder(x: Lanes, y: Lanes) -> Lanes:
    """x less the multiple of y below it; in [0, y) for positive y."""
    rest = x - (x / y).call("floor") * y
    rest = (rest < 0.0).logical("and_", y > y.like(0.0)).where(rest + y, rest)
    return (abs(rest) < abs(y)).where(rest, rest - y)


def _cos_of_asin(x: Lanes) -> Lanes:
    return ((1.0 - x) * (x + 1.0)).call("sqrt")


OPERATIONS: dict[str, Any] = {
    "number": number,
    "pow": lambda x, y: y.compare("==", 0.0).where(1.0, exp(log(x) * y)),  # of negative x not a number
    "sin": lambda x: _turned(x, 0),
    "cos": lambda x: _turned(x, 1),
    "tan": lambda x: _turned(x, 0) / _turned(x, 1),
    "atan": lambda x: atan2(x, x.like(1.0)),
    "asin": lambda x: atan2(x, _cos_of_asin(x)),
    "acos": lambda x: atan2(_cos_of_asin(x), x),
    "hypot": lambda x, y: (x * x + y * y).call("sqrt"),
    "softplus": lambda x: maximum(x, x.like(0.0)) + log1p(exp(-abs(x))),
    "silu": lambda x: x * sigmoid(x),
    "rsqrt": lambda x: 1.0 / x.call("sqrt"),
    "reciprocal": lambda x: 1.0 / x,
    "square": lambda x: x * x,
    "relu": lambda x: (x < 0.0).where(0.0, x),
    "div": operator.truediv,
    "round": lambda x: x.call("rint"),
    "sign": lambda x: (x > 0.0).where(1.0, (x < 0.0).where(-1.0, x.like(0.0))),
    "where": lambda condition, yes, no: truth(condition).where(yes, no),
    "logical_and": lambda x, y: truth(x).logical("and_", truth(y)),
    "logical_or": lambda x, y: truth(x).logical("or_", truth(y)),
    "logical_not": lambda x: Lanes(x.builder, x.builder.not_(truth(x).value)),
    "eq": lambda x, y: x.compare("==", y),
    "ne": lambda x, y: x.compare("!=", y),
    **{name: getattr(operator, name) for name in ("add", "sub", "mul", "neg", "abs", "lt", "le", "gt", "ge")},
    **{name: methodcaller("call", name) for name in ("sqrt", "floor", "ceil")},
    **{f.__name__: f for f in (exp, log, log1p, sigmoid, tanh, expm1, atan2, maximum, minimum, remainder)},
}
