"""The command line that a run is made by, for its record."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

_command: ContextVar[str | None] = ContextVar("command", default=None)


@contextmanager
def commanded(words: Sequence[str]) -> Iterator[None]:
    """Let the record of every run that the block makes say which command line made it."""
    token = _command.set(shlex.join(words))
    try:
        yield
    finally:
        _command.reset(token)


def command_line() -> str | None:
    """The words of it as a shell takes them; None in Python."""
    return _command.get()
