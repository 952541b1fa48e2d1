"""One job of a study: the files that it reads, its key, and what a worker computes, on whichever machine it is.

The key is a hash of all that the result depends on, but for what is installed: all that is said of the job, the
contents of its tables or logs, its program and recipe, programs among its settings, and what these import from their
own folder and from packages in it (`from .sibling import …`). Where files are does not count.
"""

import ast
import hashlib
import json
import math
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch

from steady_ppl.comparison.evaluate import evaluate
from steady_ppl.data.table import read_table
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.datasets.alpha_truck import read_alpha_truck
from steady_ppl.discovery.discover import discover
from steady_ppl.effects import Variant, chosen_variant, parsed, with_effects
from steady_ppl.errors import DataError, RunError, UsageError
from steady_ppl.likelihood.evidence import choose_filter, log_likelihood
from steady_ppl.model.loading import load_program, program_file
from steady_ppl.model.program import Program, for_program
from steady_ppl.runs.fit import Fit, packages_text, sha256
from steady_ppl.runs.recipes import find_recipe, recipe_file, require_settings, trains
from steady_ppl.smc.simulate import simulate
from steady_ppl.utils.cores import one_core, one_thread
from steady_ppl.utils.files import require_file
from steady_ppl.utils.random import seeded
from steady_ppl.utils.text import one_line

PARTS = ("train", "valid", "test")
LOG_FILES = ("vrpn-pose.csv", "vesc_drive.csv")
TABLE_SUFFIXES = (".csv", ".parquet")
ERRORS = ("forward", "forward_mean", "state_estimation")
OUTDATED = "its model, recipe or table is not what it was when the study was begun: the same command tries it again"
HELD_OUT = "valid_log_likelihood"  # of validation drives
IN_LIMITS = "in_limits"  # how large what is missing is, in detection limits
FIGURES = {
    "fit": (
        *("forward.", "forward_mean.", "state_estimation.", "measurement."),
        *("log_likelihood", HELD_OUT, "fit_seconds", "steps", "seconds", "peak_mib"),
    ),
    "discover": ("p_value", "found", "right", "in_class", IN_LIMITS, "seconds", "peak_mib"),
}
"""Columns of numbers that a task fills, or how they begin."""

_one_at_a_time = threading.Lock()  # torch's random state and Pyro's parameters are the process's


@dataclass(frozen=True)
class Job:
    """A cell of the grid, in values that JSON can hold.

    Attributes:
        task: "fit" or "discover".
        method: its name.
        program: PATH or PATH:CLASS.
        recipe: a name or PATH; empty for a search.
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


def without_folder(value: Any) -> Any:
    """The name of a file, whose absolute path is one machine's; a list as JSON; anything else as it is."""
    if isinstance(value, list):
        return json.dumps([without_folder(one) for one in value])
    return Path(value).name if isinstance(value, str) and Path(value).is_absolute() else value


class JobFiles:
    """The files that the jobs of a study read; each is looked at once. Its methods raise UsageError where a file cannot
    be read, or is none, and where there is no such recipe."""

    def __init__(self) -> None:
        self.digest_of, self._with_siblings = cache(digest_of), cache(_with_siblings)

    def of(self, job: Job) -> list[Path]:
        """All that a job reads: tables or logs, and programs and its recipe with what these import."""
        files = [program_file(name) for name in _texts([job.program, job.data, job.settings]) if is_program(name)]
        if job.recipe:
            files.append(recipe_file(job.recipe))
        return [*_data_files(job.data), *(one for file in files for one in self._with_siblings(file))]

    def key(self, job: Job) -> str:
        """The hash that is a job's key."""
        said = json.dumps({name: value for name, value in job.columns.items() if name != "key"}, sort_keys=True)
        said += "".join(f" {name} is a list" for name, one in job.settings.items() if isinstance(one, list))
        return hashlib.sha256("\n".join([said, *map(self.digest_of, self.of(job))]).encode()).hexdigest()[:16]

    def is_of(self, job: Job) -> bool:
        """Whether its files are there, and as they were when its key was made."""
        try:
            return self.key(job) == job.key
        except UsageError:
            return False

    def digests_of(self, jobs: Sequence[Job]) -> dict[str, str]:
        """Hashes of all that jobs read, by the files' paths."""
        return {str(file): self.digest_of(file) for job in jobs for file in self.of(job)}


def digest_of(file: Path) -> str:
    """A file's name and hash; UsageError where it cannot be read, or is none."""
    require_file(file, UsageError)
    try:
        return f"{file.name} {sha256(file)}"
    except OSError as error:
        raise UsageError(f"{file} cannot be read: {error.strerror}") from error


def is_program(value: Any) -> bool:
    """Whether it names a Python file, or a class of one."""
    return isinstance(value, str) and (value.endswith(".py") or ".py:" in value)


def _texts(value: Any) -> Iterator[str]:
    inner = value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ()
    if isinstance(value, str):
        yield value
    for one in inner:
        yield from _texts(one)


def _data_files(data: Mapping[str, Any]) -> list[Path]:
    """The tables or logs of a job that are there; none where its drives are simulated."""
    files: list[Path] = []
    if "tables" in data:
        files = [Path(data["tables"]) / f"{part}{ending}" for part in PARTS for ending in TABLE_SUFFIXES]
    if "alpha_truck" in data:
        files = [Path(data["alpha_truck"]) / part / log for part in PARTS for log in LOG_FILES]
    return [file for file in files if file.exists()]


def _with_siblings(file: Path) -> list[Path]:
    """A Python file, and those that it imports relatively, and that these import."""
    found, left = dict[Path, None](), [file]
    while left:
        one = left.pop()
        if one not in found:
            found[one] = None
            left += [name for name in _imported(one) if name.is_file()]
    return list(found)


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


def run(job: Job) -> dict[str, Any]:
    """Compute a job, on one thread; whatever goes wrong is its outcome, in one line.

    Returns columns of the table: those of the job, `outcome` ("done" or "failed"), `reason`, `seconds`, `peak_mib` (the
    most memory that this process took: on Linux during the job, else until its end), `packages` with their versions and
    the figures.
    """
    with _one_at_a_time, one_thread(), one_core():
        began = time.perf_counter()
        if sys.platform == "linux":
            with suppress(OSError):  # some containers refuse: the most memory is then that since the process began
                Path("/proc/self/clear_refs").write_text("5")
        try:
            # files change while a study goes on, and may be others on another machine
            if JobFiles().is_of(job):
                found = {"outcome": "done", **TASKS[job.task](job)}
            else:
                found = {"outcome": "failed", "reason": OUTDATED}
        except (Exception, SystemExit) as error:  # a study goes on without this job
            found = {"outcome": "failed", "reason": one_line(error)}
        spent = {"seconds": time.perf_counter() - began, "peak_mib": _peak_mib(), "packages": packages_text()}
        return job.columns | spent | found


def _peak_mib() -> float:
    """The most memory that this process has taken; NaN on Windows, which cannot be asked for it."""
    with suppress(OSError, ValueError):  # not Linux, or a container that does not say it
        words = Path("/proc/self/status").read_text().split()
        return int(words[words.index("VmHWM:") + 1]) / 1024
    if sys.platform == "win32":
        return math.nan
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 1024)


def differing_versions(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """The packages whose versions are other ones there, in words; empty where none is."""
    unlike = [name for name in here if there.get(name) != here[name]]
    return ", ".join(f"{name} {there.get(name, 'none')} (here {here[name]})" for name in unlike)


def _fit(job: Job) -> dict[str, Any]:
    """Errors on the test drives, and what it took; `total` is the root of the groups' summed squares, as the paper adds
    metres, radians and their rates."""
    data = drives(job)
    with seeded(job.seed, "program"):
        program = with_noise(load_program(job.program), job)
    recipe = find_recipe(job.recipe)
    require_settings(f"recipe {job.recipe}", recipe, job.settings)
    silent = {"progress": False} if trains(recipe) else {}
    began = time.perf_counter()
    settings, start = settings_with_noise(job), job.known_start
    fitted = recipe(program, data["train"], data["valid"], known_start=start, seed=job.seed, **silent, **settings)
    seconds = time.perf_counter() - began
    if fitted.trained and fitted.trained.interrupted:
        raise RunError("it was interrupted")
    judged = evaluate(fitted, data["test"], seed=job.seed)
    figures = {f"{group}.{name}": value for group in (*ERRORS, "measurement") for name, value in judged[group].items()}
    figures |= {f"{group}.total": math.hypot(*judged[group].values()) for group in ERRORS if judged[group]}
    return figures | {
        "log_likelihood": judged["log_likelihood"],
        HELD_OUT: _held_out(fitted, data["valid"], job.seed),
        "fit_seconds": seconds,
        "steps": fitted.trained.history[-1]["step"] if fitted.trained and fitted.trained.history else 0.0,
        "filter": judged["filter"].partition(" ")[0],
        "notes": "; ".join(fitted.notes),
    }


def _held_out(fitted: Fit, valid: Trajectories, seed: int) -> float:
    """log p(y) of a validation drive at 1 Hz, as that of the test drives: what settings may be chosen by."""
    program, data, start = fitted.program, for_program(fitted.program, valid), fitted.known_start
    filters = choose_filter(program, data, known_start=start)
    settings = {"particles": filters.particles, "look_ahead": filters.look_ahead, "known_start": start}
    with seeded(seed, "valid"):
        return float(log_likelihood(program, data, **settings).mean())


def _discover(job: Job) -> dict[str, Any]:
    """Whether what is missing is named, and how surely."""
    data = drives(job)
    program, start = with_noise(load_program(job.program), job), job.known_start
    searched = discover(program, data["train"], data["valid"], known_start=start, seed=job.seed, **job.settings)
    if searched.search.interrupted:
        raise RunError("it was interrupted")
    figures, first = searched.figures, searched.search.rounds[0].screening.tests.tested
    named = [one["effect"] for one in figures["effects"]]
    classes = [name for one in figures["effects"] for name in one["class"]]
    variant, value = planted_effect(job)
    # of the program as its owner has it: beside what was found in its place, hardly any size can be told
    same = [one for one in first if variant and one.variant.name == variant.name and not one.untestable]
    limit = same[0].detection_limit.tolist() if same else None
    return {
        "p_value": figures["p_value"],
        "verdict": figures["verdict"],
        "named": ", ".join(named),
        "planted": variant.name if variant else "",
        "found": figures["verdict"] != "none",
        "right": named == [variant.name] if variant else None,
        "in_class": variant.name in classes if variant else None,
        IN_LIMITS: in_limits(value, limit),
    }


TASKS = {"fit": _fit, "discover": _discover}


def in_limits(value: Sequence[float], limit: Sequence[float] | None) -> float:
    """How large an effect is, in detection limits, by the component that has the most of its own; `value` is how far
    each component is from where the effect is absent. 0 where none was planted, NaN where the tests do not have it."""
    if not any(value):
        return 0.0
    return math.nan if limit is None else max(abs(one) / least for one, least in zip(value, limit, strict=True))


def drives(job: Job) -> dict[str, Trajectories]:
    """Train, valid and test drives, with their true states where there are any; no test drives for a search. DataError
    where there are none, or they are damaged."""
    said = job.data
    if "tables" in said:
        return {part: read_table(_table(Path(said["tables"]), part)) for part in PARTS}
    if "alpha_truck" in said:
        folder, degrees = Path(said["alpha_truck"]), said["sigma_deg"]
        return {part: read_alpha_truck(folder / part, seed=job.seed, sigma_degrees=degrees) for part in PARTS}
    whole = simulator(job)
    seeds = {part: 10 * job.seed + i for i, part in enumerate(PARTS, 1)}
    return {part: simulate(whole, said[part], seed=seeds[part]) for part in PARTS if part in said}


def base_simulator(job: Job) -> Program:
    """What simulates the drives, without the effect that its owner's program lacks."""
    return with_noise(load_program(job.data["simulate"]), job)


def simulator(job: Job) -> Program:
    """What simulates the drives, with the effect that its owner's program lacks."""
    owner, effect = base_simulator(job), job.data["effect"]
    return with_effects(owner, [effect])[0] if effect else owner


def planted_effect(job: Job) -> tuple[Variant | None, list[float]]:
    """The effect that the drives of a job have and its owner's program lacks, and how far each component of its
    coefficient is from where it would be absent."""
    if not job.data["effect"]:
        return None, []
    name, at, options, value = parsed(job.data["effect"])
    variant = chosen_variant(base_simulator(job), name, at, **options)
    coefficient = variant.coefficient(value, torch.zeros(()))
    return variant, (coefficient - variant.effect.null).flatten().tolist()


def with_noise(program: Program, job: Job) -> Program:
    """With the noise of its bearings, which is known."""
    if (degrees := job.data.get("sigma_deg")) is not None:
        if not hasattr(program, "bearing_sd"):
            raise UsageError(f"{type(program).__name__} has no bearing_sd that sigma_deg could set")
        program.bearing_sd = math.radians(degrees)
    return program


def settings_with_noise(job: Job) -> dict[str, Any]:
    """Settings whose programs know the noise of the bearings as well."""
    if "sigma_deg" not in job.data:
        return job.settings
    return {name: with_noise(load_program(one), job) if is_program(one) else one for name, one in job.settings.items()}


def _table(folder: Path, part: str) -> Path:
    files = [folder / f"{part}{ending}" for ending in TABLE_SUFFIXES]
    if not (found := [file for file in files if file.is_file()]):
        raise DataError(f"{folder} has no {' and no '.join(file.name for file in files)}")
    return found[0]
