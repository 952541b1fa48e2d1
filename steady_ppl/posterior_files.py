"""A posterior as a file: all draws for ArviZ, or a table of medians and intervals."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from steady_ppl.errors import UsageError
from steady_ppl.utils.files import whole_file

if TYPE_CHECKING:
    import arviz

INTERVAL = (0.05, 0.95)
SUFFIXES = (".csv", ".parquet", ".nc")


def states_frame(posterior: arviz.InferenceData) -> pd.DataFrame:
    """Median and 90 % interval of every state, a row a trajectory and time step.

    Args:
        posterior: of `Fit.posterior`.

    Returns:
        Columns `trajectory`, `time` (s) and for each state component `name`, `name_low`, `name_high`, in its unit.
    """
    states = posterior["posterior"]
    time = posterior["constant_data"]["time"]
    plain = [name for name, values in states.data_vars.items() if values.dims == ("chain", "draw", *time.dims)]
    inside = np.isfinite(states[plain[0]].values[0, 0])
    labels = np.repeat(time["trajectory"].values, inside.sum(1))
    columns: dict[str, np.ndarray] = {"trajectory": labels, "time": time.values[inside]}
    for name in plain:
        low, middle, high = np.quantile(states[name].values[0][:, inside], (INTERVAL[0], 0.5, INTERVAL[1]), axis=0)
        columns |= {str(name): middle, f"{name}_low": low, f"{name}_high": high}
    return pd.DataFrame(columns)


def require_states_file(path: Path) -> None:
    """Refuse a file that states cannot be written to.

    Raises:
        UsageError: another suffix than those of a table or of netCDF.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"{path}: states are written as {', '.join(SUFFIXES)}")


def write_states(posterior: arviz.InferenceData, path: Path) -> None:
    """Write a posterior whole or not at all: a table of medians and intervals, or all draws as netCDF.

    Raises:
        UsageError: another suffix, or the file cannot be written.
    """
    require_states_file(path)
    suffix = path.suffix.lower()
    with whole_file(path) as beside:
        if suffix == ".nc":
            beside.write_bytes(netcdf(posterior))
        elif suffix == ".csv":
            states_frame(posterior).to_csv(beside, index=False)
        else:
            states_frame(posterior).to_parquet(beside, index=False)


def netcdf(draws: arviz.InferenceData) -> memoryview:
    """The bytes of a netCDF file. HDF5 is kept away from disks: on one that is full it prints pages and may crash."""
    return draws.to_datatree().to_netcdf(None, engine="h5netcdf")
