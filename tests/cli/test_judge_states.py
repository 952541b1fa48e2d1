"""`steady states`: medians and intervals as a table, all draws as netCDF."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from small import TRUTH, contents, simulated, steady, written

from steady_ppl import Fit, read_table

with warnings.catch_warnings():
    warnings.simplefilter("ignore", FutureWarning)
    import arviz


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    data = simulated(trajectories=3)
    data.lengths[1] = 9
    written(folder / "t.csv", data)
    assert steady("fit", TRUTH, folder / "t.csv", "--recipe", "hand", "--known-start", "--out", folder / "r") == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_medians_and_intervals_are_those_of_the_draws(run: Path, suffix: str, capsys) -> None:
    out = run / f"states{suffix}"
    assert steady("states", run / "r", run / "t.csv", "--draws", 20, "--out", out) == 0
    assert f"{out}: 3 trajectories, 20 draws of each" in capsys.readouterr().out
    frame = pd.read_csv(out) if suffix == ".csv" else pd.read_parquet(out)
    assert len(frame) == 13 + 9 + 13
    assert list(frame.columns[:5]) == ["trajectory", "time", "x", "x_low", "x_high"] and len(frame.columns) == 2 + 18
    draws = Fit.load(run / "r").posterior(read_table(run / "t.csv"), draws=20)["posterior"]["heading"]
    part = frame[frame["trajectory"].astype(str) == "2"]
    expected = np.quantile(draws.sel(trajectory="2", chain=0).values[:, :9], [0.05, 0.5, 0.95], axis=0)
    np.testing.assert_allclose(part[["heading_low", "heading", "heading_high"]].T, expected, rtol=1e-6)
    assert part["time"].tolist() == pytest.approx([0.1 * row for row in range(9)], abs=1e-6)


def test_netcdf_has_all_draws(run: Path) -> None:
    assert steady("states", run / "r", run / "t.csv", "--draws", 7, "--out", run / "states.nc") == 0
    found = arviz.from_netcdf(str(run / "states.nc"), engine="h5netcdf")
    assert found["posterior"].sizes["draw"] == 7 and "effective_size" in found["sample_stats"]


@pytest.mark.parametrize(("out", "said"), [("s.txt", ".csv, .parquet, .nc"), ("no/s.csv", "there is no folder")])
def test_a_file_that_cannot_be_written_is_refused_first(run: Path, out: str, said: str, capsys) -> None:
    before = contents(run)
    assert steady("states", run / "r", run / "t.csv", "--out", run / out) == 2
    assert said in capsys.readouterr().err and contents(run) == before
