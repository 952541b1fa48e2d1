"""What a study consists of: its jobs, and what is drawn of them; the record of both beside the results."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from steady_ppl.errors import RunError
from steady_ppl.utils.files import whole_file
from steady_ppl.utils.schema import ANYTHING, LINES, NUMBER, TEXT, TRUTH, WHOLE, read_record
from steady_ppl.utils.text import shown

HELD_OUT = "valid_log_likelihood"  # of validation drives
IN_LIMITS = "in_limits"  # how large what is missing is, in detection limits
TASKS = ("fit", "discover")
FIGURES = {
    "fit": (
        *("forward.", "forward_mean.", "state_estimation.", "measurement."),
        *("log_likelihood", HELD_OUT, "fit_seconds", "steps", "seconds", "peak_mib"),
    ),
    "discover": ("p_value", "found", "right", "in_class", IN_LIMITS, "seconds", "peak_mib"),
}
"""Columns of numbers that a task fills, or how they begin."""

MOST_PANELS, MOST_PUBLISHED, LONGEST = 12, 100, 1000  # of a picture; characters of its title and labels
MAX_NUMBER = 1e100  # a number beyond cannot be drawn

FORMAT = 1
RECORD = "study.json"
PICTURE: dict[str, Any] = {
    "x": TEXT,
    "y": LINES,
    "labels?": {str: TEXT},
    "published?": {str: {str: [[NUMBER, NUMBER]]}},
    "chosen_by?": TEXT,
    "leave_out?": LINES,
}
JOB: dict[str, Any] = {
    **dict.fromkeys(("task", "method", "program", "recipe", "key", "label"), TEXT),
    "data": {str: ANYTHING},
    "settings": {str: ANYTHING},
    "seed": WHOLE,
    "known_start": TRUTH,
}
RECORDED = {"title": TEXT, "task": TEXT, "jobs": [JOB], "picture": (PICTURE, None)}


@dataclass(frozen=True)
class Job:
    """A cell of the grid, in values that JSON can hold.

    Attributes:
        task: "fit" or "discover".
        method: its name.
        program, recipe: PATH or PATH:CLASS; empty for a search, or a name or PATH.
        data: its source and what else is said of it.
        settings: of the recipe or of `discover`.
        seed: of data and method.
        known_start: the first state is given.
        key: a hash of all that is said of it, its method's name too, and of the contents of the files that it reads.
        label: by which it differs from the others.
    """

    task: str
    method: str
    program: str
    recipe: str
    data: dict[str, Any]
    settings: dict[str, Any]
    seed: int
    known_start: bool
    key: str = ""
    label: str = ""

    @property
    def columns(self) -> dict[str, Any]:
        """What the table says of it: `data.…` and `settings.…` are the axes, paths are names, lists are JSON."""
        source = {f"data.{name}": without_folder(value) for name, value in self.data.items()}
        chosen = {f"settings.{name}": without_folder(value) for name, value in self.settings.items()}
        files = {"program": without_folder(self.program), "recipe": without_folder(self.recipe)}
        named = {"key": self.key, "task": self.task, "method": self.method, **files}
        return named | {"seed": self.seed, "known_start": self.known_start} | source | chosen


@dataclass(frozen=True)
class Plan:
    """A study: its jobs with seeds outermost, so that what has come in at any time is whole studies of fewer seeds."""

    title: str
    task: str
    jobs: tuple[Job, ...]
    picture: Picture | None = None


@dataclass(frozen=True)
class Picture:
    """What is drawn of a study.

    Attributes:
        x, y: a column, and columns, a panel each.
        labels: of axes, by their columns, and of methods, by their names.
        published: of a panel, by the method's name: points `(x, y)` that others have found.
        chosen_by: a column of held-out drives; of a method's settings only the one with its largest mean at each x is
            drawn. All of them when empty.
        leave_out: methods that are in the table alone.
    """

    x: str
    y: list[str]
    labels: dict[str, str] = field(default_factory=dict)
    published: dict[str, dict[str, list[list[float]]]] = field(default_factory=dict)
    chosen_by: str = ""
    leave_out: list[str] = field(default_factory=list)

    @property
    def columns(self) -> tuple[str, ...]:
        """All that is drawn or chosen by, each once."""
        return tuple(dict.fromkeys(name for name in (self.x, *self.y, self.chosen_by) if name))


def undrawable(title: str, picture: Mapping[str, Any]) -> str | None:
    """What of a picture of the right form cannot be drawn, in words; None where all can."""
    if not 1 <= len(picture["y"]) <= MOST_PANELS:
        return f"picture.y has {len(picture['y'])} columns, expected 1 to {MOST_PANELS}"
    published = picture.get("published", {})
    texts = [title, *picture.get("labels", {}).values(), *(name for lines in published.values() for name in lines)]
    if max(map(len, texts)) > LONGEST:
        return f"picture: a title, label or name of more than {LONGEST} characters"
    for column, lines in published.items():
        if len(lines) > MOST_PUBLISHED:
            return f"picture.published: {column} has {len(lines)} lines, expected at most {MOST_PUBLISHED}"
        for name, points in lines.items():
            for point in points:
                if max(map(abs, point)) > MAX_NUMBER:
                    return f"picture.published: {column}, {name}: {shown(str(point), 40)} is no point, expected [x, y]"
    return None


def record_plan(plan: Plan, folder: Path) -> None:
    """Write the plan beside its results; RunError where it cannot be written."""
    with whole_file(folder / RECORD, RunError) as beside:
        beside.write_text(json.dumps({"format": FORMAT, **asdict(plan)}, indent=1) + "\n")


def recorded_plan(folder: Path) -> Plan:
    """The plan that the results in a folder are of; RunError where there is none, it is damaged, or a newer steady-ppl
    wrote it."""
    content = read_record(folder / RECORD, RECORDED, FORMAT, "a study")
    picture = content["picture"]
    if picture is not None:
        if problem := undrawable(content["title"], picture):
            raise RunError(f"{folder / RECORD} is damaged: {problem}")
        picture = Picture(**{one.name: picture[one.name] for one in fields(Picture) if one.name in picture})
    jobs = tuple(Job(**{name: job[name] for name in JOB}) for job in content["jobs"])
    return Plan(content["title"], content["task"], jobs, picture)


def without_folder(value: Any) -> Any:
    """The name of a file, whose absolute path is one machine's; a list as JSON; anything else as it is."""
    if isinstance(value, list):
        return json.dumps([without_folder(one) for one in value])
    return Path(value).name if isinstance(value, str) and Path(value).is_absolute() else value
