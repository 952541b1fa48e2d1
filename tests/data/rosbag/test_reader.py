"""Bags that define their messages or not, what is listed of them, and damage of any kind."""

from __future__ import annotations

import random
import re
import sqlite3
import tomllib
from pathlib import Path

import pytest
from bag_drives import MAPPING, ODOMETRY, SCAN, TWIST, drive, values
from bag_writing import CELL_TEXT, KINDS, THRUST, THRUST_TEXT, write_bag
from small import steady
from small_tables import same

from steady_ppl import BagColumn, BagMapping, read_bags, read_table
from steady_ppl.data.recordings.listing import listing
from steady_ppl.data.rosbag.reader import entries, open_bag
from steady_ppl.errors import SteadyError


def without_definitions(bag: Path, types: str = "%") -> Path:
    """A sqlite bag that forgets the definitions of some types."""
    (file,) = bag.glob("*.db3")
    connection = sqlite3.connect(file)
    connection.execute("DELETE FROM message_definitions WHERE topic_type LIKE ?", (types,))
    connection.execute("UPDATE topics SET type_description_hash = ''")
    connection.commit()
    connection.close()
    metadata = bag / "metadata.yaml"
    metadata.write_text(re.sub(r"type_description_hash:\s+\S+", "type_description_hash: ''", metadata.read_text()))
    return bag


@pytest.mark.slow
@pytest.mark.parametrize("given", ["folder", "file"])
def test_what_a_bag_does_not_define_comes_from_files_or_else_from_humble(
    tmp_path: Path, capsys, refused, given: str
) -> None:
    bag = without_definitions(write_bag(tmp_path / "drive", "sqlite", drive()))
    folder = tmp_path / "src" / "boat_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Thrust.msg").write_text(THRUST_TEXT)
    (tmp_path / "mapping.toml").write_text(MAPPING)
    arguments = ("import-bag", bag, tmp_path / "mapping.toml", "--out", tmp_path / "t.csv")
    refused(2, 'defines the message type boat_msgs/msg/Thrust; name its file in the mapping: messages = ["', *arguments)
    messages = '["src"]' if given == "folder" else '["src/boat_msgs/msg/Thrust.msg", "src/boat_msgs/msg/Cell.msg"]'
    (tmp_path / "mapping.toml").write_text(f"messages = {messages}\n{MAPPING}")
    if given == "folder":
        refused(2, "defines the message type boat_msgs/msg/Cell; name its file", *arguments)
    (folder / "Cell.msg").write_text(CELL_TEXT)
    capsys.readouterr()
    assert steady(*arguments) == 0
    said = f"steady: drive does not define {THRUST}, {TWIST}, {ODOMETRY}, {SCAN}: taken from `messages`, else from"
    assert capsys.readouterr().err == f"{said} ROS 2 Humble\n"
    whole = write_bag(tmp_path / "whole" / "drive", "sqlite", drive())
    same(read_table(tmp_path / "t.csv"), read_bags([whole], BagMapping.read(tmp_path / "mapping.toml")))
    assert steady("import-bag", bag) == 0
    assert (
        'boat_msgs/msg/Thrust is not defined: name its file, messages = ["PACKAGE/msg/NAME.msg"]'
        in capsys.readouterr().out
    )


@pytest.mark.parametrize("types", ["geometry_msgs/%", "sensor_msgs/%"])
def test_a_bag_that_defines_some_of_its_types_is_helped_with_the_others(tmp_path: Path, capsys, types: str) -> None:
    bag = without_definitions(write_bag(tmp_path / "drive", "sqlite", drive()), types)
    columns = (BagColumn("u.speed", "/cmd_vel", "angular.x"), BagColumn("y.range", "/scan", "ranges[0]"))
    data = read_bags([bag], BagMapping(columns, 0.1))
    assert data.lengths.tolist() == [12] and bool((data.measurements == 0.0).all())
    said = f"steady: drive does not define {SCAN}: taken from `messages`, else from ROS 2 Humble\n"
    assert capsys.readouterr().err == (said if types == "sensor_msgs/%" else "")  # an Odometry defines Twist as well


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


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_damage_is_never_a_traceback(tmp_path: Path, kind: str) -> None:
    """Cut short anywhere, or with some bytes changed, it is read or refused."""
    bag = write_bag(tmp_path / "drive", kind, drive())
    (file,) = [bag] if bag.is_file() else [path for path in bag.iterdir() if path.suffix in (".db3", ".mcap")]
    (tmp_path / "mapping.toml").write_text(MAPPING)
    mapping, good, dice, said = (
        BagMapping.read(tmp_path / "mapping.toml"),
        file.read_bytes(),
        random.Random(0),
        list[str](),
    )
    for trial in range(16):
        bad = bytearray(good)
        if trial % 2:
            bad = bad[: dice.randrange(len(bad))]
        else:
            for _ in range(dice.choice((1, 4, 16))):
                bad[dice.randrange(len(bad))] = dice.randrange(256)
        file.write_bytes(bad)
        for attempt in (lambda: read_bags([bag], mapping, lambda line: None), lambda: _listed(bag)):
            try:
                attempt()
            except SteadyError as error:
                said.append(str(error))
    assert len(said) >= 8 and not any("\n" in line for line in said)


def _listed(bag: Path) -> str:
    with open_bag(bag) as opened:
        return listing([(opened.name, entries(opened))])
