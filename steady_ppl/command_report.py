"""`steady report`: everything on one page."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from steady_ppl.counted import count, random_seed
from steady_ppl.errors import UsageError
from steady_ppl.utils.text import tell

SIMULATIONS = 100


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
    simulations: Annotated[int, count("Simulated sets for the bands.", least=20)] = SIMULATIONS,
    program: Annotated[
        list[str] | None,
        typer.Option(help="The program, if its file moved or changed; once for each RUN, in order."),
    ] = None,
    seed: Annotated[int, random_seed()] = 0,
) -> None:
    """Write one page of HTML: verdict, measured against predicted, where it fails, what is missing, before and after.

    What `steady discover … --out RUN` found is shown if one of the runs is such a RUN. The page needs no network.
    """
    from steady_ppl.command_parts import load_runs, run_labels, used_before
    from steady_ppl.data.table import read_table
    from steady_ppl.reporting.report import report as gather
    from steady_ppl.runs.folder import read_discovery
    from steady_ppl.runs.recipes import fingerprint
    from steady_ppl.utils.files import require_place

    *runs, table = arguments
    if not runs:
        raise UsageError("report needs at least one RUN and then a TABLE")
    if out.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{out}: expected a page's name that ends in .html")
    require_place(out)
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
        how=_how(arguments, fingerprint(drives), out, discovery, title, program, simulations, seed),
        notes=used_before(labels, fingerprint(drives)),
        simulations=simulations,
        seed=seed,
    ).write(out)
    tell(f"{out}: {', '.join(labels)} on {len(drives)} drives")


def _how(
    arguments: list[Path],
    digest: str,
    out: Path,
    discovery: Path | None,
    title: str | None,
    programs: list[str] | None,
    simulations: int,
    seed: int,
) -> list[str]:
    """How each of the runs, and what was discovered, were made, by which command if one did; the table; the command as
    it was given."""
    from steady_ppl.runs.folder import RECORD, read_record

    given: list[tuple[str, Any]] = [
        ("--discovery", discovery),
        ("--title", title),
        *(("--program", one) for one in programs or []),
    ]
    given += [("--simulations", simulations if simulations != SIMULATIONS else None), ("--seed", seed or None)]
    options = [word for name, value in given if value is not None for word in (name, str(value))]
    *runs, table = arguments
    if discovery is not None and (discovery / RECORD).is_file() and discovery not in runs:
        runs.insert(1, discovery)
    fitted = []
    for run in runs:
        record = read_record(run)
        source = record["program"]
        start = "with" if record["known_start"] else "without"
        name = f"{os.path.relpath(run / source['file'])}:{source['class']}" if source else "a program of no file"
        fitted.append(f"# {run}: {name}, recipe {record['recipe']}, seed {record['seed']}, {start} a known start")
        if command := record.get("command"):
            fitted.append(command)
    fitted.append(f"# {table}: sha256 of its drives {digest[:16]}…")
    return ["\n".join([*fitted, shlex.join(["steady", "report", *map(str, arguments), *options, "--out", str(out)])])]
