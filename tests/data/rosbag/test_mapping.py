"""What goes into which column: by a file, by words or in Python, and one clear line for everything wrong with it."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from bag_drives import MAPPING, drive
from bag_writing import write_bag
from examples import MODELS
from small import steady

from steady_ppl import BagColumn, BagMapping, UsageError, read_bags, read_table


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


def test_the_mapping_that_the_how_to_shows_is_one() -> None:
    text = (MODELS.parent / "docs" / "import-bag.md").read_text().split("```toml\n")[1].split("```")[0]
    speed, bearing, heading = BagMapping.parse(tomllib.loads(text), "import-bag.md").columns
    assert speed == BagColumn("u.speed", "/cmd_vel", "linear.x", longest=1.0)
    assert bearing == BagColumn("y.bearing_0", "/bearings", "ranges[0]", clock="aligned")
    assert heading == BagColumn("x.heading", "/mocap", "pose.pose.orientation", reading="yaw")


@pytest.mark.slow
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
        ("y.a=/cmd_vel:linear.x,scale=0", "scale must not be 0"),
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
        ("step = ", "mapping.toml is not TOML: "),
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
