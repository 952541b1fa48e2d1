"""Logs of a truck that drives a circle, in the form of AlphaTruck's."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd

EPOCH = 1_638_480_235

RADIUS, TURN_RATE = 2.0, 0.8
"""The synthetic truck drives a circle about the origin: 2 m, 0.8 rad/s, several turns."""


def stamped(seconds: np.ndarray, columns: dict[str, np.ndarray]) -> pd.DataFrame:
    """A log with the messages' times in the header; the receive times in `Time` are wrong on purpose."""
    nanoseconds = np.round(seconds * 1e9).astype(np.int64)
    header = {
        "Time": EPOCH + seconds[0] + 0.37 * np.arange(len(seconds)),
        "header.seq": np.arange(len(seconds)),
        "header.stamp.secs": EPOCH + nanoseconds // 10**9,
        "header.stamp.nsecs": nanoseconds % 10**9,
        "header.frame_id": "world",
    }
    return pd.DataFrame(header | columns)


def pose_log(begin: float = 0.0, end: float = 25.0) -> pd.DataFrame:
    t = np.arange(round(begin * 100), round(end * 100) + 1) / 100
    heading = TURN_RATE * t + math.pi / 2
    return stamped(
        t,
        {
            "pose.position.x": RADIUS * np.cos(TURN_RATE * t),
            "pose.position.y": RADIUS * np.sin(TURN_RATE * t),
            "pose.position.z": np.full(len(t), 0.3),
            "pose.orientation.x": np.zeros(len(t)),
            "pose.orientation.y": np.zeros(len(t)),
            "pose.orientation.z": np.sin(heading / 2),
            "pose.orientation.w": np.cos(heading / 2),
        },
    )


def command_log(begin: float = 0.0, end: float = 25.0) -> pd.DataFrame:
    t = np.arange(round(begin * 20), round(end * 20) + 1) / 20
    return stamped(t, {"twist.linear.x": 1.0 + 0.1 * t, "twist.linear.y": 0 * t, "twist.angular.z": 0.5 - 0.02 * t})


def write(folder: Path, pose: pd.DataFrame, command: pd.DataFrame) -> Path:
    pose.to_csv(folder / "vrpn-pose.csv", index=False)
    command.to_csv(folder / "vesc_drive.csv", index=False)
    return folder
