"""What is suspicious in a table, before anything is fitted, and the line that mends it.

It rests on the table alone, and on the units and the step of a program where one is given.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from steady_ppl.data.frozen_sensors import frozen_stretches
from steady_ppl.data.suspicions import LOOKS, Array, Columns, Suspicion
from steady_ppl.data.table import from_frame, parse_cells, read_cells, to_frame
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError
from steady_ppl.utils.context import UNITS_ROW, Displayed
from steady_ppl.utils.text import shown


@dataclass(frozen=True)
class Examination(Displayed):
    """What is suspicious in a table."""

    name: str
    rows: int
    trajectories: int
    findings: list[Suspicion]
    dialect: list[str] = field(default_factory=list)  # how the file was written, which did no harm

    def __str__(self) -> str:
        count = len(self.findings)
        found = "nothing is suspicious" if not count else f"{count} finding{'s' if count > 1 else ''}"
        lines = [f"{self.name}: {self.trajectories} trajectories, {self.rows} rows; {found}."]
        lines += [f"Read with {', '.join(self.dialect)}."] if self.dialect else []
        for number, one in enumerate(self.findings, 1):
            lines += ["", f"{number}. {one}", f"   {one.mend}"]
        if any(one.mend.startswith("table") for one in self.findings):
            read = "table = pd.read_parquet" if self.name.endswith(".parquet") else "table = pd.read_csv"
            lines += ["", f"The lines that begin with “table” are for pandas: {read}({self.name!r}) first."]
        return "\n".join(lines)

    @property
    def figures(self) -> dict[str, object]:
        """Everything as a plain dict, ready for JSON."""
        found = [
            {
                "kind": one.kind,
                "column": one.column,
                "trajectories": list(one.trajectories),
                "cells": one.cells,
                "why": one.why,
                "mend": one.mend,
            }
            for one in self.findings
        ]
        shape = {"table": self.name, "rows": self.rows, "trajectories": self.trajectories}
        return {**shape, "dialect": self.dialect, "findings": found}


def examine(
    table: str | Path | pd.DataFrame | Trajectories,
    units: Mapping[str, str] | None = None,
    step: float | None = None,
) -> Examination:
    """Look for what is suspicious in a table: a `.csv` or `.parquet` file, a frame, or what was read.

    Args:
        units: of columns such as `y.compass`, as a program reads them; of others their names say what is an angle.
        step: of a program, s.

    Raises:
        DataError: the file cannot be read, or has other columns.
    """
    dialect, name = list[str](), "table"
    if isinstance(table, Trajectories):
        frame = to_frame(table)
    elif isinstance(table, pd.DataFrame):
        frame = table
    else:
        name = Path(table).name
        frame, dialect = read_cells(Path(table), UNITS_ROW.get() or None)
    numbers, findings = _numbers(frame, name, units or {}, step)
    is_whole = not findings
    for look in LOOKS:
        findings += look(numbers)
    if is_whole and not any(one.kind in ("one row", "apart", "time") for one in findings):
        findings += _frozen(table if isinstance(table, Trajectories) else from_frame(frame, name))
    unit_row = next((one for one in dialect if one.startswith("a row of units")), None)
    if unit_row is not None and not UNITS_ROW.get():
        findings.insert(0, Suspicion("units row", None, (), 1, f"row 1 is {unit_row}", "read it with --units-row"))
    return Examination(name, len(frame), len(set(numbers.labels)), findings, dialect)


def _numbers(
    frame: pd.DataFrame, name: str, units: Mapping[str, str], step: float | None
) -> tuple[Columns, list[Suspicion]]:
    """The cells as numbers, and which are none."""
    for required in ("trajectory", "time"):
        if required not in frame.columns:
            raise DataError(f"{name}: column {required}: this column is missing", column=required)
    labels = frame["trajectory"].astype(str).to_numpy()
    starts = np.append(True, labels[1:] != labels[:-1])
    run, findings, values = starts.cumsum() - 1, list[Suspicion](), dict[str, Array]()
    for column in map(str, frame.columns):
        if column == "trajectory":
            continue
        found, bad = parse_cells(frame[column])
        if column == "time" and bad.any():
            dates = pd.to_datetime(frame[column], errors="coerce", utc=True, format="ISO8601")
            if dates.notna().mean() > 0.9:
                found, bad = dates.astype("int64").to_numpy() / 1e9, np.zeros_like(bad)
                why = f"times are dates such as {frame[column].iloc[0]}, expected seconds"
                mend = 'table["time"] = pd.to_datetime(table["time"], utc=True).astype("int64") / 1e9'
                findings.append(Suspicion("dates", "time", (), len(frame), why, mend))
        if bad.any():
            row = int(bad.argmax())
            cell = shown(str(frame[column].iloc[row]), 40)
            why = f"{int(bad.sum())} cells are no numbers, the first is {cell!r} in row {row + 1}"
            mend = f'table["{column}"] = pd.to_numeric(table["{column}"], errors="coerce")'
            findings.append(Suspicion("text", column, tuple(dict.fromkeys(labels[bad])), int(bad.sum()), why, mend))
        values[column] = np.where(bad | ~np.isfinite(found), np.nan, found)
    time = values.pop("time")
    return Columns(list(labels[starts]), run, time, values, units, step), findings


def _frozen(data: Trajectories) -> Iterator[Suspicion]:
    """Stretches in which a measurement hung, or a gap was interpolated."""
    stretches = frozen_stretches(data)
    columns = dict.fromkeys(name for one in stretches for name in one.columns if name.startswith("y."))
    for column in columns:
        there = [one for one in stretches if column in one.columns]
        cells = sum(one.rows[1] - one.rows[0] + 1 for one in there)
        begin, end = there[0].seconds
        why = f"{cells} cells lie on straight lines, first from {begin:.2f} to {end:.2f} s"
        why += ": the sensor hung, or gaps were interpolated"
        mend = "steady check RUN TABLE --mask CLEAN.csv leaves out what nobody measured"
        yield Suspicion("frozen", column, tuple(dict.fromkeys(one.label for one in there)), cells, why, mend)
