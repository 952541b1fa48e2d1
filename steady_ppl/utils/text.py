"""Text for a terminal, which obeys what is written to it."""

import sys
import unicodedata
from collections.abc import Callable, Collection, Sequence

from steady_ppl.errors import SteadyError
from steady_ppl.utils.context import QUIET

# what moves the cursor, colours, renames the window, turns lines round, is not seen, or cannot be written at all
INVISIBLE = ("Cc", "Cf", "Cs", "Zl", "Zp")  # categories of Unicode: control, format, half of a pair, line separators
Say = Callable[[str], None]  # tells a person one line
TEXT_WIDTH = 100  # characters of a line in the text of a result
MAX_LINE_LENGTH = 1000  # characters of a line that is said; a file that somebody gives can put more into it


def printable(text: str, kept: str = "\t\n") -> str:
    r"""The text with what is not seen spelt out, but for the characters that are `kept`.

    Example:
        >>> printable("drive \x1b[2J")
        'drive \\x1b[2J'
    """
    if text.isprintable():
        return text
    return "".join(
        char.encode("unicode_escape").decode() if unicodedata.category(char) in INVISIBLE and char not in kept else char
        for char in text
    )


def tell(text: object, *, end: str = "\n", aside: bool = False) -> None:
    """Print for a person or a pipe; `aside` goes to stderr. Everything that a command prints goes through here."""
    print(printable(str(text)), end=end, file=sys.stderr if aside else sys.stdout, flush=True)


def shown(text: str, most: int | None = None) -> str:
    """What somebody's file says, fit for one line of a terminal: what is not seen as escapes, cut where it is too long.

    Example:
        >>> shown("drive\\x1b[2J", most=40)
        'drive\\\\x1b[2J'
    """
    return printable(text if most is None or len(text) <= most else f"{text[: most - 1]}…", kept="")


def one_line(error: BaseException) -> str:
    """An error's type and the first line of its message."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def reason_of(error: Exception) -> str:
    """What went wrong: our own message, or the kind and first line of a fault that nobody foresaw."""
    return str(error) if isinstance(error, SteadyError) else one_line(error)


def say(*remarks: str, always: bool = False) -> None:
    """Words to the person, beside what a script reads; errors are said `always`."""
    for remark in remarks if always or not QUIET.get() else ():
        lines = [shown(part, MAX_LINE_LENGTH) for part in remark.splitlines()]
        tell("\n".join([f"steady: {part}" for part in lines[:1]] + lines[1:]), aside=True)


def counted(count: int, noun: str) -> str:
    """How many there are of something whose plural ends in s."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def figure(value: float | None, form: str) -> str:
    """A figure as text, a dash where there is none."""
    return "–" if value is None else f"{value:{form}}"


def with_unit(name: str, unit: str | None) -> str:
    """A name as it is written at an axis or over a column."""
    return f"{name} [{unit}]" if unit else name


def aligned(rows: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> list[str]:
    """Rows of cells as lines of equal columns, which are flush right but for those that are `left`.

    Example:
        >>> aligned([["", "log p(y)"], ["before", "9.5"]])
        ['        log p(y)', 'before       9.5']
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    cells = [f"{{:{'<' if index in left else '>'}{width}}}" for index, width in enumerate(widths)]
    return ["  ".join(cells).format(*row).rstrip() for row in rows]
