"""What of a log goes into which column of a table: `LogMapping`, from a TOML file or one that is ready."""

from __future__ import annotations

import operator
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from steady_ppl.data.recordings.mapping import FIELD, Column, TableMapping
from steady_ppl.errors import UsageError, labelled
from steady_ppl.utils.schema import NUMBER, TEXT, mismatch

READY_FOLDER = Path(__file__).with_name("ready")
READY = tuple(sorted(file.stem for file in READY_FOLDER.glob("*.toml")))
SIGNS = {">=": operator.ge, "<=": operator.le, "==": operator.eq, "!=": operator.ne, ">": operator.gt, "<": operator.lt}
DECIMAL = r"[-+]?\d+(\.\d*)?([eE][-+]?\d+)?"
CONDITION = re.compile(rf"\s*(?P<field>{FIELD})\s*(?P<sign>{'|'.join(SIGNS)})\s*(?P<number>{DECIMAL})\s*", re.ASCII)
FIELDS = rf"{FIELD}( {FIELD})*"
COUNTS = {"east": (2,), "north": (2,), "yaw": (1, 4), "yaw from north": (1, 4)}  # of fields; of other readings one


class Condition(NamedTuple):
    """A field, how it is compared, and with what."""

    field: str
    sign: str
    number: float

    @classmethod
    def parse(cls, text: object) -> Condition:
        """The condition that `fix_type >= 3` spells; UsageError where it is not spelt so."""
        found = CONDITION.fullmatch(text) if isinstance(text, str) else None
        if found is None:
            signs = ", ".join(SIGNS)
            raise UsageError(f"{text!r} is no condition: expected FIELD SIGN NUMBER, the sign one of {signs}")
        return cls(found["field"], found["sign"], float(found["number"]))

    def holds(self, values: np.ndarray) -> np.ndarray:
        """Where the values of the field are so."""
        return SIGNS[self.sign](values, self.number)


@dataclass(frozen=True)
class LogColumn(Column):
    """One column of the table and the field of a topic that fills it: a section `[columns."u.throttle"]` of the file.

    What cannot be is a UsageError that names the column and the key; `read_logs` says what each key does.

    Attributes:
        name: the column, `u.…`, `y.…` or `x.…`.
        topic: a topic of ULog or a message of DataFlash; `[1]` behind it for its second instance.
        field: a field of its messages, or several with blanks between; `A | B`: B where a log has no A.
        reading: None for a number, "angle" (rad) or "degrees" for an angle, "yaw" for the heading of a quaternion
            (a field of four elements, or four fields: w, x, y, z), each also "… from north": clockwise from north in
            the log, anticlockwise from east in the table; "east" or "north" for metres of two fields, latitude and
            longitude (degrees, or whole numbers of 1e-7 degrees). `as` in TOML.
        between, longest, late, scale, offset: as in `BagColumn`.
        clock: "log" when it was logged, "sample" when it was measured, where the log says so, or "gps" for the
            receiver's time, moved onto the log's clock.
        when: a condition, such as `fix_type >= 3`, without which a message is not read.
    """

    readings = ("angle", "degrees", "yaw", "angle from north", "degrees from north", "yaw from north", "east", "north")
    clocks = ("log", "sample", "gps")
    lengths = ("east", "north")
    spelling: ClassVar[str] = rf"{FIELDS}( ?\| ?{FIELDS})*"

    when: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        with labelled(f"column {self.name}"):
            expected = COUNTS.get(self.reading or "", (1,))
            for names in self.choices:
                if len(names) not in expected:
                    wanted = " or ".join(str(count) for count in expected)
                    what = f"as {self.reading} takes" if self.reading else "a number is"
                    raise UsageError(f"field {self.field!r}: {what} {wanted} fields, got {len(names)}")
            if self.when is not None:
                with labelled("when"):
                    Condition.parse(self.when)

    @property
    def choices(self) -> list[list[str]]:
        """The fields, and those to take where a log has none of that name."""
        return [names.split() for names in self.field.split("|")]


@dataclass(frozen=True)
class LogMapping(TableMapping):
    """The columns of a table and the time between its rows; UsageError for what cannot be.

    Attributes:
        columns: in the order in which the table has them, among each of u., y. and x.
        step: s between rows.
        armed: `TOPIC: CONDITION`: rows are only where it holds, each time a trajectory of its own.
        origin: latitude and longitude, degrees, of x = y = 0; without it the first position of the first log.
    """

    column_type = LogColumn
    columns: tuple[LogColumn, ...]
    armed: str | None = None
    origin: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if problem := mismatch({"armed": self.armed}, {"armed": (TEXT, None)}):
            raise UsageError(problem)
        with labelled("armed"):
            _ = self.arming
        if self.origin is not None:
            place: Any = list(self.origin) if isinstance(self.origin, list | tuple) else self.origin
            if mismatch(place, [NUMBER, NUMBER]) or abs(place[0]) > 90 or abs(place[1]) > 180:
                raise UsageError(f"origin is {place!r}, expected a latitude and a longitude in degrees")

    @property
    def arming(self) -> tuple[str, Condition] | None:
        """The topic and the condition of `armed`."""
        if self.armed is None:
            return None
        topic, colon, condition = self.armed.partition(":")
        if not (colon and topic.strip()):
            raise UsageError(f"{self.armed!r}: expected TOPIC: FIELD SIGN NUMBER, such as ARM: ArmState == 1")
        return topic.strip(), Condition.parse(condition)

    @classmethod
    def content(cls, path: Path) -> dict[str, Any]:
        """What a TOML file or the ready mapping of that name spells; UsageError where it cannot be read."""
        return super().content(READY_FOLDER / f"{path}.toml" if str(path) in READY else path)
