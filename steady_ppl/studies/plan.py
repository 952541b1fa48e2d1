"""What a study compares with what, from a TOML file or from the record beside its results, and what it draws.

`docs/studies.md` shows a file, `studies/` has whole ones. Every list among the values of `[data]` and of a method's
`settings` is an axis of the grid: each of its values is tried with each of every other's, and with each seed. Paths are
relative to the file.
"""

import itertools
import json
import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from steady_ppl.errors import RunError, UsageError, labelled
from steady_ppl.runs.folder import read_versioned
from steady_ppl.studies.job import FIGURES, HELD_OUT, TASKS, Job, JobFiles, is_program, without_folder
from steady_ppl.utils.files import read_toml, whole_file
from steady_ppl.utils.schema import ANYTHING, BOOL, LINES, NUMBER, TEXT, WHOLE, mismatch, surplus
from steady_ppl.utils.text import shown

MAX_PANELS, MAX_PUBLISHED, MAX_LABEL_LENGTH = 12, 100, 1000  # of a picture; lines of a panel; characters
MAX_MAGNITUDE = 1e100  # of a number that can be drawn
MAX_JOBS, MAX_DRIVES = 100_000, 1_000_000  # of a study, and of a table that a job simulates

STUDY_FORMAT = 1  # number of the record's format
STUDY_RECORD = "study.json"
PICTURE_FORM: dict[str, Any] = {
    "x": TEXT,
    "y": LINES,
    "labels?": {str: TEXT},
    "published?": {str: {str: [[NUMBER, NUMBER]]}},
    "chosen_by?": TEXT,
    "leave_out?": LINES,
}
JOB_FORM: dict[str, Any] = {
    **dict.fromkeys(("task", "method", "program", "recipe", "key", "label"), TEXT),
    "data": {str: ANYTHING},
    "settings": {str: ANYTHING},
    "seed": WHOLE,
    "known_start": BOOL,
}
PLAN_RECORD_FORM = {"title": TEXT, "task": TEXT, "jobs": [JOB_FORM], "picture": (PICTURE_FORM, None)}

Axes = dict[str, list[Any]]
SOURCES: dict[str, dict[str, Any]] = {
    "simulate": {"train": 16, "valid": 16, "test": 32, "effect": "", "sigma_deg": None},
    "alpha_truck": {"sigma_deg": 5.0},
    "tables": {},
}
METHOD_FORM: dict[str, Any] = {"name": TEXT, "program": TEXT, "recipe?": TEXT, "settings?": {str: ANYTHING}}
PLAN_FORM: dict[str, Any] = {
    "title": TEXT,
    "task?": TEXT,
    "seeds": [WHOLE],
    "known_start?": BOOL,
    "data": {str: ANYTHING},
    "picture?": PICTURE_FORM,
    "method": [METHOD_FORM],
}


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


@dataclass(frozen=True)
class Plan:
    """A study: its jobs with seeds outermost, so that what has come in at any time is whole studies of fewer seeds."""

    title: str
    task: str
    jobs: tuple[Job, ...]
    picture: Picture | None = None


def read_plan(path: Path, data: Path | None = None) -> Plan:
    """Read a study from a TOML file, `data` in place of the folder of logs or tables that it names. UsageError says
    what is wrong, and where."""
    content = read_toml(path)
    with labelled(str(path)):
        return _plan(content, path.parent, data)


def _plan(content: Mapping[str, Any], folder: Path, data: Path | None) -> Plan:
    problem = mismatch(content, PLAN_FORM) or _unknown(content)
    if problem := problem or _undrawable(content["title"], content.get("picture")):
        raise UsageError(problem)
    if (task := content.get("task", "fit")) not in TASKS:
        raise UsageError(f"task is {task!r}, expected {' or '.join(TASKS)}")
    if task == "discover" and "simulate" not in content["data"]:
        raise UsageError("task discover needs data that are simulated, of which it knows what is missing")
    source = _source_axes(folder, content["data"], data, task)
    if not content["seeds"] or not content["method"]:
        raise UsageError("expected at least one seed and one method")
    methods = [_method_axes(folder, one, task) for one in content["method"]]
    cells = len(content["seeds"]) * _cells(source) * sum(_cells(one["settings"]) for one in methods)
    if cells > MAX_JOBS:
        raise UsageError(f"{cells:,} jobs; expected at most {MAX_JOBS:,} of one study")
    files, different = JobFiles(), dict[str, Job]()
    for job in _jobs(content, task, source, methods):
        with labelled(f"method {job.method}"):
            key = files.key(job)
        if key in different:
            need = "methods need names of their own, and seeds and other lists values that differ"
            raise UsageError(f"{job.method} with seed {job.seed} is there twice: {need}")
        different[key] = replace(job, key=key)
    jobs = _labelled(tuple(different.values()))
    picture = Picture(**content["picture"]) if "picture" in content else None
    if picture is not None:
        _require_columns(picture, task, jobs)
    return Plan(content["title"], task, jobs, picture)


def _unknown(content: Mapping[str, Any]) -> str | None:
    """A name that means nothing, so that one that is misspelt does not pass for a default."""
    methods = [surplus(one, METHOD_FORM, "method.") for one in content["method"]]
    problems = (surplus(content, PLAN_FORM), *methods, surplus(content.get("picture", {}), PICTURE_FORM, "picture."))
    return next(filter(None, problems), None)


def _jobs(content: Mapping[str, Any], task: str, source: Axes, methods: list[dict[str, Any]]) -> Iterator[Job]:
    start = content.get("known_start", False)
    for seed, data, method in itertools.product(content["seeds"], _grid(source), methods):
        for settings in _grid(method["settings"]):
            yield Job(**method | {"settings": settings}, task=task, data=data, seed=seed, known_start=start)


def _labelled(jobs: tuple[Job, ...]) -> tuple[Job, ...]:
    """By their methods and by the values of the axes."""
    seen = {(name, repr(value)) for job in jobs for name, value in (job.data | job.settings).items()}
    varied = {name for name, times in Counter(name for name, _ in seen).items() if times > 1}

    def label(job: Job) -> str:
        said = (job.data | job.settings).items()
        axes = [f"{name}={without_folder(value)}" for name, value in said if name in varied]
        return " ".join([job.method, *axes, f"seed={job.seed}"])

    return tuple(replace(job, label=label(job)) for job in jobs)


def _require_columns(picture: Picture, task: str, jobs: tuple[Job, ...]) -> None:
    """What would otherwise be met when everything has been computed."""
    if picture.chosen_by not in ("", HELD_OUT):
        raise UsageError(f"picture: chosen_by is {picture.chosen_by}, expected {HELD_OUT}: of held-out trajectories")
    if picture.chosen_by and not picture.x.startswith("data."):
        raise UsageError(f"picture: chosen_by picks settings for the same data; x is {picture.x}, expected data.…")
    rows = [job.columns for job in jobs]
    said = dict.fromkeys(name for row in rows for name in row)
    for name in picture.columns:
        known = any(name == figure or (figure.endswith(".") and name.startswith(figure)) for figure in FIGURES[task])
        if not all(isinstance(row[name], int | float) for row in rows if name in row):
            raise UsageError(f"picture: column {name} is no number")
        if name not in said and not known:
            figures = [f"{figure}…" if figure.endswith(".") else figure for figure in FIGURES[task]]
            there = ", ".join([*(one for one in said if one.startswith(("data.", "settings."))), *figures])
            raise UsageError(f"picture: there will be no column {name}; there will be {there}")
    methods = {job.method: None for job in jobs}
    for name in picture.leave_out:
        if name not in methods:
            raise UsageError(f"picture.leave_out: {name} is no method; there are {', '.join(methods)}")
    others = {name for lines in picture.published.values() for name in lines}
    for name in picture.labels:
        if name not in {*picture.columns, *methods, *others}:
            there = ", ".join([*picture.columns, *methods])
            raise UsageError(f"picture.labels: {name} is not in the picture; there are {there}")
    for column in picture.published:
        if column not in picture.y:
            raise UsageError(f"picture.published: {column} is no panel; y has {', '.join(picture.y)}")


def _source_axes(folder: Path, given: Mapping[str, Any], instead: Path | None, task: str) -> Axes:
    """The source of the data with its path, and all that is said of it, each a list of values; a search uses no test
    drives."""
    named = [name for name in SOURCES if name in given]
    if len(named) != 1:
        raise UsageError(f"data has {' and '.join(named) or 'no source'}, expected one of {', '.join(SOURCES)}")
    (kind,) = named
    sayable = {name: usual for name, usual in SOURCES[kind].items() if (task, name) != ("discover", "test")}
    if problem := surplus(given, [kind, *sayable], "data."):
        raise UsageError(problem)
    if not isinstance(given[kind], str):
        raise UsageError(f"data.{kind} is {given[kind]!r}, expected a path")
    if instead is not None and kind == "simulate":
        raise UsageError("its data are simulated, --data is for logs and tables")
    place = _beside(folder, given[kind]) if instead is None else _beside(Path(), str(instead))
    if kind != "simulate" and not Path(place).is_dir():
        raise UsageError(f"there is no folder {place} (data.{kind}); --data names another")
    axes: Axes = {kind: [place]}
    for name, usual in sayable.items():
        values = _axis(f"data.{name}", given.get(name, usual))
        form = TEXT if name == "effect" else NUMBER if name == "sigma_deg" else WHOLE
        if problem := mismatch(values, [(form, None)], f"data.{name}"):
            raise UsageError(problem)
        for value in values if form != TEXT else ():
            if value is not None and not 0 < value <= MAX_DRIVES:
                raise UsageError(f"data.{name} is {value}, expected more than 0 and at most {MAX_DRIVES:,}")
        if values != [None]:
            axes[name] = values
    return axes


def _method_axes(folder: Path, given: Mapping[str, Any], task: str) -> dict[str, Any]:
    """A method whose files have their folders and whose settings are lists of values."""
    if not given["name"].strip():
        raise UsageError(f"method.name is {given['name']!r}, expected a name")
    if task == "discover" and "recipe" in given:
        raise UsageError(f"method {given['name']}: a search takes no recipe")
    recipe = given.get("recipe", "steady") if task == "fit" else ""
    axes = {name: _axis(name, value) for name, value in given.get("settings", {}).items()}
    return {
        "method": given["name"],
        "program": _beside(folder, given["program"]),
        "recipe": _beside(folder, recipe) if recipe.endswith(".py") else recipe,
        "settings": {name: [_resolved(folder, one) for one in axis] for name, axis in axes.items()},
    }


def _cells(axes: Axes) -> int:
    return math.prod(map(len, axes.values()))


def _grid(axes: Axes) -> Iterator[dict[str, Any]]:
    """Every value of each with every other's."""
    for cell in itertools.product(*axes.values()):
        yield dict(zip(axes, cell, strict=True))


def _axis(name: str, value: Any) -> list[Any]:
    axis = value if isinstance(value, list) else [value]
    if not axis:
        raise UsageError(f"{name} is an axis without a value")
    for one in axis:
        if one is not None and not _is_plain(one):
            raise UsageError(f"{name} is {shown(repr(one), 40)}, expected numbers, text, true or false")
    return axis


def _is_plain(value: Any, depth: int = 0) -> bool:
    """Whether a table can hold it: finite numbers that are no larger than any use, text, truth, and lists of them."""
    if isinstance(value, list):
        return depth < 2 and all(_is_plain(one, depth + 1) for one in value)
    if isinstance(value, bool | str):
        return True
    if isinstance(value, int):
        return abs(value) < 2**63
    return isinstance(value, float) and math.isfinite(value) and abs(value) <= MAX_MAGNITUDE


def _beside(folder: Path, name: str) -> str:
    if "\0" in name:
        raise UsageError(f"{name!r} is no path: it has a character 0")
    return str((folder / os.path.expanduser(name)).resolve())


def _resolved(folder: Path, value: Any) -> Any:
    """Settings that name programs are paths as well."""
    if isinstance(value, list):
        return [_resolved(folder, one) for one in value]
    return _beside(folder, value) if is_program(value) else value


def _undrawable(title: str, picture: Mapping[str, Any] | None) -> str | None:
    """What of a picture of the right form cannot be drawn, in words; None where all can, or there is none."""
    if picture is None:
        return None
    if not 1 <= len(picture["y"]) <= MAX_PANELS:
        return f"picture.y has {len(picture['y'])} columns, expected 1 to {MAX_PANELS}"
    published = picture.get("published", {})
    texts = [title, *picture.get("labels", {}).values(), *(name for lines in published.values() for name in lines)]
    if max(map(len, texts)) > MAX_LABEL_LENGTH:
        return f"picture: a title, label or name of more than {MAX_LABEL_LENGTH} characters"
    for column, lines in published.items():
        if len(lines) > MAX_PUBLISHED:
            return f"picture.published: {column} has {len(lines)} lines, expected at most {MAX_PUBLISHED}"
        for name, points in lines.items():
            for point in points:
                if max(map(abs, point)) > MAX_MAGNITUDE:
                    return f"picture.published: {column}, {name}: {shown(str(point), 40)} is no point, expected [x, y]"
    return None


def record_plan(plan: Plan, folder: Path) -> None:
    """Write the plan beside its results; RunError where it cannot be written."""
    with whole_file(folder / STUDY_RECORD, RunError) as beside:
        beside.write_text(json.dumps({"format": STUDY_FORMAT, **asdict(plan)}, indent=1) + "\n")


def recorded_plan(folder: Path) -> Plan:
    """The plan that the results in a folder are of; RunError where there is none, it is damaged, or a newer steady-ppl
    wrote it."""
    content = read_versioned(folder / STUDY_RECORD, PLAN_RECORD_FORM, STUDY_FORMAT, "a study")
    picture = content["picture"]
    if problem := _undrawable(content["title"], picture):
        raise RunError(f"{folder / STUDY_RECORD} is damaged: {problem}")
    if picture is not None:
        picture = Picture(**{one.name: picture[one.name] for one in fields(Picture) if one.name in picture})
    jobs = tuple(Job(**{name: job[name] for name in JOB_FORM}) for job in content["jobs"])
    return Plan(content["title"], content["task"], jobs, picture)
