"""The benchmarks of the paper's tables, of their settings and of the unknown map, from drives to records."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import choose
import paper
import paper_methods
from experiments import LOGS, SIZES, hov, truck
from paper_methods import named
from paper_records import METHODS
from paper_tables import tables

from inference import hand
from models.hovercraft import Hovercraft
from models.truck import Truck
from steady_ppl.errors import FilterError

FEW = {"steps": 2, "validate_every": 2}


@pytest.fixture(autouse=True)
def few_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SIZES, "hov", (2, 2, 2))


@pytest.mark.parametrize(("method", "settings"), [("hand", {}), ("fit-truth", FEW)])
def test_a_run_of_a_method(method: str, settings: dict, tmp_path: Path) -> None:
    made = json.loads(json.dumps(paper.judged(method, "hov", 1, settings, tmp_path, True, tmp_path)))
    made["set"] = named(method, "hov", 1, settings)
    assert made["kept_step"] == settings.get("steps") and ("steps=2" in made["set"]) == bool(settings)
    assert paper.said(made).startswith("forward 0.") and math.isfinite(made["bootstrap"]["log_likelihood"])
    text = tables([made], 1)
    assert f"| {METHODS[method]} | {made['forward']['location']:.4f} | " in text
    assert " of 1 equal" in text and "not held against" not in text and not list(tmp_path.iterdir())


def test_a_filter_that_fails_is_a_record_without_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise FilterError("every weight is zero")

    monkeypatch.setattr(paper_methods, "log_likelihood", broken)
    test = hov(1, 1, 1, 1)[2]
    found = paper_methods.by_bootstrap(hand.fit(Hovercraft(), test, known_start=True), test, particles=10)
    assert math.isnan(found["log_likelihood"]) and found["why_not"] == "every weight is zero"


def test_settings_are_judged_by_held_out_drives(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made = choose.judged("fit-truth", "hov", 101, FEW, tmp_path)
    assert made["kept_step"] == 2 and math.isfinite(made["log_likelihood"])
    records = {named("fit-truth", "hov", seed, FEW): made for seed in (101, 102)}
    monkeypatch.setitem(choose.CANDIDATES, ("fit-truth", "hov"), [FEW])
    mean = f"{made['log_likelihood']:.2f}"
    assert f"| fit-truth | hov | steps 2, validate_every 2 | {mean} | {mean}, {mean} | 2, 2 |" in choose.table(records)


@pytest.mark.skipif(not LOGS.is_dir(), reason="the AlphaTruck logs are not part of this repository")
def test_the_picture_of_velocities(tmp_path: Path) -> None:
    for name in ("first", "second"):
        hand.fit(Truck(), truck(LOGS, 1)[0], known_start=True).save(tmp_path / name)
    file = paper.draw_velocities({name: tmp_path / name for name in ("first", "second")}, LOGS, tmp_path / "v.png")
    assert file.stat().st_size > 10_000
