"""Whether ranks are uniform, and how often an interval holds the truth."""

from __future__ import annotations

import math

import numpy as np
from scipy import stats

BINS = 20


def ranks(truth: np.ndarray, draws: np.ndarray) -> np.ndarray:
    """How many draws `(M, ...)` lie below each truth `(...)`, 0 to M.

    Uniform where the truth and the draws come from one distribution and the draws are independent (Talts, Betancourt,
    Simpson, Vehtari and Gelman 2018, Validating Bayesian Inference Algorithms with Simulation-Based Calibration).
    """
    return (draws < truth).sum(0)


def uniform(found: np.ndarray, draws: int) -> float:
    """The p-value of chi-squared in `BINS` bins of ranks `(R,)` among M draws; M + 1 is a multiple of `BINS`."""
    if (draws + 1) % BINS:
        raise ValueError(f"{draws} draws leave bins of different sizes: one less than a multiple of {BINS}")
    counts = np.bincount(found * BINS // (draws + 1), minlength=BINS)
    return float(stats.chisquare(counts).pvalue)


def together(p_values: np.ndarray) -> float:
    """One p-value of many, whatever their dependence: the Cauchy combination (Liu and Xie 2020, JASA 115:393)."""
    p = np.clip(np.ravel(p_values), 1e-300, 1 - 1e-12)
    scores = np.where(p > 1e-10, np.tan((0.5 - p) * math.pi), 1 / (p * math.pi))
    return float(stats.cauchy.sf(scores.mean()))


def inside(found: np.ndarray, draws: int, share: float) -> np.ndarray:
    """Whether ranks lie in the central interval that holds a share of the draws.

    Ends lie between draws, so the interval holds a whole number of the M + 1 gaps; the share is met to within one.
    """
    outside = round((1 - share) / 2 * (draws + 1))
    return (found >= outside) & (found <= draws - outside)


def near(values: np.ndarray, share: float) -> tuple[str, bool]:
    """The mean of independent shares `(R,)` with its standard error, and whether `share` is within three of them."""
    mean, error = float(values.mean()), float(values.std(ddof=1) / math.sqrt(len(values)))
    return f"{mean:.1%} ± {error:.1%}", abs(mean - share) <= 3 * error
