"""A bag as topics, messages and their fields, read by `rosbags`.

ROS 1 bags and most ROS 2 bags define the types of their messages. Where a ROS 2 bag does not (sqlite bags recorded
before Iron never do), the standard types are those of Humble, and others are read from .msg files. Types are asked
first, so that a field that does not exist is refused before any message is read.
"""

import difflib
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from steady_ppl.data.recordings.listing import Entry
from steady_ppl.data.rosbag.mapping import Steps
from steady_ppl.errors import DataError, SteadyError, UsageError
from steady_ppl.utils.files import require_file
from steady_ppl.utils.text import one_line

ALIGNED_KEY = 'clock = "aligned"  # its header says when it was made; leave out for the time of arrival'
TEXT_TYPES = ("string", "wstring", "wchar")


@dataclass(frozen=True)
class Bag:
    """An open bag."""

    name: str  # of its file or folder, for error messages
    reader: AnyReader
    defined: frozenset[str]  # the message types that the bag itself defines

    @property
    def store(self) -> Any:
        """rosbags' typestore with all types that the bag or the user defines."""
        return self.reader.typestore

    @property
    def topics(self) -> list[str]:
        return sorted({connection.topic for connection in self.reader.connections})

    def types(self, topic: str) -> list[str]:
        """The types of a topic's messages: one, unless publishers disagreed."""
        return sorted({connection.msgtype for connection in self.reader.connections if connection.topic == topic})

    def type_of(self, topic: str, where: str) -> str:
        """The type of a topic's messages; DataError, which begins with `where`, unless there is one that is defined."""
        if topic not in self.topics:
            near = difflib.get_close_matches(topic, self.topics, n=3, cutoff=0.5)
            hint = f"did you mean {' or '.join(near)}?" if near else f"it has {', '.join(self.topics) or 'no topics'}"
            raise DataError(f"{where}: {self.name} has no such topic; {hint}")
        names = self.types(topic)
        if len(names) > 1:
            raise DataError(f"{where}: its messages are of several types, {' and '.join(names)}; expected one")
        if missing := undefined_type(self.store, names[0]):
            what = f"neither {self.name} nor rosbags' typestore defines the message type {missing}"
            how = 'name its file in the mapping: messages = ["PACKAGE/msg/NAME.msg"], or a folder of such files'
            raise DataError(f"{where}: {what}; {how}")
        return names[0]

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[Any, int, bytes]]:
        """Connection, time of arrival (ns) and bytes of every message of some topics, in the order of the bag."""
        connections = [connection for connection in self.reader.connections if connection.topic in topics]
        with _damage(self.name):
            for connection, received, raw in self.reader.messages(connections=connections) if connections else ():
                if received >= 2**63:
                    what = f"a message of {connection.topic} came at {received} ns"
                    raise DataError(f"{self.name}: {what}: is it damaged?")
                yield connection, received, raw

    def content(self, connection: Any, raw: bytes) -> Any:
        """What the bytes of a message say; DataError where they are not of the type that the bag says."""
        with _damage(self.name, f"a message of {connection.topic} "):
            return self.reader.deserialize(raw, connection.msgtype)


@contextmanager
def open_bag(path: Path, messages: Sequence[Path] = ()) -> Iterator[Bag]:
    """Open a ROS 1 .bag, a ROS 2 folder, or a single .mcap or .db3 file; DataError for no bag or a damaged one.

    `messages` are .msg files of types that the bag does not define; UsageError where one is missing or wrong.
    """
    name = bag_name(path)
    own = _definitions(messages)
    if not path.exists():
        raise DataError(f"{name}: there is no such file or folder")
    if path.is_dir() and not (path / "metadata.yaml").exists():
        raise DataError(f"{name}: is no bag: a folder needs metadata.yaml; name the .mcap or .bag file itself")
    if path.is_file() and path.suffix not in (".bag", ".mcap", ".db3"):
        raise DataError(f"{name}: is no bag: expected a .bag, .mcap or .db3 file or a folder with metadata.yaml")
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if not file.is_dir():
            require_file(file, DataError)
    known = get_typestore(Stores.EMPTY)
    known.register({**get_typestore(Stores.ROS2_HUMBLE).fielddefs, **own})
    with _damage(name):
        reader = AnyReader([path], default_typestore=known)
        reader.open()
    try:
        with _damage(name):
            speaks = any(connection.msgdef.data for connection in reader.connections)
            defined = frozenset(reader.typestore.fielddefs) if speaks else frozenset[str]()
            extra = known.fielddefs if reader.is2 else own
            if any(undefined_type(reader.typestore, connection.msgtype) for connection in reader.connections):
                reader.typestore.register({key: extra[key] for key in extra if key not in reader.typestore.fielddefs})
        yield Bag(name, reader, defined)
    finally:
        reader.close()


def bag_name(path: Path) -> str:
    """The name of a bag's file or folder."""
    return path.name or path.resolve().name


@contextmanager
def _damage(name: str, what: str = "") -> Iterator[None]:
    """What rosbags raises on a file that is damaged, cut short or no bag, whatever its class, as one line."""
    try:
        yield
    except SteadyError:
        raise
    except Exception as error:
        said = " ".join(one_line(error).split())
        raise DataError(f"{name}: {what}cannot be read, is it damaged or cut short? ({said[:200]})") from error


def _definitions(paths: Sequence[Path]) -> dict[str, Any]:
    """The message types that .msg files, or folders of them, define, named after their package."""
    found: dict[str, Any] = {}
    for path in paths:
        files = sorted(path.rglob("*.msg")) if path.is_dir() else [path]
        if not files:
            raise UsageError(f"messages: the folder {path} holds no .msg file")
        for file in files:
            package, folder, _ = ["", "", *Path(os.path.realpath(file)).parts][-3:]
            if file.suffix != ".msg" or folder != "msg":
                raise UsageError(f"messages: expected PACKAGE/msg/NAME.msg, got {file}")
            require_file(file, UsageError)
            try:
                own = get_types_from_msg(file.read_text(encoding="utf-8"), f"{package}/msg/{file.stem}")
                get_typestore(Stores.EMPTY).register(own)  # which refuses what makes no type
                found.update(own)
            except OSError as error:
                raise UsageError(f"messages: {file} cannot be read: {error.strerror}") from error
            except Exception as error:
                raise UsageError(f"messages: {file} is not a message definition: {one_line(error)[:200]}") from error
    return found


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
        if kind[0] != Nodetype.NAME or not set("xyzw") <= dict(store.get_msgdef(kind[1]).fields).keys():
            wanted = "as yaw needs a quaternion with x, y, z and w"
            raise DataError(f"{where}: {wanted}, {so_far} is {_describe(store, kind)}")
    elif kind[0] != Nodetype.BASE or kind[1][0] in TEXT_TYPES:
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
    for _, kind in store.fielddefs[type_name][1]:
        node, name = kind if kind[0] in (Nodetype.NAME, Nodetype.BASE) else kind[1][0]
        missing = undefined_type(store, name, seen) if node == Nodetype.NAME else None
        if missing:
            return missing
    return None


def value_at(message: Any, steps: Steps, *, yaw: bool = False) -> float | None:
    """The number that a message has in a field, or the heading of a quaternion; None in too short an array.

    The heading, −π to π rad, is the rotation about z that comes last in z-y-x angles; NaN for a quaternion of zeros.
    """
    for step in steps:
        if isinstance(step, int) and step >= len(message):
            return None
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
    """Every field of a type that holds a number; a quaternion comes once more, with what reads its heading.

    An array of three numbers in a message is `gains[0…2]`; without a message, one of no fixed length is `ranges[0…]`.
    """

    def walk(kind: Any, spelt: str, value: Any) -> Iterator[str]:
        if kind[0] == Nodetype.BASE:
            if kind[1][0] not in TEXT_TYPES:
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
        return "text" if kind[1][0] in TEXT_TYPES else f"a number ({kind[1][0]})"
    if kind[0] == Nodetype.NAME:
        return f"a {kind[1]} with the fields {', '.join(name for name, _ in store.get_msgdef(kind[1]).fields)}"
    length = f" of {kind[1][1]} elements" if kind[0] == Nodetype.ARRAY else ""
    return f"an array{length}: name one by its index, such as [0]"


def entries(bag: Bag) -> list[Entry]:
    """Of each topic its type, times of arrival and numeric fields."""
    arrivals: dict[str, list[int]] = {topic: [] for topic in bag.topics}
    first: dict[str, Any] = {}
    for connection, received, raw in bag.messages(bag.topics):
        arrivals[connection.topic].append(received)
        if connection.topic not in first and not undefined_type(bag.store, connection.msgtype):
            first[connection.topic] = bag.content(connection, raw)
    found = []
    for topic, at in arrivals.items():
        types, times = bag.types(topic), np.array(at, dtype=np.int64)
        about = " and ".join(types)
        if missing := next(filter(None, (undefined_type(bag.store, one) for one in types)), None):
            remark = f'{missing} is not defined: name its file, messages = ["PACKAGE/msg/NAME.msg"], in the mapping'
            found.append(Entry(topic, about, times, remark=remark))
        elif len(types) > 1:
            found.append(Entry(topic, about, times))
        else:
            fields = list(numeric_fields(bag.store, types[0], first.get(topic)))
            keys = [ALIGNED_KEY] if has_stamp(bag.store, types[0]) else []
            found.append(Entry(topic, about, times, fields or ["no number"], list(filter(_is_value, fields)), keys))
    return found


def _is_value(field: str) -> bool:
    """Whether a field holds a number that is not a time stamp's."""
    return "stamp." not in field and "[]" not in field and not field.startswith("header")
