"""What holds for a block: that only results are wanted, and the command line, for a run's record."""

import shlex
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from typing import TypeVar

Value = TypeVar("Value")
_quiet: ContextVar[bool] = ContextVar("quiet", default=False)
_command: ContextVar[str | None] = ContextVar("command", default=None)


@contextmanager
def bound(variable: ContextVar[Value], value: Value) -> Iterator[None]:
    """Give a context variable a value for the block."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


def quietly(quiet: bool) -> AbstractContextManager[None]:
    """Say nothing but errors and results, if asked for."""
    return bound(_quiet, quiet)


def is_quiet() -> bool:
    """Whether only errors and results are wanted."""
    return _quiet.get()


def commanded(words: Sequence[str]) -> AbstractContextManager[None]:
    """Let the record of every run that the block makes say which command line made it."""
    return bound(_command, shlex.join(words))


def command_line() -> str | None:
    """The words of it as a shell takes them; None in Python."""
    return _command.get()
