"""`steady states`: where the vehicle probably was."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from steady_ppl.counted import count, random_seed
from steady_ppl.utils.text import tell


def states(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    table: Annotated[Path, typer.Argument(help="Drives.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out", help="A table (.csv, .parquet) of medians and 90 % intervals, or all draws for ArviZ (.nc)."
        ),
    ],
    draws: Annotated[int, count("Paths of each drive.")] = 100,
    particles: Annotated[int | None, count("Particles of the filter.")] = None,
    program: Annotated[str | None, typer.Option(help="The program, if its file moved or changed.")] = None,
    seed: Annotated[int, random_seed()] = 0,
) -> None:
    """Write where the vehicle probably was, given all measurements of a drive: posterior draws of its states.

    The table has for each state its median and the ends of its 90 % interval, `…_low` and `…_high`.
    """
    from steady_ppl.data.table import read_table
    from steady_ppl.model.program import for_program
    from steady_ppl.runs.diagnostics import doubts_of_units
    from steady_ppl.runs.fit import Fit
    from steady_ppl.runs.posterior import require_states_file, write_states
    from steady_ppl.smc.genealogy import few_starts
    from steady_ppl.utils.files import require_place
    from steady_ppl.utils.text import say

    require_states_file(out)
    require_place(out)
    fit, drives = Fit.load(run, program), read_table(table)
    posterior = fit.posterior(drives, draws=draws, particles=particles, seed=seed)
    write_states(posterior, out)
    tell(f"{out}: {len(drives)} drives, {draws} draws of each")
    scarce = few_starts(float(posterior["sample_stats"]["roots"].min()))
    for doubt in [*doubts_of_units(fit.program, for_program(fit.program, drives)), *([scarce] if scarce else [])]:
        say(doubt)
