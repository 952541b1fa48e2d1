"""One job of a study: what a worker computes, on whichever machine it is."""

from __future__ import annotations

import inspect
import math
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import torch

from steady_ppl.data import Trajectories
from steady_ppl.discovery import discover
from steady_ppl.effects import parsed
from steady_ppl.errors import RunError, SteadyError, UsageError, one_line
from steady_ppl.evaluation import evaluate
from steady_ppl.filtering import choose_filter, log_likelihood
from steady_ppl.fit import Fit, packages
from steady_ppl.program import for_program
from steady_ppl.program_file import load_program
from steady_ppl.run_recipe import find_recipe, require_settings, trains
from steady_ppl.seeding import seeded
from steady_ppl.studies.job_data import drives, told, told_settings, truth
from steady_ppl.studies.job_files import JobFiles
from steady_ppl.studies.plan import IN_LIMITS, Job, Plan

GROUPS = ("forward", "forward_mean", "state_estimation", "measurement")
_one_at_a_time = threading.Lock()  # torch's random state and Pyro's parameters are the process's


def run(job: Job, asked_with: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Compute a job, on one thread; whatever goes wrong is its outcome, in one line.

    Args:
        job: what to compute.
        asked_with: versions of the packages where the study is kept, if that may be another machine.

    Returns:
        Columns of the table: those of the job, `outcome` ("done" or "failed"), `reason`, `seconds`, `peak_mib` (of
        this process so far), `version` of steady-ppl and the figures.
    """
    with _one_at_a_time:
        torch.set_num_threads(1)
        began = time.perf_counter()
        try:
            _require_alike(asked_with)
            _require_unchanged(job)
            found: dict[str, Any] = {"outcome": "done"} | TASKS[job.task](job)
        except (Exception, SystemExit) as error:  # a study goes on without this job
            found = {"outcome": "failed", "reason": one_line(error)}
        spent = {"seconds": time.perf_counter() - began, "peak_mib": _peak_mib(), "version": version("steady-ppl")}
        return job.columns | spent | found


def _peak_mib() -> float:
    """The most memory that this process has taken; NaN on Windows, which cannot be asked for it."""
    if sys.platform == "win32":
        return math.nan
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 1024)


def _require_alike(asked_with: Mapping[str, str] | None) -> None:
    """A worker may have joined after all that were there had been looked at."""
    other = differing(asked_with, packages()) if asked_with else ""
    if other:
        raise RunError(f"its worker had {other}: results would not be comparable")


def differing(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """The packages whose versions are other ones there, in words; empty where none is."""
    return ", ".join(f"{name} {there[name]} (here {here[name]})" for name in here if there[name] != here[name])


def _require_unchanged(job: Job) -> None:
    """Files change while a study goes on, and may be others on another machine: what is kept is kept by its key."""
    if JobFiles().key(replace(job, key="")) != job.key:
        raise RunError("its program, recipe or table is not what it was when the study was begun: begin it again")


def require_runnable(plan: Plan) -> None:
    """Load every program, plant every effect, look at every method's settings and read every log or table once, before
    anything is sent out.

    Raises:
        SteadyError: naming the method.
    """
    for job in {(job.method, repr(job.settings)): job for job in plan.jobs}.values():
        with _named(f"method {job.method}"):
            told(load_program(job.program), job)
            if job.task == "fit":
                require_settings(job.recipe, find_recipe(job.recipe), job.settings)
            else:
                _require_search_settings(job.settings)
    for job in {repr(job.data): job for job in plan.jobs if "simulate" in job.data}.values():
        with _named("data"):
            truth(job)
    if "simulate" not in plan.jobs[0].data:
        with _named("data"):
            drives(plan.jobs[0])


@contextmanager
def _named(what: str) -> Iterator[None]:
    try:
        yield
    except SteadyError as error:
        error.args = (f"{what}: {error}",)
        raise


def _require_search_settings(settings: Mapping[str, Any]) -> None:
    given = set(list(inspect.signature(discover).parameters)[:3]) | {"known_start", "seed"}  # by the study itself
    known = [name for name in inspect.signature(discover).parameters if name not in given]
    unknown = [name for name in settings if name not in known]
    if unknown:
        raise UsageError(f"discover has no setting {unknown[0]}; there are {', '.join(known)}")


def _fit(job: Job) -> dict[str, Any]:
    """Errors on the test drives, and what it took; `total` is the root of the groups' summed squares, as the paper adds
    metres, radians and their rates."""
    data = drives(job)
    with seeded(job.seed, "program"):
        program = told(load_program(job.program), job)
    recipe = find_recipe(job.recipe)
    require_settings(job.recipe, recipe, job.settings)
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
    figures = {f"{group}.{name}": value for group in GROUPS for name, value in judged[group].items()}
    figures |= {f"{group}.total": math.hypot(*judged[group].values()) for group in GROUPS[:3] if judged[group]}
    return figures | {
        "log_likelihood": judged["log_likelihood"],
        "valid_log_likelihood": _held_out(fitted, data["valid"], job.seed),
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
    figures = discover(
        told(load_program(job.program), job),
        data["train"],
        data["valid"],
        known_start=job.known_start,
        seed=job.seed,
        **job.settings,
    ).figures
    planted, _, _, value = parsed(job.data["effect"]) if job.data["effect"] else ("", "", {}, 0.0)
    named = [one["effect"].partition(":")[0] for one in figures["effects"]]
    classes = [other.partition(":")[0] for one in figures["effects"] for other in one["class"]]
    limits = [
        one["detection_limit"]
        for one in figures["candidates"]
        if one["effect"].partition(":")[0] == planted and one["detection_limit"] is not None
    ]
    return {
        "p_value": figures["p_value"],
        "verdict": figures["verdict"],
        "named": ", ".join(named),
        "planted": planted,
        "found": figures["verdict"] != "none",
        "right": planted in named if planted else not named,
        "in_class": planted in classes if planted else not named,
        IN_LIMITS: in_limits(value, limits),
    }


TASKS = {"fit": _fit, "discover": _discover}


def in_limits(value: Any, limits: list[Any]) -> float:
    """How large an effect is, in detection limits: 0 where none was planted, NaN where the search says no limit."""

    def size(one: Any) -> float:
        return max(map(abs, one)) if isinstance(one, list | tuple) else abs(float(one))

    if value is None or (size(value) > 0 and not limits):
        return math.nan
    return size(value) / size(limits[0]) if size(value) > 0 else 0.0
