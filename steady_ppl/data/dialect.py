"""CSV as other programs write it. What is harmless is read, and told.

Harmless are a byte order mark, UTF-16, semicolons or tabs between columns, decimal commas between these, blanks around
column names, comment lines before the header, a separator at the end of every line, and a row of units that was
announced.
"""

import codecs
import csv
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow
import pyarrow.csv as arrow_csv

from steady_ppl.errors import DataError
from steady_ppl.utils.text import counted, shown

SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
COMMENTS = ("#", "%")  # signs with which a comment line begins
DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*")
EVERY_TABLE = {"trajectory", "time"}  # columns by which a header is known


@dataclass
class Dialect:
    """How a file is written."""

    is_utf_16: bool = False
    comments: int = 0  # lines before the header
    separator: str = ","
    has_last_separator: bool = False  # at the end of every row
    has_blanks: bool = False  # around column names
    units: str | None = None  # the row of them below the header
    has_decimal_commas: bool = False

    @property
    def notes(self) -> list[str]:
        """What was harmless, in words."""
        told = {
            "UTF-16": self.is_utf_16,
            f"{counted(self.comments, 'comment line')} before the header": self.comments,
            f"{SEPARATORS[self.separator]} between columns": self.separator != ",",
            "a separator at the end of every row": self.has_last_separator,
            "blanks around column names": self.has_blanks,
            f"a row of units ({self.units})": self.units is not None,
            "decimal commas": self.has_decimal_commas,
        }
        return [note for note, is_so in told.items() if is_so]

    @property
    def for_pandas(self) -> dict[str, Any]:
        """What pandas' reader must be told."""
        skipped = [*range(self.comments), *([self.comments + 1] if self.units is not None else [])]
        given = {
            "sep": self.separator != "," and self.separator,
            "decimal": self.has_decimal_commas and ",",
            "encoding": self.is_utf_16 and "utf-16",
            "skiprows": skipped,
        }
        return {name: value for name, value in given.items() if value} | (
            {"index_col": False} if self.has_last_separator else {}
        )


def read_csv(path: Path, units_row: bool | None = False) -> tuple[pd.DataFrame, Dialect]:
    """The cells of a file, as numbers where all are and else as text, under its column names; and how it is written.

    Args:
        units_row: the row below the header has units, and is left out; None: if it looks like one.

    Raises:
        DataError: rows of several lengths, or a row of units where none was announced, or none where one was.
        ValueError, csv.Error: no text, or quotes that are never closed.
    """
    dialect = Dialect()
    lines = _without_comments(_text(path.read_bytes(), dialect), dialect)
    dialect.separator = separator = _separator(lines)
    if separator == "," and not units_row and (plain := _plain(lines)) is not None:
        return plain, dialect
    # not pandas' reader: it fills up a row that was cut short and renames a column that appears twice
    cells = [row for row in csv.reader(io.StringIO(lines, newline=""), delimiter=separator, strict=True) if row]
    if not cells:
        raise DataError(f"{path.name}: the table is empty")
    header, *rows = cells
    header, rows = _without_last_separator(header, rows, dialect)
    stripped = [name.strip() for name in header]
    header, dialect.has_blanks = stripped, stripped != header
    for i, row in enumerate(rows):
        if len(row) != len(header):
            what = f"got {len(row)} cells, expected {len(header)} as in the header"
            raise DataError(f"{path.name}: row {i + 1}: {what}", row=i + 1)
    rows = _without_units(path.name, header, rows, units_row, dialect)
    if separator != "," and _has_decimal_commas(header, rows):
        rows = [_with_points(header, row) for row in rows]
        dialect.has_decimal_commas = True
    return pd.DataFrame(rows, columns=header, dtype=object), dialect


def _plain(text: str) -> pd.DataFrame | None:
    """A table of labels and finite numbers alone by Arrow's reader, which is twenty times as fast and rounds numbers as
    Python does; None where it may be more than that."""
    header = text.partition("\n")[0].rstrip("\r")
    names = header.split(",")
    is_usual = len(set(names)) == len(names) and all(name and name == name.strip() for name in names)
    if not is_usual or "trajectory" not in names or '"' in text or "\0" in text:
        return None
    types = {name: pyarrow.string() if name == "trajectory" else pyarrow.float64() for name in names}
    try:
        table = arrow_csv.read_csv(
            pyarrow.BufferReader(text.encode()),
            arrow_csv.ReadOptions(use_threads=False),
            arrow_csv.ParseOptions(quote_char=False, ignore_empty_lines=True),
            arrow_csv.ConvertOptions(column_types=types, null_values=["", "nan", "NaN"], strings_can_be_null=False),
        )
    except pyarrow.ArrowException:
        return None
    frame = table.to_pandas()
    numbers = [frame[name].to_numpy() for name in names if name != "trajectory"]
    return None if any(np.isinf(values).any() for values in numbers) else frame.astype({"trajectory": object})


def _text(content: bytes, dialect: Dialect) -> str:
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        dialect.is_utf_16 = True
        return content.decode("utf-16")
    return content.decode("utf-8-sig")


def _without_comments(text: str, dialect: Dialect) -> str:
    """The text from its first line that is neither blank nor a comment."""
    place = 0
    for line in io.StringIO(text, newline=""):
        if line.strip() and not line.lstrip().startswith(COMMENTS):
            break
        place += len(line)
        dialect.comments += bool(line.strip())
    return text[place:]


def _separator(text: str) -> str:
    """What separates the columns whose names every table has; a comma where none does."""
    first = text.partition("\n")[0]
    names = {sign: {name.strip().strip('"') for name in first.split(sign)} for sign in SEPARATORS}
    return next((sign for sign, there in names.items() if there >= EVERY_TABLE), ",")


def _without_last_separator(
    header: list[str], rows: list[list[str]], dialect: Dialect
) -> tuple[list[str], list[list[str]]]:
    """A table without the empty column that a separator at the end of every row makes."""
    count = len(header) - (not header[-1].strip())
    if len(header) > 1 and rows and all(len(row) == count + 1 and not row[-1].strip() for row in rows):
        dialect.has_last_separator = True
        return header[:count], [row[:count] for row in rows]
    return header, rows


def _without_units(
    name: str, header: Sequence[str], rows: list[list[str]], announced: bool | None, dialect: Dialect
) -> list[list[str]]:
    units = [cell.strip() for cell in rows[0]] if rows else []
    is_row_of_units = len(rows) > 1 and _is_text(header, units) and not _is_text(header, rows[1])
    if not is_row_of_units:
        if announced:
            raise DataError(f"{name}: row 1 has no units: leave --units-row (units_row=True) out", row=1)
        return rows
    said = shown(", ".join(units), 100)
    if announced is False:
        what = f"it looks like a row of units ({said}): read the table with --units-row (units_row=True)"
        raise DataError(f"{name}: row 1: {what}", row=1)
    dialect.units = said
    return rows[1:]


def _is_text(header: Sequence[str], cells: Sequence[str]) -> bool:
    """Whether no cell of a row is a number, but perhaps its label, and its time is text."""
    numbers = [cell for column, cell in zip(header, cells, strict=True) if column != "trajectory" and cell.strip()]
    times = [cell for column, cell in zip(header, cells, strict=True) if column == "time"]
    return any(cell.strip() for cell in times) and not any(map(_is_number, numbers))


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _with_points(header: Sequence[str], row: Sequence[str]) -> list[str]:
    return [cell if name == "trajectory" else cell.replace(",", ".") for name, cell in zip(header, row, strict=True)]


def _has_decimal_commas(header: Sequence[str], rows: Iterable[Sequence[str]]) -> bool:
    """Whether some number has a decimal comma and none a point."""
    found = False
    for row in rows:
        for column, cell in zip(header, row, strict=True):
            if column == "trajectory":
                continue
            if "." in cell:
                return False
            found = found or DECIMAL_COMMA.fullmatch(cell) is not None
    return found
