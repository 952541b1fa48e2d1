"""The table format: what its cells mean, and exact round trips through files, frames and arrays."""

from __future__ import annotations

import doctest
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings, strategies as st
from small import simulated
from small_tables import GOOD, SUFFIXES, example, same, write

from steady_ppl.data import table
from steady_ppl.data.table import from_arrays, from_frame, read_table, to_frame, write_table
from steady_ppl.data.trajectories import Trajectories, pad, pad_time
from steady_ppl.errors import DataError

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
name = st.text("abcXYZ_αβ., '\"", min_size=1, max_size=4).filter(lambda text: text == text.rstrip())
names = st.lists(name, max_size=3, unique=True)
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


# --- arrays and frames ------------------------------------------------------------------------------------------------


def columns(data, drive: int) -> dict[str, np.ndarray]:
    """One drive as a person would have it in memory."""
    frame = to_frame(data)
    part = frame[frame["trajectory"] == data.labels[drive]].drop(columns="trajectory")
    scalar = {name: part[name].to_numpy() for name in part if not name.startswith("y.")}
    return scalar | {"y.bearing": part.filter(like="y.").to_numpy()}


def test_arrays_are_the_table_that_they_were() -> None:
    data = simulated()
    again = from_arrays([columns(data, drive) for drive in range(3)], labels=data.labels)
    assert to_frame(again)[to_frame(data).columns].equals(to_frame(data))


def test_a_frame_in_memory_is_a_table() -> None:
    data = simulated()
    assert to_frame(from_frame(to_frame(data))).equals(to_frame(data))


def test_nan_is_a_missing_measurement_and_drives_are_numbered() -> None:
    drive = {"time": np.arange(3.0), "u.push": np.ones(3), "y.place": np.array([1.0, np.nan, 3.0])}
    data = from_arrays([drive, {name: values[:2] for name, values in drive.items()}])
    assert data.labels == ("1", "2") and data.lengths.tolist() == [3, 2]
    assert data.observed[:, 0, 0].tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("drives", "labels", "said"),
    [
        ([], None, "got 0 trajectories and 0 labels"),
        ([{}], ["a", "b"], "got 1 trajectories and 2 labels"),
        (
            [{"time": np.arange(3.0), "y.place": np.ones(2)}],
            None,
            r"trajectory 1 differ in shape: time \(3,\), y.place",
        ),
        ([{"time": np.arange(3.0), "y.place": np.ones((3, 2, 2))}], None, "differ in shape"),
        (
            [{"time": np.arange(2.0), "y.place": np.ones(2)}, {"time": np.arange(2.0), "y.other": np.ones(2)}],
            None,
            "trajectory 2 has other columns than 1",
        ),
        ([{"time": np.zeros(2), "y.place": np.ones(2)}], None, "column time, trajectory 1, row 2"),
        ([{"time": np.arange(2.0), "place": np.ones(2)}], None, "column place: unknown column"),
        (
            [{"time": np.arange(2.0)}, {"time": 5 + np.arange(2.0)}],
            ["a", "a"],
            "2 trajectories need as many labels, and a is there",
        ),
        (
            [{"time": np.arange(2.0), "y.b": np.ones((2, 2)), "y.b_0": np.ones(2)}],
            None,
            "column y.b_0 of trajectory 1 is there twice",
        ),
        ([{"time": np.arange(2.0), "trajectory": np.ones(2)}], None, "column trajectory of trajectory 1 is what the"),
    ],
)
def test_wrong_arrays_are_named(drives, labels, said: str) -> None:
    with pytest.raises(DataError, match=said):
        from_arrays(drives, labels)


def test_the_example_runs() -> None:
    assert doctest.testmod(table).attempted and not doctest.testmod(table).failed


def test_frames_keep_their_index_to_themselves() -> None:
    frame = to_frame(simulated())
    assert to_frame(from_frame(frame.set_index(pd.RangeIndex(5, 5 + len(frame))))).equals(frame)
