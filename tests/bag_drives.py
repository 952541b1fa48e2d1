"""Messages of a drive, the mapping that reads them, and messages of a single number."""

from __future__ import annotations

import math
from pathlib import Path

from bag_writing import THRUST, Said, stamped

from steady_ppl import BagColumn, BagMapping, Trajectories, read_bags

TWIST, SCAN, ODOMETRY = "geometry_msgs/msg/Twist", "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
FLOATS = "std_msgs/msg/Float64MultiArray"

MAPPING = """\
step = 0.1
[columns."u.speed"]
topic = "/cmd_vel"
field = "linear.x"
[columns."y.range"]
topic = "/scan"
field = "ranges[1]"
[columns."y.volt"]
topic = "/thrust"
field = "cells[0].volt"
scale = 2.0
offset = -1.0
[columns."x.heading"]
topic = "/odom"
field = "pose.pose.orientation"
as = "yaw"
"""

Y = BagColumn("y.a", "/y", "data")
U = BagColumn("u.b", "/u", "data")


def turned(heading: float, length: float = 1.0) -> dict[str, float]:
    return {
        "pose.pose.orientation.z": length * math.sin(heading / 2),
        "pose.pose.orientation.w": length * math.cos(heading / 2),
    }


def drive(rows: int = 12, shift: float = 0.0) -> list[Said]:
    """A command, a range, a voltage and a pose every tenth of a second."""
    messages: list[Said] = []
    for i in range(rows):
        t = i / 10
        messages.append(("/cmd_vel", TWIST, t, {"linear.x": i / 8 + shift}))
        messages.append(("/scan", SCAN, t + 0.01, stamped(t, ranges=[0.0, i / 4])))
        cells = [{"volt": 12.0 - i / 16}, {"volt": 3.0}]
        messages.append(("/thrust", THRUST, t + 0.02, stamped(t, gear="ahead", cells=cells)))
        messages.append(("/odom", ODOMETRY, t, stamped(t, **turned(0.5 * i - 3.0, 2.0))))
    return messages


def taken(bags: Path | list[Path], *columns: BagColumn, step: float = 0.1, say=lambda line: None) -> Trajectories:
    return read_bags(bags if isinstance(bags, list) else [bags], BagMapping(columns, step), say)


def values(numbers: list[tuple[float, float]], topic: str = "/y") -> list[Said]:
    return [(topic, "std_msgs/msg/Float64", at, {"data": value}) for at, value in numbers]
