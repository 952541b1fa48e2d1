"""`steady evaluate`: errors of runs on a table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from steady_ppl.counted import count, random_seed
from steady_ppl.errors import UsageError

OFTEN = 0.1  # share of the measured rows after which hardly a particle is left


def evaluate(
    arguments: Annotated[list[Path], typer.Argument(metavar="RUN... TABLE", help="Run folders, then the table.")],
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file; - prints them instead of the text.")
    ] = None,
    particles: Annotated[int | None, count("Particles of the filters.", least=2)] = None,
    rollouts: Annotated[int, count("Noisy roll-outs from each true state.")] = 1000,
    seed: Annotated[int, random_seed()] = 0,
    surveyed: Annotated[
        str | None,
        typer.Option("--map", help="The same vehicle with the true landmarks, for runs that learned theirs."),
    ] = None,
    program: Annotated[
        list[str] | None,
        typer.Option(
            help="The program, if its file moved or changed; with several RUNs once for each, in their order."
        ),
    ] = None,
) -> None:
    """The paper's errors where true states exist; errors in measurement space always."""
    from steady_ppl.command_parts import load_runs, present, run_labels, used_before
    from steady_ppl.comparison.evaluate import evaluate_all, incomparable, table_of
    from steady_ppl.data.table import read_table
    from steady_ppl.model.loading import load_program
    from steady_ppl.model.program import for_program
    from steady_ppl.runs.diagnostics import doubts_of_units
    from steady_ppl.runs.recipes import fingerprint
    from steady_ppl.smc.genealogy import FEW
    from steady_ppl.utils.files import require_place
    from steady_ppl.utils.text import say

    if len(arguments) < 2:
        raise UsageError("evaluate needs at least one RUN and then a TABLE")
    require_place(json_file)
    *runs, table = arguments
    labels = run_labels(runs)
    fits = list(load_runs(labels, program).values())
    drives = read_table(table)
    true_map = load_program(surveyed) if surveyed else None
    settings: dict[str, Any] = {"particles": particles, "rollouts": rollouts, "seed": seed, "surveyed": true_map}
    folders = [str(run) for run in runs]
    results = evaluate_all(fits, folders, drives, **settings)
    lines = [table_of(results, [f"{label} ({found['recipe']})" for label, found in zip(labels, results, strict=True)])]
    if true_map is not None:
        for label, result in zip(labels, results, strict=True):
            error, how = result["map"], "" if result["map"]["learned"] else " (declared, not learned)"
            lines.append(f"{label}: landmarks off by {error['rms']:.3g} m rms, {error['most']:.3g} m at most{how}")
    rows = [{"run": folder, **result} for folder, result in zip(folders, results, strict=True)]
    present("\n".join(lines), {"runs": rows}, json_file)
    doubts = {doubt: None for fit in fits for doubt in doubts_of_units(fit.program, for_program(fit.program, drives))}
    for reason in [
        *incomparable(results, folders),
        *used_before(labels, fingerprint(drives)),
        *drives.uneven_steps,
        *doubts,
    ]:
        say(reason)
    for run, result in zip(runs, results, strict=True):
        if result["filter"] != "lookahead":
            say(f"{run}: judged by the filter {result['filter']}")
        share, count, drive = (result["scarce"][key] for key in ("share", "particles", "trajectory"))
        if share > OFTEN:
            say(
                f"{run}: after {share:.0%} of drive {drive}'s measured rows fewer than {FEW} of the filter's {count} "
                "particles were in effect: its log p(y) scatters and is mostly too low, raise --particles"
            )
