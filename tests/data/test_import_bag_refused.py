"""One clear line for everything that can be wrong with a bag or a mapping, and nothing written."""

from __future__ import annotations

import random
import subprocess
import sys
from pathlib import Path

import pytest
from bag_drives import FLOATS, MAPPING, SCAN, TWIST, drive, values
from bag_writing import KINDS, THRUST, filled, stamped, typestore, write_bag
from small import steady

from steady_ppl import BagColumn, BagMapping, UsageError, read_bags, read_table
from steady_ppl.data.rosbag.reader import listing, open_bag
from steady_ppl.errors import SteadyError

Y = ("--map", "y.a=/scan:ranges[0]")


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "drive", "mcap", drive(4))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("y.a=/scam:ranges[0]", "topic /scam, field ranges[0]: drive has no such topic; did you mean /scan"),
        ("y.a=/nothing/alike:x", "it has /cmd_vel, /odom, /scan, /thrust"),
        ("y.a=/scan:range", "sensor_msgs/msg/LaserScan has no field range; it has header, angle_min, angle_max,"),
        ("y.a=/cmd_vel:linear.w", "linear has no field w; it has x, y, z"),
        ("y.a=/cmd_vel:linear", "expected a number, linear is a geometry_msgs/msg/Vector3 with the fields x, y, z"),
        ("y.a=/scan:ranges", "expected a number, ranges is an array: name one by its index, such as [0]"),
        ("y.a=/odom:pose.covariance", "pose.covariance is an array of 36 elements: name one by its index"),
        ("y.a=/thrust:gear", "expected a number, gear is text"),
        ("y.a=/thrust:left.x", "left is a number (float32), it has no field x"),
        ("y.a=/thrust:left[0]", "left is a number (float32), it takes no index [0]"),
        ("y.a=/odom:pose.covariance[36]", "index [36] is out of range, pose.covariance has 36 elements: 0 to 35"),
        ("y.a=/scan:ranges[2]", "the index is out of range in 4 of 4 messages, the array is shorter"),
        ("y.a=/odom:pose.pose.position,as=yaw", "as yaw needs a quaternion with x, y, z and w, pose.pose.position is"),
        ("y.a=/cmd_vel:linear.x,clock=header", 'a geometry_msgs/msg/Twist has no header.stamp; expected clock = "bag"'),
        ("y.a=/cmd_vel:linear.x,clock=sun", 'column y.a: clock is \'sun\', expected "bag" or "header" or "aligned"'),
        ("u.a=/cmd_vel:linear.x,between=spline", 'between is \'spline\', expected "hold" or "interpolate"'),
        ("y.a=/cmd_vel:linear.x,between=hold", "between is for controls (u.)"),
        ("x.a=/cmd_vel:linear.x,longest=3", "longest is for controls (u.)"),
        ("u.a=/cmd_vel:linear.x,longest=0.15", "longest is 0.15 s, expected at least two steps of 0.1 s"),
        ("y.a=/cmd_vel:linear.x,as=pitch", 'as is \'pitch\', expected "yaw" or "angle"'),
        ("y.a=/cmd_vel:linear.x,late=soon", "late is 'soon', expected a finite number"),
        ("y.a=/cmd_vel:linear.x,late=nan", "late is nan, expected a finite number"),
        ("y.a=/cmd_vel:linear.x,scale=0", "scale is 0"),
        ("y.a=/cmd_vel:linear.x,colour=red", "column y.a: unknown key colour; there are topic, field, as, between"),
        ("y.a=/cmd_vel:linear..x", "field 'linear..x' is not spelt as one"),
        ("y.a=/scan:ranges[-1]", "field 'ranges[-1]' is not spelt as one"),
        ("speed=/cmd_vel:linear.x", "column speed: expected u.NAME (a control), y.NAME (a measurement) or x.NAME"),
        ("u.=/cmd_vel:linear.x", "column u.: expected u.NAME"),
        ("y.a", "--map y.a: expected COLUMN=TOPIC:FIELD[,KEY=VALUE...], such as u.speed=/cmd_vel:linear.x"),
        ("y.a=/cmd_vel", "expected COLUMN=TOPIC:FIELD"),
        ("y.a=/cmd_vel:linear.x,late", "'late' is not KEY=VALUE"),
        ("y.a=/cmd_vel:linear.x,late=1,late=2", "late is given twice"),
        ("y.b=/cmd_vel:linear.x", "column y.b is given twice"),
    ],
)
def test_a_bad_column_is_refused(tmp_path: Path, bag: Path, refused, text: str, says: str) -> None:
    maps = ("--map", "y.b=/scan:ranges[0]", "--map", text)
    refused(2, says, "import-bag", bag, *maps, "--step", 0.1, "--out", tmp_path / "t.csv")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "mapping.toml: there is no step: say how many seconds"),
        ("step = 0.1", "mapping.toml: there is no measurement: name at least one column y.NAME"),
        ("step = 0", "there is no measurement"),
        ("step = ", "mapping.toml: is not TOML: "),
        ("stride = 0.1", "mapping.toml: unknown key stride; there are step, columns, messages"),
        ("step = 0.1\n[columns.u.speed]\ntopic = '/a'\nfield = 'b'", "column u: unknown key speed"),
        ("step = 0.1\ncolumns = 3", "columns must be sections such as"),
        ("step = 0.1\n[columns]\n'u.a' = 3", "columns must be sections such as"),
        ("step = 0.1\n[columns.'y.a']\ntopic = '/a'", "column y.a: there is no field"),
        ("step = 0.1\n[columns.'y.a']\ntopic = 3\nfield = 'b'", "column y.a: topic is 3, expected text"),
        (
            "step = 0.1\n[columns.'y.a']\ntopic = '/a'\nfield = 'b'\nlate = true",
            "late is True, expected a finite number",
        ),
        (MAPPING.split('[columns."y')[0], "there is no measurement"),
        (f"messages = 'src'\n{MAPPING}", "messages is 'src', expected a list"),
        (f"messages = ['nowhere/msg/A.msg']\n{MAPPING}", "A.msg cannot be read: No such file"),
        (f"messages = ['mapping.toml']\n{MAPPING}", "expected PACKAGE/msg/NAME.msg, got"),
        (f"messages = ['empty']\n{MAPPING}", "holds no .msg file"),
        (f"messages = ['odd']\n{MAPPING}", "is not a message definition"),
    ],
)
def test_a_bad_file_is_refused(tmp_path: Path, bag: Path, refused, text: str, says: str) -> None:
    if text == "step = 0":
        text, says = MAPPING.replace("step = 0.1", "step = 0.0"), "step is 0.0, expected the seconds between two rows"
    (tmp_path / "mapping.toml").write_text(text)
    (tmp_path / "empty").mkdir()
    (tmp_path / "odd" / "msg").mkdir(parents=True)
    (tmp_path / "odd" / "msg" / "A.msg").write_text("float64 = = 3\n")
    refused(2, says, "import-bag", bag, tmp_path / "mapping.toml", "--out", tmp_path / "t.csv")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((), "Missing argument"),
        (("m.toml",), "import-bag needs at least one BAG and at most one MAPPING.toml"),
        (("drive", "a.toml", "b.toml"), "at most one MAPPING.toml"),
        (("drive", "nowhere.toml", "--out", "t.csv"), "nowhere.toml: cannot be read: No such file"),
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
        return listing([opened])


def test_a_mapping_built_in_python_is_judged_like_a_file() -> None:
    column = BagColumn("y.a", "/a", "b")
    for wrong in (
        lambda: BagMapping((), 0.1),
        lambda: BagMapping((column,), 0.0),
        lambda: BagMapping((column, column), 0.1),
        lambda: BagColumn("a", "/a", "b"),
        lambda: BagColumn("y.a", "", "b"),
        lambda: read_bags([], BagMapping((column,), 0.1)),
    ):
        with pytest.raises(UsageError):
            wrong()


def test_help_waits_for_neither_torch_nor_rosbags() -> None:
    code = (
        "import sys; from steady_ppl.cli.main import main\n"
        "assert main(['import-bag', '--help']) == 0\n"
        "print(sorted({'torch', 'rosbags', 'pandas', 'numpy'} & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
