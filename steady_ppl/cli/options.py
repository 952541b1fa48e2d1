"""Arguments and options that several commands take."""

from pathlib import Path
from typing import Annotated, Any

import typer

MAX_COUNT = 10**9  # of whatever an option counts


def count(help: str, least: int = 1) -> Any:
    """An option that says how many, `least` or more."""
    return typer.Option(help=help, min=least, max=MAX_COUNT)


def moved(which: str) -> Any:
    """An option that names the models of several runs."""
    return typer.Option(help=f"The model, if its file moved or changed; {which}.")


Run = Annotated[Path, typer.Argument(help="Run folder.")]
RunsAndTable = Annotated[
    list[Path],
    typer.Argument(
        metavar="RUN... TABLE", help="Run folders, the reference first; then trajectories that no run has used."
    ),
]
Model = Annotated[str, typer.Argument(help="Model: models/hovercraft.py, or mine.py:Boat.")]
Moved = Annotated[str | None, typer.Option(help="The model, if its file moved or changed.")]
MovedOfRun = Annotated[str | None, typer.Option(help="The run's model, if its file moved or changed.")]
Substeps = Annotated[
    int | None, typer.Option(help="Steps of the model in each row; those of its class when not given.")
]
Seed = Annotated[int, typer.Option(help="Random seed.", min=0, max=2**63 - 1)]  # a run's record holds 63 bits
Overwrite = Annotated[bool, typer.Option("--force", help="Overwrite an existing run.")]
Table = Annotated[Path, typer.Option("--out", help="Table to write, .csv or .parquet.")]
Horizons = Annotated[
    list[float] | None,
    typer.Option(
        "--horizon",
        metavar="SECONDS",
        help="Seconds ahead, repeat for several; chosen from the trajectories when not given.",
    ),
]
Json = Annotated[Path | None, typer.Option("--json", help="JSON file to write; - prints it instead of the text.")]
