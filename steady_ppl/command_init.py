"""`steady init`: a folder to work in."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from steady_ppl.utils.text import tell

NEXT = (
    "steady fit models/hovercraft.py train.csv --valid valid.csv --known-start --recipe likelihood --out runs/first",
    "steady check runs/first test.csv",
    "steady discover runs/first train.csv --valid valid.csv --out runs/found",
    "steady report runs/first runs/found test.csv --out report.html",
)


def init(folder: Annotated[Path, typer.Argument(metavar="DIR", help="The folder to make.")]) -> None:
    """Make a folder to work in: programs, recipes and first tables of drives to try them on."""
    from steady_ppl.runs.workbench import ROOMS, furnish

    tables = furnish(folder)
    tell(f"{folder}: {', '.join(f'{room}/' for room in ROOMS)}, {', '.join(table.name for table in tables)}")
    tell("\n".join(["", "next:", f"  cd {shlex.quote(str(folder))}", *(f"  {line}" for line in NEXT)]))
