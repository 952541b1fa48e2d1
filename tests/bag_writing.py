"""Bags of every kind, written message by message."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

KINDS = ("ros1", "sqlite", "mcap", "mcap file")
START = 1_700_000_000_000_000_000  # ns, when recording begins
THRUST = "boat_msgs/msg/Thrust"
THRUST_TEXT = "std_msgs/Header header\nfloat32 left\nfloat32 right\nstring gear\nboat_msgs/Cell[] cells\n"
CELL, CELL_TEXT = "boat_msgs/msg/Cell", "float64 volt\n"

Said = tuple[str, str, float, dict[str, Any]]
"""Topic, type, s after START, and the fields that are not zero: `{"linear.x": 1.0}`."""


def typestore(kind: str) -> Any:
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(CELL_TEXT, CELL) | get_types_from_msg(THRUST_TEXT, THRUST))
    return store


def write_bag(path: Path, kind: str, messages: Sequence[Said]) -> Path:
    """Write a bag; returns what a person would name: the file, or the folder."""
    store = typestore(kind)
    path = path.with_suffix(".bag") if kind == "ros1" else path
    if kind == "ros1":
        writer: Any = rosbag1.Writer(path)
    else:
        plugin = StoragePlugin.SQLITE3 if kind == "sqlite" else StoragePlugin.MCAP
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    connections: dict[tuple[str, str], Any] = {}
    with writer:
        for topic, type_name, at, said in messages:
            key = (topic, type_name)
            if key not in connections:
                connections[key] = writer.add_connection(topic, type_name, typestore=store)
            message = filled(store, type_name, said)
            raw = (
                store.serialize_ros1(message, type_name) if kind == "ros1" else store.serialize_cdr(message, type_name)
            )
            writer.write(connections[key], nanoseconds(at), raw)
    if kind != "mcap file":
        return path
    (file,) = path.glob("*.mcap")
    return file.rename(path.with_suffix(".mcap"))


def nanoseconds(seconds: float) -> int:
    """A time after START as bags have it."""
    return START + round(seconds * 1e9)


def stamped(seconds: float, **said: Any) -> dict[str, Any]:
    """Fields with a header stamp, s after START."""
    stamp = nanoseconds(seconds)
    return {"header.stamp.sec": stamp // 10**9, "header.stamp.nanosec": stamp % 10**9, **said}


def filled(store: Any, type_name: str, said: dict[str, Any]) -> Any:
    """A message of zeros but for what is said."""
    message = _blank(store, (Nodetype.NAME, type_name))
    for field, value in said.items():
        *path, last = field.split(".")
        inner = message
        for name in path:
            inner = getattr(inner, name)
        if isinstance(value, list) and value and isinstance(value[0], dict):
            (kind,) = [kind for name, kind in store.get_msgdef(inner.__msgtype__).fields if name == last]
            value = [filled(store, kind[1][0][1], one) for one in value]
        elif isinstance(value, list):
            value = np.array(value, dtype=getattr(inner, last).dtype)
        setattr(inner, last, value)
    return message


def _blank(store: Any, kind: Any) -> Any:
    if kind[0] == Nodetype.NAME:
        fields = {name: _blank(store, inner) for name, inner in store.get_msgdef(kind[1]).fields}
        return store.types[kind[1]](**fields)
    if kind[0] == Nodetype.BASE:
        return "" if kind[1][0] == "string" else False if kind[1][0] == "bool" else 0
    (inner, length), several = kind[1], []
    if inner[0] == Nodetype.NAME or inner[1][0] == "string":
        return [_blank(store, inner) for _ in range(length if kind[0] == Nodetype.ARRAY else 0)] or several
    return np.zeros(length if kind[0] == Nodetype.ARRAY else 0, dtype=inner[1][0])
