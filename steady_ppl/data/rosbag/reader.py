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
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from steady_ppl.data.rosbag.fields import has_stamp, numeric_fields, undefined_type
from steady_ppl.errors import DataError, SteadyError, UsageError
from steady_ppl.utils.files import require_file
from steady_ppl.utils.text import one_line

Say = Callable[[str], None]
MAX_WIDTH = 110  # characters of a list of fields


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
        """The names of the topics, sorted."""
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
        missing = undefined_type(self.store, names[0])
        if missing:
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
    """Open a ROS 1 .bag, a ROS 2 folder, or a single .mcap or .db3 file.

    Raises:
        DataError: it is no bag, or damaged.
        UsageError: one of `messages`, the .msg files of types that the bag does not define, is missing or wrong.
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


def listing(bags: Sequence[Bag]) -> str:
    """Of each bag its topics with type, number of messages, median rate and numeric fields; then a mapping to start
    from, whose sections are comments."""
    sections: dict[tuple[str, str], list[str]] = {}
    lines = [line for bag in bags for line in _of_bag(bag, sections)]
    return "\n".join(lines + _skeleton(sections))


def _of_bag(bag: Bag, sections: dict[tuple[str, str], list[str]]) -> list[str]:
    """Its lines; the sections of a mapping, by topic and field, are added to those of other bags."""
    arrivals: dict[str, list[int]] = {topic: [] for topic in bag.topics}
    first: dict[str, Any] = {}
    for connection, received, raw in bag.messages(bag.topics):
        arrivals[connection.topic].append(received)
        if connection.topic not in first and not undefined_type(bag.store, connection.msgtype):
            first[connection.topic] = bag.content(connection, raw)
    lines = [f"# {bag.name}"]
    for topic, at in arrivals.items():
        types, gaps = bag.types(topic), np.diff(np.sort(np.array(at, dtype=np.int64)))
        middle = float(np.median(gaps)) if len(gaps) else 0.0
        rate = f"  {1e9 / middle:.4g} Hz" if middle > 0 else ""
        lines += ["#", f"# {topic}  {' and '.join(types)}  {len(at)} message{'' if len(at) == 1 else 's'}{rate}"]
        missing = next(filter(None, (undefined_type(bag.store, one) for one in types)), None)
        if missing:
            lines.append(f'#     nobody defines {missing}: messages = ["PACKAGE/msg/NAME.msg"] in the mapping does')
        elif len(types) == 1:
            fields = list(numeric_fields(bag.store, types[0], first.get(topic)))
            text = ", ".join(field.replace(" ", "\0") for field in fields) or "no number"
            wrapped = textwrap.wrap(text, MAX_WIDTH, break_long_words=False, break_on_hyphens=False)
            lines += [f"#     {line}".replace("\0", " ") for line in wrapped]
            sections |= _section(topic, fields, has_stamp(bag.store, types[0]))
    return lines


def _section(topic: str, fields: list[str], stamped: bool) -> dict[tuple[str, str], list[str]]:
    """What is said of a topic's first field that is not its time stamp, by topic and field; nothing without one."""
    said = [field for field in fields if "stamp." not in field and "[]" not in field and not field.startswith("header")]
    if not said:
        return {}
    field, _, reading = said[0].partition(" ")
    field = field.partition("…")[0].rstrip(".") + ("]" if "…" in field else "")
    lines = [f'# topic = "{topic}"', f'# field = "{field}"', *(['# as = "yaw"'] if reading else [])]
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
