"""Text for a terminal: names come from tables, bags and run folders, and a terminal obeys what is written to it."""

from __future__ import annotations

import re
import sys

# what moves the cursor, colours, renames the window, turns lines round, or cannot be written at all
OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def harmless(text: str) -> str:
    r"""The text with control characters but tabs and ends of lines spelt out.

    Example:
        >>> harmless("drive \x1b[2J")
        'drive \\x1b[2J'
    """
    return OBEYED.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def tell(text: object, *, end: str = "\n", aside: bool = False) -> None:
    """Print for a person or a pipe; `aside` goes to stderr. Everything that a command prints goes through here."""
    print(harmless(str(text)), end=end, file=sys.stderr if aside else sys.stdout, flush=True)
