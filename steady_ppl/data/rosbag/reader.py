"""A bag as topics and messages, read by the `rosbags` package; and a listing with a mapping to start from.

ROS 1 bags and most ROS 2 bags define the types of their messages. Where a ROS 2 bag does not (sqlite bags recorded
before Iron never do), the standard types are those of Humble, and others are read from .msg files.
"""

from __future__ import annotations

import difflib
import os
import re
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from steady_ppl.data.rosbag.fields import has_stamp, numeric_fields, undefined_types
from steady_ppl.errors import DataError, SteadyError, UsageError
from steady_ppl.utils.files import require_file
from steady_ppl.utils.text import one_line

Say = Callable[[str], None]


@dataclass(frozen=True)
class Bag:
    """An open bag.

    Attributes:
        name: its file's or folder's name, for error messages.
        reader: rosbags' reader, open.
        defined: the message types that the bag itself defines.
    """

    name: str
    reader: Any
    defined: frozenset[str]

    @property
    def store(self) -> Any:
        """rosbags' typestore with all types that the bag or the user defines."""
        return self.reader.typestore

    @property
    def topics(self) -> list[str]:
        """The names of the topics, sorted."""
        return sorted({connection.topic for connection in self.reader.connections})

    def types(self, topic: str) -> list[str]:
        """The types of a topic's messages: one, unless publishers disagreed."""
        return sorted({connection.msgtype for connection in self.reader.connections if connection.topic == topic})

    def undefined(self, type_name: str) -> list[str]:
        """Which types that messages of a type are made of nobody has defined."""
        return undefined_types(self.store, type_name)

    def type_of(self, topic: str, where: str) -> str:
        """The type of a topic's messages, defined.

        Args:
            where: what error messages begin with.

        Raises:
            DataError: no such topic, messages of several types, or a type that nobody defines.
        """
        if topic not in self.topics:
            near = difflib.get_close_matches(topic, self.topics, n=3, cutoff=0.5)
            hint = f"did you mean {' or '.join(near)}?" if near else f"it has {', '.join(self.topics) or 'no topics'}"
            raise DataError(f"{where}: {self.name} has no such topic; {hint}")
        names = self.types(topic)
        if len(names) > 1:
            raise DataError(f"{where}: its messages are of several types, {' and '.join(names)}; expected one")
        missing = self.undefined(names[0])
        if missing:
            raise DataError(
                f"{where}: neither {self.name} nor rosbags' typestore defines the message type {missing[0]}; name its "
                'file in the mapping: messages = ["PACKAGE/msg/NAME.msg"], or a folder of such files'
            )
        return names[0]

    def raw_messages(self, topics: Sequence[str]) -> Iterator[tuple[Any, int, bytes]]:
        """Connection, time of arrival (ns) and bytes of every message of some topics, in the order of the bag.

        Raises:
            DataError: the bag is damaged.
        """
        connections = [connection for connection in self.reader.connections if connection.topic in topics]
        with _damage(self.name):
            for connection, received, raw in self.reader.messages(connections=connections) if connections else ():
                if received >= 2**63:
                    raise DataError(
                        f"{self.name}: a message of {connection.topic} came at {received} ns: is it damaged?"
                    )
                yield connection, received, raw

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Time of arrival (ns) and content of every message of a topic, in the order of the bag.

        Raises:
            DataError: the bag is damaged.
        """
        for connection, received, raw in self.raw_messages([topic]):
            yield received, self.content(connection, raw)

    def content(self, connection: Any, raw: bytes) -> Any:
        """What the bytes of a message say.

        Raises:
            DataError: they are not of the type that the bag says.
        """
        with _damage(self.name, f"a message of {connection.topic} "):
            return self.reader.deserialize(raw, connection.msgtype)


@contextmanager
def open_bag(path: Path, messages: Sequence[Path] = ()) -> Iterator[Bag]:
    """Open a ROS 1 .bag, a ROS 2 folder, or a single .mcap or .db3 file.

    Args:
        messages: .msg files, or folders of them, that define types which the bag does not.

    Raises:
        DataError: it is no bag, or damaged.
        UsageError: a .msg file is missing or wrong.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

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
            if any(undefined_types(reader.typestore, connection.msgtype) for connection in reader.connections):
                reader.typestore.register({key: extra[key] for key in extra if key not in reader.typestore.fielddefs})
        yield Bag(name, reader, defined)
    finally:
        reader.close()


def bag_name(path: Path) -> str:
    """The name of a bag's file or folder."""
    return path.name or path.resolve().name


def bag_label(path: Path) -> str:
    """What a bag's trajectory is called: a file's name without suffix, a folder's name."""
    return bag_name(path) if path.is_dir() else path.stem


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
    """The message types that .msg files define, named after their package.

    Raises:
        UsageError: naming the file.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

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


_WIDTH = 116


def listing(bags: Sequence[Bag]) -> str:
    """Of each bag its topics with type, number of messages, median rate and numeric fields; then a mapping to start
    from, whose sections are comments."""
    lines: list[str] = []
    sections: dict[tuple[str, str], list[str]] = {}
    for bag in bags:
        said, found = _of_bag(bag)
        lines += said
        sections |= found
    return "\n".join(lines + _skeleton(sections))


def _of_bag(bag: Bag) -> tuple[list[str], dict[tuple[str, str], list[str]]]:
    """Its lines, and sections by topic and field."""
    arrivals: dict[str, list[int]] = {topic: [] for topic in bag.topics}
    first: dict[str, Any] = {}
    for connection, received, raw in bag.raw_messages(bag.topics):
        arrivals[connection.topic].append(received)
        if connection.topic not in first and not bag.undefined(connection.msgtype):
            first[connection.topic] = bag.content(connection, raw)
    lines: list[str] = [f"# {bag.name}"]
    sections: dict[tuple[str, str], list[str]] = {}
    for topic in bag.topics:
        types, count = bag.types(topic), len(arrivals[topic])
        rate = _median_rate(arrivals[topic])
        lines += ["#", f"# {topic}  {' and '.join(types)}  {count} message{'' if count == 1 else 's'}{rate}"]
        missing = [missing for type_name in types for missing in bag.undefined(type_name)]
        if missing:
            lines.append(f'#     nobody defines {missing[0]}: messages = ["PACKAGE/msg/NAME.msg"] in the mapping does')
        elif len(types) == 1:
            fields = list(numeric_fields(bag.store, types[0], first.get(topic)))
            lines += _wrapped(fields)
            sections |= _section(topic, fields, has_stamp(bag.store, types[0]))
    return lines, sections


def _median_rate(arrivals: list[int]) -> str:
    gaps = np.diff(np.sort(np.array(arrivals, dtype=np.int64)))
    middle = float(np.median(gaps)) if len(gaps) else 0.0
    return f"  {1e9 / middle:.4g} Hz" if middle > 0 else ""


def _wrapped(fields: list[str]) -> Iterator[str]:
    text = ", ".join(field.replace(" ", "\0") for field in fields) or "no number"
    for line in textwrap.wrap(text, _WIDTH - 6, break_long_words=False, break_on_hyphens=False):
        yield f"#     {line}".replace("\0", " ")


def _section(topic: str, fields: list[str], stamped: bool) -> dict[tuple[str, str], list[str]]:
    """What is said of a topic's first field that is not its time stamp, by topic and field; nothing without one."""
    said = [field for field in fields if "stamp." not in field and "[]" not in field and not field.startswith("header")]
    if not said:
        return {}
    field, _, reading = said[0].partition(" ")
    field = field.partition("…")[0].rstrip(".") + ("]" if "…" in field else "")
    lines = [f'# topic = "{topic}"', f'# field = "{field}"']
    if reading:
        lines.append('# as = "yaw"')
    if stamped:
        lines.append('# clock = "aligned"  # its header says when it was made; leave out for the time of arrival')
    return {(topic, field): lines}


def _skeleton(sections: dict[tuple[str, str], list[str]]) -> list[str]:
    lines = [
        "",
        "# A mapping to start from: take the sections that you need out of the comments and name their columns u.NAME",
        "# (a control), y.NAME (a measurement) or x.NAME (a state that is known).",
        "step = 0.1  # s between two rows",
    ]
    taken: list[str] = []
    for (topic, field), said in sections.items():
        name = re.sub(r"\W+", "_", f"{topic}_{field}").strip("_")
        again = taken.count(name)  # /a/b with c, and /a with b.c
        taken.append(name)
        lines += ["#", f'# [columns."y.{name}{f"_{again + 1}" if again else ""}"]', *said]
    return lines
