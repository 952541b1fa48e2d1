"""What of a recording goes into which column of a table, from a TOML file, from `--map`, or built in Python.

A kind of recording has a `Column` and a `TableMapping` of its own, which say what else it knows.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Self

from steady_ppl.errors import UsageError, labelled
from steady_ppl.utils.files import read_toml
from steady_ppl.utils.schema import NUMBER, TEXT, mismatch, surplus

KEY_FORMS = {"topic": TEXT, "field": TEXT, "longest": (NUMBER, None), "late": NUMBER, "scale": NUMBER, "offset": NUMBER}
MAX_LATE = 1e9  # s; times are whole nanoseconds in 64 bits
FIELD = r"[A-Za-z_]\w*(\[\d+\])*(\.[A-Za-z_]\w*(\[\d+\])*)*"  # twist.linear.x, ranges[0]


@dataclass(frozen=True)
class Column:
    """One column of the table and the field of a topic that fills it: a section `[columns."u.speed"]` of the file.

    What cannot be is a UsageError that names the column and the key.

    Attributes:
        name: the column, `u.…`, `y.…` or `x.…`.
        topic, field: the topic's full name and the field within its messages.
        reading: None for a number; else one of `readings`, `as` in TOML.
        between: how a control goes on from message to message, "hold" (None is the same) or "interpolate".
        longest: s, at least two steps; a longer pause of a control ends the trajectory.
        clock: one of `clocks`, by itself the first.
        late: s, subtracted from the time stamps.
        scale, offset: the column's value is `scale * read + offset`.
    """

    readings: ClassVar[tuple[str, ...]]
    lengths: ClassVar[tuple[str, ...]] = ()  # of the readings; the others are angles
    clocks: ClassVar[tuple[str, ...]]
    spelling: ClassVar[str] = FIELD

    name: str
    topic: str
    field: str
    reading: str | None = None
    between: str | None = None
    longest: float | None = None
    clock: str = ""
    late: float = 0.0
    scale: float = 1.0
    offset: float = 0.0

    @property
    def is_angle(self) -> bool:
        """Whether its values live on a circle."""
        return self.reading is not None and self.reading not in self.lengths

    def __post_init__(self) -> None:
        object.__setattr__(self, "clock", self.clock or self.clocks[0])
        with labelled(f"column {self.name}"):
            if self.name[:2] not in ("u.", "y.", "x.") or len(self.name) < 3:
                raise UsageError("expected u.NAME (a control), y.NAME (a measurement) or x.NAME (a known state)")
            if (problem := mismatch(vars(self), KEY_FORMS)) or not self.topic:
                raise UsageError(problem or "topic is '', expected text")
            allowed = {
                "between": (None, "hold", "interpolate"),
                "reading": (None, *self.readings),
                "clock": self.clocks,
            }
            for key, choices in allowed.items():
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
            if not re.fullmatch(self.spelling, self.field, re.ASCII):
                wanted = "expected names and indices such as linear.x or data[0]"
                raise UsageError(f"field {self.field!r} is not spelt as one: {wanted}")

    @property
    def kind(self) -> str:
        """`u`, `y` or `x`."""
        return self.name[0]

    @property
    def where(self) -> str:
        """What error messages call it."""
        return f"column {self.name}, topic {self.topic}, field {self.field}"


@dataclass(frozen=True)
class TableMapping:
    """The columns of a table and the time between its rows; UsageError for what cannot be.

    Attributes:
        columns: in the order in which the table has them, among each of u., y. and x.
        step: s between rows.
    """

    column_type: ClassVar[type[Column]]
    columns: tuple[Column, ...]
    step: float

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
    def content(cls, path: Path) -> dict[str, Any]:
        """What a TOML file spells; UsageError where it cannot be read."""
        return read_toml(path)

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a mapping from a TOML file; UsageError names the file and what is wrong in it."""
        return cls.parse(cls.content(Path(path)), Path(path).name)

    @classmethod
    def parse(cls, content: Mapping[str, Any], name: str) -> Self:
        """The mapping that a TOML file spells; UsageError, in which the file is called `name`, where it is none."""
        with labelled(name):
            others = [field.name for field in fields(cls) if field.name not in ("columns", "step")]
            if problem := surplus(content, ("step", "columns", *others)):
                raise UsageError(problem)
            if "step" not in content:
                raise UsageError("there is no step: say how many seconds lie between two rows, for example step = 0.1")
            columns = content.get("columns", {})
            if not isinstance(columns, Mapping) or not all(isinstance(said, Mapping) for said in columns.values()):
                raise UsageError('columns must be sections such as [columns."u.speed"]; the quotes are needed')
            found = tuple(_column(cls.column_type, column, said) for column, said in columns.items())
            return cls(found, content["step"], **{key: content[key] for key in others if key in content})


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


def _column(column_type: type[Column], name: str, said: Mapping[str, Any]) -> Column:
    keys = ["as" if field.name == "reading" else field.name for field in fields(column_type) if field.name != "name"]
    if problem := surplus(said, keys):
        raise UsageError(f"column {name}: {problem}")
    for key in ("topic", "field"):
        if key not in said:
            raise UsageError(f"column {name}: there is no {key}")
    return column_type(name, **{"reading" if key == "as" else key: value for key, value in said.items()})
