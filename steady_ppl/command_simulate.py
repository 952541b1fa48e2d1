"""`steady simulate`: drives that a program makes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from steady_ppl.counted import count, random_seed
from steady_ppl.errors import UsageError


def simulate(
    model: Annotated[str, typer.Argument(help="Program: models/hovercraft.py, or mine.py:Boat.")],
    out: Annotated[Path, typer.Option("--out", help="Table to write, .csv or .parquet.")],
    trajectories: Annotated[int | None, count("How many drives, 16 when not given.")] = None,
    seed: Annotated[int, random_seed()] = 0,
    controls: Annotated[Path | None, typer.Option(help="Take time, controls and gaps from this table.")] = None,
    substeps: Annotated[
        int | None,
        typer.Option(help="Steps of the program in each row; so many that they are 5 ms or less when not given."),
    ] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME[=VALUE]", help="Add a physical effect, see `steady effects`; as often as needed."),
    ] = None,
) -> None:
    """Simulate drives of a program, with measurements and true states."""
    from steady_ppl.command_parts import program_from
    from steady_ppl.data.table import read_table, write_table
    from steady_ppl.effects.attach import with_effects
    from steady_ppl.model.substeps import with_substeps
    from steady_ppl.model.validate import probe
    from steady_ppl.smc.simulate import simulate as run, simulated_in
    from steady_ppl.utils.progress import stages
    from steady_ppl.utils.text import say

    if controls and trajectories:
        raise UsageError("--controls has as many drives as its table: leave --trajectories out")
    program = with_effects(program_from(model, seed), effect or [], say)
    if substeps is not None:
        probe(with_substeps(program, substeps))
    like = read_table(controls) if controls else None
    with stages(("simulating", 1)) as begin:
        begin()
        drives = run(program, trajectories or 16, seed=seed, like=like, substeps=substeps)
    write_table(drives, out)
    say(simulated_in(program, drives, substeps))
