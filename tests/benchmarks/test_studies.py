"""What is filed of the ready studies is what their tables give, and pages say the same."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import pytest

import studies

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"


@pytest.mark.slow
def test_the_filed_tables_are_those_of_the_filed_results():
    tables, _ = studies.tables(RESULTS)
    assert (RESULTS / "studies.md").read_text() == tables


def page() -> str:
    return (ROOT / "docs" / "results-studies.md").read_text()


def test_figures_of_the_page_are_those_of_the_tables():
    quoted = re.findall(r"\d\.\d{3}(?: ± \d\.\d{3})?|\d+% \(\d+%–\d+%\)", page())
    tables = (RESULTS / "studies.md").read_text() + (ROOT / "studies" / "data-size.toml").read_text()  # published
    assert len(quoted) >= 10 and [one for one in quoted if one not in tables] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("study", "method", "place", "sentence"),
    [
        ("observation-noise", "STEADY", 1.25, "STEADY ends at {} at 1.25°"),
        ("observation-noise", "FitTruth", 1.25, "above FitTruth ({})"),
        ("observation-noise", "STEADY−", 1.25, "diverges; the others end at {}."),
        ("observation-noise", "STEADY−", 2.5, "At 2.5° it is {} against"),
        ("observation-noise", "STEADY", 2.5, "against {}, 9.8 % worse"),
        ("observation-noise", "SVI", 5.0, "SVI ends at {}, STEADY"),
        ("observation-noise", "STEADY", 5.0, ", STEADY at {}."),
        ("observation-noise", "STEADY, bootstrap", 1.25, "errs more at 1.25° ({})"),
        ("observation-noise", "STEADY, bootstrap", 5.0, "From 5° on it errs less: {}, "),
        ("observation-noise", "STEADY, bootstrap", 10.0, ", {} and "),
        ("observation-noise", "STEADY, bootstrap", 20.0, " and {}."),
        ("particles", "lookahead", 100, "err as much in roll-outs: {} and "),
        ("particles", "bootstrap", 20_000, " and {}."),
        ("particles", "bootstrap", 200, "With 200 it ends at {}, in"),
        ("data-size", "program with drag", 4, "needs four trajectories: {} m"),
        ("data-size", "program with drag", 160, "against {} m with 160"),
        ("data-size", "program without drag", 4, "does not improve: {} m with four"),
        ("data-size", "program without drag", 160, "four, {} m with 160"),
        ("data-size", "network, STEADY", 8, "passes the model without drag at eight ({} m)"),
        ("data-size", "network, STEADY", 160, "and ends at {} m"),
        ("data-size", "network, SVI", 16, "as good with sixteen: {} m ("),
        ("data-size", "network, STEADY", 16, "(STEADY {} m)"),
    ],
)
def test_a_figure_of_the_page_is_that_of_the_method_that_it_names(study: str, method: str, place: float, sentence: str):
    rows = pd.read_parquet(RESULTS / f"{study}.parquet")
    x, column, digits = {
        "observation-noise": (studies.SIGMA, studies.ERROR, 3),
        "particles": (studies.PARTICLES, studies.ERROR, 3),
        "data-size": (studies.DRIVES, "forward.location", 4),
    }[study]
    rows = studies.of_best_settings(rows) if study == "observation-noise" else rows
    found = rows[(rows["method"] == method) & (rows[x] == place)][column].dropna()
    assert sentence.format(f"{found.mean():.{digits}f} ± {found.std():.{digits}f}") in page()
