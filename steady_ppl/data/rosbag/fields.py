"""Fields of ROS messages: how one is spelt, whether a message type has it, and what a message says there.

A field is spelt with dots and indices, such as `twist.linear.x`, `ranges[0]` or `transforms[2].transform.rotation`.
Types are asked first, so that a field that does not exist is refused before any message is read.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any

from rosbags.interfaces import Nodetype

from steady_ppl.errors import DataError, UsageError

Steps = tuple[str | int, ...]

_SPELLING = re.compile(r"[A-Za-z_]\w*(\[\d+\])*(\.[A-Za-z_]\w*(\[\d+\])*)*", re.ASCII)
_TEXT = ("string", "wstring", "wchar")


def parse_field(field: str) -> Steps:
    """The names and indices that a field is made of; UsageError where it is not spelt as one."""
    if not _SPELLING.fullmatch(field):
        raise UsageError(f"field {field!r} is not spelt as one: expected names and indices such as linear.x or data[0]")
    return tuple(int(step) if step.isdigit() else step for step in re.findall(r"\w+", field))


def check_field(store: Any, type_name: str, steps: Steps, where: str, *, quaternion: bool = False) -> None:
    """Raise DataError, which begins with `where`, unless a message type has a number, or a quaternion, in a field."""
    kind: Any = (Nodetype.NAME, type_name)
    so_far = ""
    for step in steps:
        here = so_far or type_name
        if isinstance(step, int):
            if kind[0] not in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                raise DataError(f"{where}: {here} is {_describe(store, kind)}, it takes no index [{step}]")
            inner, length = kind[1]
            if kind[0] == Nodetype.ARRAY and step >= length:
                about = f"{here} has {length} elements: 0 to {length - 1}"
                raise DataError(f"{where}: index [{step}] is out of range, {about}")
            kind, so_far = inner, f"{so_far}[{step}]"
            continue
        if kind[0] != Nodetype.NAME:
            raise DataError(f"{where}: {here} is {_describe(store, kind)}, it has no field {step}")
        fields = dict(store.get_msgdef(kind[1]).fields)
        if step not in fields:
            raise DataError(f"{where}: {here} has no field {step}; it has {', '.join(fields) or 'none'}")
        kind, so_far = fields[step], f"{so_far}.{step}" if so_far else step
    if quaternion:
        if kind[0] != Nodetype.NAME or not {"x", "y", "z", "w"} <= dict(store.get_msgdef(kind[1]).fields).keys():
            there = _describe(store, kind)
            raise DataError(f"{where}: as yaw needs a quaternion with x, y, z and w, {so_far} is {there}")
    elif kind[0] != Nodetype.BASE or kind[1][0] in _TEXT:
        raise DataError(f"{where}: expected a number, {so_far} is {_describe(store, kind)}")


def has_stamp(store: Any, type_name: str) -> bool:
    """Whether messages of a type carry `header.stamp`."""
    return {"header.stamp.sec", "header.stamp.nanosec"} <= set(numeric_fields(store, type_name))


def undefined_type(store: Any, type_name: str, seen: set[str] | None = None) -> str | None:
    """The first of a type and the types that it is made of that the typestore does not know."""
    seen = set() if seen is None else seen
    if type_name in seen:
        return None
    seen.add(type_name)
    if type_name not in store.fielddefs:
        return type_name
    kinds = [
        kind if kind[0] in (Nodetype.NAME, Nodetype.BASE) else kind[1][0] for _, kind in store.fielddefs[type_name][1]
    ]
    parts = (undefined_type(store, name, seen) for node, name in kinds if node == Nodetype.NAME)
    return next((missing for missing in parts if missing), None)


def value_at(message: Any, steps: Steps, *, yaw: bool = False) -> float:
    """The number that a message has in a field, or the heading of a quaternion; IndexError in too short an array.

    The heading, −π to π rad, is the rotation about z that comes last in z-y-x angles. The quaternion may have any
    length; NaN where it is zero.
    """
    for step in steps:
        message = message[step] if isinstance(step, int) else getattr(message, step)
    if not yaw:
        return float(message)
    x, y, z, w = (float(getattr(message, name)) for name in "xyzw")
    if x == y == z == w == 0:
        return math.nan
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def stamp_of(message: Any) -> int:
    """`header.stamp` of a message, ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def numeric_fields(store: Any, type_name: str, message: Any = None) -> Iterator[str]:
    """Every field of a type that holds a number, arrays with the lengths that they have in a message.

    An array of three numbers is `gains[0…2]`; without a message, one of no fixed length is `ranges[0…]`. A quaternion
    comes once more, with what reads its heading.
    """

    def walk(kind: Any, spelt: str, value: Any) -> Iterator[str]:
        if kind[0] == Nodetype.BASE:
            if kind[1][0] not in _TEXT:
                yield spelt
        elif kind[0] == Nodetype.NAME:
            fields = dict(store.get_msgdef(kind[1]).fields)
            if kind[1].rpartition("/")[2] == "Quaternion":
                yield f'{spelt} (as = "yaw")'
            for name, inner in fields.items():
                if name != "structure_needs_at_least_one_member":
                    yield from walk(inner, f"{spelt}.{name}".lstrip("."), getattr(value, name, None))
        else:
            inner, length = kind[1]
            length = len(value) if value is not None else length if kind[0] == Nodetype.ARRAY else None
            if length == 0:
                yield from walk(inner, f"{spelt}[] (empty in the first message)", None)
                return
            last = "0…" if length is None else "0" if length == 1 else f"0…{length - 1}"
            yield from walk(inner, f"{spelt}[{last}]", None if value is None else value[0])

    yield from walk((Nodetype.NAME, type_name), "", message)


def _describe(store: Any, kind: Any) -> str:
    """What a field holds, in words."""
    if kind[0] == Nodetype.BASE:
        return "text" if kind[1][0] in _TEXT else f"a number ({kind[1][0]})"
    if kind[0] == Nodetype.NAME:
        return f"a {kind[1]} with the fields {', '.join(name for name, _ in store.get_msgdef(kind[1]).fields)}"
    length = f" of {kind[1][1]} elements" if kind[0] == Nodetype.ARRAY else ""
    return f"an array{length}: name one by its index, such as [0]"
