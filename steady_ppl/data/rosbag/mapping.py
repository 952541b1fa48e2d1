"""What of a bag goes into which column of a table: `BagMapping`."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from steady_ppl.data.recordings.mapping import Column, TableMapping
from steady_ppl.errors import UsageError

Steps = tuple[str | int, ...]  # the names and indices that lead to a field


@dataclass(frozen=True)
class BagColumn(Column):
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

    readings = ("yaw", "angle")
    clocks = ("bag", "header", "aligned")

    @property
    def steps(self) -> Steps:
        return tuple(int(step) if step.isdigit() else step for step in re.findall(r"\w+", self.field))


@dataclass(frozen=True)
class BagMapping(TableMapping):
    """The columns of a table and the time between its rows; UsageError for what cannot be.

    Attributes:
        columns: in the order in which the table has them, among each of u., y. and x.
        step: s between rows.
        messages: .msg files, or folders of them, that define message types which a bag does not.
    """

    column_type = BagColumn
    columns: tuple[BagColumn, ...]
    messages: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        messages: Any = self.messages
        if not isinstance(messages, list | tuple) or not all(isinstance(text, str | Path) for text in messages):
            raise UsageError(f"messages is {messages!r}, expected a list of .msg files or folders of them")
        object.__setattr__(self, "messages", tuple(Path(text) for text in messages))
        super().__post_init__()

    @classmethod
    def content(cls, path: Path) -> dict[str, Any]:
        """What a TOML file spells, `messages` counted from its folder; UsageError where it cannot be read."""
        content = super().content(path)
        if isinstance(content.get("messages"), list):
            content["messages"] = [
                path.parent / text if isinstance(text, str) else text for text in content["messages"]
            ]
        return content
