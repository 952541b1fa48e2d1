"""The quick calibration meets its musts."""

from __future__ import annotations

import json
from pathlib import Path

import calibrate
import pytest
from calibration_tables import tables


@pytest.mark.exhaustive
def test_the_quick_suite_meets_its_musts_and_a_job_that_fails_is_one_that_is_missed(tmp_path: Path, capsys):
    file = tmp_path / "quick.jsonl"
    assert calibrate.main(["--quick", "--results", str(file)]) == 0
    said = capsys.readouterr().out
    assert "bootstrap 200 fails" in said and "**no**" not in said and said.count("too few to tell |") == 5
    assert file.with_suffix(".md").read_text() in said
    records = [json.loads(line) for line in file.read_text().splitlines()]
    broken = [*records, {"set": "states cart", "failed": "ValueError: no"}]
    text, missed = tables(broken)
    assert missed == 1 and f"{len(records)} of {len(broken)} | **no**" in text
