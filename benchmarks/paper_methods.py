"""The paper's methods, as `paper.py` runs them."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiments import ROOT, Split
from resumable import digest

from inference import fit_hand, fit_truth, fit_tv, hand, steady, steady_minus, svi
from models.paper import (
    PaperHovercraft,
    PaperHovercraftTruth,
    PaperNeuralHovercraft,
    PaperNeuralTruck,
    PaperTruck,
)
from steady_ppl import Fit, Trajectories, for_program, log_likelihood, seeded
from steady_ppl.comparison.evaluate import state_estimation
from steady_ppl.errors import FilterError

Settings = dict[str, Any]
RECIPES: dict[str, Callable[..., Fit]] = {
    "hand": hand.fit,
    "fit-hand": fit_hand.fit,
    "fit-tv": fit_tv.fit,
    "svi": svi.fit,
    "steady": steady.fit,
    "steady-minus": steady_minus.fit,
    "steady-bootstrap": steady.fit,
    "fit-truth": fit_truth.fit,
    "truth": hand.fit,
}
OF_ITS_OWN: dict[str, Settings] = {
    "steady": {"guide": "gaussian"},
    "steady-bootstrap": {"guide": "bootstrap"},
}
PROGRAMS = {"hov": (PaperHovercraft, PaperNeuralHovercraft), "truck": (PaperTruck, PaperNeuralTruck)}
LINEAGES = {"hov": 8, "hov+": 1, "truck": 7}  # as the authors


def learnt(method: str, experiment: str, data: Split, seed: int, settings: Settings) -> Fit:
    """One method's fit to the train and valid drives, known start."""
    train, valid, _ = data
    own, network = PROGRAMS["truck" if experiment == "truck" else "hov"]
    with seeded(seed, "program"):
        program = {"hand": own, "truth": PaperHovercraftTruth}.get(method, network)()
    if method in ("hand", "truth"):
        return RECIPES[method](program, train, valid, known_start=True, seed=seed)
    if method != "fit-truth":
        train, valid = (part.without_truth(keep_start=True) for part in (train, valid))
    options = OF_ITS_OWN.get(method, {}) | settings
    if method == "fit-hand":
        options = {"hand": own(), "lineages": LINEAGES[experiment]} | options
    return RECIPES[method](program, train, valid, known_start=True, seed=seed, progress=False, **options)


def named(method: str, experiment: str, seed: int, settings: Settings) -> str:
    """Under what a fit's record is kept."""
    return " ".join([experiment, method, str(seed), *told(settings)])


def told(settings: Settings) -> list[str]:
    """NAME=VALUE of each setting."""
    return [f"{name}={value if isinstance(value, str) else format(value, 'g')}" for name, value in settings.items()]


def by_bootstrap(fit: Fit, table: Trajectories, particles: int = 20_000) -> dict[str, Any]:
    """What the filter that looks ahead is held against; where this one fails, no numbers and why."""
    data, settings = for_program(fit.program, table), {"particles": particles, "known_start": fit.known_start}
    with seeded("bootstrap"):
        try:
            likelihood = float(log_likelihood(fit.program, data, **settings).mean())
            return {"log_likelihood": likelihood, "state_estimation": state_estimation(fit.program, data, **settings)}
        except FilterError as error:
            none = {"location": math.nan, "angle": math.nan}
            return {"log_likelihood": math.nan, "state_estimation": none, "why_not": str(error)}


SOURCE = [ROOT / room for room in ("steady_ppl", "models", "inference")]
VERSION = digest(*SOURCE, files=[Path(__file__), Path(__file__).with_name("experiments.py")])
