"""The paper's tables: every published figure is there, and ours beside it are means, spreads and bests of the runs."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

from choose import CANDIDATES, SEEDS, table
from paper_methods import named
from paper_tables import EXPERIMENTS, METHODS, PUBLISHED, missed, tables
from unknown_map import moved

from models.hovercraft import HovercraftTruth
from models.hovercraft_unknown_map import HovercraftUnknownMap


def record(method: str, seed: int, size: float) -> dict:
    groups = {"location": size, "angle": size / 10}
    figures = dict.fromkeys(("forward", "forward_mean", "state_estimation"), groups)
    return {"experiment": "hov+", "method": method, "seed": seed, "seconds": 10.0, "log_likelihood": -size, **figures}


def test_every_cell_of_the_papers_tables_was_copied() -> None:
    with PUBLISHED.open() as file:
        rows = list(csv.DictReader(file))
    cells = {(row["metric"], row["group"], row["experiment"], row["method"]) for row in rows}
    assert len(cells) == len(rows) == 5 * len(EXPERIMENTS) * 6
    assert {row["method"] for row in rows} < set(METHODS) and {row["experiment"] for row in rows} == set(EXPERIMENTS)
    assert all(float(row["best"] or row["average"]) <= float(row["average"]) + 0.0005 for row in rows)  # rounded


def test_ours_are_means_spreads_and_the_best() -> None:
    text = tables([record("steady", 1, 0.1), record("steady", 2, 0.3), record("hand", 1, 0.5)])
    part = text.split("### ")[1:]
    location, likelihood = part[0], next(one for one in part if one.startswith("log p(y)"))
    assert "| STEADY | – | 0.380 (0.375) | 0.200 ± 0.141 (0.100) | 0.350 (0.346) | – | 0.266 (0.258) |" in location
    assert "| Hand | – | 1.209 (1.168) | 0.500 | 1.206 (1.145)" in location
    assert "-0.20 ± 0.14 (-0.10)" in likelihood
    assert "| STEADY, bootstrap" not in text


def test_what_must_hold_and_does_not_is_said() -> None:
    good = [record("steady", 1, 0.02), record("hand", 1, 0.5), record("svi", 1, 0.04)]
    text = tables(good)
    assert missed(good) == [] and "every must is met" in text and "is an artefact" in text
    bad = [record("steady", 1, 0.6), record("hand", 1, 0.5), record("fit-truth", 1, 0.03)]
    said = missed(bad)
    assert "MISSED Hov+, state estimation location: STEADY 0.6000, Hand 0.5000" in said
    assert "MISSED Hov+, forward location: STEADY 0.6000, published 0.0382" in said
    assert "MISSED Hov+, forward location: FitTruth 0.0300, must be at most 0.0275" in said
    assert all(line in tables(bad) for line in said)


def test_the_benchmark_starts() -> None:
    command = [sys.executable, PUBLISHED.parent / "paper.py", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "usage: paper.py" in done.stdout


def test_settings_that_failed_or_are_not_fitted_to_every_draw_have_no_mean() -> None:
    first, second = (CANDIDATES["svi", "truck"][i] for i in (0, 1))
    seeds = SEEDS["truck"]
    fitted = {"log_likelihood": 370.0, "kept_step": 5, "seconds": 2.0}
    both = {named("svi", "truck", seed, first): fitted for seed in seeds}
    assert "| 370.00 | 370.00, 370.00 | 5, 5 | 2, 2 |" in table(both)
    failed = both | {named("svi", "truck", seeds[0], first): {"failed": "why"}}
    assert "| – | failed, 370.00 | failed, 5 | failed, 2 |" in table(failed)
    assert "| – | 370.00 | 5 | 2 |" in table({named("svi", "truck", seeds[1], second): fitted})


def test_the_wrong_map_is_a_metre_off_at_every_landmark_and_what_is_learned_begins_there() -> None:
    program = moved(HovercraftUnknownMap(), seed=1)
    away = torch.tensor(HovercraftTruth.landmarks) - program.map
    assert away.norm(dim=-1).tolist() == pytest.approx([1.0] * len(away), abs=1e-5)
    assert torch.equal(program.landmarks, program.map) and torch.equal(program.declared, program.map)
