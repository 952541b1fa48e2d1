"""What can be wrong in a table: cells, times, labels, columns, and how its text is written.

A change takes the rows of a good table, its header first, all as text, and returns other rows, or the file's text.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random

from hostile_bytes import Spoil

Rows = list[list[str]]
Change = Callable[[Rows, Random], Rows]

CELLS = (
    *(
        "nan",
        "inf",
        "-inf",
        "1e300",
        "-1e300",
        "1e308",
        "1e-320",
        "1e999",
        "-0",
        "",
        " ",
        "abc",
        "0x1p3",
        "1_000",
        "1,5",
    ),
    *(
        "true",
        "None",
        "12:30",
        "2024-01-01",
        "50%",
        "١٢",
        "½",
        "NaN(1)",
        "=1+1",
        "\0",
        "<b>1</b>",
        "\x1b[31m1",
        "9" * 400,
    ),
)
NAMES = (
    *("y.<script>alert(1)</script>", "y.\x1b[2J", "y.../../etc/passwd", "y." + "n" * 100_000, "y.🚗", "y.\u202eabc"),
    *(
        "y.",
        "u.",
        "x.",
        "y",
        "",
        "time",
        "trajectory",
        "y.a b",
        "y.a\nb",
        "y.%s%n{0}",
        "z.a",
        "Y.position",
        "y.$\\frac{1}{0}$",
    ),
    *("y.'; DROP TABLE t;--", "u.nan", "x.None", "y.a\tb", "__index_level_0__"),
)


def _column(rows: Rows, dice: Random, kinds: str = "uyxt") -> int:
    """Any column of some groups: controls, measurements, states, time."""
    fit = [i for i, name in enumerate(rows[0]) if name[:1] in kinds and (name[1:2] == "." or name == "time")]
    return dice.choice(fit or [0])


def _filled(value: str, kinds: str) -> Change:
    """A whole column of one value."""

    def change(rows: Rows, dice: Random) -> Rows:
        at = _column(rows, dice, kinds)
        return [rows[0], *([*row[:at], value, *row[at + 1 :]] for row in rows[1:])]

    return change


def _one_cell(rows: Rows, dice: Random) -> Rows:
    row = dice.choice(rows[1:])
    row[dice.randrange(len(row))] = dice.choice(CELLS)
    return rows


def _many_cells(rows: Rows, dice: Random) -> Rows:
    value, at = dice.choice(CELLS), _column(rows, dice)
    for row in rows[1:]:
        if dice.random() < 0.5:
            row[at] = value
    return rows


def _scaled(factor: float, kinds: str, offset: float = 0.0) -> Change:
    """All columns of a group times a factor."""

    def change(rows: Rows, dice: Random) -> Rows:
        for at, name in enumerate(rows[0]):
            if name[:1] in kinds and (name[1:2] == "." or name == "time"):
                for row in rows[1:]:
                    row[at] = _times(row[at], factor, offset)
        return rows

    return change


def _times(cell: str, factor: float, offset: float) -> str:
    try:
        return repr(float(cell) * factor + offset)
    except ValueError:
        return cell


def _time(at: Callable[[int], float]) -> Change:
    """The time of every row of a trajectory by its number."""

    def change(rows: Rows, dice: Random) -> Rows:
        column, label, count = rows[0].index("time"), "", 0
        for row in rows[1:]:
            count = count + 1 if row[0] == label else 0
            label, row[column] = row[0], repr(at(count))
        return rows

    return change


def _one_time(rows: Rows, dice: Random) -> Rows:
    row, at = dice.randrange(2, len(rows)), rows[0].index("time")
    rows[row][at] = _times(rows[row - 1][at], 1.0, dice.choice((0.0, -1.0, 1e-12, 1e9, 1e300, math.nan)))
    return rows


def _kept(keep: Callable[[str, int], bool]) -> Change:
    """Only some rows, by label and number within the trajectory."""

    def change(rows: Rows, dice: Random) -> Rows:
        found, label, count = [rows[0]], "", 0
        for row in rows[1:]:
            count = count + 1 if row[0] == label else 0
            label = row[0]
            if keep(label, count):
                found.append(row)
        return found

    return change


def _shuffled(rows: Rows, dice: Random) -> Rows:
    body = rows[1:]
    dice.shuffle(body)
    return [rows[0], *body]


def _named(rows: Rows, dice: Random) -> Rows:
    rows[0][dice.randrange(len(rows[0]))] = dice.choice(NAMES)
    return rows


def _labelled(rows: Rows, dice: Random) -> Rows:
    old, new = dice.choice(rows[1:])[0], dice.choice([*NAMES, "", "1.0", "nan", "-1", "1e5"])
    return [rows[0], *([new, *row[1:]] if row[0] == old else row for row in rows[1:])]


def _lost_column(rows: Rows, dice: Random) -> Rows:
    at = dice.randrange(len(rows[0]))
    return [[*row[:at], *row[at + 1 :]] for row in rows]


def _twice_column(rows: Rows, dice: Random) -> Rows:
    at = dice.randrange(len(rows[0]))
    return [[*row, row[at]] for row in rows]


def _more_columns(rows: Rows, dice: Random) -> Rows:
    return [[*row, *(f"{'y.more_' if i == 0 else ''}{k}" for k in range(300))] for i, row in enumerate(rows)]


def _swapped_columns(rows: Rows, dice: Random) -> Rows:
    a, b = (dice.randrange(len(rows[0])) for _ in "ab")
    rows[0][a], rows[0][b] = rows[0][b], rows[0][a]
    return rows


def _cut_row(rows: Rows, dice: Random) -> Rows:
    row = dice.choice(rows)
    del row[dice.randrange(len(row)) :]
    return rows


def _twice_row(rows: Rows, dice: Random) -> Rows:
    at = dice.randrange(len(rows))
    return [*rows[: at + 1], *rows[at:]]


def _many_short(rows: Rows, dice: Random) -> Rows:
    """Two hundred trajectories of two rows."""
    return [rows[0], *([f"{n}", *row[1:]] for n in range(200) for row in rows[1:3])]


CHANGES: Mapping[str, Change] = {
    "a cell": _one_cell,
    "cells": _many_cells,
    "a time": _one_time,
    "a column's name": _named,
    "a label": _labelled,
    "a column lost": _lost_column,
    "columns swapped": _swapped_columns,
    "a row cut": _cut_row,
    "a row twice": _twice_row,
}
"""Several mutants of each make sense, and of two at once."""

ONCE: Mapping[str, Change] = {
    "rows shuffled": _shuffled,
    "a column twice": _twice_column,
    "300 columns more": _more_columns,
    "200 trajectories of two rows": _many_short,
    "constant measurement": _filled("0.5", "y"),
    "constant control": _filled("0", "u"),
    "no control": _filled("", "u"),
    "no measurement": _filled("", "y"),
    "no state": _filled("", "x"),
    "measurements zero": _scaled(0.0, "y"),
    "measurements in degrees": _scaled(180 / math.pi, "y"),
    "measurements huge": _scaled(1e300, "y"),
    "measurements large": _scaled(1e20, "y"),
    "measurements tiny": _scaled(1e-300, "y"),
    "controls huge": _scaled(1e300, "u"),
    "controls large": _scaled(1e20, "u"),
    "states huge": _scaled(1e300, "x"),
    "states in degrees": _scaled(180 / math.pi, "x"),
    "time since 1970": _scaled(1.0, "t", 1.7e9),
    "time in nanoseconds": _scaled(1e9, "t", 1.7e18),
    "time that stands": _time(lambda row: 0.0),
    "time that goes back": _time(lambda row: -0.1 * row),
    "time by 1e-300": _time(lambda row: 1e-300 * row),
    "time by 1e-9": _time(lambda row: 1e-9 * row),
    "time by 1e6": _time(lambda row: 1e6 * row),
    "time that explodes": _time(lambda row: 10.0 ** (30 * row)),
    "one row each": _kept(lambda label, count: count == 0),
    "two rows each": _kept(lambda label, count: count < 2),
    "one trajectory": _kept(lambda label, count: label == "1"),
    "one trajectory of one row": _kept(lambda label, count: label == "1" and count == 0),
    "one row of the last": _kept(lambda label, count: label != "10" or count == 0),
    "only the header": _kept(lambda label, count: False),
    "no header": lambda rows, dice: rows[1:],
}


def as_text(rows: Rows, quoting: int = csv.QUOTE_MINIMAL) -> str:
    """A table as CSV."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n", quoting=quoting).writerows(rows)
    return text.getvalue()


def in_table(change: Change) -> Spoil:
    """What spoils a CSV file so."""

    def spoil(file: Path, dice: Random) -> None:
        with file.open(newline="") as text:
            rows = list(csv.reader(text))
        file.write_text(as_text(change(rows, dice)), newline="")

    return spoil


def two(first: Change, second: Change) -> Change:
    """One change after another; nothing to change is left as it is."""
    return lambda rows, dice: second(done, dice) if len(done := first(rows, dice)) > 2 else done
