"""What is filed of the ready studies is what their tables give, and pages say the same."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import cluster_plan
import numpy as np
import pandas as pd
import pytest

import studies

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"


def test_the_filed_tables_are_those_of_the_filed_results():
    tables, _ = studies.tables(RESULTS)
    assert (RESULTS / "studies.md").read_text() == tables


def page() -> str:
    return (ROOT / "docs" / "studies.md").read_text().partition("## What they have found")[2]


def test_figures_of_the_page_are_those_of_the_tables():
    quoted = re.findall(r"\d\.\d{3}(?: ± \d\.\d{3})?|\d+% \(\d+%–\d+%\)", page())
    tables = (RESULTS / "studies.md").read_text() + (ROOT / "studies" / "data-size.toml").read_text()  # published
    assert len(quoted) >= 10 and [one for one in quoted if one not in tables] == []


@pytest.mark.parametrize(
    ("study", "method", "place", "sentence"),
    [
        ("observation-noise", "STEADY", 1.25, "STEADY ends at {} at 1.25°"),
        ("observation-noise", "FitTruth", 1.25, "above FitTruth ({})"),
        ("observation-noise", "STEADY−", 1.25, "blows up there, and the others end at {}."),
        ("observation-noise", "STEADY−", 2.5, "At 2.5° it is {} against"),
        ("observation-noise", "STEADY", 2.5, "against {}, 9.8 % worse"),
        ("observation-noise", "SVI", 5.0, "SVI ends at {}, STEADY"),
        ("observation-noise", "STEADY", 5.0, ", STEADY at {}."),
        ("observation-noise", "STEADY, bootstrap", 1.25, "errs more at 1.25° ({})"),
        ("observation-noise", "STEADY, bootstrap", 5.0, "from 5° on ({}, "),
        ("observation-noise", "STEADY, bootstrap", 10.0, ", {} and "),
        ("observation-noise", "STEADY, bootstrap", 20.0, " and {})."),
        ("particles", "lookahead", 100, "errs as much: {} and "),
        ("particles", "bootstrap", 20_000, " and {} in roll-outs"),
        ("particles", "bootstrap", 200, "200 of them end at {}, in"),
        ("data-size", "program with drag", 4, "four drives enough: {} m"),
        ("data-size", "program with drag", 160, " m in roll-outs of a second, {} with 160"),
        ("data-size", "program without drag", 4, "as good with four as with 160: {} and "),
        ("data-size", "program without drag", 160, " and {} m, 4.7 nats"),
        ("data-size", "network, STEADY", 8, "passes the program without drag at eight ({})"),
        ("data-size", "network, STEADY", 160, "and ends at {} m"),
        ("data-size", "network, SVI", 16, "as good with sixteen ({} m, "),
        ("data-size", "network, STEADY", 16, ", STEADY {})"),
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


def test_two_workers_do_nine_tenths_of_what_one_does_twice():
    found = json.loads((RESULTS / "cluster.json").read_text())["efficiency"]["cluster"]["rounds"]
    assert len(found) >= 3 and np.mean(found) >= 0.9


def test_the_plan_of_a_cluster_is_that_of_what_was_measured_and_the_pages():
    fits = pd.read_parquet(RESULTS / "observation-noise.parquet")
    plan = cluster_plan.tables(json.loads((RESULTS / "cluster.json").read_text()), fits)
    assert (RESULTS / "cluster.md").read_text() == plan
    assert plan.strip() in (ROOT / "docs" / "cluster.md").read_text()


def test_fits_are_handed_to_the_worker_that_is_free_first():
    alike = cluster_plan.schedule(np.full(10, 60.0), 2, 2, math.inf, np.random.default_rng(0))
    assert alike == (180.0, pytest.approx(10 / 12))
    unlike = cluster_plan.schedule(np.array([1.0, 1.0, 1.0, 9.0]), 1, 2, math.inf, np.random.default_rng(0))
    assert unlike == (10.0, pytest.approx(12 / 20))


def test_a_machine_that_is_down_is_given_nothing_until_it_is_back(monkeypatch):
    """The first one is idle when it dies, and is to take what the second one loses."""
    deaths = iter([[50.0], [349.0]])
    monkeypatch.setattr(cluster_plan, "_deaths", lambda life, generator: next(deaths))
    last, _ = cluster_plan.schedule(np.array([10.0, 400.0]), 2, 1, 1.0, np.random.default_rng(0))
    assert last == 50 + cluster_plan.BACK + 400


def test_machines_that_die_cost_what_they_compute_and_their_rest():
    """An hour in the mean, fits of 600 s: of 3900 s 300 are rest and 300 are a fit that is half done."""
    last, used = cluster_plan.schedule(np.full(2000, 600.0), 4, 2, 1.0, np.random.default_rng(0))
    assert used == pytest.approx(3300 / 3900, abs=0.03) and last > 2000 * 600 / 8
