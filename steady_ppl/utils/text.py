"""Text for a terminal: names come from tables, bags and run folders, and a terminal obeys what is written to it."""

from __future__ import annotations

import sys
import unicodedata

# what moves the cursor, colours, renames the window, turns lines round, is not seen, or cannot be written at all
UNSEEN = ("Cc", "Cf", "Cs", "Zl", "Zp")  # categories of Unicode: control, format, half of a pair, line separators


def harmless(text: str, kept: str = "\t\n") -> str:
    r"""The text with what is not seen spelt out, but for the characters that are `kept`.

    Example:
        >>> harmless("drive \x1b[2J")
        'drive \\x1b[2J'
    """
    if text.isprintable():
        return text
    return "".join(
        char.encode("unicode_escape").decode() if unicodedata.category(char) in UNSEEN and char not in kept else char
        for char in text
    )


def tell(text: object, *, end: str = "\n", aside: bool = False) -> None:
    """Print for a person or a pipe; `aside` goes to stderr. Everything that a command prints goes through here."""
    print(harmless(str(text)), end=end, file=sys.stderr if aside else sys.stdout, flush=True)


def shown(text: str, most: int | None = None) -> str:
    """What somebody's file says, fit for one line of a terminal: what is not seen as escapes, cut where it is too long.

    Example:
        >>> shown("drive\\x1b[2J", most=40)
        'drive\\\\x1b[2J'
    """
    return harmless(text if most is None or len(text) <= most else f"{text[: most - 1]}…", kept="")


def one_line(error: BaseException) -> str:
    """An error's type and the first line of its message."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
