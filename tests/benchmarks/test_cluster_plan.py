"""The plan of a cluster is that of what was measured, and its schedules are right."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import cluster_plan
import numpy as np
import pandas as pd
import pytest

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"


def test_two_workers_do_nine_tenths_of_what_one_does_twice():
    found = json.loads((RESULTS / "cluster.json").read_text())["efficiency"]["cluster"]["rounds"]
    assert len(found) >= 3 and np.mean(found) >= 0.9


@pytest.mark.slow
def test_the_plan_of_a_cluster_is_that_of_what_was_measured():
    fits = pd.read_parquet(RESULTS / "observation-noise.parquet")
    plan = cluster_plan.tables(json.loads((RESULTS / "cluster.json").read_text()), fits)
    assert (RESULTS / "cluster.md").read_text() == plan


def test_figures_of_the_page_are_those_of_the_plan():
    text = (ROOT / "docs" / "cluster.md").read_text().partition("## Ten thousand fits")[2]
    quoted = re.findall(r"\d[\d.]* ± [\d.]*\d|\d+%|\d+ (?:MiB|hours)|\d+ s ± \d+|\d+ of \d+", text)
    plan = (RESULTS / "cluster.md").read_text()
    assert len(quoted) >= 15 and [one for one in quoted if one not in plan] == []


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
