"""The key of a job: a hash of all that its result depends on, but for the engine and what is installed."""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from steady_ppl.errors import UsageError
from steady_ppl.given_files import require_file
from steady_ppl.program_file import program_file
from steady_ppl.run_recipe import recipe_file
from steady_ppl.studies.plan import Job

PARTS = ("train", "valid", "test")
LOGS = ("vrpn-pose.csv", "vesc_drive.csv")
TABLES = (".csv", ".parquet")


class Keys:
    """Keys of the jobs of one study; each file is hashed once.

    What counts: all that is said of a job, the contents of its tables or logs, its program and recipe, programs among
    its settings, and what these import from their own folder (`from .sibling import …`). Where files are does not.
    """

    def __init__(self) -> None:
        self.digests: dict[Path, str] = {}

    def of(self, job: Job) -> str:
        """The key.

        Raises:
            UsageError: a file cannot be read, or is none.
        """
        said = json.dumps({name: value for name, value in job.columns.items() if name != "key"}, sort_keys=True)
        said += json.dumps(job.settings) if any(isinstance(one, list) for one in job.settings.values()) else ""
        parts = [said, *map(self._digest, files_of(job))]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]

    def _digest(self, file: Path) -> str:
        if file not in self.digests:
            require_file(file, UsageError)
            try:
                with file.open("rb") as stream:
                    content = hashlib.file_digest(stream, "sha256").hexdigest()
            except OSError as error:
                raise UsageError(f"{file} cannot be read: {error.strerror}") from error
            self.digests[file] = f"{file.name} {content}"
        return self.digests[file]


def is_program(value: Any) -> bool:
    """Whether it names a Python file, or a class of one."""
    return isinstance(value, str) and (value.endswith(".py") or ".py:" in value)


def files_of(job: Job) -> list[Path]:
    """All that a job reads: tables or logs, and programs and its recipe with what these import from their own folder.

    Raises:
        UsageError: there is no such recipe.
    """
    files = [program_file(name) for name in _texts([job.program, job.data, job.settings]) if is_program(name)]
    if job.recipe:
        files.append(recipe_file(job.recipe))
    return [*data_files(job.data), *(one for file in files for one in with_siblings(file))]


def _texts(value: Any) -> Iterator[str]:
    inner = value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ()
    if isinstance(value, str):
        yield value
    for one in inner:
        yield from _texts(one)


def data_files(data: Mapping[str, Any]) -> list[Path]:
    """The tables or logs of a job that are there; none where its drives are simulated."""
    files: list[Path] = []
    if "tables" in data:
        files = [Path(data["tables"]) / f"{part}{ending}" for part in PARTS for ending in TABLES]
    if "alpha_truck" in data:
        files = [Path(data["alpha_truck"]) / part / log for part in PARTS for log in LOGS]
    return [file for file in files if file.exists()]


def with_siblings(file: Path) -> list[Path]:
    """A Python file, and those of its folder that it imports relatively, and that these import."""
    found, left = dict[Path, None](), [file]
    while left:
        file = left.pop()
        if file not in found:
            found[file] = None
            left += [name for name in _imported(file) if name.is_file()]
    return list(found)


def _imported(file: Path) -> Iterator[Path]:
    require_file(file, UsageError)
    try:
        tree = ast.parse(file.read_bytes())
    except (OSError, SyntaxError, ValueError, RecursionError):
        return  # who loads it says so
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level == 1:
            names = [node.module.partition(".")[0]] if node.module else [alias.name for alias in node.names]
            yield from (file.with_name(f"{name}.py") for name in names)
