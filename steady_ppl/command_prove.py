"""`steady prove`: the table of before and after on drives that were not used."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from steady_ppl.counted import random_seed
from steady_ppl.errors import UsageError


def prove(
    arguments: Annotated[
        list[Path],
        typer.Argument(metavar="RUN... TABLE", help="Run folders, the one before first, then drives not used for any."),
    ],
    truth: Annotated[str | None, typer.Option(help="The program that made the drives, if it is known.")] = None,
    oracle: Annotated[Path | None, typer.Option(help="A run of the true structure, fitted like the others.")] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file; - prints them instead of the text.")
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Draw the errors into this file, for example .png.")] = None,
    program: Annotated[
        list[str] | None,
        typer.Option(help="The program, if its file moved or changed; once for each RUN and the oracle, in order."),
    ] = None,
    seed: Annotated[int, random_seed()] = 0,
) -> None:
    """Prove that runs are better than the first one: log p(y), open-loop errors and noise, with paired intervals."""
    from steady_ppl.command_parts import (
        load_runs,
        present,
        program_from,
        run_labels,
        used_before,
    )
    from steady_ppl.comparison.prove import prove as judge
    from steady_ppl.data.table import read_table
    from steady_ppl.runs.recipes import fingerprint
    from steady_ppl.utils.files import require_picture, require_place, write_picture

    *runs, table = arguments
    if not runs:
        raise UsageError("prove needs at least one RUN and then a TABLE")
    require_picture(picture)
    require_place(json_file)
    labels = run_labels(runs, taken={"oracle", "truth"}) | ({"oracle": oracle} if oracle else {})
    rows: dict[str, Any] = load_runs(labels, program)
    if truth is not None:
        rows["truth"] = program_from(truth, seed)
    drives = read_table(table)
    found = judge(rows, drives, truth="truth" if truth is not None else None, seed=seed)
    found.notes[:0] = used_before(labels, fingerprint(drives))
    if picture is not None:
        from steady_ppl.plotting.comparison import proof_picture

        write_picture(proof_picture(found), picture)
    runs_by_label = {label: str(run) for label, run in labels.items()}
    present(str(found), {"runs": runs_by_label, **found.figures}, json_file)
