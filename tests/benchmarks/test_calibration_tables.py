"""Musts of the calibration hold, miss, or are too few to tell."""

from __future__ import annotations

from calibration_tables import Musts, _check, _discovery


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
