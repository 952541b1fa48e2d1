"""Every command with its options, and every recipe with its settings, as Markdown: from the code itself."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from steady_ppl.cli.main import app
from steady_ppl.runs.recipes import find_recipe

RECIPES = sorted((Path(__file__).parents[1] / "inference").glob("[a-z]*.py"))
SHARED = ("program", "table", "valid", "known_start", "seed", "run")  # by options of their own, or by Python alone


def page() -> str:
    """Return a section for `steady` itself, one for each command, and one for each recipe."""
    group = typer.main.get_command(app)
    commands = ["## Every option", "", *_section("steady", group), *_commands("steady", group)]
    about = "`--set NAME=VALUE` of `steady fit` gives a setting. `--steps` gives `steps`. None leaves it to the recipe."
    return "\n".join([*commands, "## Every setting of a recipe", "", about, "", *_recipes()])


def _recipes() -> Iterator[str]:
    usual = _meanings(find_recipe("steady"))
    for file in RECIPES:
        recipe = find_recipe(str(file))
        meanings = usual | _meanings(recipe)
        settings = [one for one in inspect.signature(recipe).parameters.values() if one.name not in SHARED]
        rows = [f"| `{one.name}` | {one.default} | {meanings[one.name]} |" for one in settings]
        head = ["| setting | default | meaning |", "|---|---|---|"] if rows else ["It has none."]
        yield from (f"### `--recipe {file.stem.replace('_', '-')}`", "", *head, *rows, "")


def _meanings(recipe: Any) -> dict[str, str]:
    """What the section of arguments in a docstring says of each, several of which may share a line."""
    _, _, after = (inspect.getdoc(recipe) or "").partition("Args:\n")
    listed = re.findall(r"^    (\w[\w, ]*): (.+?)(?=^    \w|^\w|\Z)", after.partition("\n\n")[0] + "\n", re.M | re.S)
    return {name: " ".join(meaning.split()) for names, meaning in listed for name in names.split(", ")}


def _commands(name: str, group: Any) -> Iterator[str]:
    for called, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from _commands(f"{name} {called}", command)
        else:
            yield from _section(f"{name} {called}", command)


def _section(name: str, command: Any) -> list[str]:
    """A heading, what the command does, and a table of what it takes: `--help` prints the same."""
    with command.make_context(name, [], resilient_parsing=True) as context:
        rows = [_row(parameter, context) for parameter in command.params]
    return [f"### `{name}`", "", command.help, "", "| takes | meaning |", "|---|---|", *rows, ""]


def _row(parameter: Any, context: Any) -> str:
    parameter.hidden = False  # some are, so that `steady --help` fits one screen
    typed, about = parameter.get_help_record(context)
    if parameter.param_type_name == "argument":
        typed = parameter.metavar or parameter.name.upper()
    return f"| `{typed}` | {about.replace('<', '&lt;')} |"
