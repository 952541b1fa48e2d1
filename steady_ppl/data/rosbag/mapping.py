"""What of a bag goes into which column of a table: `BagMapping`, from a TOML file, from `--map`, or built in Python."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from steady_ppl.errors import UsageError, labelled
from steady_ppl.utils.files import read_toml
from steady_ppl.utils.schema import NUMBER, TEXT, mismatch, surplus

ALLOWED_VALUES = {
    "between": (None, "hold", "interpolate"),
    "reading": (None, "yaw", "angle"),
    "clock": ("bag", "header", "aligned"),
}
KEY_FORMS = {"topic": TEXT, "field": TEXT, "longest": (NUMBER, None), "late": NUMBER, "scale": NUMBER, "offset": NUMBER}
MAX_LATE = 1e9  # s; times are whole nanoseconds in 64 bits
SPELLING = re.compile(r"[A-Za-z_]\w*(\[\d+\])*(\.[A-Za-z_]\w*(\[\d+\])*)*", re.ASCII)  # twist.linear.x, ranges[0]
Steps = tuple[str | int, ...]  # the names and indices that lead to a field


@dataclass(frozen=True)
class BagColumn:
    """One column of the table and the field of a topic that fills it: a section `[columns."u.speed"]` of the file.

    What cannot be is a UsageError that names the column and the key; `read_bags` says what each key does.

    Attributes:
        name: the column, `u.…`, `y.…` or `x.…`.
        topic, field: the topic's full name and the field within its messages.
        reading: None for a number, "yaw" for the heading of a quaternion, "angle" for a number that is an angle, rad;
            `as` in TOML.
        between: how a control goes on from message to message, "hold" (None is the same) or "interpolate".
        longest: s, at least two steps; a longer pause of a control ends the trajectory.
        clock: "bag", "header" or "aligned".
        late: s, subtracted from the time stamps.
        scale, offset: the column's value is `scale * read + offset`.
    """

    name: str
    topic: str
    field: str
    reading: str | None = None
    between: str | None = None
    longest: float | None = None
    clock: str = "bag"
    late: float = 0.0
    scale: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        with labelled(f"column {self.name}"):
            if self.name[:2] not in ("u.", "y.", "x.") or len(self.name) < 3:
                raise UsageError("expected u.NAME (a control), y.NAME (a measurement) or x.NAME (a known state)")
            if (problem := mismatch(vars(self), KEY_FORMS)) or not self.topic:
                raise UsageError(problem or "topic is '', expected text")
            for key, choices in ALLOWED_VALUES.items():
                if (value := getattr(self, key)) not in choices:
                    known = " or ".join(f'"{choice}"' for choice in choices if choice)
                    raise UsageError(f"{'as' if key == 'reading' else key} is {value!r}, expected {known}")
            for key in ("between", "longest") if self.kind != "u" else ():
                if getattr(self, key) is not None:
                    raise UsageError(f"{key} is for controls (u.); measurements and states are not held: leave it out")
            if abs(self.late) > MAX_LATE:
                raise UsageError(f"late is {self.late:g} s, expected at most {MAX_LATE:g} s")
            if self.scale == 0:
                raise UsageError("scale must not be 0")
            if not SPELLING.fullmatch(self.field):
                wanted = "expected names and indices such as linear.x or data[0]"
                raise UsageError(f"field {self.field!r} is not spelt as one: {wanted}")

    @property
    def kind(self) -> str:
        """`u`, `y` or `x`."""
        return self.name[0]

    @property
    def steps(self) -> Steps:
        return tuple(int(step) if step.isdigit() else step for step in re.findall(r"\w+", self.field))

    @property
    def where(self) -> str:
        """What error messages call it."""
        return f"column {self.name}, topic {self.topic}, field {self.field}"


@dataclass(frozen=True)
class BagMapping:
    """The columns of a table and the time between its rows; UsageError for what cannot be.

    Attributes:
        columns: in the order in which the table has them, among each of u., y. and x.
        step: s between rows.
        messages: .msg files, or folders of them, that define message types which a bag does not.
    """

    columns: tuple[BagColumn, ...]
    step: float
    messages: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if mismatch(self.step, NUMBER) or self.step <= 0:
            raise UsageError(f"step is {self.step!r}, expected the seconds between two rows, more than 0")
        names = set[str]()
        for column in self.columns:
            if column.name in names:
                raise UsageError(f"column {column.name} is given twice")
            names.add(column.name)
            if column.longest is not None and column.longest < 2 * self.step:
                # else a measurement in the pause could be in a row on either side of it
                least = f"expected at least two steps of {self.step} s"
                raise UsageError(f"column {column.name}: longest is {column.longest} s, {least}")
        if not any(column.kind == "y" for column in self.columns):
            raise UsageError("there is no measurement: name at least one column y.NAME")

    @classmethod
    def read(cls, path: str | Path) -> BagMapping:
        """Read a mapping from a TOML file; UsageError names the file and what is wrong in it."""
        return cls.parse(read_mapping(Path(path)), Path(path).name)

    @classmethod
    def parse(cls, content: Mapping[str, Any], name: str) -> BagMapping:
        """The mapping that a TOML file spells; UsageError, in which the file is called `name`, where it is none."""
        with labelled(name):
            if problem := surplus(content, ("step", "columns", "messages")):
                raise UsageError(problem)
            if "step" not in content:
                raise UsageError("there is no step: say how many seconds lie between two rows, for example step = 0.1")
            columns, messages = content.get("columns", {}), content.get("messages", [])
            if not isinstance(columns, Mapping) or not all(isinstance(said, Mapping) for said in columns.values()):
                raise UsageError('columns must be sections such as [columns."u.speed"]; the quotes are needed')
            if not isinstance(messages, list | tuple) or not all(isinstance(text, str | Path) for text in messages):
                raise UsageError(f"messages is {messages!r}, expected a list of .msg files or folders of them")
            found = tuple(_column(column, said) for column, said in columns.items())
            return cls(found, content["step"], tuple(Path(text) for text in messages))


def read_mapping(path: Path) -> dict[str, Any]:
    """What a TOML file spells, `messages` counted from its folder; UsageError where it cannot be read."""
    content = read_toml(path)
    if isinstance(content.get("messages"), list):
        content["messages"] = [path.parent / text if isinstance(text, str) else text for text in content["messages"]]
    return content


def parse_map(text: str) -> tuple[str, dict[str, Any]]:
    """The column and its keys that `COLUMN=TOPIC:FIELD[,KEY=VALUE...]` spells; UsageError where it is not spelt so."""
    source, *pairs = text.split(",")
    name, equals, rest = source.partition("=")
    topic, colon, field = rest.rpartition(":")
    name, topic, field = name.strip(), topic.strip(), field.strip()
    if not (equals and colon and name and topic and field):
        raise UsageError(f"--map {text}: expected COLUMN=TOPIC:FIELD[,KEY=VALUE...], such as u.speed=/cmd_vel:linear.x")
    said: dict[str, Any] = {"topic": topic, "field": field}
    for pair in pairs:
        key, equals, value = (part.strip() for part in pair.partition("="))
        if not (equals and key and value):
            raise UsageError(f"--map {text}: {pair!r} is not KEY=VALUE")
        if key in said:
            raise UsageError(f"--map {text}: {key} is given twice")
        try:
            said[key] = float(value)
        except ValueError:
            said[key] = value.strip("\"'")
    return name, said


def _column(name: str, said: Mapping[str, Any]) -> BagColumn:
    keys = ["as" if field.name == "reading" else field.name for field in fields(BagColumn) if field.name != "name"]
    if problem := surplus(said, keys):
        raise UsageError(f"column {name}: {problem}")
    for key in ("topic", "field"):
        if key not in said:
            raise UsageError(f"column {name}: there is no {key}")
    return BagColumn(name, **{"reading" if key == "as" else key: value for key, value in said.items()})
