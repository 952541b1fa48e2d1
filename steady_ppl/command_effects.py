"""The commands about physical effects: `steady add` and `steady effects`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

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
    from steady_ppl.fit import Fit
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
    from steady_ppl.effects.page import page

    tell(page(program_from(model, 0) if model else None), end="")


def with_effects(program: Any, effects: list[str], say: Any) -> Any:
    """A program with effects as users write them; says which values they have."""
    from steady_ppl.effects import added, chosen_variant, parsed, set_coefficient

    named: list[str] = []
    for text in effects:
        name, at, options, value = parsed(text)
        variant = chosen_variant(program, name, at, **options)
        if variant.name in named:
            raise UsageError(f"effect {variant.name} is given twice")
        named.append(variant.name)
        there = [known for known in added(program) if known.name == variant.name]
        if there and (not options or dict(there[0].options) == dict(variant.options)):
            variant, origin = there[0], "as given" if value else "of the run"
            if value is not None:
                program = set_coefficient(program, variant, value)
        else:
            program, origin = program.with_effect(variant, value), "as given" if value else "typical"
            variant = added(program)[-1]
        numbers = getattr(program, variant.parameter).detach().flatten().tolist()
        unit = "" if variant.unit == "1" else f" {variant.unit}"
        say(f"{variant.label} = {', '.join(f'{number:.4g}' for number in numbers)}{unit} ({origin})")
    return program
