"""The pages beside the records of discovery say what the records say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import continuous_tables
import discovery_boat
import discovery_conditions

RESULTS = Path(continuous_tables.__file__).with_name("results")


def records(name: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (RESULTS / f"{name}.jsonl").read_text().splitlines()]


def test_the_boats() -> None:
    assert (RESULTS / "discovery_boat.md").read_text() == discovery_boat.table(records("discovery_boat"))


def test_other_conditions() -> None:
    page = discovery_conditions.page(records("discovery-conditions"), seeds=2, clean_sets=100)
    assert (RESULTS / "discovery-conditions.md").read_text() == page


def test_continuous_time() -> None:
    page = continuous_tables.tables(records("continuous-alarms"), records("continuous-planted"))
    assert (RESULTS / "continuous.md").read_text().startswith(page.rstrip())
