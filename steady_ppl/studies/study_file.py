"""What a study compares with what, from a TOML file.

    title = "Observation noise on the truck"
    task = "fit"                            # or "discover"
    seeds = [1, 2, 3]                       # of the data, and of what is done with them
    known_start = true                      # optional

    [data]                                  # one of simulate, alpha_truck and tables
    alpha_truck = "../logs"                 # a folder with train/, valid/ and test/
    sigma_deg = [1.25, 2.5, 5, 10, 20]

    [[method]]
    name = "STEADY"
    program = "../models/neural_vehicle.py:NeuralTruck"
    recipe = "steady"
    settings = {ramp = 3.0, steps = 160}

    [picture]                               # optional
    x = "data.sigma_deg"                    # a column of the table
    y = ["forward.total"]                   # a panel each
    labels = {"data.sigma_deg" = "noise of the bearings [°]"}
    published = {"forward.total" = {STEADY = [[1.25, 0.434], [5, 0.456]]}}

Every list among the values of `[data]` and of a method's `settings` is an axis of the grid: each of its values is tried
with each of every other's, and with each seed. Paths are relative to the file.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from steady_ppl.errors import UsageError
from steady_ppl.given_files import ANYTHING, LINES, NUMBER, TEXT, TRUTH, WHOLE, Absent, Maybe, misfit, require_file
from steady_ppl.studies.plan import POINTS, Job, Picture, Plan, without_folder

TASKS = ("fit", "discover")
SOURCES: dict[str, dict[str, Any]] = {
    "simulate": {"train": 16, "valid": 16, "test": 32, "effect": "", "sigma_deg": None},
    "alpha_truck": {"sigma_deg": 5.0},
    "tables": {},
}
"""Where data come from, and what else may be said of them, with what it is when nothing is said."""

FORM = {
    "title": TEXT,
    "task": Absent(TEXT),
    "seeds": [WHOLE],
    "known_start": Absent(TRUTH),
    "data": {str: ANYTHING},
    "picture": Absent(
        {
            "x": TEXT,
            "y": LINES,
            "labels": Absent({str: TEXT}),
            "published": Absent(POINTS),
        }
    ),
    "method": [{"name": TEXT, "program": TEXT, "recipe": Absent(TEXT), "settings": Absent({str: ANYTHING})}],
}


def read_plan(path: Path, data: Path | None = None) -> Plan:
    """Read a study.

    Args:
        path: the TOML file.
        data: the folder of the logs or tables, in place of the one that the file names.

    Raises:
        UsageError: naming what is wrong, and where.
    """
    require_file(path, UsageError)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError(f"there is no study {path}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"{path} cannot be read as TOML: {error}") from error
    problem = misfit(content, FORM) or _surplus(content)
    if problem is not None:
        raise UsageError(f"{path}: {problem}")
    task = content.get("task", "fit")
    if task not in TASKS:
        raise UsageError(f"{path}: task is {task!r}, expected {' or '.join(TASKS)}")
    if task == "discover" and "simulate" not in content["data"]:
        raise UsageError(f"{path}: task discover needs data that are simulated, of which it knows what is missing")
    source = _source(path, content["data"], data)
    if not content["seeds"] or not content["method"]:
        raise UsageError(f"{path}: expected at least one seed and one method")
    jobs = tuple(_jobs(path, content, task, source))
    picture = Picture(**content["picture"]) if "picture" in content else None
    return Plan(content["title"], task, _labelled(_without_doubles(path, jobs)), picture)


def _surplus(content: Mapping[str, Any]) -> str | None:
    """A name that means nothing, so that one that is misspelt does not pass for a default."""
    places = [("", content, FORM), *(("method.", one, FORM["method"][0]) for one in content["method"])]  # type: ignore
    places += [("picture.", content["picture"], FORM["picture"].form)] if "picture" in content else []  # type: ignore
    for place, given, known in places:
        for name in given:
            if name not in known:
                return f"{place}{name} means nothing here; there are {', '.join(known)}"
    return None


def _source(path: Path, given: Mapping[str, Any], folder: Path | None) -> dict[str, Any]:
    """The source of the data with its path, and all that is said of it."""
    named = [name for name in SOURCES if name in given]
    if len(named) != 1:
        raise UsageError(f"{path}: data has {' and '.join(named) or 'no source'}, expected one of {', '.join(SOURCES)}")
    (kind,) = named
    surplus = [name for name in given if name not in {kind, *SOURCES[kind]}]
    if surplus:
        known = ", ".join(SOURCES[kind]) or "nothing else"
        raise UsageError(f"{path}: data.{surplus[0]} means nothing beside {kind}; there is {known}")
    if not isinstance(given[kind], str):
        raise UsageError(f"{path}: data.{kind} is {given[kind]!r}, expected a path")
    if folder is not None and kind == "simulate":
        raise UsageError(f"{path}: its data are simulated, --data is for logs and tables")
    place = str(_beside(path, given[kind])) if folder is None else str(folder.resolve())
    if kind != "simulate" and not Path(place).is_dir():
        raise UsageError(f"{path}: there is no folder {place} (data.{kind}); --data names another")
    said = {name: given.get(name, usual) for name, usual in SOURCES[kind].items()}
    for name, value in said.items():
        form = TEXT if name == "effect" else NUMBER if name == "sigma_deg" else WHOLE
        problem = misfit(value if isinstance(value, list) else [value], [Maybe(form)], f"data.{name}")
        if problem is not None:
            raise UsageError(f"{path}: {problem}")
    return {kind: place} | {name: value for name, value in said.items() if value is not None}


def _jobs(path: Path, content: Mapping[str, Any], task: str, source: Mapping[str, Any]) -> Iterator[Job]:
    files = _contents(path, [Path(value) for name, value in source.items() if name in ("alpha_truck", "tables")])
    for seed in content["seeds"]:
        for data in _grid(path, source):
            for method in content["method"]:
                program = str(_beside(path, method["program"]))
                recipe = method.get("recipe", "steady") if task == "fit" else ""
                recipe = str(_beside(path, recipe)) if recipe.endswith(".py") else recipe
                given = {name: _resolved(path, value) for name, value in method.get("settings", {}).items()}
                for settings in _grid(path, given):
                    start = content.get("known_start", False)
                    job = Job(task, method["name"], program, recipe, data, settings, seed, start, key=files)
                    named = [program, recipe, *data.values(), *settings.values()]
                    programs = [Path(file.partition(".py")[0] + ".py") for file in named if _is_program(file)]
                    said = json.dumps(job.columns, sort_keys=True)
                    yield replace(job, key=_hash(said.encode(), _contents(path, programs).encode()))


def _grid(path: Path, values: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    axes = [value if isinstance(value, list) else [value] for value in values.values()]
    for name, axis in zip(values, axes, strict=True):
        if not axis:
            raise UsageError(f"{path}: {name} is an axis without a value")
        if not all(isinstance(value, str | int | float | bool | list) for value in axis):
            raise UsageError(f"{path}: {name} is {axis}, expected numbers, text, true or false")
    for cell in itertools.product(*axes):
        yield dict(zip(values, cell, strict=True))


@cache
def _contents_of(files: tuple[Path, ...]) -> str:
    return _hash(*(file.read_bytes() for file in files))


def _contents(path: Path, places: Sequence[Path]) -> str:
    """A hash of what is in some files and folders; where they are does not count."""
    files = [file for place in places for file in (sorted(place.rglob("*")) if place.is_dir() else [place])]
    try:
        return _contents_of(tuple(file for file in files if not file.is_dir()))
    except OSError as error:
        raise UsageError(f"{path}: {error.filename} cannot be read: {error.strerror}") from error


def _hash(*parts: bytes) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()[:16]


def _without_doubles(path: Path, jobs: tuple[Job, ...]) -> tuple[Job, ...]:
    seen: dict[str, Job] = {}
    for job in jobs:
        if job.key in seen:
            raise UsageError(
                f"{path}: {job.method} is there twice: methods need names of their own, and axes other values"
            )
        seen[job.key] = job
    return jobs


def _labelled(jobs: tuple[Job, ...]) -> tuple[Job, ...]:
    """By their methods and by the values of the axes."""
    seen: dict[str, set[str]] = {}
    for job in jobs:
        for name, value in (job.data | job.settings).items():
            seen.setdefault(name, set()).add(repr(value))
    varied = {name for name, values in seen.items() if len(values) > 1}

    def label(job: Job) -> str:
        said = (job.data | job.settings).items()
        axes = [f"{name}={without_folder(value)}" for name, value in said if name in varied]
        return " ".join([job.method, *axes, f"seed={job.seed}"])

    return tuple(replace(job, label=label(job)) for job in jobs)


def _beside(path: Path, name: str) -> Path:
    return (path.parent / name).resolve()


def _resolved(path: Path, value: Any) -> Any:
    """Settings that name programs are paths as well."""
    if isinstance(value, list):
        return [_resolved(path, one) for one in value]
    return str(_beside(path, value)) if _is_program(value) else value


def _is_program(value: Any) -> bool:
    return isinstance(value, str) and (value.endswith(".py") or ".py:" in value)
