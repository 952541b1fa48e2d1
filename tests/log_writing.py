"""Logs of PX4 and ArduPilot, written byte by byte as their formats are documented.

https://docs.px4.io/main/en/dev_log/ulog_file_format.html; ArduPilot, libraries/AP_Logger/README.md.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

PX4_TYPES = {"uint64_t": "u8", "int32_t": "i4", "float": "f4", "double": "f8", "uint8_t": "u1", "bool": "u1"}
PACKED = {char: char for char in "bBhHiIfdqQ"} | {"n": "4s", "N": "16s", "Z": "64s", "a": "64s", "M": "B"}
PACKED |= {"c": "h", "C": "H", "e": "i", "E": "I", "L": "i"}


class Sent(NamedTuple):
    """The messages of a topic: its fields by name with their type, `(messages,)` or `(messages, elements)`."""

    name: str
    fields: dict[str, tuple[str, Any]]
    instance: int = 0


def ulog(topics: Sequence[Sent], start: int = 0, extra: bytes = b"") -> bytes:
    """A ULog of topics whose first field is `timestamp`, µs; `extra` stands before the data."""
    flags = _px4("B", bytes(40))
    text, data = b"", list[tuple[int, bytes]]()
    for number, topic in enumerate(topics):
        arrays = {name: np.asarray(values) for name, (_, values) in topic.fields.items()}
        spelt = []
        for name, (kind, _) in topic.fields.items():
            size = f"[{arrays[name].shape[1]}]" if arrays[name].ndim == 2 else ""
            spelt.append(f"{kind}{size} {name};")
        if topic.instance == 0:
            text += _px4("F", f"{topic.name}:{''.join(spelt)}".encode())
        form = [(name, f"<{PX4_TYPES[topic.fields[name][0]]}", array.shape[1:]) for name, array in arrays.items()]
        records = np.empty(len(arrays["timestamp"]), dtype=form)
        for name, array in arrays.items():
            records[name] = array
        size, raw = records.itemsize, records.tobytes()
        head = struct.pack("<HcH", size + 2, b"D", number)
        times = arrays["timestamp"].tolist()
        data += [(t, head + raw[i * size : (i + 1) * size]) for i, t in enumerate(times)]
    for number, topic in enumerate(topics):
        text += _px4("A", struct.pack("<BH", topic.instance, number) + topic.name.encode())
    data.sort(key=lambda one: one[0])
    return b"ULog\x01\x12\x35\x01" + struct.pack("<Q", start) + flags + text + extra + b"".join(raw for _, raw in data)


def _px4(kind: str, body: bytes) -> bytes:
    return struct.pack("<Hc", len(body), kind.encode()) + body


def dropout(milliseconds: int) -> bytes:
    return _px4("O", struct.pack("<H", milliseconds))


class Kind(NamedTuple):
    """A type of DataFlash messages, its fields' characters and names, and the messages, one tuple each."""

    name: str
    form: str
    columns: str
    rows: Sequence[tuple[Any, ...]]
    units: str = ""


def dataflash(kinds: Sequence[Kind]) -> bytes:
    """A DataFlash log of messages whose first field is TimeUS, in the order of their times."""
    text = _fmt(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
    text += _fmt(129, 44, "FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds")
    data = list[tuple[int, bytes]]()
    for number, kind in enumerate(kinds, 130):
        pack = struct.Struct("<" + "".join(PACKED[char] for char in kind.form))
        text += _fmt(number, pack.size + 3, kind.name, kind.form, kind.columns)
        text += _ardupilot(129, struct.pack("<QB16s16s", 0, number, kind.units.encode(), b""))
        data += [(row[0], _ardupilot(number, pack.pack(*row))) for row in kind.rows]
    data.sort(key=lambda one: one[0])
    return text + b"".join(raw for _, raw in data)


def _ardupilot(number: int, body: bytes) -> bytes:
    return b"\xa3\x95" + bytes([number]) + body


def _fmt(number: int, length: int, name: str, form: str, columns: str) -> bytes:
    return _ardupilot(128, struct.pack("<BB4s16s64s", number, length, name.encode(), form.encode(), columns.encode()))
