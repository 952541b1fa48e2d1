"""One job of a study: what a worker computes, on whichever machine it is."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from steady_ppl.comparison.evaluate import evaluate
from steady_ppl.data.table import read_table
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.datasets.alpha_truck import read_alpha_truck
from steady_ppl.discovery.discover import discover
from steady_ppl.effects import Variant, chosen_variant, parsed
from steady_ppl.effects.attach import with_effects
from steady_ppl.errors import DataError, RunError, UsageError
from steady_ppl.likelihood.evidence import choose_filter, log_likelihood
from steady_ppl.model.loading import load_program
from steady_ppl.model.program import Program, for_program
from steady_ppl.runs.fit import Fit, packages
from steady_ppl.runs.recipes import find_recipe, require_settings, trains
from steady_ppl.smc.simulate import simulate
from steady_ppl.studies.fingerprints import PARTS, TABLES, JobFiles, is_program
from steady_ppl.studies.plan import HELD_OUT, IN_LIMITS, Job
from steady_ppl.utils.cores import one_core, one_thread
from steady_ppl.utils.random import seeded
from steady_ppl.utils.text import one_line

ERRORS = ("forward", "forward_mean", "state_estimation")
CHANGED = "its program, recipe or table is not what it was when the study was begun: the same command tries it again"
_one_at_a_time = threading.Lock()  # torch's random state and Pyro's parameters are the process's


def run(job: Job) -> dict[str, Any]:
    """Compute a job, on one thread; whatever goes wrong is its outcome, in one line.

    Returns:
        Columns of the table: those of the job, `outcome` ("done" or "failed"), `reason`, `seconds`, `peak_mib` (the
        most memory that this process took: on Linux during the job, else until its end), `packages` with their
        versions and the figures.
    """
    with _one_at_a_time, one_thread(), one_core():
        began = time.perf_counter()
        _forget_peak()
        try:
            # files change while a study goes on, and may be others on another machine
            if JobFiles().is_of(job):
                found = {"outcome": "done", **TASKS[job.task](job)}
            else:
                found = {"outcome": "failed", "reason": CHANGED}
        except (Exception, SystemExit) as error:  # a study goes on without this job
            found = {"outcome": "failed", "reason": one_line(error)}
        spent = {"seconds": time.perf_counter() - began, "peak_mib": _peak_mib(), "packages": in_words(packages())}
        return job.columns | spent | found


def _forget_peak() -> None:
    """Count the most memory that this process takes from here on, where the system can do that (Linux, but for some
    containers)."""
    if sys.platform == "linux":
        with suppress(OSError):  # then it is counted from the process's beginning
            Path("/proc/self/clear_refs").write_text("5")


def _peak_mib() -> float:
    """The most memory that this process has taken; NaN on Windows, which cannot be asked for it."""
    with suppress(OSError, ValueError):  # not Linux, or a container that does not say it
        words = Path("/proc/self/status").read_text().split()
        return int(words[words.index("VmHWM:") + 1]) / 1024
    if sys.platform == "win32":
        return math.nan
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 1024)


def in_words(versions: Mapping[str, str]) -> str:
    """Packages and their versions."""
    return ", ".join(f"{name} {number}" for name, number in versions.items())


def differing(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """The packages whose versions are other ones there, in words; empty where none is."""
    unlike = [name for name in here if there.get(name) != here[name]]
    return ", ".join(f"{name} {there.get(name, 'none')} (here {here[name]})" for name in unlike)


def _fit(job: Job) -> dict[str, Any]:
    """Errors on the test drives, and what it took; `total` is the root of the groups' summed squares, as the paper adds
    metres, radians and their rates."""
    data = drives(job)
    with seeded(job.seed, "program"):
        program = told(load_program(job.program), job)
    recipe = find_recipe(job.recipe)
    require_settings(f"recipe {job.recipe}", recipe, job.settings)
    silent = {"progress": False} if trains(recipe) else {}
    began = time.perf_counter()
    fitted = recipe(
        program,
        data["train"],
        data["valid"],
        known_start=job.known_start,
        seed=job.seed,
        **silent,
        **told_settings(job),
    )
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
    data = for_program(fitted.program, valid)
    choice = choose_filter(fitted.program, data, known_start=fitted.known_start)
    with seeded(seed, "valid"):
        found = log_likelihood(
            fitted.program,
            data,
            particles=choice.particles,
            look_ahead=choice.look_ahead,
            known_start=fitted.known_start,
        )
    return float(found.mean())


def _discover(job: Job) -> dict[str, Any]:
    """Whether what is missing is named, and how surely."""
    data = drives(job)
    searched = discover(
        told(load_program(job.program), job),
        data["train"],
        data["valid"],
        known_start=job.known_start,
        seed=job.seed,
        **job.settings,
    )
    figures, first = searched.figures, searched.search.rounds[0].screening.tests.tested
    named = [one["effect"] for one in figures["effects"]]
    classes = [name for one in figures["effects"] for name in one["class"]]
    variant, value = planted(job)
    # of the program as its owner has it: beside what was found in its place, hardly any size can be told
    limits = [
        one.detection_limit.tolist()
        for one in first
        if variant and one.variant.name == variant.name and not one.untestable
    ]
    return {
        "p_value": figures["p_value"],
        "verdict": figures["verdict"],
        "named": ", ".join(named),
        "planted": variant.name if variant else "",
        "found": figures["verdict"] != "none",
        "right": named == [variant.name] if variant else None,
        "in_class": variant.name in classes if variant else None,
        IN_LIMITS: in_limits(value, limits[0] if limits else None),
    }


TASKS = {"fit": _fit, "discover": _discover}


def in_limits(value: Sequence[float], limit: Sequence[float] | None) -> float:
    """How large an effect is, in detection limits, by the component that has the most of its own: 0 where none was
    planted, NaN where the tests do not have it.

    Args:
        value: how far each component of the coefficient is from where the effect is absent.
        limit: of each of its components.
    """
    if not any(value):
        return 0.0
    return math.nan if limit is None else max(abs(one) / least for one, least in zip(value, limit, strict=True))


Split = dict[str, Trajectories]


def drives(job: Job) -> Split:
    """Train, valid and test drives, with their true states where there are any; no test drives for a search.

    Raises:
        DataError: there are none, or they are damaged.
    """
    said = job.data
    if "tables" in said:
        return {part: read_table(_table(Path(said["tables"]), part)) for part in PARTS}
    if "alpha_truck" in said:
        folder, degrees = Path(said["alpha_truck"]), said["sigma_deg"]
        return {part: read_alpha_truck(folder / part, seed=job.seed, sigma_degrees=degrees) for part in PARTS}
    whole = truth(job)
    seeds = {part: 10 * job.seed + i for i, part in enumerate(PARTS, 1)}
    return {part: simulate(whole, said[part], seed=seeds[part]) for part in PARTS if part in said}


def without_effect(job: Job) -> Program:
    """What simulates the drives, without the effect that its owner's program lacks."""
    return told(load_program(job.data["simulate"]), job)


def truth(job: Job) -> Program:
    """What simulates the drives, with the effect that its owner's program lacks."""
    owner, effect = without_effect(job), job.data["effect"]
    return with_effects(owner, [effect], say=lambda line: None) if effect else owner


def planted(job: Job) -> tuple[Variant | None, list[float]]:
    """The effect that the drives of a job have and its owner's program lacks, and how far each component of its
    coefficient is from where it would be absent."""
    if not job.data["effect"]:
        return None, []
    name, at, options, value = parsed(job.data["effect"])
    variant = chosen_variant(without_effect(job), name, at, **options)
    coefficient = variant.coefficient(value, torch.zeros(()))
    return variant, (coefficient - variant.effect.null).flatten().tolist()


def told(program: Program, job: Job) -> Program:
    """With the noise of its bearings, which is known."""
    degrees = job.data.get("sigma_deg")
    if degrees is not None:
        if not hasattr(program, "bearing_sd"):
            raise UsageError(f"{type(program).__name__} has no bearing_sd that sigma_deg could set")
        program.bearing_sd = math.radians(degrees)
    return program


def told_settings(job: Job) -> dict[str, Any]:
    """Settings whose programs know the noise of the bearings as well."""
    if "sigma_deg" not in job.data:
        return job.settings
    return {
        name: told(load_program(value), job) if is_program(value) else value for name, value in job.settings.items()
    }


def _table(folder: Path, part: str) -> Path:
    files = [folder / f"{part}{ending}" for ending in TABLES]
    found = [file for file in files if file.is_file()]
    if not found:
        raise DataError(f"{folder} has no {' and no '.join(file.name for file in files)}")
    return found[0]
