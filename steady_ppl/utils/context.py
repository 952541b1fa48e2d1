"""What code is given from outside: functions of higher packages, and values that hold for a block.

The root, which is imported before any other package, puts the functions here.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Concatenate, TypeVar

Value = TypeVar("Value")
QUIET: ContextVar[bool] = ContextVar("quiet", default=False)
"""Whether nothing but errors and results is said."""
UNITS_ROW: ContextVar[bool] = ContextVar("units_row", default=False)
"""Whether tables that are read have a row of units below their header."""
COMMAND: ContextVar[str | None] = ContextVar("command", default=None)
"""The command line, for the record of every run that the block makes, as a shell takes it; None in Python."""

html: Callable[[object], str] = repr
"""The HTML that a notebook shows of a value: `plotting.notebook`."""

attach_listed: Callable[[object], object]
"""Give a model the effects that its class lists: `effects.attach`."""

with_effect: Callable[Concatenate[Value, ...], Value]
"""A copy of a model with an effect: `effects.attach`."""


@contextmanager
def bound(variable: ContextVar[Value], value: Value) -> Iterator[None]:
    """Give a context variable a value for the block."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


class Displayed:
    """A value that a notebook shows as HTML."""

    def _repr_html_(self) -> str:
        return html(self)
