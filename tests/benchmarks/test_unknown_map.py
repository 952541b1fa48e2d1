"""The benchmark of unknown landmarks learns maps, and what is filed is what the records give."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
import unknown_map
from experiments import hov
from resumable import stored

from models.hovercraft import HovercraftTruth
from models.hovercraft_unknown_map import HovercraftUnknownMap

RESULTS = Path(unknown_map.__file__).with_name("results")
FEW = {"steps": 2, "validate_every": 2}


@pytest.fixture(autouse=True)
def few_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unknown_map, "hov", lambda seed, truth: hov(seed, 2, 2, 2, truth=truth))


@pytest.mark.exhaustive
def test_an_unknown_map_is_learned_beside_the_known_one(monkeypatch: pytest.MonkeyPatch) -> None:
    known, unknown, _ = unknown_map.PROGRAMS["mechanistic"]
    monkeypatch.setitem(unknown_map.PROGRAMS, "mechanistic", (known, unknown, FEW | {"guide": "gaussian"}))
    made = json.loads(json.dumps(unknown_map.judged("mechanistic", 1)))
    assert 0.5 < made["learned map"]["map"]["rms"] < 1.5
    assert unknown_map.said(made).startswith(f"map off by {made['learned map']['map']['rms']:.3f} m, forward 0.")


def test_the_wrong_map_is_a_metre_off_at_every_landmark_and_what_is_learned_begins_there() -> None:
    program = unknown_map.moved(HovercraftUnknownMap(), seed=1)
    away = torch.tensor(HovercraftTruth.landmarks) - program.map
    assert away.norm(dim=-1).tolist() == pytest.approx([1.0] * len(away), abs=1e-5)
    assert torch.equal(program.landmarks, program.map) and torch.equal(program.declared, program.map)


@pytest.mark.parametrize(
    ("rms", "location", "angle", "missed"),
    [(0.14, 1.1, 1.0, 0), (0.16, 1.0, 1.0, 1), (0.14, 1.2, 1.0, 1), (0.14, 1.0, 1.2, 1), (0.16, 1.0, 1.2, 2)],
)
def test_a_map_that_is_too_far_off_or_costs_too_much_is_missed(
    rms: float, location: float, angle: float, missed: int
) -> None:
    known = {"forward": {"location": 1.0, "angle": 1.0}}
    learned = {"forward": {"location": location, "angle": angle}, "map": {"rms": rms}}
    records = [{"program": "network", "known map": known, "learned map": learned}] * 2
    lines, good = unknown_map.summary({"rms": 0.1, "sd": 0.01}, records)
    assert lines[0].endswith("0.100 ± 0.010 m") and lines[1].count("MISSED") == missed and good == (missed == 0)
    assert unknown_map.summary({"rms": 0.1, "sd": 0.01}, [*records, {"failed": "why"}])[1] is False


def test_what_is_filed_is_what_the_records_give() -> None:
    records = stored(RESULTS / "unknown_map.jsonl")
    bound = records.pop(unknown_map.BOUND)
    lines, _ = unknown_map.summary(bound, list(records.values()))
    assert len(lines) == 3 and (RESULTS / "unknown_map.md").read_text().splitlines() == [f"- {line}" for line in lines]
