"""The table: one row a trajectory and time step, as CSV, Parquet, a pandas frame or arrays; long drives in pieces.

Columns: `trajectory`, `time` (s), `u.<control>`, `y.<measurement>` and, where known, `x.<state component>`.

- An empty `y.` cell is a missing measurement, an empty `x.` cell an unknown state; NaN counts as empty.
- A control acts from its row to the next, so it may be empty in a trajectory's last row, and only there.
- The rows of a trajectory follow one another, two at least, with strictly increasing time.
"""

import csv
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pandas as pd
import pyarrow
import pyarrow.parquet
import torch
from torch import Tensor

from steady_ppl.data.dialect import Dialect, read_csv
from steady_ppl.data.trajectories import Trajectories, pad, pad_time
from steady_ppl.errors import DataError, TableWarning, require
from steady_ppl.utils.context import UNITS_ROW
from steady_ppl.utils.files import require_file, whole_file
from steady_ppl.utils.text import shown

MAX_PIECES = 1_000_000  # of all drives
MAX_DRIVE_ROWS = 20_000  # of a drive that is looked at as a whole


def read_table(path: str | Path, *, units_row: bool | None = None) -> Trajectories:
    """Read the trajectories of a `.csv` or `.parquet` file, in order of first appearance, float64.

    `states` is None when no `x.` cell is filled. A `TableWarning` says how a CSV was read that other programs wrote:
    UTF-16, semicolons or tabs, decimal commas, blanks around names, comment lines, a separator at the end of rows.

    Args:
        units_row: the row below the header of a CSV has units; None: as the command line says.

    Raises:
        DataError: naming the file and, where they apply, the column, the trajectory and the row.
    """
    path = Path(path)
    frame, dialect = read_cells(path, UNITS_ROW.get() if units_row is None else units_row)
    data = from_frame(frame, name=path.name)
    if dialect.notes:
        warnings.warn(f"{path.name}: read with {', '.join(dialect.notes)}", TableWarning, stacklevel=2)
    return data


def read_cells(path: Path, units_row: bool | None) -> tuple[pd.DataFrame, Dialect]:
    """The cells of a `.csv` or `.parquet` file, and how a CSV is written, see `read_table`.

    Args:
        units_row: the row below the header of a CSV has units; None: if it looks like one.
    """
    require_file(path, DataError)
    try:
        return read_csv(path, units_row) if _suffix(path) == ".csv" else (_read_parquet(path), Dialect())
    except FileNotFoundError as error:
        raise DataError(f"{path.name}: there is no such file") from error
    except (OSError, ValueError, csv.Error, pyarrow.ArrowException) as error:
        reason = getattr(error, "strerror", None) or str(error).partition("\n")[0]
        raise DataError(f"{path.name}: cannot be read as {_suffix(path)[1:]}: {reason}") from error


def write_table(data: Trajectories, path: str | Path) -> None:
    """Write a table to a `.csv` or `.parquet` file; `read_table` gives the same numbers back, bit for bit in float64.

    The file appears whole or not at all. DataError for another suffix, a missing folder, or a table that `read_table`
    would refuse; a CSV has no blanks at the ends of names.
    """
    path = Path(path)
    suffix = require_table_file(path)
    frame = to_frame(data)
    from_frame(frame, name=path.name)
    for column in frame.columns if suffix == ".csv" else ():
        if column != column.strip():
            fail(path.name, "a name ends with a blank: give it another, or write .parquet", column=column)
    write = frame.to_csv if suffix == ".csv" else frame.to_parquet
    with whole_file(path, DataError) as beside:
        write(beside, index=False)


def to_frame(data: Trajectories) -> pd.DataFrame:
    """The table as a pandas frame, trajectory after trajectory; missing cells are NaN.

    Raises:
        DataError: two trajectories have the same label, or a measurement that was made is NaN.
    """
    again = pd.Series(data.labels, dtype=object).duplicated()
    if again.any():
        fail("table", "two trajectories have this label", column="trajectory", trajectory=data.labels[again.argmax()])
    for t, b, k in (data.measurements.isnan() & data.observed & data.rows[..., None]).nonzero()[:1].tolist():
        row, column = int(data.lengths[:b].sum()) + t + 1, f"y.{data.measurement_names[k]}"
        fail("table", "a measurement is NaN", column=column, trajectory=data.labels[b], row=row)
    blocks = [data.time[..., None], data.controls, data.measurements.masked_fill(~data.observed, torch.nan)]
    names = ["time", *(f"u.{n}" for n in data.control_names), *(f"y.{n}" for n in data.measurement_names)]
    if data.states is not None:
        blocks.append(data.states)
        names += [f"x.{n}" for n in data.state_names]
    values = torch.cat([block.detach().double() for block in blocks], -1).transpose(0, 1)[data.rows.T]
    frame = pd.DataFrame(values.cpu().numpy(), columns=names)
    frame.insert(0, "trajectory", np.repeat(np.array(data.labels, dtype=object), data.lengths.cpu().numpy()))
    return frame


def from_frame(frame: pd.DataFrame, name: str = "table") -> Trajectories:
    """The trajectories of a pandas frame; its index is ignored.

    Args:
        frame: the table's columns; cells are numbers or text that spells numbers.
        name: what error messages call the table.

    Raises:
        DataError: naming the column, the trajectory and the row.
    """
    controls, measurements, states = _columns(frame, name)
    labels, lengths = _trajectories(frame["trajectory"], name)
    row_labels, ends = np.repeat(labels, lengths), lengths.cumsum()
    inner = np.ones(len(frame), dtype=bool)
    inner[ends - 1] = False
    every, none = np.ones_like(inner), np.zeros_like(inner)

    def numbers(column: str, required: np.ndarray) -> np.ndarray:
        return finite_numbers(frame[column], name, required, row_labels)

    def split(columns: list[str], required: np.ndarray) -> tuple[Tensor, ...]:
        block = np.stack([np.empty(len(frame)), *(numbers(column, required) for column in columns)], -1)[:, 1:]
        return torch.from_numpy(block).split(lengths.tolist())

    time = numbers("time", every)
    back = np.append(False, np.diff(time) <= 0)
    back[ends[:-1]] = False
    for row in np.flatnonzero(back)[:1].tolist():
        problem = f"time must strictly increase, got {time[row]} after {time[row - 1]}"
        fail(name, problem, column="time", trajectory=row_labels[row], row=row + 1)
    acting, measured, truth = split(controls, inner), split(measurements, none), split(states, none)
    known = any(bool((~values.isnan()).any()) for values in truth)
    return Trajectories(
        time=pad_time(torch.from_numpy(time).split(lengths.tolist())),
        controls=pad([values.nan_to_num(0.0) for values in acting]),
        measurements=pad([values.nan_to_num(0.0) for values in measured]),
        observed=pad([~values.isnan() for values in measured], False),
        lengths=torch.from_numpy(lengths),
        states=pad(truth, torch.nan) if known else None,
        labels=tuple(labels),
        control_names=tuple(column[2:] for column in controls),
        measurement_names=tuple(column[2:] for column in measurements),
        state_names=tuple(column[2:] for column in states) if known else (),
    )


def _columns(frame: pd.DataFrame, name: str) -> tuple[list[str], list[str], list[str]]:
    """The control, measurement and state columns, in the table's order."""
    columns: list[Any] = list(frame.columns)
    groups: dict[str, list[str]] = {"u.": [], "y.": [], "x.": []}
    seen = set[Any]()
    for column in columns:
        if column in seen:
            fail(name, "this column appears twice", column=column)
        seen.add(column)
        if column in ("trajectory", "time"):
            continue
        if str(column)[:2] not in groups or len(column) < 3:
            fail(name, "unknown column, expected trajectory, time, u.…, y.… or x.…; is it misnamed?", column=column)
        groups[column[:2]].append(column)
    for required in ("trajectory", "time"):
        if required not in columns:
            fail(name, "this column is missing", column=required)
    if not groups["y."]:
        fail(name, "there is no measurement, expected at least one column y.…")
    return groups["u."], groups["y."], groups["x."]


def _trajectories(cells: pd.Series, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The labels in order of first appearance and the trajectories' numbers of rows."""
    if len(cells) == 0:
        fail(name, "the table has no rows")
    labels, empty = labels_of(cells)
    if empty.any():
        fail(name, "got an empty cell, expected a label", column="trajectory", row=int(empty.argmax()) + 1)
    starts = np.flatnonzero(np.append(True, labels[1:] != labels[:-1]))
    lengths, labels = np.diff(starts, append=len(labels)), labels[starts]
    again = pd.Series(labels).duplicated().to_numpy()
    for bad, problem in (
        (again, "this trajectory goes on after another one; keep its rows together"),
        (lengths < 2, "a trajectory needs at least two rows, got one"),
    ):
        for i in np.flatnonzero(bad)[:1].tolist():
            fail(name, problem, column="trajectory", trajectory=labels[i], row=int(starts[i]) + 1)
    return labels, lengths


def labels_of(cells: pd.Series) -> tuple[np.ndarray, np.ndarray]:
    """The label of every row as text, and which are empty."""
    whole = pd.api.types.is_float_dtype(cells.dtype) and bool((cells.dropna() % 1 == 0).all())  # numbers with a gap
    codes, different = pd.factorize(cells, use_na_sentinel=False)
    named = np.array([f"{cell:.0f}" if whole else str(cell) for cell in different], dtype=object)
    is_empty = pd.isna(different) | np.array([not label.strip() for label in named], dtype=bool)
    return named[codes], is_empty[codes]


def finite_numbers(
    cells: pd.Series, name: str, required: np.ndarray, trajectories: np.ndarray | None = None
) -> np.ndarray:
    """A column as float64, NaN for an empty cell that is not `required`; any other cell is a DataError."""
    values, bad = parse_cells(cells)
    bad = bad | np.isinf(values) | (np.isnan(values) & required)
    for row in np.flatnonzero(bad)[:1].tolist():
        wanted = "a finite number" if required[row] else "a finite number or an empty cell"
        cell, trajectory = cells.iloc[row], None if trajectories is None else trajectories[row]
        empty = not str(cell).strip() or (pd.api.types.is_scalar(cell) and pd.isna(cell))
        got = "an empty cell" if empty else f"{str(cell)[:40]!r}"
        fail(name, f"got {got}, expected {wanted}", column=str(cells.name), trajectory=trajectory, row=row + 1)
    return values


def parse_cells(cells: pd.Series) -> tuple[np.ndarray, np.ndarray]:
    """The cells as float64, NaN where empty, and where they are not numbers."""
    bad = np.zeros(len(cells), dtype=bool)
    if pd.api.types.is_float_dtype(cells.dtype) or pd.api.types.is_integer_dtype(cells.dtype):
        return cells.to_numpy(dtype=np.float64, na_value=np.nan, copy=True), bad
    if (numbers := _parse_numbers(cells)) is not None:
        return numbers, bad
    values = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells.where(cells.notna(), "")):
        text = str(cell).strip()
        try:
            values[i] = float(text or "nan")
        except ValueError:
            bad[i] = True
        bad[i] |= "_" in text or not text.isascii()  # float() takes separators, and digits of other scripts
    return values, bad


def _parse_numbers(cells: pd.Series) -> np.ndarray | None:
    """Text cells as float64 where all are empty or plain numbers; None where some may be something else."""
    text = cells.to_numpy(dtype=object)
    if not all(type(cell) is str for cell in text) or "_" in (whole := "".join(text)) or not whole.isascii():
        return None
    try:
        return np.where(text == "", "nan", text).astype(np.float64)
    except ValueError:
        return None


def _read_parquet(path: Path) -> pd.DataFrame:
    # not pandas' reader: it turns a folder named seed=3 on the way into a column
    with path.open("rb") as file:
        table = pyarrow.parquet.ParquetFile(file).read()
    table.validate(full=True)  # text that is not UTF-8
    frame = table.to_pandas(ignore_metadata=True)
    return frame.drop(columns=[column for column in frame if column.startswith("__index_level_")])


def require_table_file(path: Path) -> str:
    """The suffix of a file that a table can be written to; DataError for another one, or a missing folder."""
    suffix = _suffix(path)
    if not path.parent.is_dir():
        raise DataError(f"{path.name}: cannot be written: there is no folder {path.parent.name}, create it first")
    return suffix


def _suffix(path: Path) -> str:
    if (suffix := path.suffix.lower()) not in (".csv", ".parquet"):
        raise DataError(f"{path.name}: a table is a .csv or .parquet file")
    return suffix


def fail(
    name: str, problem: str, *, column: str | None = None, trajectory: str | None = None, row: int | None = None
) -> NoReturn:
    """Raise a DataError whose one line says where."""
    places = (("column", column), ("trajectory", trajectory), ("row", row))
    where = ", ".join(f"{kind} {shown(str(place), 100)}" for kind, place in places if place is not None)
    message = " ".join(f"{name}: {where}{': ' if where else ''}{problem}".split())
    raise DataError(message, column=column, trajectory=trajectory, row=row)


def from_arrays(drives: Sequence[Mapping[str, Any]], labels: Sequence[str] | None = None) -> Trajectories:
    """The trajectories of arrays: for each trajectory its columns `time`, `u.…`, `y.…` and, where known, `x.…`.

    Args:
        drives: column → `(rows,)`, or `(rows, K)` for the columns `…_0` to `…_K-1`; NaN is an empty cell.
        labels: the trajectories' names, 1, 2, … when not given.

    Raises:
        DataError: naming the column, the trajectory and the row.

    Example:
        >>> import numpy as np
        >>> time = np.arange(3) / 10
        >>> from_arrays([{"time": time, "u.left": 0 * time, "y.bearing": np.zeros((3, 2))}]).measurement_names
        ('bearing_0', 'bearing_1')
    """
    labels = [str(i + 1) for i in range(len(drives))] if labels is None else list(labels)
    if not drives or len(labels) != len(drives):
        raise DataError(f"arrays: got {len(drives)} trajectories and {len(labels)} labels")
    if repeated := sorted({label for label in labels if labels.count(label) > 1}):
        raise DataError(f"arrays: {len(drives)} trajectories need as many labels, and {repeated[0]} is there twice")
    frames = []
    for label, drive in zip(labels, drives, strict=True):
        columns: dict[str, np.ndarray] = {}
        for name, values in drive.items():
            values = np.asarray(values)
            parts = {name: values} if values.ndim < 2 else {f"{name}_{i}": part for i, part in enumerate(values.T)}
            if twice := sorted(parts.keys() & columns.keys() | ({name} & {"trajectory"})):
                why = "is what the labels are called" if name == "trajectory" else "is there twice"
                raise DataError(f"arrays: column {twice[0]} of trajectory {label} {why}", column=twice[0])
            columns |= parts
        shapes = {name: values.shape for name, values in columns.items()}
        if len(set(shapes.values())) > 1 or any(len(shape) != 1 for shape in shapes.values()):
            told = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            raise DataError(f"arrays: the columns of trajectory {label} differ in shape: {told}", trajectory=label)
        frames.append(pd.DataFrame({"trajectory": label} | columns))
        if set(columns) != set(frames[0].columns) - {"trajectory"}:
            raise DataError(f"arrays: trajectory {label} has other columns than {labels[0]}", trajectory=label)
    return from_frame(pd.concat(frames), name="arrays")


def refuse_long(data: Trajectories) -> None:
    """Raise DataError, naming the longest trajectory, where it has more than `MAX_DRIVE_ROWS` rows."""
    longest = int(data.lengths.argmax())
    label, rows = data.labels[longest], int(data.lengths[longest])
    if rows > MAX_DRIVE_ROWS:
        what = f"trajectory {label} has {rows} rows, and at most {MAX_DRIVE_ROWS} are looked at in one piece"
        how = "cut it by `steady data cut TABLE --seconds 60 --out PIECES`"
        raise DataError(f"{what}: {how}", trajectory=label)


def cut(data: Trajectories, seconds: float) -> Trajectories:
    """Return the same trajectories in pieces of some seconds: one that is longer becomes `…-1`, `…-2`, …

    Each piece begins at its first row that has a measurement; pieces of one row or without a measurement are left out.
    Time stays as recorded.

    Raises:
        UsageError: no length of time.
        DataError: nothing is left, or two pieces would have one name.

    Example:
        >>> import torch
        >>> from steady_ppl import from_arrays
        >>> time = torch.arange(50) / 10
        >>> cut(from_arrays([{"time": time, "u.push": 0 * time, "y.range": time}]), 2.0).labels
        ('1-1', '1-2', '1-3')
    """
    require(0 < seconds < math.inf, "seconds", seconds, "above 0")
    frame = to_frame(data)
    drives = frame.groupby("trajectory", sort=False)
    since = frame["time"] - drives["time"].transform("first")
    require(float(since.max()) / seconds < MAX_PIECES, "seconds", seconds, f"enough for {MAX_PIECES} pieces")
    piece = np.floor(since / seconds + 1e-6).astype(int)  # a row that rounding puts before its time is in time
    measured = frame.filter(regex=r"^y\.").notna().any(axis=1)
    place = [frame["trajectory"], piece]
    kept = measured.groupby(place).cummax()
    kept &= kept.groupby(place).transform("sum") > 1
    if not kept.any():
        raise DataError(f"no piece of {seconds:g} s has two rows that begin with a measurement: take longer pieces")
    several = piece.groupby(frame["trajectory"]).transform("max") > 0
    called = frame["trajectory"].where(~several, frame["trajectory"].astype(str) + "-" + (piece + 1).astype(str))
    names = called[kept].groupby([series[kept] for series in place], sort=False).first()
    if names.duplicated().any():
        twice = names[names.duplicated()].iloc[0]
        raise DataError(f"two pieces would be called {twice}: give the trajectories other names", trajectory=twice)
    return from_frame(frame.assign(trajectory=called)[kept])
