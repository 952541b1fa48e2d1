"""Whether `discover` and `check` are as sure as they may be where nothing is missing, and intervals where something is.

The sets of `discover` are made like those of the discovery benchmark (`discovery_sets.py`), with seeds that it has not
seen; `check` gets clean ones of two kinds.
"""

from __future__ import annotations

import torch
from discovery_sets import BenchmarkSet, benchmark_sets, owner, tables

from steady_ppl import Fit, check, simulate
from steady_ppl.discovery.discover import discover

SEED = 60_000
CLEAN = {"one long drive": (1, 30.0, False), "twelve drives": (12, 6.0, True)}  # number, s, known start


def fresh(stratum: str, index: int) -> BenchmarkSet:
    """The index-th set of a stratum, "clean" or "single", drawn anew."""
    if stratum == "clean":
        return BenchmarkSet(f"calibration-clean-{index}", stratum, (), SEED + index)
    singles = sorted((one for one in benchmark_sets() if one.stratum == stratum), key=lambda one: one.seed)
    like = singles[(7 * index) % len(singles)]  # one after the other of another effect and another size
    return BenchmarkSet(f"calibration-{like.name}", stratum, like.effects, SEED + 1000 + index, known=like.known)


def judged(stratum: str, index: int) -> dict:
    """What is said of a set, as `discovery_scores` reads it."""
    torch.set_num_threads(1)
    chosen = fresh(stratum, index)
    train, valid, _ = tables(chosen)
    figures = discover(owner(chosen.known), train, valid, known_start=True, seed=chosen.seed).figures
    found = [{key: one[key] for key in ("effect", "coefficient", "interval_90")} for one in figures["effects"]]
    return {
        "p_value": figures["p_value"],
        "verdict": figures["verdict"],
        "effects": list(chosen.effects),
        "found": found,
    }


def checked(kind: str, index: int) -> dict:
    """Whom `check` accuses of clean drives of the program itself."""
    torch.set_num_threads(1)
    drives, seconds, known_start = CLEAN[kind]
    program = owner(())
    program.duration = seconds
    data = simulate(program, drives, seed=SEED + 2000 + index)
    figures = check(Fit(program, "hand", known_start=known_start), data, seed=index).figures
    return {"p_value": figures["p_value"], "who": figures["who"], "findings": len(figures["findings"])}
