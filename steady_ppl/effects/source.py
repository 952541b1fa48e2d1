"""An effect's function as lines of a program: what it does and what it comes to, with the options as literals.

Three spellings are tried until no line is too long: everything in its place (`-self.linear_drag * velocity[channel]`),
then the coefficient as `c`, then the options as variables too.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import math
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

import steady_ppl
from steady_ppl.effects.declaration import Effect, Variant
from steady_ppl.errors import UsageError

WIDTH = 120


@dataclass(frozen=True)
class Written:
    """What an effect does, in lines without indentation.

    Attributes:
        body: the statements.
        value: the expression that they come to, and the lines on which it goes on.
    """

    body: list[str]
    value: list[str]

    def after(self, head: str, indent: int) -> list[str]:
        """The body, then the expression behind `return ` or `name = `."""
        return [*self.body, *broken(head, self.value, indent)]


class Source:
    """The source of an effect's function.

    Args:
        effect: whose.
        arguments: what the arguments are called in the program's method, `self` first; the function may call them
            otherwise.

    Raises:
        UsageError: it cannot be read, or is not written as `declaration` asks.
    """

    def __init__(self, effect: Effect, arguments: Sequence[str]) -> None:
        self.effect, self.function = effect, effect.function
        try:
            text = textwrap.dedent(inspect.getsource(self.function))
            node = ast.parse(text).body[0]
        except (OSError, TypeError, SyntaxError, IndexError) as error:
            raise self._refused("its function cannot be read from a file") from error
        if not isinstance(node, ast.FunctionDef):
            raise self._refused("its function is not written as `def name(self, …):`")
        body = node.body[1:] if ast.get_docstring(node) is not None else node.body
        last, self.lines = body[-1] if body else node, text.encode().splitlines()
        whole = isinstance(last, ast.Return) and self.lines[last.lineno - 1].strip().startswith(b"return ")
        if not whole or sum(isinstance(found, ast.Return) for found in ast.walk(node)) > 1:
            raise self._refused("its function needs one `return`, at its end")
        self.last, self.nodes = last, [found for statement in body for found in ast.walk(statement)]
        self.first = body[0].lineno
        while self.lines[self.first - 2].strip().startswith(b"#"):
            self.first -= 1
        self.parameters = tuple(inspect.signature(self.function).parameters)
        self.called = dict(zip(self.parameters, arguments, strict=False))

    @cached_property
    def names(self) -> list[ast.Name]:
        return [node for node in self.nodes if isinstance(node, ast.Name)]

    @cached_property
    def assigned(self) -> set[str]:
        """Names that the function gives values to."""
        return {name.id for name in self.names if isinstance(name.ctx, ast.Store)}

    @cached_property
    def tight(self) -> set[int]:
        """Names to which a power or an attribute binds more tightly than a sign does."""
        powers = {id(node.left) for node in self.nodes if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow)}
        return powers | {id(node.value) for node in self.nodes if isinstance(node, ast.Attribute)}

    def uses(self, argument: str) -> bool:
        """Whether it depends on an argument of the method."""
        return any(self.called.get(name.id) == argument for name in self.names)

    @cached_property
    def outside(self) -> dict[str, Any]:
        """What the function uses of its module, by name."""
        own = self.assigned | set(self.parameters) | set(vars(builtins))
        used = {name.id for name in self.names} - own - {node.arg for node in self.nodes if isinstance(node, ast.arg)}
        known = {**self.function.__globals__, **inspect.getclosurevars(self.function).nonlocals}
        if used - known.keys():
            raise self._refused(f"its function uses {min(used - known.keys())}, which is nowhere defined")
        return {name: known[name] for name in sorted(used)}

    def imports(self) -> dict[str, str]:
        """Import statements, by the name that they give.

        Raises:
            UsageError: something cannot be imported from anywhere.
        """
        return {name: self._import(name, value) for name, value in self.outside.items() if not is_literal(value)}

    def _import(self, name: str, value: Any) -> str:
        if isinstance(value, ModuleType):
            return f"import {value.__name__}" + (f" as {name}" if name != value.__name__ else "")
        if name in dir(steady_ppl) and getattr(steady_ppl, name) is value:
            return f"from steady_ppl import {name}"
        module, called = getattr(value, "__module__", None) or "_", getattr(value, "__name__", None)
        if module.startswith("_") or module == self.function.__module__ or not called:
            raise self._refused(
                f"its function uses {name}, which another file cannot import: write it out within the function"
            )
        return f"from {module} import {called}" + (f" as {name}" if name != called else "")

    def written(self, variant: Variant, indent: int, taken: Collection[str]) -> Written:
        """The function with a variant's options and the coefficient `self.<parameter>`.

        Args:
            variant: of this effect.
            indent: of the lines where they will stand.
            taken: names that must keep their values.
        """
        constants = {name: value for name, value in self.outside.items() if is_literal(value)}
        used = {name.id for name in self.names}
        options = {n: value for n, value in {**constants, **variant.options}.items() if n in used}
        strange = [name for name, value in options.items() if not is_literal(value)]
        if strange:
            raise self._refused(f"its option {strange[0]} is neither a number nor a name, nor some of them")
        literals = {name: literal(value) for name, value in options.items()}
        coefficient = {"c": f"self.{variant.parameter}"}
        renamed = {own: name for own, name in self.called.items() if own != name}
        renamed |= {name: f"own_{name}" for name in self.assigned & set(taken)}
        begins = {renamed[own]: self.called[own] for own in self.called if own in self.assigned and own in renamed}
        in_text = any(isinstance(node, ast.JoinedStr) for node in self.nodes)  # where names have no place of their own
        found = None
        for spelled, bound in (
            ({**coefficient, **literals}, {}),
            (literals, coefficient),
            ({}, coefficient | literals),
        ):
            if spelled and (in_text or spelled.keys() & self.assigned):
                continue
            found = self._spelled({**spelled, **renamed}, {**begins, **bound})
            if all(indent + len(line) <= WIDTH for line in (*found.body, "return " + found.value[0], *found.value)):
                break
        assert found is not None
        return found

    def _spelled(self, names: Mapping[str, str], bound: Mapping[str, str]) -> Written:
        lines = list(self.lines)
        for name in sorted(self.names, key=lambda name: -name.col_offset):
            if name.id in names:
                line = lines[name.lineno - 1]
                text = names[name.id].encode()
                if id(name) in self.tight and (text[:1] == b"-" or text.isdigit()):
                    text = b"(" + text + b")"
                lines[name.lineno - 1] = line[: name.col_offset] + text + line[name.end_col_offset :]
        start = self.last.lineno
        body = textwrap.dedent(b"\n".join(lines[self.first - 1 : start - 1]).decode()).splitlines()
        value = textwrap.dedent(b"\n".join(lines[start - 1 : self.last.end_lineno]).decode()).splitlines()
        value[0] = value[0].removeprefix("return ")
        return Written([*(f"{a} = {b}" for a, b in bound.items()), *(line for line in body if line.strip())], value)

    def _refused(self, why: str) -> UsageError:
        return UsageError(f"effect {self.effect.name} cannot be written out: {why}")


def broken(head: str, value: Sequence[str], indent: int) -> list[str]:
    """A head and an expression, which is broken at its outermost bracket if the line is too long."""
    text = value[0]
    if len(value) > 1 or indent + len(head) + len(text) <= WIDTH:
        return [head + text, *value[1:]]
    node = ast.parse(text, mode="eval").body
    if isinstance(node, ast.Dict | ast.DictComp | ast.List | ast.ListComp):
        return [head + text[0], *(f"    {entry}" for entry in _entries(text, node, indent + 4)), text[-1]]
    if indent + 4 + len(text) <= WIDTH and isinstance(node, ast.BinOp | ast.Compare | ast.BoolOp):
        return [f"{head}(", f"    {text}", ")"]
    return [f"{head}{text}  # fmt: skip  # noqa: E501"]


def _entries(text: str, node: ast.Dict | ast.DictComp | ast.List | ast.ListComp, indent: int) -> list[str]:
    """What stands between the brackets, a line each."""

    def said(part: ast.AST | None) -> str:
        return ast.get_source_segment(text, part) or "" if part is not None else ""

    if isinstance(node, ast.List):
        return [f"{said(item)}," for item in node.elts]
    if isinstance(node, ast.Dict):
        pairs = zip(node.keys, node.values, strict=True)
        return [f"{said(key)}: {said(item)}," if key else f"**{said(item)}," for key, item in pairs]
    if indent + len(text) - 2 <= WIDTH:
        return [text[1:-1]]
    element = f"{said(node.key)}: {said(node.value)}" if isinstance(node, ast.DictComp) else said(node.elt)
    clauses = text[1:-1].partition(element)[2].strip()
    return [element, clauses]


def is_literal(value: Any) -> bool:
    """Whether Python reads the value back from what it prints."""
    if isinstance(value, tuple | list):
        return all(is_literal(item) for item in value)
    return isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value))


def literal(value: Any) -> str:
    """A literal as the formatter writes it."""
    if isinstance(value, str):
        return f'"{value}"' if value.isprintable() and not set(value) & {'"', "\\"} else repr(value)
    if isinstance(value, tuple | list):
        inside = ", ".join(literal(item) for item in value)
        comma = "," if isinstance(value, tuple) and len(value) == 1 else ""
        return f"({inside}{comma})" if isinstance(value, tuple) else f"[{inside}]"
    return repr(value)
