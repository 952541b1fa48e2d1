"""Bags that do not define what their messages are made of, as recorders before ROS 2 Iron wrote them."""

from __future__ import annotations

import re
import sqlite3
from pathlib import Path

import pytest
from bag_drives import MAPPING, ODOMETRY, SCAN, TWIST, drive
from bag_writing import CELL_TEXT, THRUST, THRUST_TEXT, write_bag
from small import steady
from small_tables import same

from steady_ppl import BagColumn, BagMapping, read_bags, read_table


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
    assert 'nobody defines boat_msgs/msg/Thrust: messages = ["PACKAGE/msg/NAME.msg"]' in capsys.readouterr().out


@pytest.mark.parametrize("types", ["geometry_msgs/%", "sensor_msgs/%"])
def test_a_bag_that_defines_some_of_its_types_is_helped_with_the_others(tmp_path: Path, capsys, types: str) -> None:
    bag = without_definitions(write_bag(tmp_path / "drive", "sqlite", drive()), types)
    columns = (BagColumn("u.speed", "/cmd_vel", "angular.x"), BagColumn("y.range", "/scan", "ranges[0]"))
    data = read_bags([bag], BagMapping(columns, 0.1))
    assert data.lengths.tolist() == [12] and bool((data.measurements == 0.0).all())
    said = f"steady: drive does not define {SCAN}: taken from `messages`, else from ROS 2 Humble\n"
    assert capsys.readouterr().err == (said if types == "sensor_msgs/%" else "")  # an Odometry defines Twist as well
