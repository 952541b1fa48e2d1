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

import pandas as pd
import pyarrow
import pyarrow.parquet
from hypothesis import strategies as st
from mutants import Change, of_a_line, of_text, spelt

Frame = pd.DataFrame  # of a CSV file's cells, as text
FrameChange = Callable[[st.DrawFn, Frame], Frame]

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


def in_frame(change: FrameChange) -> Change:
    """A change of the cells of a CSV file."""
    read = lambda text: pd.read_csv(io.StringIO(text), dtype=object, keep_default_na=False)  # noqa: E731
    return of_text(lambda draw, text: change(draw, read(text)).to_csv(index=False, lineterminator="\n"))


def _any(draw: st.DrawFn, count: int) -> int:
    return draw(st.integers(0, count - 1))


def _of(frame: Frame, kinds: str) -> list[int]:
    """Columns of some groups: controls, measurements, states, time; the first one where there is none."""
    names = enumerate(frame.columns)
    return [i for i, name in names if name[:1] in kinds and (name[1:2] == "." or name == "time")] or [0]


def _put(frame: Frame, rows: Any, columns: Any, value: Any) -> Frame:
    frame.iloc[rows, columns] = value
    return frame


def _filled(kinds: str, value: str) -> FrameChange:
    """A whole column of one value."""
    return lambda draw, frame: _put(frame, slice(None), draw(st.sampled_from(_of(frame, kinds))), value)


def _scaled(kinds: str, *factors: float, offset: float = 0.0) -> FrameChange:
    """All columns of a group times a factor."""

    def change(draw: st.DrawFn, frame: Frame) -> Frame:
        at, factor = _of(frame, kinds), draw(st.sampled_from(factors))
        return _put(frame, slice(None), at, frame.iloc[:, at].apply(pd.to_numeric, errors="coerce") * factor + offset)

    return change


def _counts(frame: Frame) -> pd.Series:
    """The number of every row within its trajectory."""
    return frame.iloc[:, 0].groupby(frame.iloc[:, 0]).cumcount()


def _time(at: Callable[[int], float]) -> FrameChange:
    """The time of every row of a trajectory by its number."""
    return lambda draw, frame: _put(frame, slice(None), _of(frame, "t")[0], _counts(frame).map(at))


def _a_time(draw: st.DrawFn, frame: Frame) -> Frame:
    row, at = draw(st.integers(1, len(frame) - 1)), _of(frame, "t")[0]
    later = draw(st.sampled_from((0.0, -1.0, 1e-12, 1e9, 1e300, math.nan)))
    return _put(frame, row, at, float(frame.iloc[row - 1, at]) + later)


def _named(draw: st.DrawFn, frame: Frame) -> Frame:
    names, at = list(frame.columns), _any(draw, frame.shape[1])
    return frame.set_axis([*names[:at], draw(st.sampled_from(NAMES) | st.text(max_size=9)), *names[at + 1 :]], axis=1)


def _swapped(draw: st.DrawFn, frame: Frame) -> Frame:
    names = list(frame.columns)
    a, b = (_any(draw, len(names)) for _ in "ab")
    names[a], names[b] = names[b], names[a]
    return frame.set_axis(names, axis=1)


def _labelled(draw: st.DrawFn, frame: Frame) -> Frame:
    labels = frame.iloc[:, 0]
    old, new = labels.iloc[_any(draw, len(labels))], draw(st.sampled_from(LABELS) | st.text(max_size=9))
    return _put(frame, slice(None), 0, labels.mask(labels == old, new))


def _lost(draw: st.DrawFn, frame: Frame) -> Frame:
    at = _any(draw, frame.shape[1])
    return frame.iloc[:, [i for i in range(frame.shape[1]) if i != at]]


def _row_twice(draw: st.DrawFn, frame: Frame) -> Frame:
    at = _any(draw, len(frame))
    return frame.iloc[[*range(at + 1), *range(at, len(frame))]]


def _short(draw: st.DrawFn, frame: Frame) -> Frame:
    return pd.concat([_put(frame.iloc[:2].copy(), slice(None), 0, f"{n}") for n in range(200)])


def _more(draw: st.DrawFn, frame: Frame) -> Frame:
    return pd.concat([frame, Frame("1", frame.index, [f"y.more_{i}" for i in range(300)])], axis=1)


LOG: Mapping[str, FrameChange] = {
    "a cell": lambda draw, frame: _put(frame, _any(draw, len(frame)), _any(draw, frame.shape[1]), draw(cells)),
    "cells": lambda draw, frame: _put(
        frame, draw(st.lists(st.integers(0, len(frame) - 1), min_size=1)), _any(draw, frame.shape[1]), draw(cells)
    ),
    "a column lost": _lost,
}  # fmt: skip
FRAMES: Mapping[str, FrameChange] = {
    **LOG, "a time": _a_time, "a column's name": _named, "a label": _labelled, "columns swapped": _swapped,
    "a row twice": _row_twice, "300 columns more": _more, "200 trajectories of two rows": _short,
    "rows shuffled": lambda draw, frame: frame.iloc[draw(st.permutations(range(len(frame))))],
    "a column twice": lambda draw, frame: pd.concat([frame, frame.iloc[:, _any(draw, frame.shape[1])]], axis=1),
    "constant measurement": _filled("y", "0.5"), "constant control": _filled("u", "0"),
    "no control": _filled("u", ""), "no measurement": _filled("y", ""), "no state": _filled("x", ""),
    "measurements scaled": _scaled("y", 0.0, 180 / math.pi, 1e20, 1e300, 1e-300),
    "controls scaled": _scaled("u", 1e20, 1e300), "states scaled": _scaled("x", 180 / math.pi, 1e300),
    "time since 1970": _scaled("t", 1.0, offset=1.7e9), "time in nanoseconds": _scaled("t", 1e9, offset=1.7e18),
    "time that stands": _time(lambda row: 0.0), "time that goes back": _time(lambda row: -0.1 * row),
    "time by 1e-300": _time(lambda row: 1e-300 * row), "time by 1e-9": _time(lambda row: 1e-9 * row),
    "time by 1e6": _time(lambda row: 1e6 * row), "time that explodes": _time(lambda row: 10.0 ** (30 * row)),
    "one row each": lambda draw, frame: frame[_counts(frame) == 0],
    "two rows each": lambda draw, frame: frame[_counts(frame) < 2],
    "one trajectory": lambda draw, frame: frame[frame.iloc[:, 0] == "1"],
    "one row of the last": lambda draw, frame: frame[(frame.iloc[:, 0] != "10") | (_counts(frame) == 0)],
    "one row": lambda draw, frame: frame[:1], "only the header": lambda draw, frame: frame[:0],
}  # fmt: skip


def _two(draw: st.DrawFn, frame: Frame) -> Frame:
    """One change after another; where the second finds nothing to change, the first alone."""
    first, second = (FRAMES[draw(st.sampled_from(sorted(FRAMES)))] for _ in "ab")
    frame = first(draw, frame)
    if len(frame) > 1:
        with suppress(IndexError, ValueError):
            return second(draw, frame.copy())
    return frame


def _quoted(text: str) -> str:
    return pd.read_csv(io.StringIO(text), dtype=object).to_csv(index=False, quoting=csv.QUOTE_ALL)


def _cut(draw: st.DrawFn, line: str) -> list[str]:
    """A row without its last cells."""
    here = line.split(",")
    return [",".join(here[: _any(draw, len(here))])]


SPELT: Mapping[str, Change] = {
    name: spelt(spell)
    for name, spell in {
        "semicolons and decimal commas": lambda text: text.replace(",", ";").replace(".", ","),
        "semicolons": lambda text: text.replace(",", ";"), "tabs": lambda text: text.replace(",", "\t"),
        "a byte order mark": lambda text: "\ufeff" + text, "two byte order marks": lambda text: "\ufeff\ufeff" + text,
        "CRLF": lambda text: text.replace("\n", "\r\n"), "CR alone": lambda text: text.replace("\n", "\r"),
        "Latin 1": lambda text: text.replace("time", "zeït").encode("latin-1"), "quotes around all": _quoted,
        "an open quote": lambda text: text.replace("\n", '\n"', 1), "no header": lambda text: text.partition("\n")[2],
        "empty lines": lambda text: text.replace("\n", "\n\n"), "no last line end": lambda text: text.rstrip("\n"),
        "commas at the end": lambda text: text.replace("\n", ",\n"),
        "a cell of a megabyte": lambda text: text.replace("\n", "\n" + "1" * 1_000_000, 1),
        "a line of ten megabytes": lambda text: "," * 10_000_000 + "\n" + text,
        "a comment first": lambda text: "# made by hand\n" + text,
    }.items()
} | {"a row cut": of_a_line(_cut)}  # fmt: skip
TABLE: Mapping[str, Change] = {n: in_frame(change) for n, change in {**FRAMES, "two at once": _two}.items()} | SPELT
LOGS: Mapping[str, Change] = {name: in_frame(change) for name, change in LOG.items()} | SPELT

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
