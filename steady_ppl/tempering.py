"""Schedules of the observation weight (w_obs in STEADY)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from steady_ppl.errors import require


class Tempering(Protocol):
    """A schedule of the observation weight."""

    def __call__(self, progress: float) -> float:
        """The weight at `progress` through the training, 0 to 1."""
        ...


@dataclass(frozen=True)
class Constant:
    """The same weight throughout; 1 is STEADY− (no tempering)."""

    weight: float = 1.0

    def __call__(self, progress: float) -> float:
        return self.weight


@dataclass(frozen=True)
class LinearRamp:
    """From `first` to 1 over the first `share` of the training; the paper ramps from 0.001 over all of it.
    A share of 0 is no ramp."""

    first: float = 0.001
    share: float = 1.0

    def __post_init__(self) -> None:
        require(0 <= self.first < math.inf, "the first weight", self.first, "0 or more")
        require(0 <= self.share < math.inf, "the ramp's share of the training", self.share, "0 or more")

    def __call__(self, progress: float) -> float:
        return self.first + (1 - self.first) * min(1.0, progress / self.share) if self.share > 0 else 1.0
