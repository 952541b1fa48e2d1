"""Every effect of the catalogue is found: at four detection limits, or at its physical maximum where that is less."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from steady_ppl import for_program, simulate
from steady_ppl.discovery.finding import findings
from steady_ppl.discovery.search import search
from steady_ppl.effects import parsed

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

from discovery_limits import KNOWN, owner, with_effects
from discovery_sets import EFFECTS, text_of_size

SEEN = [effect for effect in EFFECTS if effect != "coloured_noise"]  # white and coloured are alike at this noise
DRIVES, ROWS = 12, 81
pytestmark = pytest.mark.slow
SIZE = 4 * (16 * 100 / (DRIVES * (ROWS - 1))) ** 0.5  # the stored limits are those of 16 drives of 101 rows


@pytest.mark.parametrize("effect", SEEN)
def test_it_is_found(effect: str) -> None:
    known = KNOWN.get(effect, ())
    text = text_of_size(effect, SIZE)
    truth, program = with_effects(owner(known), (text,)), owner(known)
    truth.duration = (ROWS - 1) * truth.step
    drives = [simulate(truth, DRIVES, seed=seed) for seed in (1, 2)]
    train, valid = (for_program(program, table).without_truth(keep_start=True) for table in drives)
    found = findings(search(program, train, valid, known_start=True, sets=50, later_sets=50))
    name, where, *_ = parsed(text)
    assert found and ":".join(part for part in (name, where) if part) in found[0].alike, [
        finding.alike for finding in found
    ]
    assert found[0].kind == found[0].variant.effect.verdict
