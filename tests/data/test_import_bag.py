"""Bags of every kind become the table that the mapping says, and the numbers are those that were written."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch
from bag_drives import FLOATS, MAPPING, TWIST, U, Y, drive, taken, values
from bag_writing import KINDS, Said, write_bag
from examples import MODELS
from small import simulated, steady
from small_tables import same

from steady_ppl import BagColumn, BagMapping, DataError, read_bags, read_table
from steady_ppl.data.table import to_frame

# --- kinds of bags ----------------------------------------------------------------------------------------------------


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


def test_options_spell_the_same_as_a_file(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "drive", "mcap", drive())
    (tmp_path / "mapping.toml").write_text(MAPPING)
    assert steady("import-bag", bag, tmp_path / "mapping.toml", "--out", tmp_path / "a.csv") == 0
    maps = (
        "u.speed=/cmd_vel:linear.x",
        "y.range=/scan:ranges[1]",
        "y.volt=/thrust:cells[0].volt,scale=2,offset=-1",
        "x.heading=/odom:pose.pose.orientation,as=yaw",
    )
    options = [word for text in maps for word in ("--map", text)]
    assert steady("import-bag", bag, *options, "--step", 0.1, "--out", tmp_path / "b.csv") == 0
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    extra = ("--map", "y.left=/thrust:left", "--step", 0.2)
    assert steady("import-bag", bag, tmp_path / "mapping.toml", *extra, "--out", tmp_path / "c.csv") == 0
    data = read_table(tmp_path / "c.csv")
    assert data.measurement_names == ("range", "volt", "left") and data.median_step == pytest.approx(0.2)


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


@pytest.mark.parametrize("kind", KINDS)
def test_without_a_mapping_the_bag_is_listed_and_the_list_is_a_mapping_to_start_from(
    tmp_path: Path, capsys, kind: str
) -> None:
    bag = write_bag(tmp_path / "drive", kind, drive())
    assert steady("import-bag", bag) == 0
    out, error = capsys.readouterr()
    assert error == ""
    for says in (
        f"# /cmd_vel  {TWIST}  12 messages  10 Hz\n#     linear.x, linear.y, linear.z, angular.x, angular.y,",
        'pose.pose.orientation (as = "yaw"), pose.pose.orientation.x',
        "pose.covariance[0…35]",
        "ranges[0…1], intensities[] (empty in the first message)",
        "left, right, cells[0…1].volt\n",
        '# [columns."y.cmd_vel_linear_x"]\n# topic = "/cmd_vel"\n# field = "linear.x"\n',
    ):
        assert says in out
    assert "gear" not in out  # which is text
    start = tmp_path / "start.toml"
    start.write_text(out)
    with pytest.raises(Exception, match="there is no measurement"):
        BagMapping.read(start)
    head, step, sections = out.partition("step = 0.1  # s between two rows\n")
    start.write_text(head + step + re.sub("^# ?", "", sections, flags=re.MULTILINE))
    columns = {column.topic: column for column in BagMapping.read(start).columns}
    assert columns["/cmd_vel"] == BagColumn("y.cmd_vel_linear_x", "/cmd_vel", "linear.x")
    assert columns["/scan"].field == "angle_min" and columns["/scan"].clock == "aligned"
    assert len(columns) == 4


def test_the_list_of_several_bags_is_one_mapping(tmp_path: Path, capsys) -> None:
    for name in ("one", "two"):
        write_bag(tmp_path / name, "mcap", drive())
    assert steady("import-bag", tmp_path / "one", tmp_path / "two") == 0
    out = capsys.readouterr().out
    assert "# one\n" in out and "# two\n" in out
    assert tomllib.loads(out) == {"step": 0.1} and out.count('"y.cmd_vel_linear_x"') == 1


def test_topics_that_spell_alike_are_columns_of_their_own(tmp_path: Path, capsys) -> None:
    bag = write_bag(tmp_path / "drive", "mcap", values([(0.0, 1.0)], "/a/b") + values([(0.0, 1.0)], "/a_b"))
    assert steady("import-bag", bag) == 0
    sections = capsys.readouterr().out.partition("step = 0.1")[2]
    mapping = tomllib.loads("step = 0.1" + re.sub("^# ?", "", sections, flags=re.MULTILINE))
    assert {name: said["topic"] for name, said in mapping["columns"].items()} == {
        "y.a_b_data": "/a/b",
        "y.a_b_data_2": "/a_b",
    }


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


def test_the_mapping_that_the_how_to_shows_is_one() -> None:
    text = (MODELS.parent / "docs" / "import-bag.md").read_text().split("```toml\n")[1].split("```")[0]
    speed, bearing, heading = BagMapping.parse(tomllib.loads(text), "import-bag.md").columns
    assert speed == BagColumn("u.speed", "/cmd_vel", "linear.x", longest=1.0)
    assert bearing == BagColumn("y.bearing_0", "/bearings", "ranges[0]", clock="aligned")
    assert heading == BagColumn("x.heading", "/mocap", "pose.pose.orientation", reading="yaw")


# --- end to end -------------------------------------------------------------------------------------------------------


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
