"""The calibration suite: its tests of uniformity notice what they must, and its quick mode runs."""

from __future__ import annotations

import json
from pathlib import Path

import calibrate
import numpy as np
import pytest
from calibration_tables import Musts, _check, _discovery, tables
from uniformity import inside, near, ranks, together, uniform

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


DRAWS, DRIVES = 99, 1000


def p_value(offset: float = 0.0, scale: float = 1.0, seed: int = 1) -> float:
    """Of truths beside draws that are off by an offset and a factor."""
    random = np.random.default_rng(seed)
    truth, draws = random.normal(size=DRIVES), offset + scale * random.normal(size=(DRAWS, DRIVES))
    return uniform(ranks(truth, draws), DRAWS)


def test_ranks_are_uniform_only_where_draws_are_right():
    assert np.mean([p_value(seed=seed) < 0.05 for seed in range(200)]) < 0.05 + 4 * np.sqrt(0.05 * 0.95 / 200)
    assert p_value(offset=0.3) < 1e-6
    assert p_value(scale=0.7) < 1e-6
    assert p_value(scale=1.4) < 1e-6


def test_ranks_must_fall_into_equal_bins():
    with pytest.raises(ValueError, match="multiple of 20"):
        uniform(np.zeros(10, dtype=int), 50)


def test_many_p_values_are_one_however_they_depend():
    random = np.random.default_rng(2)
    alone, alike = random.uniform(size=(400, 30)), np.repeat(random.uniform(size=(400, 1)), 30, 1)
    for values in (alone, alike):
        assert np.mean([together(row) < 0.05 for row in values]) < 0.05 + 4 * np.sqrt(0.05 * 0.95 / 400)
    assert together(np.array([1e-12, *[0.5] * 30])) < 1e-9
    assert 0 < together(np.zeros(3)) < 1e-200 and together(np.ones(3)) > 0.99


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_an_interval_holds_its_share_of_uniform_ranks(share):
    assert inside(np.arange(DRAWS + 1), DRAWS, share).mean() == pytest.approx(share, abs=2 / (DRAWS + 1))


def test_a_share_is_near_within_three_standard_errors():
    values = np.repeat([0.0, 1.0], [10, 90])
    assert near(values, 0.9) == ("90.0% ± 3.0%", True)
    assert not near(values, 0.5)[1]


def record_of(stratum: str, index: int, **found) -> dict:
    return {"set": f"{stratum} {index}", "of": [stratum, index], "p_value": 0.5, "verdict": "none", **found}


def musts(of) -> list[str]:
    found = Musts()
    of(found)
    return [line.rstrip(" |").rpartition("| ")[2] for line in found.lines]


def test_a_must_that_so_few_cannot_miss_is_not_said_to_hold():
    few, many = ([record_of("one long drive", i, who="nothing found", findings=0) for i in range(n)] for n in (1, 60))
    assert musts(lambda found: _check(few, found)) == ["too few to tell"]
    assert musts(lambda found: _check(many, found)) == ["yes"]
    accused = [one | {"who": "dynamics"} for one in many]
    assert musts(lambda found: _check(accused, found)) == ["**no**"]


def test_where_no_planted_effect_is_named_its_intervals_do_not_hold():
    clean = [record_of("clean", i, p_value=(i + 0.5) / 60) for i in range(60)]
    unnamed = [record_of("single", i, effects=[], planted=["magnus"]) for i in range(3)]
    assert musts(lambda found: _discovery([*clean, *unnamed], found)) == ["yes", "yes", "**no**"]


@pytest.mark.slow
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
