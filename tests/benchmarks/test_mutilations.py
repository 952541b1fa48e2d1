"""Ways of spoiling drives change them, repeat, and leave what a table can hold."""

from __future__ import annotations

import time

import mutilations
import numpy as np
import pytest
import torch
from mutilations import TABLES, WALL, WAYS, TimeIsUp, changed, page, searched_for, spoiled, within
from small import simulated

from steady_ppl import load_program, read_table, write_table
from steady_ppl.effects import catalogue

MAY_CHANGE_NOTHING = {"repeated rows", "saturated sensor", "frozen sensor", "dropouts", "swapped measurements"}


def told(data) -> list[torch.Tensor]:
    return [data.time, data.controls, data.measurements * data.observed, data.observed, data.lengths]


@pytest.mark.slow
@pytest.mark.parametrize("name", WAYS)
def test_a_way_changes_drives_and_repeats(name):
    data = simulated(trajectories=6, rows=12)
    before = [values.clone() for values in told(data)]
    changes = 0
    for seed in range(5):
        one, again = (WAYS[name](changed(data), np.random.default_rng(seed)) for _ in range(2))
        assert all(map(torch.equal, told(one), told(again)))
        pairs = zip(told(one), before, strict=True)
        changes += not all(values.shape == old.shape and torch.equal(values, old) for values, old in pairs)
        assert bool((one.time.diff(dim=0) > 0).all()) and all(bool(values.isfinite().all()) for values in told(one))
    assert all(map(torch.equal, told(data), before))
    assert changes == 5 or (changes > 0 and name in MAY_CHANGE_NOTHING)


@pytest.mark.parametrize("table", TABLES)
def test_spoiled_drives_can_be_written_and_read(table, tmp_path):
    data, ways = spoiled(table, 4, np.random.default_rng(3))
    assert ways and set(ways) <= set(WAYS)
    write_table(data, tmp_path / "t.csv")
    if int(data.lengths.min()) > 1:
        assert len(read_table(tmp_path / "t.csv")) == len(data)


def test_a_search_is_told_to_keep_to_few_effects():
    program = load_program(mutilations.ROOT / "models" / "hovercraft.py")
    names = {effect.name for effect in catalogue(program)}
    told = [searched_for(program, np.random.default_rng(seed)) for seed in range(60)]
    assert {len(names) - len(one["withheld"]) for one in told} == {mutilations.FEW, len(names)}
    assert 0 < sum(not one["only"] for one in told) < 60


def test_a_case_that_takes_too_long_is_ended():
    with pytest.raises(TimeIsUp), within(0.05, WALL, TimeIsUp):
        time.sleep(60)


def test_the_page_counts_outcomes_and_names_what_went_wrong():
    records = [
        {"set": "demo 0", "table": "demo", "ways": ["jumps", "noise"], "outcome": "verdict", "said": "none"},
        {"set": "boat 1", "table": "boat", "ways": ["jumps"], "outcome": "traceback", "said": "KeyError: 1"},
    ]
    text = page(records)
    assert "| jumps | 1 | 0 | 1 | 0 |" in text and "| **all** | 1 | 0 | 1 | 0 |" in text
    assert text.endswith("- boat 1 (jumps): KeyError: 1")
