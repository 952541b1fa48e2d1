"""`steady fit`: learn a program's parameters."""

from __future__ import annotations

import ast
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from steady_ppl.counted import MOST, count, random_seed
from steady_ppl.errors import UsageError
from steady_ppl.utils.text import shown, tell

WORDS = {"true": True, "false": False, "none": None}
RECIPES = ("steady", "likelihood", "steady-minus", "svi", "hand", "fit-hand", "fit-tv", "fit-truth")


class Device(StrEnum):
    """Where tensors live."""

    cpu = "cpu"
    cuda = "cuda"


class GuideName(StrEnum):
    """The E step of STEADY, and the guides of SVI."""

    lookahead = "lookahead"
    gaussian = "gaussian"
    bootstrap = "bootstrap"
    network = "network"
    mean_field = "mean-field"
    smoother = "smoother"


def fit(
    context: typer.Context,
    model: Annotated[str, typer.Argument(help="Program: models/hovercraft.py, or mine.py:Boat.")],
    table: Annotated[Path, typer.Argument(help="Training drives, .csv or .parquet.")],
    out: Annotated[Path, typer.Option("--out", help="Run folder to write.")],
    valid: Annotated[Path | None, typer.Option(help="Held-out drives that decide when to stop.")] = None,
    recipe: Annotated[
        str,
        typer.Option(
            help=f"{', '.join(RECIPES)}, or a recipe of your own: PATH.py.",
            autocompletion=lambda incomplete: [name for name in RECIPES if name.startswith(incomplete)],
        ),
    ] = "steady",
    guide: Annotated[
        GuideName | None, typer.Option(help="The E step: the first three steady's, the others svi's.")
    ] = None,
    hand: Annotated[str | None, typer.Option(help="The program written by hand, for fit-hand.")] = None,
    known_start: Annotated[bool, typer.Option(help="Give the first row's x. columns as the exact start.")] = False,
    substeps: Annotated[
        int | None, typer.Option(help="Steps of the program in each row; as its class says when not given.")
    ] = None,
    particles: Annotated[int | None, count("Particles for each drive.")] = None,
    draws: Annotated[int | None, count("Paths for each drive in the M step.")] = None,
    steps: Annotated[int | None, count("E steps.")] = None,
    setting: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Any other setting of the recipe, for example ramp=0.7."),
    ] = None,
    seed: Annotated[int, random_seed()] = 0,
    device: Annotated[Device, typer.Option(help="Where to compute.")] = Device.cpu,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted run.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing run.")] = False,
) -> None:
    """Learn a program's parameters from measurements."""
    from steady_ppl.command_parts import program_from
    from steady_ppl.data.table import read_table
    from steady_ppl.runs.recipes import run_recipe
    from steady_ppl.utils.text import is_quiet, say

    given: dict[str, Any] = {"particles": particles, "draws": draws, "steps": steps, "hand": hand}
    given["guide"] = guide and guide.value
    result = run_recipe(
        recipe,
        program_from(model, seed, substeps),
        read_table(table),
        read_table(valid) if valid else None,
        out,
        options=_settings(setting or [], {name: value for name, value in given.items() if value is not None}),
        known_start=known_start,
        seed=seed,
        device=device.value,
        resume=resume,
        force=force,
        progress=not is_quiet(),
    )
    for note in result.notes:
        say(note)
    tell(f"{out}: {result.program}")
    if result.trained is not None:
        judged = {e["step"]: e["log_likelihood"] for e in result.trained.history if "log_likelihood" in e}
        if judged:
            first, kept = next(iter(judged.values())), judged[result.trained.kept]
            tell(
                f"held-out log p(y) of a drive {first:.2f} → {kept:.2f} at step {result.trained.kept}, "
                "whose parameters were kept"
            )
        if result.trained.interrupted:
            say(f"interrupted; the run so far is usable, `--resume` goes on with {out}")
            raise typer.Exit(1)


def _settings(pairs: list[str], options: dict[str, Any]) -> dict[str, Any]:
    """Add `NAME=VALUE` settings to the named options: Python literals, true, false, none, or else words."""
    for pair in pairs:
        name, equals, text = pair.partition("=")
        name = name.strip().replace("-", "_")
        if not (equals and name):
            raise UsageError(f"--set {pair}: expected NAME=VALUE")
        if name in options:
            raise UsageError(f"--set {pair}: {name} is given twice")
        word = text.strip()
        try:
            options[name] = ast.literal_eval(word)
        except (ValueError, SyntaxError):
            options[name] = WORDS.get(word, word)
        if isinstance(options[name], int) and abs(options[name]) > MOST:
            raise UsageError(f"--set {shown(pair, 60)}: expected a whole number up to {MOST}")
    return options
