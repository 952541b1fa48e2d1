"""Send the jobs of a study out and keep what comes back.

A result is kept when it comes. A job whose worker dies is tried again; one that kills each of its workers is given up.
"""

import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from steady_ppl.comparison.evaluate import OPEN_LOOP
from steady_ppl.discovery.discover import discover
from steady_ppl.errors import ComputationError, RunError, UsageError, labelled
from steady_ppl.model.loading import load_program
from steady_ppl.model.program import Program, error_indices, for_program
from steady_ppl.runs.fit import packages_text
from steady_ppl.runs.recipes import find_recipe, require_settings
from steady_ppl.smc.simulate import simulate
from steady_ppl.studies.executors import Executor, ResultRow
from steady_ppl.studies.job import ERRORS, OUTDATED, base_simulator, drives, settings_with_noise, simulator, with_noise
from steady_ppl.studies.plan import STUDY_RECORD, Plan, record_plan, recorded_plan
from steady_ppl.studies.table import read_results, study_table
from steady_ppl.utils.text import Say


def run_study(plan: Plan, folder: Path, place: Executor, *, again: bool = False, say: Say = lambda line: None) -> int:
    """Compute what of a study is not there yet.

    Args:
        folder: where its table is.
        again: try jobs that have failed once more.
        say: hears a line a job.

    Returns:
        How many jobs have failed.

    Raises:
        RunError: the folder cannot be written or read, holds another study, or another process writes to it.
        ComputationError: there is nothing left to compute on; all that had come is kept.
    """
    with study_table(folder) as table:
        wanted = {job.key: job for job in plan.jobs}
        if (folder / STUDY_RECORD).exists():  # whose results must not be put aside for those of another study
            there = recorded_plan(folder)
            if there.title != plan.title and wanted.keys().isdisjoint(job.key for job in there.jobs):
                raise RunError(f"{folder} holds another study, {there.title!r}: choose another folder")
        table.keep(wanted)
        record_plan(plan, folder)
        rows = read_results(folder).to_dict("records")
        failed = [row for row in rows if row["outcome"] == "failed"]
        retried = {row["key"] for row in failed if again or row.get("reason") == OUTDATED}
        kept = {row["key"]: row["outcome"] for row in rows if row["key"] not in retried}
        left = {key: job for key, job in wanted.items() if key not in kept}
        if kept:
            say(f"{len(kept)} of {len(wanted)} jobs are there already")
        here = packages_text()
        found = {row.get("packages") for row in rows if row["key"] in kept}  # none of a job that was given up
        if others := sorted(one for one in found - {here} if isinstance(one, str)):
            say(f"some of them were computed with {'; '.join(others)}: here is {here}")
        jobs, began = len(left), time.monotonic()

        def keep(row: ResultRow) -> None:
            table.add(row)
            kept[row["key"]] = row["outcome"]
            result = f"failed, {row['reason']}" if row["outcome"] == "failed" else f"{row['seconds']:.0f} s"
            label, time_left = left.pop(row["key"]).label, _time_left(began, jobs - len(left), len(left))
            say(f"{len(kept)}/{len(wanted)} {label}: {result}, {time_left}")

        ended: tuple[type[BaseException], ...] = (ComputationError, KeyboardInterrupt, *place.lost)
        try:
            with place, closing(place.results(list(left.values()), say)) as results:
                for row in results:
                    keep(row)
        except ended as error:
            so_far = f"{len(kept)} of {len(wanted)} jobs are kept in {folder}; the same command goes on"
            if isinstance(error, KeyboardInterrupt):
                say(so_far)
                raise
            gone = f"the cluster is gone ({type(error).__name__})"
            reason = str(error) if isinstance(error, ComputationError) else gone
            raise ComputationError(f"{reason}: {so_far}") from error
    return sum(outcome == "failed" for outcome in kept.values())


def _time_left(began: float, done: int, left: int) -> str:
    seconds = (time.monotonic() - began) / done * left
    for size, unit in ((86_400, "days"), (3600, "h"), (60, "min")):
        if seconds > 2 * size:
            return f"{seconds / size:.0f} {unit} left"
    return f"{seconds:.0f} s left"


def require_runnable(plan: Plan) -> None:
    """Load every program, plant every effect, look at every method's settings, read every log or table once, hand every
    program a drive and look for the columns of the picture. A SteadyError names the method."""
    programs: list[tuple[str, Program]] = []
    for job in {(job.method, repr(job.settings)): job for job in plan.jobs}.values():
        with labelled(f"method {job.method}"):
            programs.append((job.method, with_noise(load_program(job.program), job)))
            settings_with_noise(job)
            if job.task == "fit":
                require_settings(f"recipe {job.recipe}", find_recipe(job.recipe), job.settings)
            else:
                require_settings("discover", discover, job.settings)
    for job in {repr(job.data): job for job in plan.jobs if "simulate" in job.data}.values():
        with labelled("data"):
            simulator(job)
    first = plan.jobs[0]
    with labelled("data"):
        if "simulate" in first.data:
            given = simulate(base_simulator(first), 1, seed=first.seed)  # an effect changes no column
        else:
            given = drives(first)["train"]
    for method, program in programs:
        with labelled(f"method {method}"):
            read = for_program(program, given)
            if first.known_start:
                read.require_known_start()
    if plan.task == "fit" and plan.picture is not None:
        _require_figures(plan.picture.columns, [program for _, program in programs])


def _require_figures(columns: Sequence[str], programs: Sequence[Program]) -> None:
    """Each is of an error that one of the programs has."""
    errors = {"total": None} | {name: None for program in programs for name in error_indices(program)}
    known = dict.fromkeys(ERRORS, errors) | {"measurement": dict.fromkeys(("one_step", "coverage_90", *OPEN_LOOP))}
    for column in columns:
        group, _, name = column.partition(".")
        if group in known and name not in known[group]:
            raise UsageError(f"picture: there will be no column {column}; {group} has {', '.join(known[group])}")
