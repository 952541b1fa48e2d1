"""The path from the hand-written program of the AlphaTruck to one with what it lacks, found from bearings alone."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch
from experiments import truck

from models.truck import Truck
from steady_ppl import Fit, Trajectories, discover
from steady_ppl.comparison.evaluate import evaluate
from steady_ppl.data.trajectories import concatenated
from steady_ppl.effects import record
from steady_ppl.utils.random import seeded

MOST = 5  # discoveries after one another


def path(logs: Path, draw: int, *, judged: bool = True) -> dict[str, Any]:
    """Discover, add and refit until nothing with a name is left.

    Args:
        logs: folder with train/, valid/ and test/.
        draw: seed of the bearings.
        judged: compute errors on the test drives, which decide nothing.

    Returns:
        The steps, each with the verdict, what was added, and the errors.
    """
    torch.set_num_threads(1)
    train, valid, test = truck(logs, draw, centred=True)
    drives = concatenated(train=train, valid=valid).without_truth(keep_start=True)
    with seeded(0, "program"):
        now: Any = Truck()
    judges = test if judged else None
    steps: list[dict[str, Any]] = []
    for index in range(MOST):
        began = time.perf_counter()
        found = discover(now, drives, known_start=True, seed=index)
        seconds = time.perf_counter() - began
        if not steps:
            steps.append(_step(found.before, judges, {"added": []}))
        steps.append(_step(found.after, judges, {"seconds": seconds} | _said(found)))
        now = found.after
        if found.shape or not found.search.found:
            break
    return {"draw": draw, "steps": steps}


def _said(found: Any) -> dict[str, Any]:
    figures = found.figures
    return {
        "verdict": figures["verdict"],
        "sentence": figures["sentence"],
        "p_value": figures["p_value"],
        "added": figures["effects"],
        "notes": figures["notes"],
        "rounds": figures["rounds"],
    }


def _step(fit: Fit, judges: Trajectories | None, more: dict[str, Any]) -> dict[str, Any]:
    errors = {} if judges is None else {"test": evaluate(fit, judges)}
    return {"program": str(fit.program), "effects": record(fit.program)} | errors | more
