"""What can be wrong in a table: cells, times, labels, columns, how its text is written, and kinds of Parquet."""

from __future__ import annotations

import csv
import datetime
import decimal
import io
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import pyarrow
import pyarrow.parquet
from hypothesis import strategies as st
from mutants import Change, of_text, spelt

Rows = list[list[str]]  # the header first
RowChange = Callable[[st.DrawFn, Rows], Rows]

CELLS = (
    "nan", "inf", "-inf", "1e300", "-1e300", "1e308", "1e-320", "1e999", "-0", "", " ", "abc", "0x1p3", "1_000", "1,5",
    "true", "None", "12:30", "2024-01-01", "50%", "١٢", "½", "NaN(1)", "=1+1", "\0", "<b>1</b>", "\x1b[31m1", "9" * 400,
)  # fmt: skip
NAMES = (
    "y.<script>alert(1)</script>", "y.\x1b[2J", "y.../../etc/passwd", f"y.{'n' * 100_000}", "y.🚗", "y.\u202eabc", "y.",
    "u.", "x.", "y", "", "time", "trajectory", "y.a b", "y.a\nb", "y.%s%n{0}", "z.a", "Y.position", "u.nan", "x.None",
    "y.$\\frac{1}{0}$", "y.'; DROP TABLE t;--", "y.a\tb", "__index_level_0__",
)  # fmt: skip
LABELS = (*NAMES, "1.0", "nan", "-1", "1e5")
cells = st.sampled_from(CELLS) | st.floats().map(repr) | st.text(max_size=9)


def as_text(rows: Rows, quoting: int = csv.QUOTE_MINIMAL) -> str:
    """A table as CSV."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n", quoting=quoting).writerows(rows)
    return text.getvalue()


def in_rows(change: RowChange) -> Change:
    """A change of the rows of a CSV file."""
    return of_text(lambda draw, text: as_text(change(draw, list(csv.reader(io.StringIO(text, newline=""))))))


def _of(rows: Rows, kinds: str) -> list[int]:
    """Columns of some groups: controls, measurements, states, time; the first one where there is none."""
    found = [i for i, name in enumerate(rows[0]) if name[:1] in kinds and (name[1:2] == "." or name == "time")]
    return found or [0]


def _any(draw: st.DrawFn, count: int) -> int:
    return draw(st.integers(0, count - 1))


def _a_cell(draw: st.DrawFn, rows: Rows) -> Rows:
    row = rows[1 + _any(draw, len(rows) - 1)]
    row[_any(draw, len(row))] = draw(cells)
    return rows


def _cells(draw: st.DrawFn, rows: Rows) -> Rows:
    value, at = draw(cells), draw(st.sampled_from(_of(rows, "uyxt")))
    for i in draw(st.sets(st.integers(1, len(rows) - 1), min_size=1)):
        rows[i][at] = value
    return rows


def _numbers(kinds: str, *factors: float, offset: float = 0.0) -> RowChange:
    """All columns of a group times a factor."""

    def change(draw: st.DrawFn, rows: Rows) -> Rows:
        factor = draw(st.sampled_from(factors))
        for row in rows[1:]:
            for at in _of(rows, kinds):
                row[at] = _times(row[at], factor, offset)
        return rows

    return change


def _times(cell: str, factor: float, offset: float) -> str:
    try:
        return repr(float(cell) * factor + offset)
    except ValueError:
        return cell


def _filled(kinds: str, *values: str) -> RowChange:
    """A whole column of one value."""

    def change(draw: st.DrawFn, rows: Rows) -> Rows:
        value, at = draw(st.sampled_from(values)), draw(st.sampled_from(_of(rows, kinds)))
        return [rows[0], *([*row[:at], value, *row[at + 1 :]] for row in rows[1:])]

    return change


def _counted(rows: Rows) -> list[tuple[int, list[str]]]:
    """Every row with its number within its trajectory."""
    found, label, count = [], None, 0
    for row in rows[1:]:
        count = count + 1 if row[0] == label else 0
        label = row[0]
        found.append((count, row))
    return found


def _time(at: Callable[[int], float]) -> RowChange:
    """The time of every row of a trajectory by its number."""

    def change(draw: st.DrawFn, rows: Rows) -> Rows:
        column = rows[0].index("time")
        for count, row in _counted(rows):
            row[column] = repr(at(count))
        return rows

    return change


def _a_time(draw: st.DrawFn, rows: Rows) -> Rows:
    row, at = draw(st.integers(2, len(rows) - 1)), rows[0].index("time")
    rows[row][at] = _times(rows[row - 1][at], 1.0, draw(st.sampled_from((0.0, -1.0, 1e-12, 1e9, 1e300, math.nan))))
    return rows


def _kept(keep: Callable[[str, int], bool]) -> RowChange:
    """Only some rows, by label and number within the trajectory."""
    return lambda draw, rows: [rows[0], *(row for count, row in _counted(rows) if keep(row[0], count))]


def _a_name(draw: st.DrawFn, rows: Rows) -> Rows:
    rows[0][_any(draw, len(rows[0]))] = draw(st.sampled_from(NAMES) | st.text(max_size=9))
    return rows


def _a_label(draw: st.DrawFn, rows: Rows) -> Rows:
    old, new = rows[1 + _any(draw, len(rows) - 1)][0], draw(st.sampled_from(LABELS) | st.text(max_size=9))
    return [rows[0], *([new, *row[1:]] if row[0] == old else row for row in rows[1:])]


def _lost(draw: st.DrawFn, rows: Rows) -> Rows:
    at = _any(draw, len(rows[0]))
    return [[*row[:at], *row[at + 1 :]] for row in rows]


def _twice(draw: st.DrawFn, rows: Rows) -> Rows:
    at = _any(draw, len(rows[0]))
    return [[*row, row[at]] for row in rows]


def _swapped(draw: st.DrawFn, rows: Rows) -> Rows:
    a, b = (_any(draw, len(rows[0])) for _ in "ab")
    rows[0][a], rows[0][b] = rows[0][b], rows[0][a]
    return rows


def _cut(draw: st.DrawFn, rows: Rows) -> Rows:
    row = draw(st.sampled_from(rows))
    del row[_any(draw, len(row)) :]
    return rows


def _row_twice(draw: st.DrawFn, rows: Rows) -> Rows:
    at = _any(draw, len(rows))
    return [*rows[: at + 1], *rows[at:]]


def _more(draw: st.DrawFn, rows: Rows) -> Rows:
    return [[*row, *(f"{'' if i else 'y.more_'}{k}" for k in range(300))] for i, row in enumerate(rows)]


LOG: Mapping[str, RowChange] = {"a cell": _a_cell, "cells": _cells, "a column lost": _lost, "a row cut": _cut}
TIMES: Mapping[str, RowChange] = {
    "time since 1970": _numbers("t", 1.0, offset=1.7e9), "time in nanoseconds": _numbers("t", 1e9, offset=1.7e18),
    "time that stands": _time(lambda row: 0.0), "time that goes back": _time(lambda row: -0.1 * row),
    "time by 1e-300": _time(lambda row: 1e-300 * row), "time by 1e-9": _time(lambda row: 1e-9 * row),
    "time by 1e6": _time(lambda row: 1e6 * row), "time that explodes": _time(lambda row: 10.0 ** (30 * row)),
}  # fmt: skip
FEWER: Mapping[str, RowChange] = {
    "one row each": _kept(lambda label, count: count == 0), "two rows each": _kept(lambda label, count: count < 2),
    "one trajectory": _kept(lambda label, count: label == "1"),
    "one trajectory of one row": _kept(lambda label, count: label == "1" and count == 0),
    "one row of the last": _kept(lambda label, count: label != "10" or count == 0),
    "only the header": lambda draw, rows: rows[:1], "no header": lambda draw, rows: rows[1:],
}  # fmt: skip
ROWS: Mapping[str, RowChange] = {
    **LOG, **TIMES, **FEWER, "a time": _a_time, "a column's name": _a_name, "a label": _a_label,
    "columns swapped": _swapped, "a row twice": _row_twice, "a column twice": _twice, "300 columns more": _more,
    "rows shuffled": lambda draw, rows: [rows[0], *draw(st.permutations(rows[1:]))],
    "200 trajectories of two rows": lambda draw, rows: [
        rows[0], *([f"{n}", *row[1:]] for n in range(200) for row in rows[1:3])
    ],
    "constant measurement": _filled("y", "0.5"), "constant control": _filled("u", "0"),
    "no control": _filled("u", ""), "no measurement": _filled("y", ""), "no state": _filled("x", ""),
    "measurements scaled": _numbers("y", 0.0, 180 / math.pi, 1e20, 1e300, 1e-300),
    "controls scaled": _numbers("u", 1e20, 1e300), "states scaled": _numbers("x", 180 / math.pi, 1e300),
}  # fmt: skip


def _two(draw: st.DrawFn, rows: Rows) -> Rows:
    """One change after another; where the second finds nothing to change, the first alone."""
    first, second = (ROWS[draw(st.sampled_from(sorted(ROWS)))] for _ in "ab")
    rows = first(draw, rows)
    if len(rows) > 2:
        with suppress(IndexError, ValueError):
            rows = second(draw, rows)
    return rows


SPELT: Mapping[str, Change] = {
    "semicolons and decimal commas": spelt(lambda text: text.replace(",", ";").replace(".", ",")),
    "semicolons": spelt(lambda text: text.replace(",", ";")), "tabs": spelt(lambda text: text.replace(",", "\t")),
    "a byte order mark": spelt(lambda text: "\ufeff" + text),
    "two byte order marks": spelt(lambda text: "\ufeff\ufeff" + text),
    "CRLF": spelt(lambda text: text.replace("\n", "\r\n")),
    "CR alone": spelt(lambda text: text.replace("\n", "\r")),
    "Latin 1": spelt(lambda text: text.replace("time", "zeït").encode("latin-1")),
    "an open quote": spelt(lambda text: text.replace("\n", '\n"', 1)),
    "quotes around all": spelt(lambda text: as_text(list(csv.reader(text.splitlines())), csv.QUOTE_ALL)),
    "empty lines": spelt(lambda text: text.replace("\n", "\n\n")),
    "commas at the end": spelt(lambda text: text.replace("\n", ",\n")),
    "a cell of a megabyte": spelt(lambda text: text.replace("\n", "\n" + "1" * 1_000_000, 1)),
    "a line of ten megabytes": spelt(lambda text: "," * 10_000_000 + "\n" + text),
    "no last line end": spelt(lambda text: text.rstrip("\n")),
    "a comment first": spelt(lambda text: "# made by hand\n" + text),
}  # fmt: skip
TABLE: Mapping[str, Change] = {name: in_rows(change) for name, change in (ROWS | {"two at once": _two}).items()} | SPELT
LOGS: Mapping[str, Change] = {name: in_rows(change) for name, change in LOG.items()} | SPELT

DAY, SECOND = datetime.datetime(2024, 1, 1), datetime.timedelta(seconds=1)
VALUES: Mapping[str, Callable[[int], Any]] = {
    "booleans": lambda i: i % 2 == 0, "whole numbers": lambda i: i, "whole numbers of 64 bits": lambda i: 2**63 - 1 - i,
    "text": str, "words": lambda i: "word", "bytes": lambda i: b"\xff\x00", "times of day": lambda i: DAY + i * SECOND,
    "durations": lambda i: i * SECOND, "dates": lambda i: DAY.date(), "decimals": lambda i: decimal.Decimal(i) / 8,
    "lists": lambda i: [1.0, 2.0], "empty lists": lambda i: [], "structs": lambda i: {"a": 1.0},
    "infinity": lambda i: math.inf, "nothing": lambda i: None, "half nothing": lambda i: None if i % 2 else float(i),
    "complex as text": lambda i: "1+2j",
}  # fmt: skip
ARRAYS: Mapping[str, Callable[[int], pyarrow.Array]] = {
    **{name: lambda n, make=make: pyarrow.array(map(make, range(n))) for name, make in VALUES.items()},
    "half precision": lambda n: pyarrow.array([float(i) for i in range(n)], pyarrow.float16()),
    "categories": lambda n: pyarrow.array([str(i % 3) for i in range(n)]).dictionary_encode(),
}


def _columns(change: Callable[[st.DrawFn, pyarrow.Table], pyarrow.Table]) -> Change:
    def changed(draw: st.DrawFn, content: bytes) -> bytes:
        table, now = pyarrow.parquet.read_table(io.BytesIO(content)), io.BytesIO()
        pyarrow.parquet.write_table(change(draw, table), now)
        return now.getvalue()

    return changed


def _another(make: Callable[[int], pyarrow.Array]) -> Change:
    """One column, labels and time included, becomes one of another kind."""

    def change(draw: st.DrawFn, table: pyarrow.Table) -> pyarrow.Table:
        at = _any(draw, table.num_columns)
        return table.set_column(at, table.column_names[at], make(table.num_rows))

    return _columns(change)


def _renamed(rename: Callable[[list[str]], list[str]]) -> Change:
    return _columns(lambda draw, table: table.rename_columns(rename(table.column_names)))


PARQUET: Mapping[str, Change] = {
    **{name: _another(make) for name, make in ARRAYS.items()},
    "no rows": _columns(lambda draw, table: table.slice(0, 0)),
    "no columns": _columns(lambda draw, table: table.select([])),
    "columns twice": _renamed(lambda names: ["trajectory", *["time"] * (len(names) - 1)]),
    "odd names": _renamed(lambda names: [f"y.\0{i}\n<b>" for i in range(len(names))]),
    "an index of pandas": _columns(lambda draw, table: table.append_column("__index_level_0__", table.column(1))),
    "a column named index only": _renamed(lambda names: ["__index_level_0__", *names[1:]]),
}
