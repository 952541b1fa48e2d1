"""What is filed under benchmarks/results is what the records give, and the page of results says the same."""

from __future__ import annotations

from pathlib import Path

import choose
import paper
import pytest
from paper_methods import named
from paper_settings import CHOSEN
from paper_tables import tables
from resumable import Record, stored

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"


@pytest.fixture(scope="module")
def records() -> list[Record]:
    """Of the runs that the tables are of; the file also has those with settings that were given up."""
    found = stored(RESULTS / "paper.jsonl")
    jobs = [
        named(method, experiment, seed, CHOSEN.get((method, experiment), {}))
        for experiment in paper.EXPERIMENTS
        for method in paper.METHODS
        for seed in range(1, 1 + paper.RUNS)
        if (method, experiment) not in paper.LEFT_OUT
    ]
    return [found[name] for name in jobs]


def test_the_filed_tables_are_those_of_the_filed_records(records: list[Record]) -> None:
    assert tables(records) == (RESULTS / "paper.md").read_text()


def test_the_page_shows_the_short_tables() -> None:
    filed, page = (file.read_text() for file in (RESULTS / "paper.md", ROOT / "docs" / "results-paper.md"))
    parts = [part for part in filed.split("## ") if part.startswith("In short")]
    assert len(parts) == 2
    for part in parts:
        _, rows = part.split("\n\n", 1)
        assert rows.count("\n| ") >= 9 and rows.strip() in page


def test_the_filed_choices_are_those_of_the_filed_records() -> None:
    assert choose.table(stored(RESULTS / "choices.jsonl")) == (RESULTS / "choices.md").read_text()
