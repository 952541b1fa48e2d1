"""The page of promises names what there is, and its figures are those of the records."""

from __future__ import annotations

import json
import re
from pathlib import Path

import calibrate
import determinism
from calibration_tables import tables

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
PAGE = (ROOT / "docs" / "promises.md").read_text()


def records(name: str) -> list[dict]:
    return [json.loads(line) for line in (RESULTS / f"{name}.jsonl").read_text().splitlines()]


def rows(text: str) -> list[list[str]]:
    """Cells of every line of every table."""
    return [
        [cell.strip() for cell in line.strip("| ").split("|")] for line in text.splitlines() if line.startswith("|")
    ]


def test_every_file_that_is_named_is_there():
    named = set(re.findall(r"`((?:tests|benchmarks)/[\w./-]+)`", PAGE))
    assert len(named) > 10 and [name for name in named if not (ROOT / name).exists()] == []


def test_the_calibration_is_that_of_its_records_and_the_page_has_its_musts():
    found = records("calibration")
    wanted = list(calibrate.jobs(calibrate.FULL))
    assert sorted(record["set"] for record in found) == sorted(wanted)
    kinds = {record["kind"] for record in found}
    assert len({(record["kind"], record["version"]) for record in found}) == len(kinds)  # each kind by one engine
    text, missed = tables(sorted(found, key=lambda record: wanted.index(record["set"])))
    assert (RESULTS / "calibration.md").read_text() == text
    musts = text.partition("\n\n")[0]
    assert musts in PAGE and musts.count("**no**") == missed


def test_the_trials_of_the_fuzzer_are_those_of_their_table():
    *groups, total = rows((RESULTS / "fuzzing.md").read_text())[2:]
    counts = [sum(int(cells[i]) for cells in groups) for i in range(2, 8)]
    most = [max((cells[i] for cells in groups), key=float) for i in (8, 9)]
    assert [*map(str, counts), *most] == total[2:] and counts[4:] == [0, 0]
    figures = [int(total[1].split()[0]), *counts]
    assert [*(f"{figure:,}" for figure in figures), *most] in rows(PAGE)


def test_what_repeats_is_that_of_the_run_with_every_command():
    table = (RESULTS / "determinism.md").read_text()
    assert table in PAGE
    told = {cells[0]: tuple(cells[1:3]) for cells in rows(table)[2:]}
    assert told == dict.fromkeys(determinism.COMMANDS, ("same", "same"))
