"""`steady check`: compare a run with measurements."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from steady_ppl.counted import count, random_seed
from steady_ppl.errors import UsageError


def check(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    table: Annotated[Path, typer.Argument(help="Drives to compare with, best others than those of the fit.")],
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file; - prints them instead of the text.")
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Draw the picture into this file, for example .png.")] = None,
    mask: Annotated[
        Path | None,
        typer.Option(help="Write the table without the stretches that nobody measured, for fits and checks, here."),
    ] = None,
    simulations: Annotated[int, count("Simulated sets for the bands.", least=20)] = 100,
    program: Annotated[str | None, typer.Option(help="The program, if its file moved or changed.")] = None,
    seed: Annotated[int, random_seed()] = 0,
) -> None:
    """Compare a run with measurements: where, when and in which regime it fails, and who is at fault."""
    from steady_ppl.command_parts import present
    from steady_ppl.criticism.check import check as compare
    from steady_ppl.data.frozen_sensors import masked
    from steady_ppl.data.table import read_table, require_table_file, write_table
    from steady_ppl.runs.fit import Fit
    from steady_ppl.utils.files import require_picture, require_place, write_picture
    from steady_ppl.utils.text import say

    require_picture(picture)
    require_place(json_file)
    if mask is not None:
        require_table_file(mask)
        require_place(mask)
        if os.path.realpath(mask) in (os.path.realpath(table), json_file and os.path.realpath(json_file)):
            raise UsageError(f"--mask {mask} is the table itself, or the file of --json: name another file")
    drives = read_table(table)
    found = compare(Fit.load(run, program), drives, simulations=simulations, seed=seed)
    if picture is not None:
        from steady_ppl.plotting.check import check_picture

        write_picture(check_picture(found), picture)
    present(str(found), {"run": str(run), **found.figures}, json_file)
    if mask is not None:
        write_table(masked(drives, found.stuck), mask)
        count = len(found.stuck)
        say(f"{mask}: {table.name} without {count} stretch{'' if count == 1 else 'es'} that nobody measured")
