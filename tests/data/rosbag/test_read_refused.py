"""One clear line for everything that can be wrong with a bag, and nothing written."""

from __future__ import annotations

from pathlib import Path

import pytest
from bag_drives import FLOATS, SCAN, TWIST, values
from bag_writing import THRUST, filled, stamped, typestore, write_bag
from small import steady

from steady_ppl import BagColumn, BagMapping, UsageError, read_bags, read_table

Y = ("--map", "y.a=/scan:ranges[0]")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((), "Missing argument"),
        (("m.toml",), "import-bag needs at least one BAG and at most one MAPPING.toml"),
        (("drive", "a.toml", "b.toml"), "at most one MAPPING.toml"),
        (("drive", "nowhere.toml", "--out", "t.csv"), "nowhere.toml cannot be read: No such file"),
        (("drive", "--out", "t.csv"), "name what to take from the bag"),
        (("drive", "--step", "0.1"), "name what to take from the bag"),
        (("drive", *Y, "--step", "0.1"), "name the table to write: --out TABLE"),
        (("drive", *Y, "--out", "t.csv"), "there is no step"),
        (("drive", *Y, "--out", "t.csv", "--step", "-1"), "step is -1.0, expected the seconds between two rows"),
        (("drive", *Y, "--out", "t.csv", "--step", "nan"), "step is nan"),
        (("drive", *Y, "--out", "t.csv", "--step", "fast"), "--step"),
        (("drive", *Y, "--out", "t.txt", "--step", "0.1"), "t.txt: a table is a .csv or .parquet file"),
        (("drive", *Y, "--out", "no/t.csv", "--step", "0.1"), "there is no folder no"),
        (("drive", "drive", *Y, "--out", "t.csv", "--step", "0.1"), "two bags are named drive"),
        (("nowhere.bag", *Y, "--out", "t.csv", "--step", "0.1"), "nowhere.bag: there is no such file or folder"),
        (("nowhere.bag",), "nowhere.bag: there is no such file or folder"),
        (("notes.txt",), "notes.txt: is no bag: expected a .bag, .mcap or .db3 file or a folder with metadata.yaml"),
        (("folder",), "folder: is no bag: a folder needs metadata.yaml"),
        (("notes.bag",), "notes.bag: cannot be read, is it damaged or cut short?"),
        (("notes.mcap",), "notes.mcap: cannot be read, is it damaged or cut short?"),
        (("notes.db3",), "notes.db3: cannot be read, is it damaged or cut short?"),
    ],
)
def test_bad_usage_is_one_line(tmp_path: Path, monkeypatch, bag: Path, refused, arguments, says: str) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("notes.txt", "notes.bag", "notes.mcap", "notes.db3"):
        (tmp_path / name).write_text("not a bag")
    (tmp_path / "folder").mkdir()
    refused(2, says, "import-bag", *arguments)


def test_a_control_that_is_not_known_is_refused(tmp_path: Path, refused) -> None:
    rows = [("/u", FLOATS, 0.1, {"data": [1.0]}), ("/u", FLOATS, 0.2, {"data": [float("nan"), 1.0]})]
    bag = write_bag(tmp_path / "d", "mcap", rows + values([(0.1, 1.0)]))
    arguments = ("--map", "y.a=/y:data", "--step", 0.1, "--out", tmp_path / "t.csv")
    says = "column u.a, topic /u, field data[0]: got nan after 0.100 s, expected a finite number"
    refused(2, says, "import-bag", bag, "--map", "u.a=/u:data[0]", *arguments)
    refused(2, "out of range in 1 of 2 messages", "import-bag", bag, "--map", "u.a=/u:data[1]", *arguments)


def test_a_stamp_that_nobody_set_is_refused(tmp_path: Path, refused) -> None:
    rows = [("/scan", SCAN, 0.1, stamped(0.1, ranges=[1.0])), ("/scan", SCAN, 0.2, {"ranges": [1.0]})]
    bag = write_bag(tmp_path / "d", "sqlite", rows)
    says = 'the header.stamp of 1 of 2 messages is zero, nobody set it; use clock = "bag"'
    for clock in ("header", "aligned"):
        maps = ("--map", f"y.a=/scan:ranges[0],clock={clock}", "--step", 0.1)
        refused(2, says, "import-bag", bag, *maps, "--out", tmp_path / "t.csv")


def test_a_topic_of_two_types_is_refused_and_listed(tmp_path: Path, refused, capsys) -> None:
    rows = [("/a", TWIST, 0.0, {}), ("/a", THRUST, 0.1, {})]
    bag = write_bag(tmp_path / "d", "mcap", rows)
    says = f"its messages are of several types, {THRUST} and {TWIST}"
    refused(2, says, "import-bag", bag, "--map", "y.a=/a:left", "--step", 0.1, "--out", tmp_path / "t.csv")
    assert steady("import-bag", bag) == 0
    assert f"# /a  {THRUST} and {TWIST}  2 messages" in capsys.readouterr().out


def test_a_control_without_a_message_is_refused(tmp_path: Path, refused) -> None:
    from rosbags.rosbag1 import Writer

    store = typestore("ros1")
    with Writer(tmp_path / "d.bag") as writer:
        writer.add_connection("/u", TWIST, typestore=store)
        connection = writer.add_connection("/y", THRUST, typestore=store)
        for i in range(3):
            writer.write(connection, i * 10**8, store.serialize_ros1(filled(store, THRUST, {}), THRUST))
    maps = ("--map", "u.a=/u:linear.x", "--map", "y.a=/y:left", "--step", 0.1)
    refused(2, "there is no message, and a control must be", "import-bag", tmp_path / "d.bag", *maps, "--out", "t.csv")
    assert steady("import-bag", tmp_path / "d.bag") == 0


def test_trajectories_of_one_name_are_refused(tmp_path: Path) -> None:
    commands = values([(0.0, 1.0), (0.1, 1.0), (5.0, 1.0), (5.1, 1.0)], "/u")
    seen = values([(i / 10, 1.0) for i in range(52)])
    pausing = write_bag(tmp_path / "a", "ros1", commands + seen)  # a-1 and a-2
    other = write_bag(tmp_path / "a-2", "ros1", commands[:2] + seen[:2])
    maps = ("--map", "u.b=/u:data,longest=1", "--map", "y.a=/y:data", "--step", 0.1)
    mapping = BagMapping((BagColumn("u.b", "/u", "data", longest=1.0), BagColumn("y.a", "/y", "data")), 0.1)
    with pytest.raises(UsageError, match="two trajectories are named a-2: rename the bag a.bag"):
        read_bags([other, pausing], mapping, lambda line: None)
    assert steady("import-bag", pausing, *maps, "--out", tmp_path / "t.csv") == 0
    assert read_table(tmp_path / "t.csv").labels == ("a-1", "a-2")
