"""The axes of a study's grid: what is said of its data and of its methods, each a list of values to try."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from steady_ppl.errors import UsageError
from steady_ppl.studies.job_files import is_program
from steady_ppl.studies.plan import LARGEST
from steady_ppl.utils.schema import NUMBER, TEXT, WHOLE, Maybe, misfit
from steady_ppl.utils.text import shown

SOURCES: dict[str, dict[str, Any]] = {
    "simulate": {"train": 16, "valid": 16, "test": 32, "effect": "", "sigma_deg": None},
    "alpha_truck": {"sigma_deg": 5.0},
    "tables": {},
}
"""Where data come from, and what else may be said of them, with what it is when nothing is said."""

MOST_DRIVES = 1_000_000
Axes = dict[str, list[Any]]


def source_axes(folder: Path, given: Mapping[str, Any], instead: Path | None, task: str) -> Axes:
    """The source of the data with its path, and all that is said of it, each a list of values; a search uses no test
    drives."""
    named = [name for name in SOURCES if name in given]
    if len(named) != 1:
        raise UsageError(f"data has {' and '.join(named) or 'no source'}, expected one of {', '.join(SOURCES)}")
    (kind,) = named
    sayable = {name: usual for name, usual in SOURCES[kind].items() if (task, name) != ("discover", "test")}
    surplus = [name for name in given if name not in {kind, *sayable}]
    if surplus:
        known = ", ".join(sayable) or "nothing else"
        raise UsageError(f"data.{surplus[0]} means nothing beside {kind}; there is {known}")
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
        problem = misfit(values, [Maybe(form)], f"data.{name}")
        if problem is not None:
            raise UsageError(problem)
        for value in values if form != TEXT else ():
            if value is not None and not 0 < value <= MOST_DRIVES:
                raise UsageError(f"data.{name} is {value}, expected more than 0 and at most {MOST_DRIVES:,}")
        if values != [None]:
            axes[name] = values
    return axes


def method_axes(folder: Path, given: Mapping[str, Any], task: str) -> dict[str, Any]:
    """A method whose files have their folders and whose settings are lists of values."""
    if task == "discover" and "recipe" in given:
        raise UsageError(f"method {given['name']}: a recipe means nothing to a search")
    recipe = given.get("recipe", "steady") if task == "fit" else ""
    axes = {name: _axis(name, value) for name, value in given.get("settings", {}).items()}
    return {
        "method": given["name"],
        "program": _beside(folder, given["program"]),
        "recipe": _beside(folder, recipe) if recipe.endswith(".py") else recipe,
        "settings": {name: [_resolved(folder, one) for one in axis] for name, axis in axes.items()},
    }


def count(axes: Axes) -> int:
    """How many cells there are."""
    return math.prod(map(len, axes.values()))


def grid(axes: Axes) -> Iterator[dict[str, Any]]:
    """Every value of each with every other's."""
    for cell in itertools.product(*axes.values()):
        yield dict(zip(axes, cell, strict=True))


def _axis(name: str, value: Any) -> list[Any]:
    axis = value if isinstance(value, list) else [value]
    if not axis:
        raise UsageError(f"{name} is an axis without a value")
    problems = [one for one in axis if one is not None and not _is_plain(one)]
    if problems:
        raise UsageError(f"{name} is {shown(repr(problems[0]), 40)}, expected numbers, text, true or false")
    return axis


def _is_plain(value: Any, depth: int = 0) -> bool:
    """Whether a table can hold it: finite numbers that are no larger than any use, text, truth, and lists of them."""
    if isinstance(value, list):
        return depth < 2 and all(_is_plain(one, depth + 1) for one in value)
    if isinstance(value, bool | str):
        return True
    if isinstance(value, int):
        return abs(value) < 2**63
    return isinstance(value, float) and math.isfinite(value) and abs(value) <= LARGEST


def _beside(folder: Path, name: str) -> str:
    if "\0" in name:
        raise UsageError(f"{name!r} is no path: it has a character 0")
    return str((folder / os.path.expanduser(name)).resolve())


def _resolved(folder: Path, value: Any) -> Any:
    """Settings that name programs are paths as well."""
    if isinstance(value, list):
        return [_resolved(folder, one) for one in value]
    return _beside(folder, value) if is_program(value) else value
