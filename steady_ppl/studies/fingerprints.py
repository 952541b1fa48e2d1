"""The files that a job reads, and its key: a hash of all that its result depends on, but for what is installed."""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from steady_ppl.errors import UsageError
from steady_ppl.model.loading import program_file
from steady_ppl.runs.fit import sha256
from steady_ppl.runs.recipes import recipe_file
from steady_ppl.studies.plan import Job
from steady_ppl.utils.files import require_file

PARTS = ("train", "valid", "test")
LOGS = ("vrpn-pose.csv", "vesc_drive.csv")
TABLES = (".csv", ".parquet")


class JobFiles:
    """The files that the jobs of a study read, and what of these their results depend on; each is looked at once.

    What counts: all that is said of a job, the contents of its tables or logs, its program and recipe, programs among
    its settings, and what these import from their own folder and from packages in it (`from .sibling import …`). Where
    files are does not.
    """

    def __init__(self) -> None:
        self.digests: dict[Path, str] = {}
        self.siblings: dict[Path, list[Path]] = {}

    def key(self, job: Job) -> str:
        """The hash.

        Raises:
            UsageError: a file cannot be read, or is none.
        """
        said = json.dumps({name: value for name, value in job.columns.items() if name != "key"}, sort_keys=True)
        said += "".join(f" {name} is a list" for name, one in job.settings.items() if isinstance(one, list))
        parts = [said, *map(self._digest, self.of(job))]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]

    def is_of(self, job: Job) -> bool:
        """Whether its files are there, and as they were when its key was made."""
        try:
            return self.key(job) == job.key
        except UsageError:
            return False

    def digests_of(self, jobs: Sequence[Job]) -> dict[str, str]:
        """Hashes of all that jobs read, by the files' paths.

        Raises:
            UsageError: as `key`.
        """
        files = dict.fromkeys(file for job in jobs for file in self.of(job))
        return {str(file): self._digest(file) for file in files}

    def digest_or_none(self, file: str) -> str | None:
        """A hash as `digests_of` has it; None where the file cannot be read."""
        try:
            return self._digest(Path(file))
        except UsageError:
            return None

    def of(self, job: Job) -> list[Path]:
        """All that a job reads: tables or logs, and programs and its recipe with what these import from their own
        folder.

        Raises:
            UsageError: there is no such recipe.
        """
        files = [program_file(name) for name in _texts([job.program, job.data, job.settings]) if is_program(name)]
        if job.recipe:
            files.append(recipe_file(job.recipe))
        return [*data_files(job.data), *(one for file in files for one in self._with_siblings(file))]

    def _with_siblings(self, file: Path) -> list[Path]:
        """A Python file, and those that it imports relatively, and that these import."""
        if file not in self.siblings:
            found, left = dict[Path, None](), [file]
            while left:
                one = left.pop()
                if one not in found:
                    found[one] = None
                    left += [name for name in _imported(one) if name.is_file()]
            self.siblings[file] = list(found)
        return self.siblings[file]

    def _digest(self, file: Path) -> str:
        if file not in self.digests:
            require_file(file, UsageError)
            try:
                content = sha256(file)
            except OSError as error:
                raise UsageError(f"{file} cannot be read: {error.strerror}") from error
            self.digests[file] = f"{file.name} {content}"
        return self.digests[file]


def is_program(value: Any) -> bool:
    """Whether it names a Python file, or a class of one."""
    return isinstance(value, str) and (value.endswith(".py") or ".py:" in value)


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


def _imported(file: Path) -> Iterator[Path]:
    require_file(file, UsageError)
    try:
        tree = ast.parse(file.read_bytes())
    except (OSError, SyntaxError, ValueError, RecursionError):
        return  # who loads it says so
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level:
            place = file.parents[node.level - 1] if node.level <= len(file.parents) else file.parent
            for part in node.module.split(".") if node.module else ():
                place /= part
                yield from (place.with_suffix(".py"), place / "__init__.py")
            for alias in node.names:
                yield from (place / f"{alias.name}.py", place / alias.name / "__init__.py")
