"""Judge fitted programs on one table: the paper's errors where the truth is known, measurement space always."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from steady_ppl.comparison.metrics import (
    forward,
    forward_mean,
    has_truth,
    map_errors,
    measurement_errors,
    state_estimation,
)
from steady_ppl.comparison.result import number
from steady_ppl.data.table import refuse_long
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import UsageError, labelled
from steady_ppl.likelihood.evidence import choose_filter, evidence
from steady_ppl.likelihood.problem import Problem
from steady_ppl.model.planar_vehicle import UnknownMap
from steady_ppl.model.program import Program, for_program, names
from steady_ppl.runs.fit import Fit
from steady_ppl.utils.cores import one_thread
from steady_ppl.utils.progress import stages
from steady_ppl.utils.random import seeded
from steady_ppl.utils.text import aligned


@one_thread()
def evaluate(
    fit: Fit,
    table: Trajectories,
    *,
    particles: int | None = None,
    rollouts: int = 1000,
    look_ahead: bool | None = None,
    seed: int = 0,
    surveyed: Program | None = None,
) -> dict[str, Any]:
    """Errors of one fitted program; equal seeds give every program the same random numbers.

    Args:
        fit: what is judged; its `known_start` decides whether the filters start at the true first state.
        table: drives that were not used for the fit.
        particles: N of each filter (the paper: 100 000); 200 looking ahead and 5000 otherwise when not given.
        rollouts: noisy roll-outs from each true state.
        look_ahead: whether log p(y) and the states come from a filter that looks ahead; None where the program allows.
        seed: of the Monte-Carlo draws.
        surveyed: a program of the same vehicle with the true landmarks, if the map is to be judged.

    Returns:
        `known_start` and `measured` (what log p(y) is given and is of), `filter` ("lookahead", or "bootstrap" and why),
        `log_likelihood` (mean per trajectory at every tenth row), `scarce` (how many `particles` its filter had, and in
        which `trajectory` after the largest `share` of measured rows fewer than ten of them were in effect), `forward`,
        `forward_mean`, `state_estimation` (error groups; empty without true states), `measurement` and, if asked for,
        `map` (see `map_errors`; `learned`: whether the landmarks are elsewhere than declared).

    Raises:
        DataError: the table lacks a column or a known start, or a drive is too long (`refuse_long`).
        UsageError: the map is none, or another vehicle's.
        FilterError: the filter broke down.
    """
    problem = _checked(fit, table, surveyed)
    program, data, known_start = problem.program, problem.data, problem.known_start
    choice = choose_filter(program, data, known_start=known_start, particles=particles, look_ahead=look_ahead)
    settings: dict[str, Any] = {"look_ahead": choice.look_ahead, "known_start": known_start}
    settings["particles"] = choice.particles
    result: dict[str, Any] = {"recipe": fit.recipe, "known_start": known_start}
    result |= {"measured": list(data.measurement_names), "filter": choice.name}
    with stages(("log p(y)", 1), ("states", 2), ("measurements", 2)) as begin:
        begin()
        with seeded(seed, "log_likelihood"):
            found = evidence(program, data, **settings)
            result["log_likelihood"] = float(found.log_likelihood.mean())
            worst = int(found.scarce.argmax())
            scarce = {"trajectory": data.labels[worst], "share": float(found.scarce[worst])}
            result["scarce"] = scarce | {"particles": choice.particles}
        result |= {"forward": {}, "forward_mean": {}, "state_estimation": {}}
        begin()
        if has_truth(data):
            with seeded(seed, "forward"):
                result["forward"] = forward(program, data, rollouts=rollouts)
            result["forward_mean"] = forward_mean(program, data)
            with seeded(seed, "state_estimation"):
                result["state_estimation"] = state_estimation(program, data, **settings)
        begin()
        with seeded(seed, "measurement"):
            result["measurement"] = measurement_errors(program, data, particles=2000, known_start=known_start)
    if surveyed is not None:
        result["map"] = _judged_map(program, surveyed)
    return result


def evaluate_all(
    fits: Sequence[Fit], labels: Sequence[str], table: Trajectories, *, surveyed: Program | None = None, **settings: Any
) -> list[dict[str, Any]]:
    """`evaluate` of several fits, all checked before anything is computed.

    Raises:
        SteadyError: as `evaluate` does, the fit's label before the message.
    """
    for fit, label in zip(fits, labels, strict=True):
        with labelled(label):
            _checked(fit, table, surveyed)
    results = []
    with stages(*((f"evaluating {label}", 1) for label in labels)) as begin:
        for fit, label in zip(fits, labels, strict=True):
            begin()
            with labelled(label):
                results.append(evaluate(fit, table, surveyed=surveyed, **settings))
    return results


def _checked(fit: Fit, table: Trajectories, surveyed: Program | None) -> Problem:
    """The fit's program and the columns that it reads, if table and map suit it."""
    data = for_program(fit.program, table)
    refuse_long(data)
    problem = Problem(fit.program, data, fit.known_start)
    if surveyed is not None:
        _judged_map(fit.program, surveyed)
    return problem


def _judged_map(program: Program, surveyed: Program) -> dict[str, Any]:
    for one in (program, surveyed):
        if not len(getattr(one, "landmarks", ())):
            raise UsageError(f"program {type(one).__name__} has no landmarks: judge it without a map")
    errors = map_errors(program, surveyed)
    for what, own, other in zip(("states", "controls", "measurements"), _form(program), _form(surveyed), strict=True):
        if own != other:
            raise UsageError(
                f"the map is another vehicle's: {type(surveyed).__name__} has the {what} {', '.join(other)}, "
                f"{type(program).__name__} has {', '.join(own)}; name a program of the same vehicle"
            )
    learned = isinstance(program, UnknownMap) and not torch.equal(program.landmarks, program.declared)
    return {**errors, "learned": learned}


def _form(program: Program) -> tuple[tuple[str, ...], ...]:
    """States, controls and measurements, without the states that an added effect brings."""
    resting = names(program.resting)
    states = tuple(name for name in program.state_names if name not in resting)
    return states, program.control_names, program.measurement_names


def incomparable(results: Sequence[Mapping[str, Any]], labels: Sequence[str]) -> list[str]:
    """Why log p(y) of one fit says nothing beside that of another, a line a reason."""
    runs = list(zip(labels, results, strict=True))
    columns = dict.fromkeys(name for result in results for name in result["measured"])
    unread = {label: [f"y.{name}" for name in columns if name not in result["measured"]] for label, result in runs}
    known = [label for label, result in runs if result["known_start"]]
    drawn = [label for label, result in runs if not result["known_start"]]
    reasons = []
    if any(unread.values()):
        said = "; ".join(f"{label} does not read {', '.join(lacking)}" for label, lacking in unread.items() if lacking)
        reasons.append(
            f"log p(y) is not comparable, nor are errors in measurement space: {said}; compare runs that read the same"
        )
    if known and drawn:
        reasons.append(
            f"log p(y) is not comparable: the start is known to {', '.join(known)} and from the prior in "
            f"{', '.join(drawn)}; compare runs that were given the same"
        )
    return reasons


def table_of(results: Sequence[Mapping[str, Any]], labels: Sequence[str]) -> str:
    """The results as one table of text, a line a program.

    Columns: the start, where it is known to some of them only; log p(y); for the first two error groups the forward
    error with noisy roll-outs, of the mean roll-out, and the state-estimation error; then the errors in measurement
    space.
    """
    groups = list(next((r["forward"] for r in results if r["forward"]), {}))[:2]
    started = len({result["known_start"] for result in results}) > 1
    measured = ["one_step", "open_loop_1s", "open_loop_3s", "coverage_90"]
    errors = [f"{name} {group}" for name in ("forward", "mean", "state") for group in groups]
    header = ["", *(["start"] if started else []), "log p(y)", *errors, *measured]
    lines = [header]
    for label, result in zip(labels, results, strict=True):
        start = "known" if result["known_start"] else "prior"
        line = [label, *([start] if started else []), f"{result['log_likelihood']:.2f}"]
        for name in ("forward", "forward_mean", "state_estimation"):
            line += [number(result[name].get(group), ".4f") for group in groups]
        line += [number(result["measurement"].get(name), ".4f") for name in measured]
        lines.append(line)
    return "\n".join(aligned(lines))
