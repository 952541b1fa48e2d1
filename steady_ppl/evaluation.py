"""Judge fitted programs on one table: the paper's errors where the truth is known, measurement space always."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from steady_ppl.data import Trajectories
from steady_ppl.filtering import choose_filter, log_likelihood
from steady_ppl.fit import Fit
from steady_ppl.measurement_errors import measurement_errors
from steady_ppl.metrics import forward, forward_mean, map_errors, state_estimation
from steady_ppl.program import Program, for_program
from steady_ppl.seeding import seeded


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
        surveyed: a program with the true landmarks, if the map is to be judged.

    Returns:
        `filter` ("lookahead", or "bootstrap" and why), `log_likelihood` (mean per trajectory at every tenth row),
        `forward`, `forward_mean`, `state_estimation` (error groups; empty without true states), `measurement` and, if
        asked for, `map` (see `map_errors`).
    """
    program, known_start = fit.program, fit.known_start
    data = for_program(program, table)
    choice = choose_filter(program, data, known_start=known_start, particles=particles, look_ahead=look_ahead)
    settings: dict[str, Any] = {
        "particles": choice.particles,
        "look_ahead": choice.look_ahead,
        "known_start": known_start,
    }
    result: dict[str, Any] = {"recipe": fit.recipe, "filter": choice.name}
    with seeded(seed, "log_likelihood"):
        values = log_likelihood(program, data, **settings)
        result["log_likelihood"] = float(values.mean())
    result |= {"forward": {}, "forward_mean": {}, "state_estimation": {}}
    if has_truth(data):
        with seeded(seed, "forward"):
            result["forward"] = forward(program, data, rollouts=rollouts)
        result["forward_mean"] = forward_mean(program, data)
        with seeded(seed, "state_estimation"):
            result["state_estimation"] = state_estimation(program, data, **settings)
    with seeded(seed, "measurement"):
        result["measurement"] = measurement_errors(program, data, particles=2000, known_start=known_start)
    if surveyed is not None:
        result["map"] = map_errors(program, surveyed)
    return result


def has_truth(data: Trajectories) -> bool:
    """Whether the states are known beyond a first row."""
    return data.states is not None and bool(torch.isfinite(data.states[1:]).any())


def table_of(results: Sequence[Mapping[str, Any]], labels: Sequence[str]) -> str:
    """The results as one table of text, a line a program.

    Columns: log p(y); for the first two error groups the forward error with noisy roll-outs, of the mean roll-out, and
    the state-estimation error; then the errors in measurement space.
    """
    groups = list(next((r["forward"] for r in results if r["forward"]), {}))[:2]
    header = ["", "log p(y)"]
    for name in ("forward", "mean", "state"):
        header += [f"{name} {group}" for group in groups]
    measured = ["one_step", "open_loop_1s", "open_loop_3s", "coverage_90"]
    header += measured
    lines = [header]
    for label, result in zip(labels, results, strict=True):
        line = [label, f"{result['log_likelihood']:.2f}"]
        for name in ("forward", "forward_mean", "state_estimation"):
            line += [_figure(result[name].get(group)) for group in groups]
        line += [_figure(result["measurement"].get(name)) for name in measured]
        lines.append(line)
    widths = [max(len(line[column]) for line in lines) for column in range(len(header))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def _figure(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"
