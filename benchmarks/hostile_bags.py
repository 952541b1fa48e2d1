"""Good bags of every kind to spoil, and what can be wrong in a mapping, a message definition and a published log."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random

from hostile_bytes import Spoil

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from bag_writing import KINDS, stamped, write_bag

MAPPING = """\
step = 0.1
messages = ["boat_msgs"]
[columns."u.speed"]
topic = "/cmd_vel"
field = "linear.x"
longest = 2.0
[columns."y.range"]
topic = "/scan"
field = "ranges[1]"
clock = "header"
[columns."y.heading"]
topic = "/odom"
field = "pose.pose.orientation"
as = "yaw"
clock = "aligned"
[columns."x.x"]
topic = "/odom"
field = "pose.pose.position.x"
"""
MESSAGE = "float64 volt\nstring name\nfloat32[3] gains\n"
VALUES = (
    *("0", "-1", "nan", "inf", "-inf", "1e300", "1e-300", "1e-9", "true", "''", "[]", "{}", "1979-05-27", "12:00:00"),
    *("'x'", "9223372036854775807", "99999999999999999999999", "[[[[1]]]]", "'\\u0000'", "'../../etc'", "'/dev/zero'"),
    *("'<script>'", "[1, 'a']", "{a = {b = {c = 1}}}", "0x7f", "'linear.x[99999999999999999999]'", "'yaw'", "'header'"),
)

SECTIONS = (
    *("[columns]", "[columns.u.speed]", '[columns."<script>"]', '[columns."y.\\u001b[2J"]', "[[columns]]", "[step]"),
    *('[columns."y."]', f'[columns."y.{"n" * 10_000}"]', '[columns.""]', '[columns."y.range"]', "[a.b.c.d]"),
)
DEFINITIONS = (
    *("boat_msgs/Battery self\n", "float64[99999999999] many\n", "float64[-1] none\n", "nowhere/Type a\n", "=\n"),
    *("float64 a\n" * 3, f"float64 a{'b' * 100_000}\n", "string<=5 s\nfloat64[<=3] v\n", "int8 X=300\n"),
    *("\n".join(f"float64 a{i}" for i in range(20_000)), "# nothing\n", "float64 \x1b[31m\n", "float64 class\n"),
)


def write_bags(folder: Path) -> None:
    """A bag of every kind with a command, a range, a pose and messages of a type of its own, and a mapping."""
    messages = []
    for i in range(10):
        at = 0.1 * i
        messages += [
            ("/cmd_vel", "geometry_msgs/msg/Twist", at, {"linear.x": 0.5 + at}),
            ("/scan", "sensor_msgs/msg/LaserScan", at + 0.01, stamped(at, ranges=[1.0, 2.0 + at])),
            ("/odom", "nav_msgs/msg/Odometry", at + 0.02, stamped(at, **{"pose.pose.orientation.w": 1.0})),
            ("/thrust", "boat_msgs/msg/Thrust", at + 0.03, stamped(at, left=1.0)),
        ]
    for kind in KINDS:
        write_bag(folder / kind.replace(" ", "_"), kind, messages)
    (folder / "mapping.toml").write_text(MAPPING)
    definitions = folder / "boat_msgs" / "msg"
    definitions.mkdir(parents=True)
    (definitions / "Battery.msg").write_text(MESSAGE)


def _lines(change: Callable[[list[str], Random], list[str]]) -> Spoil:
    def spoil(file: Path, dice: Random) -> None:
        file.write_text("\n".join(change(file.read_text().splitlines(), dice)) + "\n")

    return spoil


def _another_value(lines: list[str], dice: Random) -> list[str]:
    at = dice.choice([i for i, line in enumerate(lines) if "=" in line])
    lines[at] = f"{lines[at].partition('=')[0]}= {dice.choice(VALUES)}"
    return lines


def _one_more(lines: list[str], dice: Random) -> list[str]:
    key = dice.choice(("late", "scale", "offset", "between", "longest", "clock", "as", "field", "step", "colour"))
    lines.insert(dice.randrange(len(lines)), f"{key} = {dice.choice(VALUES)}")
    return lines


def _lost(lines: list[str], dice: Random) -> list[str]:
    del lines[dice.randrange(len(lines))]
    return lines


def _shuffled(lines: list[str], dice: Random) -> list[str]:
    dice.shuffle(lines)
    return lines


def _another_name(lines: list[str], dice: Random) -> list[str]:
    at = dice.choice([i for i, line in enumerate(lines) if line.startswith("[")])
    lines[at] = dice.choice(SECTIONS)
    return lines


TOML: Mapping[str, Spoil] = {
    "another value": _lines(_another_value),
    "one more key": _lines(_one_more),
    "a line lost": _lines(_lost),
    "another section": _lines(_another_name),
}
TOML_ONCE: Mapping[str, Spoil] = {
    "lines shuffled": _lines(_shuffled),
    "nested 10,000 deep": _lines(lambda lines, dice: [f"step = {'[' * 10_000}{']' * 10_000}", *lines[1:]]),
    "tables 10,000 deep": _lines(lambda lines, dice: [*lines, f"[{'.'.join(['a'] * 10_000)}]"]),
    "a number of 10,000 digits": _lines(lambda lines, dice: [f"step = {'9' * 10_000}", *lines[1:]]),
    "10,000 columns": _lines(
        lambda lines, dice: [
            *lines,
            *(f'[columns."y.c{i}"]\ntopic = "/scan"\nfield = "ranges[0]"' for i in range(10_000)),
        ]
    ),
    "messages from the root": _lines(lambda lines, dice: [lines[0], 'messages = ["/proc/self"]', *lines[2:]]),
    "messages without end": _lines(lambda lines, dice: [lines[0], 'messages = ["/dev/zero"]', *lines[2:]]),
    "steps of a nanosecond": _lines(lambda lines, dice: ["step = 1e-9", *lines[1:]]),
    "late by an age": _lines(lambda lines, dice: [*lines, "late = 1e300"]),
}
DEFINITION: Mapping[str, Spoil] = {
    "another definition": lambda file, dice: _write(
        file,
        dice.choice(DEFINITIONS),
    ),
}


def _write(file: Path, text: str) -> None:
    file.write_text(text)


def write_logs(folder: Path) -> None:
    """Twelve seconds as AlphaTruck's logs are."""
    folder.mkdir()
    pose = [
        "header.stamp.secs,header.stamp.nsecs,pose.position.x,pose.position.y,pose.orientation.z,pose.orientation.w"
    ]
    drive = ["header.stamp.secs,header.stamp.nsecs,twist.linear.x,twist.angular.z"]
    for i in range(121):
        stamp = f"{100 + i // 10},{i % 10 * 100_000_000}"
        pose.append(f"{stamp},{0.01 * i},0.5,0.1,0.99")
        drive.append(f"{stamp},0.1,0.02")
    (folder / "vrpn-pose.csv").write_text("\n".join(pose) + "\n")
    (folder / "vesc_drive.csv").write_text("\n".join(drive) + "\n")
