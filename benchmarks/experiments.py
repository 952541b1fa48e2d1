"""The paper's experiments in pieces: data, the four programs, what was published.

The paper's world and its programs take its authors' explicit Euler step, by the names of `models/paper.py`.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from inference import fit_truth, hand, steady  # noqa: E402
from models.paper import (  # noqa: E402
    PaperHovercraft,
    PaperHovercraftTruth,
    PaperNeuralHovercraft,
    PaperNeuralTruck,
    PaperTruck,
)
from steady_ppl import Fit, PlanarVehicle, Trajectories, seeded, simulate  # noqa: E402
from steady_ppl.datasets.alpha_truck import read_alpha_truck  # noqa: E402

# Chosen by held-out log p(y): on Hov with simulated drives of the seeds 101 to 104, on the truck with the valid split,
# draws 11 and 12 of the bearings. The truck's ramp ends at an observation weight of .35 (tried: ramps of 1, 3 and 8
# trainings for the bootstrap, 1.5 and 3 for the Gaussian guide, equal within .3 nats): white noise cannot hold what the
# controls do with a lag, at full weight it grows to cover that; the paper's best parameters come from weights near .1.
# The bootstrap on the truck: 300 or 1000 particles. The network's decays (hidden .3, 1, 3; noise .1, 3 on the truck;
# hidden 10, 40, noise .1, 10, skip .1, 1 on Hov) are in `models/neural_vehicle.py`. Hov+: 250 steps with a decay of 1
# or 400 with .3, equal within .02 nats.
STEADY_SETTINGS: dict[tuple[str, str], dict] = {
    ("bootstrap", "hov"): {},
    ("bootstrap", "truck"): {"particles": 1000, "steps": 160, "ramp": 3.0},
    ("gaussian", "hov"): {},
    ("gaussian", "hov-mechanistic"): {"learning_rate": 2e-2},
    ("gaussian", "hov+"): {"batch": 32, "steps": 400, "weight_decay": 0.3, "validate_every": 40},
    ("gaussian", "truck"): {"ramp": 3.0, "steps": 160},
}
STEADY_SETTINGS |= {("lookahead", e): s for (guide, e), s in STEADY_SETTINGS.items() if guide == "gaussian"}
STEADY_SETTINGS |= {("bootstrap", e): STEADY_SETTINGS["gaussian", e] for e in ("hov-mechanistic", "hov+")}  # not chosen
# Likewise: a decay of .3 or 1, 500 or 1500 steps. The longer training has the same log p(y) on the valid split (34.1
# against 33.9, 34.5 against 34.7, draws 11 and 12) and the smaller error of its true states (.142 m against .152).
FIT_TRUTH_SETTINGS: dict[str, dict] = {"hov": {}, "truck": {"weight_decay": 0.3, "steps": 1500, "validate_every": 150}}
LOGS = ROOT.parent / "shared" / "data" / "alpha_truck"
Split = tuple[Trajectories, Trajectories, Trajectories]


@dataclass(frozen=True)
class Condition:
    """What is seen of the drives; the drives themselves are the same.

    Attributes:
        degrees: standard deviation of the bearings.
        landmarks: how many of the declared ones the program sees, the first; all when None.
        every: measurements of every n-th row only.
    """

    degrees: float = 5.0
    landmarks: int | None = None
    every: int = 1

    def of(self, vehicle: PlanarVehicle) -> PlanarVehicle:
        """The vehicle, made to see so."""
        vehicle.landmarks, vehicle.bearing_sd = vehicle.landmarks[: self.landmarks], math.radians(self.degrees)
        return vehicle


SIZES = {"hov": (16, 16, 32), "hov-mechanistic": (16, 16, 32), "hov+": (160, 32, 32)}  # train, valid, test
STANDARD = Condition()
CONDITIONS = {
    "standard": STANDARD,
    "1hz": Condition(every=10),
    "two-landmarks": Condition(landmarks=2),
    "1.25deg": Condition(degrees=1.25),
    "20deg": Condition(degrees=20),
}


def hov(
    seed: int,
    train: int = 16,
    valid: int = 16,
    test: int = 32,
    condition: Condition = STANDARD,
    truth: type[PlanarVehicle] = PaperHovercraftTruth,
) -> Split:
    """Hov (train 16) or Hov+ (train 160, valid 32): train, valid and test drives of one data seed."""
    world = condition.of(truth())
    sizes = enumerate((train, valid, test), 1)
    return tuple(  # type: ignore
        simulate(world, size, seed=10 * seed + part).observed_every(condition.every) for part, size in sizes
    )


def truck(folder: Path, seed: int, condition: Condition = STANDARD, *, centred: bool = False) -> Split:
    """The AlphaTruck logs with one draw of the bearings; `centred` velocities are those of a row, the authors' those of
    half a row later."""
    return tuple(  # type: ignore
        read_alpha_truck(folder / split, seed=seed, sigma_degrees=condition.degrees, centred=centred).observed_every(
            condition.every
        )
        for split in ("train", "valid", "test")
    )


def learn(
    method: str, vehicle: str, data: Split, seed: int, *, guide: str = "bootstrap", progress: bool = False
) -> Fit:
    """Fit one method to the train and valid drives, known start, as the paper does."""
    torch.set_num_threads(1)
    train, valid, _ = data
    network = PaperNeuralHovercraft if vehicle == "hov" else PaperNeuralTruck
    own = PaperHovercraft if vehicle == "hov" else PaperTruck
    with seeded(seed, "program"):
        program = {"steady": network, "fit-truth": network, "hand": own, "truth": PaperHovercraftTruth}[method]()
    if method == "steady":
        bearings_only = tuple(part.without_truth(keep_start=True) for part in (train, valid))
        return steady.fit(
            program,
            *bearings_only,
            guide=guide,
            known_start=True,
            seed=seed,
            progress=progress,
            **STEADY_SETTINGS[guide, vehicle],
        )
    if method == "fit-truth":
        return fit_truth.fit(
            program, train, valid, known_start=True, seed=seed, progress=progress, **FIT_TRUTH_SETTINGS[vehicle]
        )
    return hand.fit(program, train, valid, known_start=True, seed=seed)
