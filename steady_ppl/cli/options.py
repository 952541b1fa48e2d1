"""Arguments and options that several commands have."""

from pathlib import Path
from typing import Annotated, Any

import typer

MAX_COUNT = 10**9  # of whatever an option counts


def count(help: str, least: int = 1) -> Any:
    """An option that says how many, `least` or more."""
    return typer.Option(help=help, min=least, max=MAX_COUNT)


def moved(which: str) -> Any:
    """An option that names the programs of several runs."""
    return typer.Option(help=f"The program, if its file moved or changed; {which}.")


Run = Annotated[Path, typer.Argument(help="Run folder.")]
RunsAndTable = Annotated[
    list[Path],
    typer.Argument(metavar="RUN... TABLE", help="Run folders, the one before first, then drives not used for any."),
]
Model = Annotated[str, typer.Argument(help="Program: models/hovercraft.py, or mine.py:Boat.")]
Moved = Annotated[str | None, typer.Option(help="The program, if its file moved or changed.")]
MovedOfRun = Annotated[str | None, typer.Option(help="The run's program, if its file moved or changed.")]
Substeps = Annotated[
    int | None, typer.Option(help="Steps of the program in each row; as its class says when not given.")
]
Seed = Annotated[int, typer.Option(help="Random seed.", min=0, max=2**63 - 1)]  # a run's record holds 63 bits
Overwrite = Annotated[bool, typer.Option("--force", help="Overwrite an existing run.")]
Table = Annotated[Path, typer.Option("--out", help="Table to write, .csv or .parquet.")]
Json = Annotated[
    Path | None, typer.Option("--json", help="Write the figures to this file; - prints them instead of the text.")
]
