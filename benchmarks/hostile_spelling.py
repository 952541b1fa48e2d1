"""How the text of a table can be written otherwise: separators, encodings, line ends, quotes."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random

from hostile_bytes import Spoil
from hostile_tables import as_text


def _spelt(spell: Callable[[str], bytes]) -> Spoil:
    def spoil(file: Path, dice: Random) -> None:
        file.write_bytes(spell(file.read_text()))

    return spoil


SPELT: Mapping[str, Spoil] = {
    "semicolons and decimal commas": _spelt(lambda text: text.replace(",", ";").replace(".", ",").encode()),
    "semicolons": _spelt(lambda text: text.replace(",", ";").encode()),
    "tabs": _spelt(lambda text: text.replace(",", "\t").encode()),
    "a byte order mark": _spelt(lambda text: b"\xef\xbb\xbf" + text.encode()),
    "two byte order marks": _spelt(lambda text: b"\xef\xbb\xbf" * 2 + text.encode()),
    "CRLF": _spelt(lambda text: text.replace("\n", "\r\n").encode()),
    "CR alone": _spelt(lambda text: text.replace("\n", "\r").encode()),
    "Latin 1": _spelt(lambda text: text.replace("time", "zeït").encode("latin-1")),
    "an open quote": _spelt(lambda text: text.replace("\n", '\n"', 1).encode()),
    "quotes around all": _spelt(
        lambda text: as_text(list(csv.reader(text.splitlines())), quoting=csv.QUOTE_ALL).encode()
    ),
    "empty lines": _spelt(lambda text: text.replace("\n", "\n\n").encode()),
    "commas at the end": _spelt(lambda text: text.replace("\n", ",\n").encode()),
    "a cell of a megabyte": _spelt(lambda text: text.replace("\n", "\n" + "1" * 1_000_000, 1).encode()),
    "a line of ten megabytes": _spelt(lambda text: ("," * 10_000_000 + "\n" + text).encode()),
    "no last line end": _spelt(lambda text: text.rstrip("\n").encode()),
    "a comment first": _spelt(lambda text: ("# made by hand\n" + text).encode()),
}
