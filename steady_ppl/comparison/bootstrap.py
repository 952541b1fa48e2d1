"""Two programs on the same drives: how sure is the difference of their figures?

The drive is the unit of resampling, since its rows depend on each other, and both programs meet the same drives in
every resample. A figure is computed anew from the sums over the drives that were drawn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import special

RESAMPLES = 2000
COVERAGE = 0.95
MIN_DRIVES = 5  # drives


@dataclass(frozen=True)
class Sums:
    """A mean over cells, or the root of one, from what each drive adds to it.

    Attributes:
        total: `(B,)` sum over the drive's cells.
        count: `(B,)` how many cells they are.
        root: whether the figure is the root of the mean, as of squared errors.
    """

    total: np.ndarray
    count: np.ndarray
    root: bool = False

    @property
    def value(self) -> float | None:
        """The figure; None where there is no cell or it is not finite."""
        value = float(self.of(np.ones((1, len(self.total))))[0])
        return value if math.isfinite(value) else None

    def of(self, weights: np.ndarray) -> np.ndarray:
        """The figure where drives count several times or not at all, `(R,)` for weights `(R, B)`."""
        with np.errstate(all="ignore"):
            mean = (weights @ self.total) / (weights @ self.count)
        return np.sqrt(mean) if self.root else mean

    def among(self, drives: np.ndarray) -> Sums:
        """Of some drives."""
        return Sums(self.total[drives], self.count[drives], self.root)


@dataclass(frozen=True)
class Change:
    """A difference with its 95 % interval.

    Attributes:
        value: the one program's figure less the other's.
        interval: its ends.
        relative: the same divided by the other's figure, with `relative_interval`; None where that is zero.
    """

    value: float
    interval: tuple[float, float]
    relative: float | None = None
    relative_interval: tuple[float, float] | None = None

    @property
    def sign(self) -> int:
        """1 or −1 where the interval lies above or below zero, else 0."""
        low, high = self.interval
        return int(low > 0) - int(high < 0)


def paired(ours: Sums, theirs: Sums, *, seed: int) -> Change | None:
    """The difference between two figures of the same drives.

    The interval is between percentiles of the resampled differences, at levels that make it as wide as Student's for
    a mean of few drives (Hesterberg 2015, The American Statistician 69, section 5.3, the expanded percentile interval).

    Args:
        ours, theirs: of the same drives.
        seed: of the resampling.

    Returns:
        None where fewer than 5 drives have such a figure, or where it is not finite.
    """
    both = (ours.count > 0) & (theirs.count > 0)
    if both.sum() < MIN_DRIVES:
        return None
    ours, theirs = ours.among(both), theirs.among(both)
    drives = int(both.sum())
    drawn = np.random.default_rng([seed, drives]).multinomial(drives, np.full(drives, 1 / drives), RESAMPLES)
    weights = np.concatenate([np.ones((1, drives)), drawn])
    one, other = ours.of(weights), theirs.of(weights)
    if not np.isfinite(one).all() or not np.isfinite(other).all():
        return None
    difference = one - other
    change = Change(float(difference[0]), _interval(difference[1:], drives))
    if not (other > 0).all():
        return change
    ratio = difference / other
    return Change(change.value, change.interval, float(ratio[0]), _interval(ratio[1:], drives))


def _interval(values: np.ndarray, drives: int) -> tuple[float, float]:
    student = special.stdtrit(drives - 1, (1 - COVERAGE) / 2)
    tail = special.ndtr(student * math.sqrt(drives / (drives - 1)))
    low, high = np.quantile(values, [tail, 1 - tail])
    return float(low), float(high)
