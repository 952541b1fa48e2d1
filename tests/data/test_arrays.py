"""Tables from arrays and frames."""

import doctest

import numpy as np
import pandas as pd
import pytest
from small import simulated

import steady_ppl as st
from steady_ppl.data import table


def columns(data, drive: int) -> dict[str, np.ndarray]:
    """One drive as a person would have it in memory."""
    frame = st.to_frame(data)
    part = frame[frame["trajectory"] == data.labels[drive]].drop(columns="trajectory")
    scalar = {name: part[name].to_numpy() for name in part if not name.startswith("y.")}
    return scalar | {"y.bearing": part.filter(like="y.").to_numpy()}


def test_arrays_are_the_table_that_they_were() -> None:
    data = simulated()
    again = st.from_arrays([columns(data, drive) for drive in range(3)], labels=data.labels)
    assert st.to_frame(again)[st.to_frame(data).columns].equals(st.to_frame(data))


def test_a_frame_in_memory_is_a_table() -> None:
    data = simulated()
    assert st.to_frame(st.from_frame(st.to_frame(data))).equals(st.to_frame(data))


def test_nan_is_a_missing_measurement_and_drives_are_numbered() -> None:
    drive = {"time": np.arange(3.0), "u.push": np.ones(3), "y.place": np.array([1.0, np.nan, 3.0])}
    data = st.from_arrays([drive, {name: values[:2] for name, values in drive.items()}])
    assert data.labels == ("1", "2") and data.lengths.tolist() == [3, 2]
    assert data.observed[:, 0, 0].tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("drives", "labels", "said"),
    [
        ([], None, "got 0 drives and 0 labels"),
        ([{}], ["a", "b"], "got 1 drives and 2 labels"),
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
            "2 drives need 2 labels, and a is there",
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
    with pytest.raises(st.DataError, match=said):
        st.from_arrays(drives, labels)


def test_the_example_runs() -> None:
    assert doctest.testmod(table).attempted and not doctest.testmod(table).failed


def test_frames_keep_their_index_to_themselves() -> None:
    frame = st.to_frame(simulated())
    assert st.to_frame(st.from_frame(frame.set_index(pd.RangeIndex(5, 5 + len(frame))))).equals(frame)
