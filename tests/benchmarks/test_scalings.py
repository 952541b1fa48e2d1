"""Other units change what numbers are multiplied with, and nothing else."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
import scalings
from scalings import CASES, SYSTEMS, unit_of

from steady_ppl import for_program
from steady_ppl.effects import Sizes, catalogue

NO_UNIT = ("tails", "colour")


@cache
def sizes_of(case: str, system: str) -> dict[str, tuple[float, float]]:
    """Of every effect its scale, and by what its coefficient's unit multiplies it."""
    program, train, _, _ = CASES[case](SYSTEMS[system], Path())
    data = for_program(program, train)
    sizes = Sizes(program, data)
    every = [v for effect in catalogue(program) if effect.form not in NO_UNIT for v in effect.variants(program, data)]
    return {variant.name: (sizes.of(variant).scale, unit_of(variant, SYSTEMS[system])) for variant in every}


@pytest.mark.exhaustive
@pytest.mark.parametrize("case", ["demo", "boat"])
@pytest.mark.parametrize("system", ["mixed, small time", "mixed, large time"])
def test_sizes_are_multiplied_as_their_units_are(case, system):
    base, there = sizes_of(case, "as it is"), sizes_of(case, system)
    assert base.keys() == there.keys() and len(base) > 20
    for name, (scale, unit) in there.items():
        assert scale == pytest.approx(base[name][0] * unit, rel=0.02), name


def test_a_difference_is_named():
    record = {"verdict": "dynamics", "substeps": 1, "effects": {"drag": [0.1]}, "gain": 50.0}
    other = {"verdict": "sensor", "substeps": 1, "effects": {"bias": [0.2]}, "gain": 50.2}
    assert list(scalings.differences(record, record)) == []
    assert list(scalings.differences(record, other)) == ["verdict sensor", "effects bias", "50.20 nats"]
