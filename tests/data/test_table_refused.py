"""One clear error for each thing that can be wrong with a table, and nothing written that could not be read back."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow
import pyarrow.parquet
import pytest
from small_tables import GOOD, SUFFIXES, example, write

from steady_ppl.data.table import from_frame, read_table, to_frame, write_table
from steady_ppl.errors import DataError

# --- what is wrong with a table


def change(row: int, column: str, cell: str) -> str:
    """GOOD with one cell replaced; rows count from 1."""
    lines = [line.split(",") for line in GOOD.splitlines()]
    lines[row][lines[0].index(column)] = cell
    return "\n".join(",".join(line) for line in lines) + "\n"


def rejected(text: str, folder: Path) -> DataError:
    """The error for a CSV table; one line, and it names the file but not where it lies."""
    with pytest.raises(DataError) as caught:
        read_table(write(folder, text))
    message = str(caught.value)
    assert "\n" not in message and message.startswith("drives.csv: ") and str(folder) not in message
    for place, value in (("column", caught.value.column), ("trajectory", caught.value.trajectory)):
        assert value is None or f"{place} {value}" in message
    assert caught.value.row is None or f"row {caught.value.row}:" in message
    return caught.value


@pytest.mark.parametrize(
    ("row", "column", "cell", "trajectory", "says"),
    [
        (2, "y.range", "two", "b", "got 'two', expected a finite number or an empty cell"),
        (4, "u.left", "two", "a", "got 'two', expected a finite number"),
        (5, "x.x", "two", "a", "got 'two', expected a finite number or an empty cell"),
        (3, "time", "noon", "b", "got 'noon', expected a finite number"),
        (2, "y.range", "1_000", "b", "got '1_000'"),
        (2, "y.range", "１", "b", "got '１'"),
        (2, "y.range", "NA", "b", "got 'NA'"),
        (2, "y.range", "inf", "b", "got 'inf'"),
        (5, "x.x", "-inf", "a", "got '-inf'"),
        (1, "u.left", "Infinity", "b", "got 'Infinity'"),
        (3, "u.left", "inf", "b", "got 'inf'"),
        (3, "time", "inf", "b", "got 'inf'"),
        (2, "y.bearing", "1e999", "b", "got '1e999'"),
        (4, "time", "", "a", "got an empty cell, expected a finite number"),
        (2, "u.left", "", "b", "got an empty cell, expected a finite number"),
        (4, "u.left", " ", "a", "got an empty cell, expected a finite number"),
        (3, "time", "0.1", "b", "time must strictly increase, got 0.1 after 0.1"),
        (5, "time", "4.25", "a", "time must strictly increase, got 4.25 after 5.0"),
        (2, "trajectory", "", None, "got an empty cell"),
        (3, "trajectory", "c", "c", "at least two rows, got one"),
        (5, "trajectory", "b", "b", "keep its rows together"),
    ],
)
def test_a_bad_cell(tmp_path: Path, row: int, column: str, cell: str, trajectory: str | None, says: str) -> None:
    error = rejected(change(row, column, cell), tmp_path)
    assert (error.column, error.trajectory, error.row) == (column, trajectory, row)
    assert says in str(error)


def test_a_last_row_that_stands_alone(tmp_path: Path) -> None:
    error = rejected(GOOD + "c,0,1,1,1,1\n", tmp_path)
    assert (error.column, error.trajectory, error.row) == ("trajectory", "c", 6)


def test_an_infinite_number_in_a_frame_is_an_error() -> None:
    frame = to_frame(example())
    frame.loc[3, "y.range"] = np.inf
    with pytest.raises(DataError, match="column y.range, trajectory a, row 4: got 'inf'") as caught:
        from_frame(frame)
    assert (caught.value.column, caught.value.trajectory, caught.value.row) == ("y.range", "a", 4)


@pytest.mark.parametrize("value", [True, pd.Timestamp("2024-01-01"), [1.0], 1j])
def test_a_cell_of_another_type_is_not_a_number(value: object) -> None:
    frame = to_frame(example()).astype({"time": object})
    frame["time"] = pd.Series([value] * 5, dtype=object)
    with pytest.raises(DataError, match="expected a finite number") as caught:
        from_frame(frame)
    assert (caught.value.column, caught.value.trajectory, caught.value.row) == ("time", "b", 1)


def test_integers_with_gaps_are_numbers() -> None:
    frame = to_frame(example())
    frame["y.range"] = pd.array([None, 2, 3, 4, 5], dtype="Int64")
    assert from_frame(frame).observed[..., 1].tolist() == [[False, True], [True, True], [True, False]]


@pytest.mark.parametrize(
    ("header", "column", "says"),
    [
        ("trajectory,time,u.left,y.bearing,y.bearing,x.x", "y.bearing", "appears twice"),
        ("trajectory,time,time,y.bearing,y.range,x.x", "time", "appears twice"),
        ("Trajectory,time,u.left,y.bearing,y.range,x.x", "Trajectory", "unknown column"),
        ("trajectory,time,left,y.bearing,y.range,x.x", "left", "unknown column"),
        ("trajectory,time,u.,y.bearing,y.range,x.x", "u.", "unknown column"),
        ("trajectory,time,,y.bearing,y.range,x.x", "", "unknown column"),
        ("u.trajectory,time,u.left,y.bearing,y.range,x.x", "trajectory", "missing"),
        ("trajectory,u.time,u.left,y.bearing,y.range,x.x", "time", "missing"),
        ("trajectory,time,u.left,u.bearing,u.range,x.x", None, "at least one column y."),
    ],
)
def test_a_bad_header(tmp_path: Path, header: str, column: str | None, says: str) -> None:
    error = rejected(header + GOOD[GOOD.index("\n") :], tmp_path)
    assert (error.column, error.trajectory, error.row) == (column, None, None)
    assert says in str(error)


@pytest.mark.parametrize(
    ("text", "row", "says"),
    [
        ("", None, "empty"),
        ("\n\n", None, "empty"),
        (GOOD.splitlines()[0] + "\n", None, "no rows"),
        (GOOD + "a,6.0,1.0", 6, "got 3 cells, expected 6"),
        (GOOD.replace("\na,5.0", ",9\na,5.0"), 3, "got 7 cells, expected 6"),
        (GOOD.replace(",0.7", ',"0.7'), None, "cannot be read as csv"),
    ],
)
def test_a_bad_file(tmp_path: Path, text: str, row: int | None, says: str) -> None:
    error = rejected(text, tmp_path)
    assert (error.column, error.trajectory, error.row) == (None, None, row)
    assert says in str(error)


def test_a_label_or_cell_with_line_breaks_still_gives_one_line(tmp_path: Path) -> None:
    text = 'trajectory,time,y.a\n"p\nq",0,"far\ntoo long' + "!" * 5000 + '"\n"p\nq",1,2\n'
    with pytest.raises(DataError) as caught:
        read_table(write(tmp_path, text))
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 200
    assert (caught.value.column, caught.value.trajectory, caught.value.row) == ("y.a", "p\nq", 1)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_missing_file(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(DataError, match=f"^nowhere.{suffix}: there is no such file$"):
        read_table(tmp_path / f"nowhere.{suffix}")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_folder_is_not_a_table(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"drives.{suffix}").mkdir()
    with pytest.raises(DataError, match=f"drives.{suffix} is a folder: expected a file$"):
        read_table(tmp_path / f"drives.{suffix}")


def test_another_suffix_is_refused(tmp_path: Path) -> None:
    for name in ("drives.xlsx", "drives", "drives.csv.gz"):
        with pytest.raises(DataError, match="a table is a .csv or .parquet file"):
            read_table(write(tmp_path, GOOD, name))
        with pytest.raises(DataError, match="a table is a .csv or .parquet file"):
            write_table(example(), tmp_path / name)
        assert (tmp_path / name).read_text() == GOOD


@pytest.mark.parametrize("content", [b"", b"no parquet at all", b"PAR1" + bytes(100) + b"PAR1"])
def test_unreadable_parquet(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "drives.parquet").write_bytes(content)
    with pytest.raises(DataError, match=r"^drives.parquet: cannot be read as parquet: [^\n]+$"):
        read_table(tmp_path / "drives.parquet")


def test_unreadable_csv(tmp_path: Path) -> None:
    (tmp_path / "drives.csv").write_bytes(b"\xff\x00\x01")
    with pytest.raises(DataError, match=r"^drives.csv: cannot be read as csv: [^\n]+$"):
        read_table(tmp_path / "drives.csv")


def test_parquet_cut_short(tmp_path: Path) -> None:
    write_table(example(), tmp_path / "drives.parquet")
    whole = (tmp_path / "drives.parquet").read_bytes()
    (tmp_path / "drives.parquet").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match="cannot be read as parquet"):
        read_table(tmp_path / "drives.parquet")


def test_a_parquet_column_that_appears_twice(tmp_path: Path) -> None:
    table = pyarrow.table([["a", "a"], [0.0, 1.0], [1.0, 2.0], [3.0, 4.0]], names=["trajectory", "time", "y.a", "y.a"])
    pyarrow.parquet.write_table(table, tmp_path / "drives.parquet")
    with pytest.raises(DataError, match="appears twice") as caught:
        read_table(tmp_path / "drives.parquet")
    assert caught.value.column == "y.a"


def test_an_empty_parquet_table(tmp_path: Path) -> None:
    to_frame(example()).iloc[:0].to_parquet(tmp_path / "drives.parquet")
    with pytest.raises(DataError, match="no rows"):
        read_table(tmp_path / "drives.parquet")


# --- what is not written


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_no_folder_is_created(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(DataError, match="no folder results"):
        write_table(example(), tmp_path / "results" / f"drives.{suffix}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_data_that_could_not_be_read_back_leaves_the_old_file(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"drives.{suffix}"
    write_table(example(), path)
    before = path.read_bytes()
    diverged = replace(example(), controls=example().controls.masked_fill(example().controls == 1.5, math.inf))
    with pytest.raises(DataError, match="got 'inf'") as caught:
        write_table(diverged, path)
    assert (caught.value.column, caught.value.trajectory, caught.value.row) == ("u.left", "b", 2)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_failure_while_writing_leaves_the_old_file(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"drives.{suffix}"
    write_table(example(), path)
    before = path.read_bytes()

    def disk_full(frame: pd.DataFrame, target: Path, **options: object) -> None:
        Path(target).write_text("half a ta")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pd.DataFrame, f"to_{suffix}", disk_full)
    with pytest.raises(DataError, match=f"drives.{suffix} cannot be written: No space left on device$"):
        write_table(example(), path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_a_folder_in_the_way(tmp_path: Path) -> None:
    (tmp_path / "drives.csv").mkdir()
    with pytest.raises(DataError, match="drives.csv cannot be written: Is a directory"):
        write_table(example(), tmp_path / "drives.csv")
    assert list(tmp_path.iterdir()) == [tmp_path / "drives.csv"]


def test_trajectories_of_one_label_are_not_run_together(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="two trajectories have this label") as caught:
        write_table(example().subset([0, 1, 1]), tmp_path / "drives.csv")
    assert caught.value.trajectory == "a" and list(tmp_path.iterdir()) == []


@pytest.mark.exhaustive
def test_many_drives_take_no_longer_each_than_few() -> None:
    many = np.repeat([f"drive {i}" for i in range(60_000)], 2)
    frame = pd.DataFrame({"trajectory": many, "time": np.tile([0.0, 1.0], 60_000), "u.push": 0.0, "y.range": 1.0})
    data, began = from_frame(frame), time.perf_counter()
    assert to_frame(data)["trajectory"].nunique() == 60_000
    assert time.perf_counter() - began < 5


def test_a_measurement_that_is_nan_is_not_written_as_missing(tmp_path: Path) -> None:
    measurements = example().measurements.clone()
    measurements[1, 1, 0] = math.nan
    with pytest.raises(DataError, match="a measurement is NaN") as caught:
        write_table(replace(example(), measurements=measurements), tmp_path / "drives.csv")
    assert (caught.value.column, caught.value.trajectory, caught.value.row) == ("y.bearing", "a", 5)
    assert list(tmp_path.iterdir()) == []


def test_a_blank_label_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected a label"):
        write_table(replace(example(), labels=("b", " ")), tmp_path / "drives.csv")
    assert list(tmp_path.iterdir()) == []
