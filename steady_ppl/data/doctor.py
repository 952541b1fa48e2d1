"""What is suspicious in a table, before anything is fitted, and the line that mends it.

It rests on the table alone, and on the units and the step of a program where one is given.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from steady_ppl.data.dialect import Dialect
from steady_ppl.data.frozen_sensors import frozen_stretches
from steady_ppl.data.suspicions import LOOKS, Array, Columns, Suspicion, cell
from steady_ppl.data.table import fail, from_frame, labels_of, parse_cells, read_cells, to_frame
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError
from steady_ppl.utils.context import UNITS_ROW, Displayed
from steady_ppl.utils.text import counted, shown

OF_DATES = (
    'table["time"] = (pd.to_datetime(table["time"], utc=True, format="ISO8601") - pd.Timestamp(0, tz="UTC")) '
    "/ pd.Timedelta(seconds=1)"
)
REFUSED = ("one row", "apart", "time", "text", "dates", "infinite", "units row")  # kinds that the reader refuses
FEW_VALUES = 0.1  # of a column's cells, so few different values: it counts steps, or is coarse
MAX_SHOWN = 6  # findings on one screen


@dataclass(frozen=True)
class Examination(Displayed):
    """What is suspicious in a table."""

    name: str
    rows: int
    trajectories: int
    findings: list[Suspicion]
    dialect: Dialect = field(default_factory=Dialect)  # how the file was written, which did no harm

    def __str__(self) -> str:
        count = len(self.findings)
        found = "nothing is suspicious" if not count else counted(count, "finding")
        drives = "1 trajectory" if self.trajectories == 1 else f"{self.trajectories} trajectories"
        lines = [f"{self.name}: {drives}, {counted(self.rows, 'row')}; {found}."]
        lines += [f"Read with {', '.join(self.dialect.notes)}."] if self.dialect.notes else []
        for number, one in enumerate(self.findings[:MAX_SHOWN], 1):
            lines += ["", f"{number}. {one}", f"   {one.mend}"]
        if count > MAX_SHOWN:
            rest = (f"{one.kind} ({one.column})" if one.column else one.kind for one in self.findings[MAX_SHOWN:])
            told = shown(", ".join(dict.fromkeys(rest)), 200)
            lines += ["", f"And {count - MAX_SHOWN} more (--json has them all): {told}"]
        if any(one.mend.startswith("table") for one in self.findings):
            lines += ["", "Lines that begin with “table” are for pandas, between these two:", f"   {self.reading}"]
            lines += ['   table.to_csv("mended.csv", index=False)']
        return "\n".join(lines)

    @property
    def reading(self) -> str:
        """The line that reads the table with pandas, its labels as they are."""
        if self.name.endswith(".parquet"):
            return f"import numpy as np, pandas as pd; table = pd.read_parquet({self.name!r})"
        if not self.name.endswith(".csv"):
            return "import numpy as np, pandas as pd"
        labels = "dtype={'trajectory': str}"
        if self.dialect.has_blanks:  # also the name of the labels
            labels = "converters={0: str}"
        given = "".join(f", {name}={value!r}" for name, value in self.dialect.for_pandas.items())
        given = f"{labels}, keep_default_na=False, na_values=['', 'nan', 'NaN']{given}"
        names = ".rename(columns=str.strip)" if self.dialect.has_blanks else ""
        return f"import numpy as np, pandas as pd; table = pd.read_csv({self.name!r}, {given}){names}"

    @property
    def figures(self) -> dict[str, object]:
        """Everything as a plain dict, ready for JSON."""
        shape = {"table": self.name, "rows": self.rows, "trajectories": self.trajectories}
        return {**shape, "dialect": self.dialect.notes, "findings": [asdict(one) for one in self.findings]}


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
    dialect, name = Dialect(), "table"
    if isinstance(table, Trajectories):
        frame = to_frame(table)
    elif isinstance(table, pd.DataFrame):
        frame = table
    else:
        name = Path(table).name
        frame, dialect = read_cells(Path(table), UNITS_ROW.get() or None)
    numbers, findings = _numbers(frame, name, units or {}, step)
    for look in LOOKS:
        findings += look(numbers)
    try:
        findings += _frozen(table if isinstance(table, Trajectories) else from_frame(frame, name), numbers)
    except DataError as error:  # of what the reader refuses
        if not any(one.kind in REFUSED for one in findings):
            where = () if error.trajectory is None else (error.trajectory,)
            why = str(error).partition(": ")[2]
            findings.append(Suspicion("refused", None, where, 1, why, "mend the table by hand there"))
    if dialect.units is not None and not UNITS_ROW.get():
        why = f"row 1 is a row of units ({dialect.units})"
        findings.insert(0, Suspicion("units row", None, (), 1, why, "read it with --units-row"))
    return Examination(name, len(frame), len(set(numbers.labels)), findings, dialect)


def _numbers(
    frame: pd.DataFrame, name: str, units: Mapping[str, str], step: float | None
) -> tuple[Columns, list[Suspicion]]:
    """The cells as numbers, and which are none."""
    for required in ("trajectory", "time"):
        if required not in frame.columns:
            fail(name, "this column is missing", column=required)
    for twice in frame.columns[frame.columns.duplicated()][:1]:
        fail(name, "this column appears twice", column=str(twice))
    if not len(frame):
        fail(name, "the table has no rows")
    labels, _ = labels_of(frame["trajectory"])
    starts = np.append(True, labels[1:] != labels[:-1])
    run, findings, values = starts.cumsum() - 1, list[Suspicion](), dict[str, Array]()
    for column in frame.columns:
        if column == "trajectory":
            continue
        found, bad = parse_cells(frame[column])
        if column == "time" and bad.any():
            dates = pd.to_datetime(frame[column], errors="coerce", utc=True, format="ISO8601")
            if dates.notna().mean() > 0.9:
                found = ((dates - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1)).to_numpy(dtype=np.float64)
                bad = np.zeros_like(bad)
                why = f"times are dates such as {frame[column].iloc[0]}, expected seconds"
                findings.append(Suspicion("dates", "time", (), len(frame), why, OF_DATES))
        if bad.any():
            count, row = int(bad.sum()), int(bad.argmax())
            said = shown(str(frame[column].iloc[row]), 40)
            none = "1 cell is no number" if count == 1 else f"{count} cells are no numbers"
            why = f"{none}, the first is {said!r} in row {row + 1}"
            mend = f'{cell(column)} = pd.to_numeric({cell(column)}, errors="coerce")'
            if 2 * count > len(frame) or str(column)[:2] not in ("y.", "x."):
                mend = "bring it to numbers where the log is made: most cells would be lost, or may not be empty"
            findings.append(Suspicion("text", str(column), tuple(dict.fromkeys(labels[bad])), count, why, mend))
        if (endless := np.isinf(found)).any():
            why = f"{counted(int(endless.sum()), 'cell')} hold no finite number"
            mend = f"{cell(column)} = {cell(column)}.replace([np.inf, -np.inf], np.nan)"
            which = tuple(dict.fromkeys(labels[endless]))
            findings.append(Suspicion("infinite", str(column), which, int(endless.sum()), why, mend))
        values[str(column)] = np.where(bad | ~np.isfinite(found), np.nan, found)
    time = values.pop("time")
    return Columns(list(labels[starts]), run, time, values, units, step), findings


def _frozen(data: Trajectories, table: Columns) -> Iterator[Suspicion]:
    """Stretches in which a measurement hung, or a gap was interpolated, and the vehicle did not just stand still."""
    seen = [f"y.{name}" for name in data.measurement_names]
    stretches, begins = frozen_stretches(data), np.append(0, data.lengths.cumsum(0).numpy())

    def is_hung(name: str, drive: int, first: int, last: int) -> bool:
        values, rows = table.values[name], slice(begins[drive] + first, begins[drive] + last + 1)
        here, every = values[rows], values[np.isfinite(values)]
        if not np.isfinite(here).any():  # codes, which are said already
            return False
        if np.nanmax(here) > np.nanmin(here):
            return True
        is_at_end = here[0] in (every.min(), every.max())
        others = [table.values[one][rows] for one in seen if one != name]
        is_still = all(np.isfinite(one).sum() < 2 or np.nanmax(one) == np.nanmin(one) for one in others)
        return not is_at_end and not is_still and len(np.unique(every)) > FEW_VALUES * len(every)

    for column in dict.fromkeys(name for one in stretches for name in one.columns if name.startswith("y.")):
        there = [one for one in stretches if column in one.columns and is_hung(column, one.drive, *one.rows)]
        if not there:
            continue
        cells = sum(one.rows[1] - one.rows[0] + 1 for one in there)
        begin, end = there[0].seconds
        why = f"{cells} cells lie on straight lines, first from {begin:.2f} to {end:.2f} s"
        why += ": the sensor hung, or gaps were interpolated"
        mend = "steady check RUN TABLE --mask CLEAN.csv leaves out unmeasured stretches"
        yield Suspicion("frozen", column, tuple(dict.fromkeys(one.label for one in there)), cells, why, mend)
