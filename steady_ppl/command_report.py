"""`steady report`: everything on one page."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from steady_ppl.errors import UsageError


def report(
    arguments: Annotated[
        list[Path],
        typer.Argument(metavar="RUN... TABLE", help="Run folders, the one before first, then drives not used for any."),
    ],
    out: Annotated[Path, typer.Option("--out", help="The page to write.")] = Path("report.html"),
    discovery: Annotated[
        Path | None,
        typer.Option(help="What `steady discover` found: its RUN or its --json file, if none of the RUNs has it."),
    ] = None,
    title: Annotated[str | None, typer.Option(help="Of the page; the runs' names when not given.")] = None,
    simulations: Annotated[int, typer.Option(help="Simulated sets for the bands.", min=20)] = 100,
    program: Annotated[
        list[str] | None,
        typer.Option(help="The program, if its file moved or changed; once for each RUN, in order."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Random seed.", min=0)] = 0,
) -> None:
    """Write one page of HTML: verdict, measured against predicted, where it fails, what is missing, before and after.

    What `steady discover … --out RUN` found is shown if one of the runs is such a RUN. The page needs no network.
    """
    from steady_ppl.command_parts import load_runs, require_folder, run_labels, used_before
    from steady_ppl.reporting import report as gather
    from steady_ppl.run_folder import read_discovery
    from steady_ppl.run_recipe import fingerprint
    from steady_ppl.table import read_table

    *runs, table = arguments
    if not runs:
        raise UsageError("report needs at least one RUN and then a TABLE")
    if out.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{out}: expected a page's name that ends in .html")
    require_folder(out)
    labels = run_labels(runs)
    fits = load_runs(labels, program)
    drives = read_table(table)
    found = [one for run in labels.values() if (one := read_discovery(run)) is not None]
    if discovery is not None and (given := read_discovery(discovery)) is None:
        raise UsageError(f"{discovery} is neither a RUN that `steady discover` made nor its --json file")
    gather(
        fits,
        drives,
        discovery=given if discovery is not None else found[-1] if found else None,
        title=title or f"{', '.join(labels)} on {table.name}",
        how=[shlex.join(["steady", "report", *map(str, arguments), "--out", str(out)])],
        notes=used_before(labels, fingerprint(drives)),
        simulations=simulations,
        seed=seed,
    ).write(out)
    print(f"{out}: {', '.join(labels)} on {len(drives)} drives")
