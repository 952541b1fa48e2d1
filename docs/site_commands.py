"""Every command with its arguments and options as Markdown, from the commands themselves."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer

from steady_ppl.cli.main import app


def page() -> str:
    """Return a section for `steady` itself and one for each command."""
    group = typer.main.get_command(app)
    return "\n".join(["## Every option", "", *_section("steady", group), *_commands("steady", group)])


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
