"""What holds for a block: that only results are wanted, and the command line, for a run's record."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Value = TypeVar("Value")
QUIET: ContextVar[bool] = ContextVar("quiet", default=False)
"""Whether nothing but errors and results is said."""
COMMAND: ContextVar[str | None] = ContextVar("command", default=None)
"""The command line, for the record of every run that the block makes, as a shell takes it; None in Python."""


@contextmanager
def bound(variable: ContextVar[Value], value: Value) -> Iterator[None]:
    """Give a context variable a value for the block."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)
