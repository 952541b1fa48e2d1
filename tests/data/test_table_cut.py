"""Long drives are cut into pieces, and refused in one where time and memory would grow with them without end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from small import HOVERCRAFT, simulated, steady, written

import steady_ppl as st
from steady_ppl.data.table import MAX_DRIVE_ROWS


def test_pieces_are_the_rows_of_their_time_as_they_were():
    data = simulated(trajectories=2, rows=25)
    pieces = st.cut(data, 1.0)
    assert pieces.labels == ("1-1", "1-2", "1-3", "2-1", "2-2", "2-3") and pieces.lengths.tolist() == [10, 10, 5] * 2
    whole, parts = st.to_frame(data), st.to_frame(pieces)
    pd.testing.assert_frame_equal(parts.drop(columns="trajectory"), whole.drop(columns="trajectory"))
    assert st.cut(data, 100.0).labels == ("1", "2")
    again = st.cut(pieces, 1.0)
    assert torch.equal(again.measurements, pieces.measurements) and again.labels == pieces.labels


def test_a_piece_begins_with_a_measurement_and_has_two_rows():
    data = simulated(trajectories=1, rows=31)
    observed = data.observed.clone()
    observed[:3] = False  # of the first piece
    observed[10:20] = False  # all of the second
    pieces = st.cut(replace(data, observed=observed), 1.0)
    assert pieces.labels == ("1-1", "1-3") and pieces.lengths.tolist() == [7, 10]  # row 31 is a piece of its own
    assert pieces.observed[0].any(-1).all()


def test_a_control_may_have_y_in_its_name():
    data = simulated(trajectories=1, rows=21)
    observed = data.observed.clone()
    observed[:10] = False
    pieces = st.cut(replace(data, observed=observed, control_names=("battery.volts", "right")), 1.0)
    assert pieces.labels == ("1-2",)


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf"), 1e-20, 1e-320])
def test_no_length_of_time_is_refused(seconds):
    with pytest.raises(st.UsageError, match="seconds"):
        st.cut(simulated(), seconds)


def test_what_cannot_be_cut_says_why():
    data = simulated(trajectories=3, rows=21)
    with pytest.raises(st.DataError, match=r"no piece of 0\.05 s has two rows"):
        st.cut(data, 0.05)
    with pytest.raises(st.DataError, match="two pieces would be called a-1"):
        st.cut(replace(data, labels=("a", "a-1", "b"), lengths=torch.tensor([21, 8, 21])), 1.0)


@pytest.mark.exhaustive
def test_what_looks_at_drives_as_a_whole_refuses_long_ones(tmp_path, capsys):
    rows = MAX_DRIVE_ROWS + 1
    frame = st.to_frame(simulated(trajectories=6, rows=11))
    first = frame[frame["trajectory"] == "1"]
    first = pd.concat([first] * (rows // 11 + 1)).iloc[:rows].assign(time=np.arange(rows) / 10)
    stretched = pd.concat([first, frame[frame["trajectory"] != "1"]])
    table, run, other = (tmp_path / name for name in ("long.csv", "run", "other"))
    st.write_table(st.from_frame(stretched), table)
    valid = written(tmp_path / "valid.csv", simulated(trajectories=6, seed=1))
    for folder in (run, other):
        assert steady("fit", HOVERCRAFT, valid, "--recipe", "hand", "--out", folder) == 0
    commands = [
        ("check", run, table),
        ("evaluate", run, table),
        ("prove", run, other, table),
        ("states", run, table, "--out", tmp_path / "states.csv"),
        ("discover", run, table, "--valid", valid),
        ("report", run, table, "--out", tmp_path / "page.html"),
    ]
    for command in commands:
        capsys.readouterr()
        assert steady(*command) == 2, command
        said = capsys.readouterr().err
        assert f"trajectory 1 has {rows} rows" in said and "steady data cut" in said, command
