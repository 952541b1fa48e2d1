"""What has come in of a study: one Parquet table, and beside it what came since it was last written.

A result is on disk, whole, before the next one is taken; the table is written anew when a tenth more have come, and a
hundred, which keeps ten thousand results from being written ten thousand times. Results of jobs that the study no
longer has are in a second table, from which they come back when it has them again.
"""

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow
import pyarrow.parquet
from pandas.api.types import infer_dtype
from pyarrow.types import is_boolean, is_floating, is_integer, is_large_string, is_null, is_string

from steady_ppl.errors import RunError
from steady_ppl.runs.folder import exclusive_writer
from steady_ppl.utils.files import require_file, whole_file
from steady_ppl.utils.text import printable

TABLE, EARLIER, ARRIVED = "results.parquet", "earlier.parquet", "arrived"
COLUMN_TYPES = (is_integer, is_floating, is_boolean, is_string, is_large_string, is_null)
NUMERIC_KINDS = ("integer", "floating", "mixed-integer-float")  # as pandas infers them
MIN_RESULTS_BETWEEN_WRITES = 100  # results for which the table is written anew, at least


class StudyTable:
    """The results in a study's folder, a row a job; of a job that was computed again the later row counts. Its methods
    raise RunError where a file cannot be written, or one in the folder is damaged."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.waiting, self.rows = folder, 0, 0

    def add(self, row: Mapping[str, Any]) -> None:
        """Keep a result."""
        seen = {name: printable(value) if isinstance(value, str) else value for name, value in row.items()}
        _write(pd.DataFrame([seen]), self.folder / ARRIVED / f"{row['key']}.parquet")
        self.waiting += 1
        if self.waiting >= max(MIN_RESULTS_BETWEEN_WRITES, self.rows // 10):
            self.merge()

    def keep(self, keys: Collection[str]) -> None:
        """Have the table hold what there is of these jobs, and nothing else."""
        self.merge()
        table, earlier = self.folder / TABLE, self.folder / EARLIER
        now = read_results(self.folder)
        self.rows = len(now)
        everything = _joined([*_read_if_there(earlier), now])
        own = everything["key"].isin(keys)
        if set(everything["key"][own]) == set(now["key"]):
            return
        _write(everything, earlier)  # all of it, so that nothing is lost between here and the last line
        _write(everything[own], table)
        _write(everything[~own], earlier)

    def merge(self) -> None:
        """Write the table with all that has come."""
        if arrived := list((self.folder / ARRIVED).glob("*.parquet")):
            everything = read_results(self.folder)
            _write(everything, self.folder / TABLE)
            self.rows = len(everything)
        for file in arrived:
            with suppress(OSError):  # it is in the table
                file.unlink()
        self.waiting = 0


@contextmanager
def study_table(folder: Path) -> Iterator[StudyTable]:
    """The table of a study for the block that fills it, whole at its end however that comes; RunError where the folder
    cannot be made, or another process writes to it."""
    with exclusive_writer(folder):
        arrived = folder / ARRIVED
        if arrived.is_symlink():
            raise RunError(f"{arrived} is a link: results are kept in a folder of the study's own")
        try:
            arrived.mkdir(exist_ok=True)
        except OSError as error:
            raise RunError(f"{arrived} cannot be written: {error.strerror}") from error
        table = StudyTable(folder)
        try:
            yield table
        finally:
            table.merge()
            if not any(arrived.iterdir()):
                arrived.rmdir()


def read_results(folder: Path) -> pd.DataFrame:
    """All results that are there, the last of each job; empty where there are none. RunError: a file is damaged."""
    arrived = []  # before the table: what its writer merges meanwhile is in the table when that is read
    for file in sorted((folder / ARRIVED).glob("*.parquet")):
        try:
            arrived.append(_read(file))
        except RunError:
            if os.path.lexists(file):
                raise
    return _joined([*_read_if_there(folder / TABLE), *arrived])


def _joined(parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
    if not parts:
        return pd.DataFrame({"key": []})
    return pd.concat(parts, ignore_index=True).drop_duplicates("key", keep="last", ignore_index=True)


def _read_if_there(file: Path) -> list[pd.DataFrame]:
    return [_read(file)] if os.path.lexists(file) else []


def _read(file: Path) -> pd.DataFrame:
    require_file(file, RunError)
    try:
        columns = pyarrow.parquet.read_table(file)
        columns.validate(full=True)  # text that is none
        found = columns.to_pandas(ignore_metadata=True)
    except (OSError, ValueError, TypeError, pyarrow.ArrowException) as error:
        reason = str(error).partition("\n")[0]
        raise RunError(f"{file} is damaged: {reason}; move it away, and its jobs are computed again") from error
    for column in columns.schema:
        if not any(fits(column.type) for fits in COLUMN_TYPES):
            raise RunError(f"{file} is no table of a study: its column {column.name} holds {column.type}")
    for name in ("key", "outcome"):
        if name not in found or not found[name].map(lambda value: isinstance(value, str)).all():
            raise RunError(f"{file} is no table of a study: it has no column {name} of text")
    return found


def _write(frame: pd.DataFrame, file: Path) -> None:
    """Write a table; a column of several kinds of values becomes text, since Parquet's have one."""
    frame = frame.copy(deep=False)
    for name in frame:
        if infer_dtype(frame[name]) not in (*NUMERIC_KINDS, "boolean", "string", "empty"):
            frame[name] = frame[name].map(_text, na_action="ignore")
    with whole_file(file, RunError) as beside:
        frame.to_parquet(beside, index=False)
        with beside.open("r+b") as written:
            os.fsync(written.fileno())  # before it has its name: no power cut leaves half of it


def _text(value: object) -> str:
    """A whole number without a fraction, however the column held it: it has one where others are absent."""
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)
