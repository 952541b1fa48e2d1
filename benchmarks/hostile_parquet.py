"""What can be wrong in a Parquet file that pyarrow itself has written: kinds of columns that are no numbers."""

from __future__ import annotations

import datetime
import decimal
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random

import pyarrow
import pyarrow.parquet
from hostile_bytes import Spoil


def _kind(values: Callable[[int], pyarrow.Array]) -> Spoil:
    """One column, labels and time included, becomes one of another kind."""

    def spoil(file: Path, dice: Random) -> None:
        table = pyarrow.parquet.read_table(file)
        at = dice.randrange(table.num_columns)
        table = table.set_column(at, table.column_names[at], values(table.num_rows))
        pyarrow.parquet.write_table(table, file)

    return spoil


def _table(change: Callable[[pyarrow.Table], pyarrow.Table]) -> Spoil:
    def spoil(file: Path, dice: Random) -> None:
        pyarrow.parquet.write_table(change(pyarrow.parquet.read_table(file)), file)

    return spoil


DAY = datetime.datetime(2024, 1, 1)
KINDS: Mapping[str, Spoil] = {
    "booleans": _kind(lambda n: pyarrow.array([i % 2 == 0 for i in range(n)])),
    "whole numbers": _kind(lambda n: pyarrow.array(list(range(n)))),
    "whole numbers of 64 bits": _kind(lambda n: pyarrow.array([2**63 - 1 - i for i in range(n)])),
    "half precision": _kind(lambda n: pyarrow.array([float(i) for i in range(n)], pyarrow.float16())),
    "text": _kind(lambda n: pyarrow.array([str(i) for i in range(n)])),
    "words": _kind(lambda n: pyarrow.array(["word"] * n)),
    "bytes": _kind(lambda n: pyarrow.array([b"\xff\x00"] * n)),
    "times of day": _kind(lambda n: pyarrow.array([DAY + datetime.timedelta(seconds=i) for i in range(n)])),
    "durations": _kind(lambda n: pyarrow.array([datetime.timedelta(seconds=i) for i in range(n)])),
    "dates": _kind(lambda n: pyarrow.array([DAY.date()] * n)),
    "decimals": _kind(lambda n: pyarrow.array([decimal.Decimal(i) / 8 for i in range(n)])),
    "lists": _kind(lambda n: pyarrow.array([[1.0, 2.0]] * n)),
    "empty lists": _kind(lambda n: pyarrow.array([[]] * n, pyarrow.list_(pyarrow.float64()))),
    "structs": _kind(lambda n: pyarrow.array([{"a": 1.0}] * n)),
    "categories": _kind(lambda n: pyarrow.array([str(i % 3) for i in range(n)]).dictionary_encode()),
    "nothing": _kind(lambda n: pyarrow.nulls(n)),
    "half nothing": _kind(lambda n: pyarrow.array([None if i % 2 else float(i) for i in range(n)])),
    "infinity": _kind(lambda n: pyarrow.array([float("inf")] * n)),
    "complex as text": _kind(lambda n: pyarrow.array(["1+2j"] * n)),
}
ONCE: Mapping[str, Spoil] = {
    "no rows": _table(lambda table: table.slice(0, 0)),
    "no columns": _table(lambda table: table.select([])),
    "columns twice": _table(lambda table: table.rename_columns(["trajectory", *["time"] * (table.num_columns - 1)])),
    "odd names": _table(lambda table: table.rename_columns([f"y.\0{i}\n<b>" for i in range(table.num_columns)])),
    "an index of pandas": _table(lambda table: table.append_column("__index_level_0__", table.column(1))),
    "a column named index only": _table(
        lambda table: table.rename_columns(["__index_level_0__", *table.column_names[1:]])
    ),
}
