"""The commands about physical effects: `steady add` and `steady effects`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from steady_ppl.effects.attach import with_effects
from steady_ppl.errors import UsageError
from steady_ppl.utils.text import tell

Effects = Annotated[
    list[str] | None,
    typer.Argument(metavar="EFFECT...", help="NAME[:AT][:OPTION=NUMBER][=NUMBER[,NUMBER]], see `steady effects`."),
]


def add(
    source: Annotated[str, typer.Argument(metavar="RUN|MODEL", help="A run folder, or a program's file.")],
    out: Annotated[Path, typer.Option("--out", metavar="MODEL.py", help="Program to write, beside the old one.")],
    effects: Effects = None,
    program: Annotated[str | None, typer.Option(help="The run's program, if its file moved or changed.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")] = False,
) -> None:
    """Write a program with physical effects; `fit` it like any other.

    Its parameters start at the run's values, a coefficient at the value that is given, else at the run's, else at the
    effect's typical one.
    """
    from steady_ppl.command_parts import program_from
    from steady_ppl.effects import added, write_program
    from steady_ppl.runs.fit import Fit
    from steady_ppl.utils.text import say

    is_run = Path(source).is_dir()
    if program and not is_run:
        raise UsageError("--program names the program of a RUN: leave it out")
    grown = Fit.load(source, program).program if is_run else program_from(source, 0)
    grown = with_effects(grown, effects or [], say)
    if not added(grown):
        raise UsageError(f"{source} has no effect that its file does not have: name one, `steady effects` lists them")
    notes = write_program(grown, out, force=force)
    for note in notes if is_run else []:
        say(note)
    tell(f"{out}: {grown}")
    for variant in added(grown):
        tell(f"{variant.label}: {variant.effect.text}")
        tell(f"{variant.label}: ${variant.effect.equation}$")


def effects(
    model: Annotated[str | None, typer.Argument(help="Only those that this program could have, and why.")] = None,
) -> None:
    """List the physical effects that a program may lack."""
    from steady_ppl.command_parts import program_from
    from steady_ppl.effects.registry import page

    tell(page(program_from(model, 0) if model else None), end="")
