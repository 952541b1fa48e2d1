"""`steady data`: published logs to tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


@app.command("alpha-truck", epilog="Example:  steady data alpha-truck alpha_truck/train --out train.csv")
def alpha_truck(
    folder: Annotated[Path, typer.Argument(help="One split: holds vrpn-pose.csv and vesc_drive.csv.")],
    out: Annotated[Path, typer.Option("--out", help="Table to write, .csv or .parquet.")],
    sigma_deg: Annotated[float, typer.Option(help="Standard deviation of the simulated bearings, degrees.")] = 5.0,
    seed: Annotated[int, typer.Option(help="Random seed.", min=0)] = 0,
) -> None:
    """One split of the AlphaTruck logs to a table, resampled as the authors do.

    The logs are published in datasets/alpha_truck of the repository MrVPlusOne/STEADY on GitHub. They are real motion
    capture and commands; the bearings are simulated from the true poses. True states are kept in the x. columns.
    """
    from steady_ppl.alpha_truck import read_alpha_truck
    from steady_ppl.table import write_table

    write_table(read_alpha_truck(folder, sigma_degrees=sigma_deg, seed=seed), out)


@app.callback()
def data() -> None:
    """Published logs to tables."""
