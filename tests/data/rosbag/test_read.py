"""Bags of every kind become the table that the mapping says, and the numbers are those that were written."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from bag_drives import FLOATS, MAPPING, U, Y, drive, taken, values
from bag_writing import KINDS, Said, write_bag
from small import simulated, steady
from small_tables import same

from steady_ppl import BagColumn, BagMapping, DataError, read_bags, read_table
from steady_ppl.data.table import to_frame

# --- kinds of bags ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag_gives_the_numbers_that_were_written(tmp_path: Path, capsys, kind: str) -> None:
    bag = write_bag(tmp_path / "drive", kind, drive())
    (tmp_path / "mapping.toml").write_text(MAPPING)
    assert steady("import-bag", bag, tmp_path / "mapping.toml", "--out", tmp_path / "drive.csv") == 0
    out, error = capsys.readouterr()
    assert out == f"{tmp_path / 'drive.csv'}: 1 trajectory, 12 rows, y.range in 12, y.volt in 12\n" and error == ""
    data, i = read_table(tmp_path / "drive.csv"), torch.arange(12, dtype=torch.float64)
    assert (data.labels, data.control_names, data.state_names) == (("drive",), ("speed",), ("heading",))
    assert data.measurement_names == ("range", "volt") and bool(data.observed.all())
    assert torch.equal(data.time[:, 0], i * 0.1)
    assert torch.equal(data.controls[:, 0, 0], i / 8)
    assert torch.equal(data.measurements[:, 0], torch.stack([i / 4, 2 * (12 - i / 16) - 1], -1))
    assert torch.allclose(data.states[:, 0, 0], 0.5 * i - 3.0, rtol=0, atol=1e-12)  # on beyond pi, in one go
    same(read_bags([bag], BagMapping.read(tmp_path / "mapping.toml")), data)


# --- rows -------------------------------------------------------------------------------------------------------------


def test_a_command_is_held_or_interpolated_and_a_measurement_neither(tmp_path: Path) -> None:
    commands = values([(0.0, 1.0), (0.25, 2.0), (0.4, 5.0)], "/u")
    seen = values([(0.0, 1.0), (0.16, 3.0), (0.5, 7.0)])
    bag = write_bag(tmp_path / "d", "mcap", commands + seen)
    line = BagColumn("u.line", "/u", "data", between="interpolate")
    frame = to_frame(taken(bag, U, line, Y))
    assert frame["u.b"].tolist() == [1.0, 1.0, 1.0, 2.0, 5.0, 5.0]
    np.testing.assert_allclose(frame["u.line"], [1.0, 1.4, 1.8, 3.0, 5.0, 5.0], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(frame["y.a"], [1.0, np.nan, 3.0, np.nan, np.nan, 7.0])


def test_of_several_measurements_the_nearest_is_kept_and_the_others_are_counted(tmp_path: Path, capsys) -> None:
    seen = values([(0.0, 0.0), (0.06, 1.0), (0.11, 2.0), (0.14, 3.0), (0.2, 4.0), (0.23, math.nan)])
    bag = write_bag(tmp_path / "d", "ros1", values([(0.0, 1.0)], "/u") + seen)
    data = read_bags([bag], BagMapping((U, Y), 0.1))
    assert data.measurements[:, 0, 0].tolist() == [0.0, 2.0, 4.0]
    said = "steady: d: measurements left out, because another was nearer to their row: 2 of 5 y.a\n"
    assert capsys.readouterr().err == said


def test_measurements_before_the_first_command_are_left_out_and_counted(tmp_path: Path, capsys) -> None:
    seen = values([(i / 10, float(i)) for i in range(10)])
    bag = write_bag(tmp_path / "d", "mcap", seen + values([(0.5, 1.0)], "/u"))
    data = read_bags([bag], BagMapping((U, Y), 0.1))
    assert data.measurements[:, 0, 0].tolist() == [5.0, 6.0, 7.0, 8.0, 9.0]
    said = "measurements left out, because some control was not known then: 5 of 10 y.a"
    assert capsys.readouterr().err == f"steady: d: {said}\n"


def test_nan_infinity_and_arrays_too_short_are_missing(tmp_path: Path) -> None:
    cells = [[1.0, 2.0], [1.0, math.nan], [1.0, -math.inf], [1.0], [1.0, 6.0]]
    bag = write_bag(tmp_path / "d", "mcap", [("/y", FLOATS, i / 10, {"data": row}) for i, row in enumerate(cells)])
    said: list[str] = []
    first, second = BagColumn("y.a", "/y", "data[0]"), BagColumn("y.b", "/y", "data[1]")
    frame = to_frame(taken(bag, first, second, say=said.append))
    np.testing.assert_array_equal(frame["y.b"], [2.0, np.nan, np.nan, np.nan, 6.0])
    assert len(said) == 1 and "the array is shorter in 1 of 5 messages" in said[0]


def test_a_state_is_interpolated_between_near_neighbours_only(tmp_path: Path) -> None:
    known = values([(0.05, 1.0), (0.25, 2.0), (0.5, 3.0), (0.6, 4.0)], "/x")
    bag = write_bag(tmp_path / "d", "mcap", known + values([(i / 10, 0.0) for i in range(9)]))
    frame = to_frame(taken(bag, Y, BagColumn("x.c", "/x", "data")))
    nan = np.nan
    np.testing.assert_allclose(frame["x.c"], [nan, 1.25, 1.75, nan, nan, 3.0, 4.0, nan, nan], rtol=0, atol=1e-12)


def test_the_heading_of_a_tilted_quaternion_of_any_length(tmp_path: Path) -> None:
    yaw, pitch, size = 2.5, 0.7, 3.0
    cy, sy, cp, sp = math.cos(yaw / 2), math.sin(yaw / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    said = {"w": cy * cp * size, "x": -sy * sp * size, "y": cy * sp * size, "z": sy * cp * size}
    messages = [
        ("/q", "geometry_msgs/msg/PoseStamped", i / 10, {f"pose.orientation.{k}": v for k, v in said.items()})
        for i in range(2)
    ]
    messages.append(("/q", "geometry_msgs/msg/PoseStamped", 0.2, {}))  # no rotation at all: no heading
    bag = write_bag(tmp_path / "d", "ros1", messages)
    data = taken(bag, BagColumn("y.h", "/q", "pose.orientation", reading="yaw"))
    np.testing.assert_allclose(data.measurements[:, 0, 0], [yaw, yaw], rtol=0, atol=1e-12)


# --- several trajectories ---------------------------------------------------------------------------------------------


def test_several_bags_are_trajectories_named_after_their_files(tmp_path: Path) -> None:
    kinds = zip(("one", "two", "three"), ("ros1", "sqlite", "mcap file"), strict=True)
    bags = [write_bag(tmp_path / name, kind, drive(5 + i, i)) for i, (name, kind) in enumerate(kinds)]
    (tmp_path / "mapping.toml").write_text(MAPPING)
    data = read_bags(bags, BagMapping.read(tmp_path / "mapping.toml"))
    assert data.labels == ("one", "two", "three") and data.lengths.tolist() == [5, 6, 7]
    assert data.controls[0, :, 0].tolist() == [0.0, 1.0, 2.0] and bool((data.time[0] == 0).all())


def test_a_pause_of_a_control_splits_and_what_says_nothing_is_dropped(tmp_path: Path, capsys) -> None:
    at = [0.0, 0.1, 0.2, 0.3, 5.0, 7.0, 7.1, 9.0, 9.1, 9.2, 15.0, 15.1]
    seen = [i / 10 for i in range(100) if not 65 < i < 75]
    bag = write_bag(
        tmp_path / "d",
        "mcap",
        values([(t, t) for t in at], "/u") + values([(t, t) for t in seen]),
    )
    paused = BagColumn("u.b", "/u", "data", longest=1.0)
    data = read_bags([bag], BagMapping((paused, Y), 0.1))
    assert data.labels == ("d-1", "d-4") and data.lengths.tolist() == [4, 3]
    assert data.controls[:4, 0, 0].tolist() == [0.0, 0.1, 0.2, 0.3] and data.controls[:3, 1, 0].tolist() == at[7:10]
    assert data.measurements[:3, 1, 0].tolist() == at[7:10] and bool((data.time[0] == 0).all())
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "steady: d-2, from 5.000 s, has one row and is left out"
    assert lines[1] == "steady: d-3, from 7.000 s, has no measurement and is left out"
    assert len(lines) == 3 and "some control was not known then: 83 of 91 y.a" in lines[2]
    whole = read_bags([bag], BagMapping((U, Y), 0.1))
    assert whole.labels == ("d",) and whole.lengths.tolist() == [100]


# --- what is in a bag -------------------------------------------------------------------------------------------------


def test_a_pause_over_which_a_command_is_held_is_said(tmp_path: Path, capsys) -> None:
    controls = [(at / 10, 1.0) for at in (*range(20), *range(600, 620))]
    bag = write_bag(tmp_path / "drive", "mcap", values(controls, "/u") + values([(at / 10, 0.0) for at in range(625)]))
    options = ("--map", "u.b=/u:data", "--map", "y.a=/y:data", "--step", 0.1, "--out", tmp_path / "drive.csv")
    assert steady("import-bag", bag, *options) == 0
    assert "no /u for 58.1 s, 1.9 s after its first: u.b is held as if" in capsys.readouterr().err
    said: list[str] = []
    data = taken(bag, BagColumn("u.b", "/u", "data", longest=1.0), Y, say=said.append)
    assert len(data) == 2 and not any("is held" in line for line in said)
    taken(bag, BagColumn("u.b", "/u", "data", between="interpolate"), Y, say=said.append)
    assert any("u.b is interpolated over it" in line for line in said)


# --- end to end -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_simulated_drives_come_back_from_bags_as_they_were(tmp_path: Path, kind: str) -> None:
    drives, bags = simulated(trajectories=3, rows=25), []
    missing = torch.zeros_like(drives.observed)
    missing[5:8, 1, :2] = missing[12] = True
    for b, label in enumerate(drives.labels):
        messages: list[Said] = []
        for i, t in enumerate(drives.time[:, b].tolist()):
            bearings = drives.measurements[i, b].masked_fill(missing[i, b], math.nan).tolist()
            messages.append(("/thrust", FLOATS, t, {"data": drives.controls[i, b].tolist()}))
            messages.append(("/bearings", FLOATS, t + 0.03, {"data": bearings}))
            messages.append(("/truth", FLOATS, t, {"data": drives.states[i, b].tolist()}))
        bags.append(write_bag(tmp_path / label, kind, messages))
    columns = [BagColumn(f"u.{name}", "/thrust", f"data[{i}]") for i, name in enumerate(drives.control_names)]
    columns += [BagColumn(f"y.{name}", "/bearings", f"data[{i}]") for i, name in enumerate(drives.measurement_names)]
    columns += [BagColumn(f"x.{name}", "/truth", f"data[{i}]") for i, name in enumerate(drives.state_names)]
    found, expected = to_frame(read_bags(bags, BagMapping(tuple(columns), 0.1))), to_frame(drives)
    for i, name in enumerate(drives.measurement_names):
        expected.loc[missing[..., i].T.flatten().numpy(), f"y.{name}"] = np.nan
    assert found.equals(expected)


def test_a_bag_without_a_trajectory_is_an_error(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "d", "mcap", values([(0.0, 1.0)]) + values([(1.0, 1.0)], "/u"))
    with pytest.raises(DataError, match="no trajectory is left of d: .* are the clocks the same"):
        taken(bag, U, Y)
