"""What is looked at before the first job of a study is computed."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

from steady_ppl.comparison.metrics import OPEN_LOOP
from steady_ppl.discovery import discover
from steady_ppl.errors import UsageError, labelled
from steady_ppl.model.loading import load_program
from steady_ppl.model.program import Program, error_groups, for_program
from steady_ppl.runs.recipes import find_recipe, require_kind, require_settings
from steady_ppl.smc.simulate import simulate
from steady_ppl.studies.job import ERRORS
from steady_ppl.studies.job_data import drives, told, told_settings, truth, without_effect
from steady_ppl.studies.plan import Plan


def require_runnable(plan: Plan) -> None:
    """Load every program, plant every effect, look at every method's settings, read every log or table once, hand every
    program a drive and look for the columns of the picture.

    Raises:
        SteadyError: naming the method.
    """
    programs: list[tuple[str, Program]] = []
    for job in {(job.method, repr(job.settings)): job for job in plan.jobs}.values():
        with labelled(f"method {job.method}"):
            programs.append((job.method, told(load_program(job.program), job)))
            told_settings(job)
            if job.task == "fit":
                require_settings(job.recipe, find_recipe(job.recipe), job.settings)
            else:
                _require_search_settings(job.settings)
    for job in {repr(job.data): job for job in plan.jobs if "simulate" in job.data}.values():
        with labelled("data"):
            truth(job)
    first = plan.jobs[0]
    with labelled("data"):
        # an effect changes no column
        given = (
            simulate(without_effect(first), 1, seed=first.seed) if "simulate" in first.data else drives(first)["train"]
        )
    for method, program in programs:
        with labelled(f"method {method}"):
            read = for_program(program, given)
            if first.known_start:
                _ = read.known_start
    if plan.task == "fit" and plan.picture is not None:
        _require_figures(plan.picture.columns, [program for _, program in programs])


def _require_figures(columns: Sequence[str], programs: Sequence[Program]) -> None:
    """Each is of an error that one of the programs has."""
    errors = {"total": None} | {name: None for program in programs for name in error_groups(program)}
    known = dict.fromkeys(ERRORS, errors) | {"measurement": dict.fromkeys(("one_step", "coverage_90", *OPEN_LOOP))}
    for column in columns:
        group, _, name = column.partition(".")
        if group in known and name not in known[group]:
            raise UsageError(f"picture: there will be no column {column}; {group} has {', '.join(known[group])}")


def _require_search_settings(settings: Mapping[str, Any]) -> None:
    given = set(list(inspect.signature(discover).parameters)[:3]) | {"known_start", "seed"}  # by the study itself
    known = [name for name in inspect.signature(discover).parameters if name not in given]
    unknown = [name for name in settings if name not in known]
    if unknown:
        raise UsageError(f"discover has no setting {unknown[0]}; there are {', '.join(known)}")
    for name, value in settings.items():
        require_kind(discover, name, value)
