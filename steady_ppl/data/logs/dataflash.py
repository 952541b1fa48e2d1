"""ArduPilot's binary DataFlash logs.

A message is 0xA3 0x95, its type, and its fields without padding, low bytes first. Messages FMT (type 128) say of every
type its length, name, the character of each field's form and the fields' names; FMTU marks which field counts
instances. pymavlink reads these logs too, one Python object a message, with 93 MB of what is not needed here; this
takes one pass over the headers, keeps where messages lie, and copies the fields at once.

Source: ArduPilot, libraries/AP_Logger/README.md and LogStructure.h.
"""

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from steady_ppl.data.logs.log import Log, Topic, span
from steady_ppl.errors import DataError
from steady_ppl.utils.text import counted

HEAD = b"\xa3\x95"
FMT, FMT_LENGTH = 0x80, 89
FORMS: Mapping[str, tuple[str, float]] = {
    "a": ("32i2", 1),
    "b": ("i1", 1),
    "B": ("u1", 1),
    "h": ("i2", 1),
    "H": ("u2", 1),
    "i": ("i4", 1),
    "I": ("u4", 1),
    "f": ("f4", 1),
    "d": ("f8", 1),
    "n": ("S4", 1),
    "N": ("S16", 1),
    "Z": ("S64", 1),
    "c": ("i2", 100),
    "C": ("u2", 100),
    "e": ("i4", 100),
    "E": ("u4", 100),
    "L": ("i4", 1e7),
    "M": ("u1", 1),
    "q": ("i8", 1),
    "Q": ("u8", 1),
    "g": ("f2", 1),
}  # NumPy's form and the divisor of each character
CLOCKS = {"log": ("TimeUS",), "sample": ("SampleUS",), "gps": ("GWk", "GMS")}


@dataclass
class _Kind:
    """A type of messages, and where they lie."""

    name: str
    record: np.dtype
    divisors: dict[str, float]
    at: "array[int]" = field(default_factory=lambda: array("q"))  # bytes from the beginning of the log


def read_dataflash(path: Path) -> Log:
    """Read a log as far as it is whole; DataError where nothing of it can be read."""
    data = path.read_bytes()
    kinds, damaged, left = _scan(data, path.name)
    marks = _instance_fields(kinds, data)
    topics: dict[str, Topic] = {}
    for number, kind in kinds.items():
        records = _records(kind, data)
        instance = marks.get(number, "I")
        which = records[instance] if instance in kind.divisors and records[instance].dtype == np.uint8 else None
        for value in (None if which is None else np.unique(which).tolist()) or [None]:
            some = records if value is None else records[which == value]
            topics[f"{kind.name}[{value}]" if value else kind.name] = _topic(kind, some)
    start, end = span(topics)
    notes = []
    if damaged:
        where, lost = counted(len(damaged), "place"), counted(sum(damaged), "byte")
        notes.append(f"it is damaged in {where}: {lost} there are no message and are not read")
    if left:
        what = f"the last {counted(left, 'byte')} are not read"
        notes.append(f"it is cut short or damaged at its end, after {(end - start) / 1e9:.3f} s: {what}")
    return Log(path.name, "ArduPilot DataFlash", topics, start, end, tuple(notes))


def _scan(data: bytes, name: str) -> tuple[dict[int, _Kind], list[int], int]:
    """The types of messages by number, with where theirs lie; how many bytes are none at each damaged place, and at
    the end."""
    kinds: dict[int, _Kind] = {FMT: _kind("FMT", "BBnNZ", "Type,Length,Name,Format,Columns")}
    lengths = [0] * 256
    lengths[FMT] = FMT_LENGTH
    at, end, good, damage = 0, len(data), 0, list[int]()

    def is_message(where: int) -> bool:
        return data[where : where + 2] == HEAD and where + 2 < end and 0 < lengths[data[where + 2]] <= end - where

    while at < end:
        if not is_message(at):
            start, at = at, data.find(HEAD, at + 1)
            while at >= 0 and not (is_message(at) and _goes_on(data, at + lengths[data[at + 2]])):
                at = data.find(HEAD, at + 1)
            if at < 0:
                break
            damage.append(at - start)
        number = data[at + 2]
        if number == FMT:
            _define(data[at + 3 : at + FMT_LENGTH], kinds, lengths)
        kinds[number].at.append(at)
        at += lengths[number]
        good = at
    if len(kinds) == 1:
        raise DataError(f"{name}: cannot be read, it defines no message (FMT); is it damaged or cut short?")
    return kinds, damage, end - good


def _goes_on(data: bytes, at: int) -> bool:
    """Whether another message, or the end of the log, is where a message ends."""
    return data[at : at + 2] == HEAD[: len(data) - at]


def _define(body: bytes, kinds: dict[int, _Kind], lengths: list[int]) -> None:
    """Add the type that an FMT message defines, unless it is damaged or defined already."""
    number, length = body[0], body[1]
    name, form, columns = (_text(part) for part in (body[2:6], body[6:22], body[22:86]))
    if number in kinds or not name or not set(form) <= FORMS.keys() or len(columns.split(",")) != len(form):
        return
    kind = _kind(name, form, columns)
    if kind.record.itemsize + 3 == length and len(kind.divisors) == len(form):
        kinds[number] = kind
        lengths[number] = length


def _kind(name: str, form: str, columns: str) -> _Kind:
    names = columns.split(",")
    pairs = {column: FORMS[char] for column, char in zip(names, form, strict=True)}
    record = np.dtype([(column, _dtype(spelt)) for column, (spelt, _) in pairs.items()])
    return _Kind(name, record, {column: divisor for column, (_, divisor) in pairs.items()})


def _dtype(spelt: str) -> np.dtype:
    return np.dtype(("<i2", 32)) if spelt == "32i2" else np.dtype(f"<{spelt}")


def _text(raw: bytes) -> str:
    return raw.split(b"\0")[0].decode("ascii", "replace")


def _records(kind: _Kind, data: bytes) -> np.ndarray:
    size = kind.record.itemsize
    return np.frombuffer(b"".join(data[at + 3 : at + 3 + size] for at in kind.at), kind.record)


def _instance_fields(kinds: Mapping[int, _Kind], data: bytes) -> dict[int, str]:
    """Of each type the field that counts instances, as messages FMTU say: a # at its place among their units."""
    marks: dict[int, str] = {}
    for said in (kind for kind in kinds.values() if kind.name == "FMTU"):
        records = _records(said, data)
        if {"FmtType", "UnitIds"} <= said.divisors.keys() and records["UnitIds"].dtype.kind == "S":
            for number, units in zip(records["FmtType"].tolist(), records["UnitIds"].tolist(), strict=True):
                place, names = units.find(b"#"), list(kinds[number].divisors) if number in kinds else []
                if 0 <= place < len(names):
                    marks[number] = names[place]
    return marks


def _topic(kind: _Kind, records: np.ndarray) -> Topic:
    fields: dict[str, np.ndarray] = {}
    for name in kind.divisors:
        values = records[name]
        fields |= {name: values} if values.ndim == 1 else {f"{name}[{i}]": values[:, i] for i in range(32)}
    return Topic(fields, CLOCKS, {name: divisor for name, divisor in kind.divisors.items() if divisor != 1})
