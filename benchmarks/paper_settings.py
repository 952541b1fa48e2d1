"""The settings by which `paper.py` compares the methods; defaults where there are none.

Chosen by held-out log p(y) of development drives: those of SVI, FitHand and FitTV by `choose.py`, which prints what was
tried (`results/choices.md`); those of STEADY and FitTruth are in `experiments.py`. On Hov+ STEADY's steps and decay and
FitTruth's were chosen there, by its own development drives; SVI, FitHand and FitTV take what was chosen on Hov, SVI in
batches.
"""

from __future__ import annotations

from typing import Any

from experiments import FIT_TRUTH_SETTINGS, STEADY_SETTINGS

EXPERIMENTS = ("hov", "hov+", "truck")
LONGER = {"steps": 1500, "validate_every": 150}
CHOSEN: dict[tuple[str, str], dict[str, Any]] = {
    ("svi", "hov+"): {"batch": 32},
    ("fit-hand", "hov"): LONGER,
    ("fit-hand", "hov+"): LONGER,
    ("fit-hand", "truck"): LONGER | {"weight_decay": 0.3},
    ("fit-tv", "hov"): {"regularization": 1.0},
    ("fit-tv", "hov+"): {"regularization": 1.0},
    ("fit-tv", "truck"): {"regularization": 0.1},
}
CHOSEN |= {("steady", experiment): STEADY_SETTINGS["gaussian", experiment] for experiment in EXPERIMENTS}
CHOSEN |= {
    ("steady-minus", experiment): {
        name: value for name, value in CHOSEN["steady", experiment].items() if name != "ramp"
    }
    for experiment in EXPERIMENTS
}
CHOSEN |= {("steady-bootstrap", experiment): STEADY_SETTINGS["bootstrap", experiment] for experiment in EXPERIMENTS}
CHOSEN |= {("fit-truth", experiment): settings for experiment, settings in FIT_TRUTH_SETTINGS.items()}
CHOSEN["fit-truth", "hov+"] = LONGER | {"weight_decay": 0.3}
