"""The page on the real truck says what the records say."""

from __future__ import annotations

import json
import statistics
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
RECORDS = [json.loads(line) for line in (ROOT / "benchmarks" / "results" / "truck.jsonl").read_text().splitlines()]
PAGE = (ROOT / "docs" / "truck.md").read_text()


def of(program: str) -> list[dict]:
    runs = sorted((record for record in RECORDS if record.get("program") == program), key=lambda run: run["draw"])
    assert [run["draw"] for run in runs] == [1, 2, 3, 4, 5]
    return runs


@pytest.mark.parametrize("program", ["hand", "fitted", "network", "discovered", "hybrid"])
def test_the_table_is_the_mean_of_five_draws(program: str) -> None:
    (row,) = (line for line in PAGE.splitlines() if line.startswith(f"| {program} |"))
    for group, places in (("forward", 4), ("forward_mean", 4), ("state_estimation", 3)):
        for what in ("location", "angle"):
            mean = statistics.fmean(run[group][what] for run in of(program))
            assert f"{mean:.{places}f}".removeprefix("0") in row, (group, what)
    likelihood = [run["log_likelihood"] for run in of(program)]
    assert f"{statistics.fmean(likelihood):.2f} ± {statistics.stdev(likelihood):.2f}".replace(" 0.", " .") in row


@pytest.mark.parametrize(
    ("program", "other"),
    [("discovered", "hand"), ("discovered", "network"), ("hybrid", "hand"), ("hybrid", "network")],
)
def test_gains_are_of_the_same_draws(program: str, other: str) -> None:
    gains = [a["log_likelihood"] - b["log_likelihood"] for a, b in zip(of(program), of(other), strict=True)]
    assert f"{statistics.fmean(gains):.2f} ± {statistics.stdev(gains):.2f}".replace(" 0.", " .") in PAGE
