"""One job of a study: what a worker computes, on whichever machine it is."""

from __future__ import annotations

import inspect
import math
import resource
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from steady_ppl.alpha_truck import read_alpha_truck
from steady_ppl.command_effects import with_effects
from steady_ppl.data import Trajectories
from steady_ppl.discovery import discover
from steady_ppl.effects import parsed
from steady_ppl.errors import DataError, RunError, SteadyError, UsageError, one_line
from steady_ppl.evaluation import evaluate
from steady_ppl.filtering import choose_filter, log_likelihood
from steady_ppl.fit import Fit
from steady_ppl.program import Program, for_program
from steady_ppl.program_file import load_program
from steady_ppl.run_recipe import find_recipe, require_settings, trains
from steady_ppl.seeding import seeded
from steady_ppl.simulation import simulate
from steady_ppl.studies.keys import PARTS, TABLES, Keys, is_program
from steady_ppl.studies.plan import IN_LIMITS, Job, Plan
from steady_ppl.table import read_table

GROUPS = ("forward", "forward_mean", "state_estimation", "measurement")
Split = dict[str, Trajectories]
_one_at_a_time = threading.Lock()  # torch's random state and Pyro's parameters are the process's


def run(job: Job) -> dict[str, Any]:
    """Compute a job, on one thread; whatever goes wrong is its outcome, in one line.

    Returns:
        Columns of the table: those of the job, `outcome` ("done" or "failed"), `reason`, `seconds`, `peak_mib` (of
        this process so far), `version` of steady-ppl and the figures.
    """
    with _one_at_a_time:
        torch.set_num_threads(1)
        began = time.perf_counter()
        try:
            _require_unchanged(job)
            found: dict[str, Any] = {"outcome": "done"} | TASKS[job.task](job)
        except (Exception, SystemExit) as error:  # a study goes on without this job
            found = {"outcome": "failed", "reason": one_line(error)}
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        spent = {"seconds": time.perf_counter() - began, "peak_mib": peak, "version": version("steady-ppl")}
        return job.columns | spent | found


def _require_unchanged(job: Job) -> None:
    """Files change while a study goes on, and may be others on another machine: what is kept is kept by its key."""
    if Keys().of(replace(job, key="")) != job.key:
        raise RunError("its program, recipe or table is not what it was when the study was begun: begin it again")


def require_runnable(plan: Plan) -> None:
    """Load every program, plant every effect and look at every method's settings, before anything is sent out.

    Raises:
        SteadyError: naming the method.
    """
    for job in {(job.method, repr(job.settings)): job for job in plan.jobs}.values():
        with _named(f"method {job.method}"):
            _told(load_program(job.program), job)
            if job.task == "fit":
                require_settings(job.recipe, find_recipe(job.recipe), job.settings)
            else:
                _require_search_settings(job.settings)
    for job in {repr(job.data): job for job in plan.jobs if "simulate" in job.data}.values():
        with _named("data"):
            _truth(job)


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
        program = _told(load_program(job.program), job)
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
        **_told_settings(job),
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
        _told(load_program(job.program), job),
        data["train"],
        data["valid"],
        known_start=job.known_start,
        seed=job.seed,
        **job.settings,
    ).figures
    planted, _, _, value = parsed(job.data["effect"]) if job.data["effect"] else ("", "", {}, None)
    named = [one["effect"].partition(":")[0] for one in figures["effects"]]
    classes = [other.partition(":")[0] for one in figures["effects"] for other in one["class"]]
    limits = [
        one["detection_limit"]
        for one in figures["candidates"]
        if one["effect"].partition(":")[0] == planted and one["detection_limit"] is not None
    ]
    limit = _size(limits[0]) if limits else math.nan
    return {
        "p_value": figures["p_value"],
        "verdict": figures["verdict"],
        "named": ", ".join(named),
        "planted": planted,
        "found": figures["verdict"] != "none",
        "right": planted in named if planted else not named,
        "in_class": planted in classes if planted else not named,
        IN_LIMITS: _size(value) / limit if value and limits else math.nan,
    }


TASKS = {"fit": _fit, "discover": _discover}


def drives(job: Job) -> Split:
    """Train, valid and test drives, with their true states where there are any.

    Raises:
        DataError: there are none, or they are damaged.
    """
    told = job.data
    if "tables" in told:
        return {part: read_table(_table(Path(told["tables"]), part)) for part in PARTS}
    if "alpha_truck" in told:
        folder, degrees = Path(told["alpha_truck"]), told["sigma_deg"]
        return {part: read_alpha_truck(folder / part, seed=job.seed, sigma_degrees=degrees) for part in PARTS}
    truth = _truth(job)
    return {part: simulate(truth, told[part], seed=10 * job.seed + i) for i, part in enumerate(PARTS, 1)}


def _truth(job: Job) -> Program:
    """What simulates the drives, with the effect that its owner's program lacks."""
    truth, effect = _told(load_program(job.data["simulate"]), job), job.data["effect"]
    return with_effects(truth, [effect], say=lambda line: None) if effect else truth


def _told(program: Program, job: Job) -> Program:
    """With the noise of its bearings, which is known."""
    degrees = job.data.get("sigma_deg")
    if degrees is not None:
        if not hasattr(program, "bearing_sd"):
            raise UsageError(f"{job.program} has no bearing_sd that sigma_deg could set")
        program.bearing_sd = math.radians(degrees)
    return program


def _told_settings(job: Job) -> dict[str, Any]:
    """Settings whose programs know the noise of the bearings as well."""
    if "sigma_deg" not in job.data:
        return job.settings
    return {
        name: _told(load_program(value), job) if is_program(value) else value for name, value in job.settings.items()
    }


def _table(folder: Path, part: str) -> Path:
    files = [folder / f"{part}{ending}" for ending in TABLES]
    found = [file for file in files if file.is_file()]
    if not found:
        raise DataError(f"{folder} has no {' and no '.join(file.name for file in files)}")
    return found[0]


def _size(value: Any) -> float:
    return max(map(abs, value)) if isinstance(value, list | tuple) else abs(float(value))
