"""Arithmetic on vectors of particles while a kernel is written: what looks like a number writes an instruction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from llvmlite import ir

FLOAT, INTEGER = ir.FloatType(), ir.IntType(32)
FLAGS = ("contract", "nsz")


@dataclass(frozen=True)
class Lanes:
    """A value of the kernel: one number, or one a lane."""

    builder: Any
    value: Any

    @property
    def type(self) -> Any:
        return self.value.type

    def like(self, number: float | int, kind: Any = FLOAT) -> Lanes:
        """A constant of this value's shape."""
        if isinstance(self.type, ir.VectorType):
            kind = ir.VectorType(kind, self.type.count)
            return Lanes(self.builder, ir.Constant(kind, [number] * kind.count))
        return Lanes(self.builder, ir.Constant(kind, number))

    def _pair(self, other: Any) -> tuple[Lanes, Lanes]:
        if not isinstance(other, Lanes):
            kind = self.type.element if isinstance(self.type, ir.VectorType) else self.type
            return self, self.like(other, kind)
        if isinstance(self.type, ir.VectorType) and not isinstance(other.type, ir.VectorType):
            return self, other.spread(self.type.count)
        if isinstance(other.type, ir.VectorType) and not isinstance(self.type, ir.VectorType):
            return self.spread(other.type.count), other
        return self, other

    def spread(self, lanes: int) -> Lanes:
        """One number in every lane."""
        if isinstance(self.type, ir.VectorType):
            return self
        kind = ir.VectorType(self.type, lanes)
        first = self.builder.insert_element(ir.Constant(kind, ir.Undefined), self.value, ir.Constant(INTEGER, 0))
        mask = ir.Constant(ir.VectorType(INTEGER, lanes), [0] * lanes)
        return Lanes(self.builder, self.builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), mask))

    def _do(self, name: str, other: Any) -> Lanes:
        left, right = number(self)._pair(number(other) if isinstance(other, Lanes) else other)
        return Lanes(self.builder, getattr(self.builder, name)(left.value, right.value, flags=FLAGS))

    def __add__(self, other: Any) -> Lanes:
        return self._do("fadd", other)

    def __sub__(self, other: Any) -> Lanes:
        return self._do("fsub", other)

    def __rsub__(self, other: Any) -> Lanes:
        return self.like(other) - self

    def __mul__(self, other: Any) -> Lanes:
        return self._do("fmul", other)

    def __truediv__(self, other: Any) -> Lanes:
        return self._do("fdiv", other)

    def __rtruediv__(self, other: Any) -> Lanes:
        return self.like(other) / self

    def __neg__(self) -> Lanes:
        return Lanes(self.builder, self.builder.fneg(self.value))

    def compare(self, how: str, other: Any) -> Lanes:
        """A truth value; false where either is not a number, except for "!="."""
        left, right = number(self)._pair(number(other) if isinstance(other, Lanes) else other)
        unordered = how == "!="
        make = self.builder.fcmp_unordered if unordered else self.builder.fcmp_ordered
        return Lanes(self.builder, make(how, left.value, right.value))

    def __lt__(self, other: Any) -> Lanes:
        return self.compare("<", other)

    def __gt__(self, other: Any) -> Lanes:
        return self.compare(">", other)

    def __ge__(self, other: Any) -> Lanes:
        return self.compare(">=", other)

    def where(self, yes: Any, no: Any) -> Lanes:
        """`yes` where this truth value holds, else `no`."""
        if not isinstance(yes, Lanes):
            yes = no.like(yes)
        yes, no = yes._pair(no)
        condition, yes = self._pair(yes) if isinstance(yes.type, ir.VectorType) else (self, yes)
        if isinstance(condition.type, ir.VectorType):
            yes, no = yes.spread(condition.type.count), no.spread(condition.type.count)
        return Lanes(self.builder, self.builder.select(condition.value, yes.value, no.value))

    def logical(self, name: str, other: Lanes) -> Lanes:
        left, right = self._pair(other)
        return Lanes(self.builder, getattr(self.builder, name)(left.value, right.value))

    def call(self, name: str) -> Lanes:
        """A function of the processor, such as `sqrt`, `floor`, `fabs` or `rint`."""
        kind = f"v{self.type.count}f32" if isinstance(self.type, ir.VectorType) else "f32"
        name, module = f"llvm.{name}.{kind}", self.builder.module
        declared = module.globals.get(name) or ir.Function(module, ir.FunctionType(self.type, [self.type]), name)
        return Lanes(self.builder, self.builder.call(declared, [self.value]))

    def integer(self) -> Lanes:
        return Lanes(self.builder, self.builder.fptosi(self.value, _shaped(self, INTEGER)))

    def bits(self) -> Lanes:
        return Lanes(self.builder, self.builder.bitcast(self.value, _shaped(self, INTEGER)))

    def of_bits(self) -> Lanes:
        return Lanes(self.builder, self.builder.bitcast(self.value, _shaped(self, FLOAT)))

    def to_float(self) -> Lanes:
        return Lanes(self.builder, self.builder.sitofp(self.value, _shaped(self, FLOAT)))

    def on_integers(self, name: str, number: int) -> Lanes:
        return Lanes(self.builder, getattr(self.builder, name)(self.value, self.like(number, INTEGER).value))

    def added(self, other: Lanes) -> Lanes:
        return Lanes(self.builder, self.builder.add(self.value, other.value))

    def has_bit(self, bit: int) -> Lanes:
        """Whether an integer has a bit."""
        masked, zero = self.on_integers("and_", bit), self.like(0, INTEGER)
        return Lanes(self.builder, self.builder.icmp_signed("!=", masked.value, zero.value))


def _shaped(like: Lanes, kind: Any) -> Any:
    return ir.VectorType(kind, like.type.count) if isinstance(like.type, ir.VectorType) else kind


def truth(x: Lanes) -> Lanes:
    """Whether a number is not zero."""
    kind = x.type.element if isinstance(x.type, ir.VectorType) else x.type
    return x if kind == ir.IntType(1) else x.compare("!=", 0.0)


def number(x: Lanes) -> Lanes:
    """A truth value as 1 or 0."""
    kind = x.type.element if isinstance(x.type, ir.VectorType) else x.type
    if kind == FLOAT:
        return x
    return Lanes(x.builder, x.builder.uitofp(x.value, _shaped(x, FLOAT)))
