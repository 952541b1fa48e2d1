"""The table format: exact round trips, and one clear error for each thing that can be wrong."""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow
import pyarrow.parquet
import pytest
import torch
from hypothesis import given, settings, strategies as st

from steady_ppl.data.table import from_frame, read_table, to_frame, write_table
from steady_ppl.data.trajectories import Trajectories, pad, pad_time
from steady_ppl.errors import DataError

SUFFIXES = ("csv", "parquet")

GOOD = """\
trajectory,time,u.left,y.bearing,y.range,x.x
b,0.0,1.0,0.5,,10.0
b,0.1,1.5,,2.0,
b,0.3,,0.7,2.5,
a,5.0,2.0,0.1,3.0,20.0
a,5.5,2.5,0.2,3.5,21.0
"""


def write(folder: Path, text: str, name: str = "drives.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def same(a: Trajectories, b: Trajectories) -> None:
    """Equal bit for bit, names and shapes included."""
    for field in fields(Trajectories):
        left, right = getattr(a, field.name), getattr(b, field.name)
        if not isinstance(left, torch.Tensor):
            assert left == right, field.name
            continue
        assert left.dtype == right.dtype and left.shape == right.shape, field.name
        if left.is_floating_point():
            empty = left.isnan()
            assert torch.equal(empty, right.isnan()), field.name
            left, right = (t.masked_fill(empty, 0.0).contiguous().view(torch.int64) for t in (left, right))
        assert torch.equal(left, right), field.name


def example(truth: bool = True) -> Trajectories:
    """Two trajectories of 3 and 2 rows, as GOOD spells them."""
    return Trajectories(
        time=torch.tensor([[0.0, 5.0], [0.1, 5.5], [0.3, 6.0]], dtype=torch.float64),
        controls=torch.tensor([[[1.0], [2.0]], [[1.5], [2.5]], [[0.0], [0.0]]], dtype=torch.float64),
        measurements=torch.tensor(
            [[[0.5, 0.0], [0.1, 3.0]], [[0.0, 2.0], [0.2, 3.5]], [[0.7, 2.5], [0.0, 0.0]]], dtype=torch.float64
        ),
        observed=torch.tensor([[[1, 0], [1, 1]], [[0, 1], [1, 1]], [[1, 1], [0, 0]]], dtype=torch.bool),
        lengths=torch.tensor([3, 2]),
        states=torch.tensor([[[10.0], [20.0]], [[math.nan], [21.0]], [[math.nan], [math.nan]]], dtype=torch.float64)
        if truth
        else None,
        labels=("b", "a"),
        control_names=("left",),
        measurement_names=("bearing", "range"),
        state_names=("x",) if truth else (),
    )


# --- what a table means


def test_csv_gives_the_tensors_it_spells(tmp_path: Path) -> None:
    same(read_table(write(tmp_path, GOOD)), example())


def test_parquet_gives_the_same_as_csv(tmp_path: Path) -> None:
    pd.read_csv(write(tmp_path, GOOD)).to_parquet(tmp_path / "drives.parquet")
    same(read_table(tmp_path / "drives.parquet"), example())


def test_the_order_of_the_columns_is_free_and_kept(tmp_path: Path) -> None:
    frame = pd.read_csv(write(tmp_path, GOOD))
    data = from_frame(frame[["y.range", "time", "x.x", "y.bearing", "u.left", "trajectory"]])
    assert data.measurement_names == ("range", "bearing")
    assert torch.equal(data.measurements, example().measurements.flip(-1))


def test_states_are_none_when_every_state_cell_is_empty(tmp_path: Path) -> None:
    text = GOOD.replace("10.0\n", "\n").replace(",20.0", ",").replace("21.0", "")
    same(read_table(write(tmp_path, text)), example(truth=False))


def test_states_are_none_without_state_columns(tmp_path: Path) -> None:
    frame = pd.read_csv(write(tmp_path, GOOD)).drop(columns="x.x")
    same(from_frame(frame), example(truth=False))


def test_a_start_alone_is_known() -> None:
    data = example()
    assert data.states is not None
    back = from_frame(to_frame(data.without_truth(keep_start=True)))
    assert torch.equal(back.known_start, data.states[0])
    assert back.states is not None and bool(back.states[1:].isnan().all())


def test_labels_are_text_whatever_the_cells_are(tmp_path: Path) -> None:
    frame = pd.DataFrame({"trajectory": [7, 7, 3, 3], "time": [0, 1, 0, 2], "y.a": [1, 2, 3, 4]})
    assert from_frame(frame).labels == ("7", "3")
    assert from_frame(frame.astype({"trajectory": "category"})).labels == ("7", "3")
    assert from_frame(frame).steps.tolist() == [[1.0, 2.0]]
    assert from_frame(frame).controls.shape == (2, 2, 0)


def test_text_that_spells_missing_is_a_label_not_an_empty_cell(tmp_path: Path) -> None:
    path = write(tmp_path, "trajectory,time,y.a\nNA,0,1\nNA,1,2\n007,0,1\n007,1,2\n")
    assert read_table(path).labels == ("NA", "007")


def test_excel_csv_is_read(tmp_path: Path) -> None:
    path = tmp_path / "drives.csv"
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    same(read_table(path), example())


def test_spaces_around_numbers_and_blank_lines_do_no_harm(tmp_path: Path) -> None:
    text = GOOD.replace(",1.5,", ", 1.5 ,").replace("0.5,,10", "0.5,  ,10").replace("a,5.0", "\na,5.0") + "\n"
    same(read_table(write(tmp_path, text)), example())


def test_nan_counts_as_empty(tmp_path: Path) -> None:
    same(read_table(write(tmp_path, GOOD.replace("0.5,,", "0.5,NaN,"))), example())


def test_frame_index_is_ignored() -> None:
    frame = to_frame(example())
    same(from_frame(frame.set_index(pd.Index([9, 9, 9, 1, 0]))), example())


def test_read_parquet_ignores_the_folder_names(tmp_path: Path) -> None:
    folder = tmp_path / "seed=3"
    folder.mkdir()
    write_table(example(), folder / "drives.parquet")
    same(read_table(folder / "drives.parquet"), example())


def test_a_parquet_index_is_read_where_it_holds_columns_and_ignored_elsewhere(tmp_path: Path) -> None:
    frame = to_frame(example())
    frame.set_index(["trajectory", "time"]).to_parquet(tmp_path / "named.parquet")
    frame.set_index(pd.Index([9, 9, 9, 1, 0])).to_parquet(tmp_path / "numbered.parquet")
    same(read_table(tmp_path / "named.parquet"), example())
    same(read_table(tmp_path / "numbered.parquet"), example())


# --- round trips


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("truth", [True, False])
def test_round_trip(tmp_path: Path, suffix: str, truth: bool) -> None:
    path = tmp_path / f"drives.{suffix}"
    write_table(example(truth), path)
    same(read_table(path), example(truth))
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


numbers = st.floats(allow_nan=False, allow_infinity=False, width=64)
names = st.lists(st.text("abcXYZ_αβ., '\"", min_size=1, max_size=4), max_size=3, unique=True)
labels = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")) | st.sampled_from('\n",;'), min_size=1)


@st.composite
def tables(draw: st.DrawFn) -> Trajectories:
    """Any valid data: ragged, own steps, missing cells, states known in part or not at all."""
    lengths = draw(st.lists(st.integers(2, 5), min_size=1, max_size=4))
    unique_labels = st.lists(labels.filter(str.strip), min_size=len(lengths), max_size=len(lengths), unique=True)
    control_names, measurement_names, state_names = draw(names), draw(names.filter(len)), draw(names)
    moderate = st.floats(-1e300, 1e300)
    time, controls, measurements, observed, states = [], [], [], [], []

    def block(cells: st.SearchStrategy, rows: int, columns: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
        row = st.lists(cells, min_size=columns, max_size=columns)
        return torch.tensor(draw(st.lists(row, min_size=rows, max_size=rows)), dtype=dtype).reshape(rows, columns)

    for rows in lengths:
        time.append(
            torch.tensor(
                sorted(draw(st.lists(moderate, min_size=rows, max_size=rows, unique=True))), dtype=torch.float64
            )
        )
        controls.append(block(numbers, rows, len(control_names)))
        observed.append(block(st.booleans(), rows, len(measurement_names), torch.bool))
        measurements.append(block(numbers, rows, len(measurement_names)).masked_fill(~observed[-1], 0.0))
        states.append(block(numbers | st.just(math.nan), rows, len(state_names)))
    truth = pad(states, math.nan)
    known = bool((~truth.isnan()).any())
    return Trajectories(
        time=pad_time(time),
        controls=pad(controls),
        measurements=pad(measurements),
        observed=pad(observed, False),
        lengths=torch.tensor(lengths),
        states=truth if known else None,
        labels=tuple(draw(unique_labels)),
        control_names=tuple(control_names),
        measurement_names=tuple(measurement_names),
        state_names=tuple(state_names) if known else (),
    )


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=25, deadline=None)
@given(data=tables())
def test_round_trip_of_anything(suffix: str, data: Trajectories) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"drives.{suffix}"
        write_table(data, path)
        same(read_table(path), data)


@settings(max_examples=25, deadline=None)
@given(data=tables())
def test_round_trip_through_a_frame(data: Trajectories) -> None:
    frame = to_frame(data)
    assert len(frame) == int(data.lengths.sum())
    same(from_frame(frame), data)


def test_single_precision_is_written_exactly(tmp_path: Path) -> None:
    data = example()
    single = replace(data, time=data.time.float(), controls=data.controls.float())
    write_table(single, tmp_path / "drives.csv")
    assert torch.equal(read_table(tmp_path / "drives.csv").controls, single.controls.double())


def test_measurements_left_out_are_empty_cells(tmp_path: Path) -> None:
    thinned = example().observed_every(2)
    write_table(thinned, tmp_path / "drives.csv")
    back = read_table(tmp_path / "drives.csv")
    assert torch.equal(back.observed, thinned.observed)
    assert bool((back.measurements[~thinned.observed] == 0).all())
    assert (tmp_path / "drives.csv").read_text().splitlines()[2] == "b,0.1,1.5,,,"


def test_no_state_columns_are_written_without_truth(tmp_path: Path) -> None:
    write_table(example().without_truth(), tmp_path / "drives.csv")
    assert (tmp_path / "drives.csv").read_text().splitlines()[0] == "trajectory,time,u.left,y.bearing,y.range"


def test_unlabelled_trajectories_are_numbered() -> None:
    assert from_frame(to_frame(replace(example(), labels=()))).labels == ("1", "2")


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
    (tmp_path / "drives.csv").write_bytes(b"\xff\xfe\x00\x01")
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
