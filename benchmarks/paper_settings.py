"""The settings by which `paper.py` compares the methods; defaults where there are none.

Chosen by held-out log p(y) of development drives, the best mean of two seeds (of four for SVI on the truck), most by
`choose.py`, which prints what was tried (`results/choices.md`). Those of STEADY but its guide, and FitTruth's on the
truck, are in `experiments.py`. Not chosen: on Hov+ FitTV takes the regularisation chosen on Hov and STEADY by the
bootstrap what was chosen for the Gaussian guide; STEADY− takes STEADY's but the ramp.
"""

from __future__ import annotations

from typing import Any

from experiments import FIT_TRUTH_SETTINGS, STEADY_SETTINGS
from paper_records import EXPERIMENTS

LONGER = {"steps": 1500, "validate_every": 150}
CHOSEN: dict[tuple[str, str], dict[str, Any]] = {
    ("svi", "hov+"): {"batch": 32, "steps": 3000, "validate_every": 150},
    ("fit-hand", "hov"): LONGER,
    ("fit-hand", "hov+"): {"weight_decay": 0.3},
    ("fit-hand", "truck"): LONGER | {"weight_decay": 0.3},
    ("fit-tv", "hov"): {"regularization": 1.0, "validate_every": 10, "patience": 15},
    ("fit-tv", "hov+"): {"regularization": 1.0},
    ("fit-tv", "truck"): {"regularization": 0.1, "weight_decay": 0.3, "learning_rate": 2e-3},
}
CHOSEN |= {("steady", experiment): STEADY_SETTINGS["gaussian", experiment] for experiment in EXPERIMENTS}
CHOSEN["steady", "truck"] = STEADY_SETTINGS["lookahead", "truck"] | {"guide": "lookahead"}
CHOSEN |= {
    ("steady-minus", experiment): {
        name: value for name, value in CHOSEN["steady", experiment].items() if name != "ramp"
    }
    for experiment in EXPERIMENTS
}
CHOSEN |= {("steady-bootstrap", experiment): STEADY_SETTINGS["bootstrap", experiment] for experiment in EXPERIMENTS}
CHOSEN |= {("fit-truth", experiment): settings for experiment, settings in FIT_TRUTH_SETTINGS.items()}
CHOSEN["fit-truth", "hov+"] = LONGER | {"weight_decay": 0.3}
