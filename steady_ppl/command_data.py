"""`steady data`: published logs to tables, and long drives in pieces."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from steady_ppl.counted import random_seed
from steady_ppl.utils.text import tell

app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


@app.command("alpha-truck", epilog="Example:  steady data alpha-truck alpha_truck/train --out train.csv")
def alpha_truck(
    folder: Annotated[Path, typer.Argument(help="One split: holds vrpn-pose.csv and vesc_drive.csv.")],
    out: Annotated[Path, typer.Option("--out", help="Table to write, .csv or .parquet.")],
    sigma_deg: Annotated[float, typer.Option(help="Standard deviation of the simulated bearings, degrees.")] = 5.0,
    centred: Annotated[
        bool, typer.Option("--centred", help="Velocities of each row itself, not the authors' of half a row later.")
    ] = False,
    seed: Annotated[int, random_seed()] = 0,
) -> None:
    """One split of the AlphaTruck logs to a table, resampled as the authors do.

    The logs are published in datasets/alpha_truck of the repository MrVPlusOne/STEADY on GitHub. They are real motion
    capture and commands; the bearings are simulated from the true poses. True states are kept in the x. columns.
    """
    from steady_ppl.data.table import write_table
    from steady_ppl.datasets.alpha_truck import read_alpha_truck

    write_table(read_alpha_truck(folder, sigma_degrees=sigma_deg, seed=seed, centred=centred), out)


@app.command("cut", epilog="Example:  steady data cut log.csv --seconds 60 --out drives.csv")
def cut(
    table: Annotated[Path, typer.Argument(help="Drives.")],
    seconds: Annotated[float, typer.Option(help="Length of a piece, s.")],
    out: Annotated[Path, typer.Option("--out", help="Table to write, .csv or .parquet.")],
) -> None:
    """Long drives in pieces, `…-1`, `…-2`, … of the drive's name.

    Each begins at its first row that has a measurement; pieces of one row or without a measurement are left out.
    """
    from steady_ppl.data.table import cut, read_table, require_table_file, write_table
    from steady_ppl.utils.text import say

    require_table_file(out)
    drives = read_table(table)
    pieces = cut(drives, seconds)
    write_table(pieces, out)
    tell(f"{out}: {len(pieces)} drives")
    left_out = int(drives.lengths.sum() - pieces.lengths.sum())
    if left_out:
        say(f"{left_out} rows left out: before a piece's first measurement, or in pieces that have none or one row")


@app.callback()
def data() -> None:
    """Published logs to tables; long drives in pieces."""
