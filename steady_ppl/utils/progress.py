"""How far a computation has come. Computations say where they are; who wants to know listens.

with stages(("smoothing", 1), ("simulating", 3)) as begin:   # names and their shares of the time
    begin(); …
    begin(); …                                               # stages inside a stage divide its share
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace

from steady_ppl.utils.context import bound

Listener = Callable[[str, float], None]


@dataclass(frozen=True)
class _Stage:
    """Where the computation is: what it does, which part of the whole that is, and whether it is in a stage."""

    listener: Listener
    doing: str = ""
    first: float = 0.0
    last: float = 1.0
    inside: bool = False


_stage: ContextVar[_Stage | None] = ContextVar("stage", default=None)


def listening(listener: Listener) -> AbstractContextManager[None]:
    """Tell `listener` what is begun and which share of the whole is done, whenever a stage begins; at the end of the
    outermost ones it hears no name and a share of 1."""
    return bound(_stage, _Stage(listener))


def unheard() -> AbstractContextManager[None]:
    """Let the block tell nobody how far it has come."""
    return bound(_stage, None)


@contextmanager
def stages(*named: tuple[str, float]) -> Iterator[Callable[[], None]]:
    """Divide what is going on into stages, one after another: what each does, and how long it takes relative to the
    others. Yields what is to be called as each begins."""
    outer = _stage.get()
    total, done, remaining = sum(share for _, share in named), 0.0, iter(named)

    def begin() -> None:
        nonlocal done
        doing, share = next(remaining)
        if outer is None:
            return
        width = (outer.last - outer.first) / total
        first, last = outer.first + done * width, outer.first + (done + share) * width
        done += share
        said = ": ".join(part for part in (outer.doing, doing) if part)
        _stage.set(replace(outer, doing=said, first=first, last=last, inside=True))
        outer.listener(said, first)

    try:
        yield begin
    finally:
        if outer is not None:
            _stage.set(outer)
            if not outer.inside:
                outer.listener("", 1.0)
