"""Whether every filter's p(y) is right on average.

A particle filter's estimate of p(y), not of its logarithm, is unbiased with any number of particles (Del Moral 2004,
section 7.4.1). The cart's exact value is that of its linearisation, which is the cart itself. The other programs have
none: there the estimates are held against those of the filter that looks ahead with 4,000 particles, the least
scattered. SVI's guides estimate p(y) by importance sampling, a draw at a time.
"""

from __future__ import annotations

import math
from functools import cache

import torch
from calibration_states import problem
from calibration_variational import FAMILIES, log_weights
from references import runs
from torch import Tensor

from steady_ppl import Program, Trajectories, run_filter, seeded
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.model.problem import Problem

FILTERS = {
    "bootstrap 200": (200, False),
    "bootstrap 4000": (4000, False),
    "lookahead 100": (100, True),
    "lookahead 1000": (1000, True),
}
ESTIMATORS = (*FILTERS, *FAMILIES)
FINE, COUNT = 4000, 1000
DRAWS_A_RUN = 20  # of SVI's guides, whose draws cost less than a filter's run


@cache
def drive(name: str) -> tuple[Program, Trajectories]:
    """A program and one of its drives."""
    program, data = problem(name, 1, 2)
    return program, data.without_truth()


def estimates(name: str, particles: int, look_ahead: bool, count: int) -> Tensor:
    """log p(y) by independent runs, `(R,)`."""
    program, data = drive(name)
    with seeded("evidence", particles, look_ahead):
        found = run_filter(
            program,
            runs(data, count),
            particles=particles,
            known_start=False,
            look_ahead=look_ahead,
            keep_history=False,
        )
    return found.log_likelihood.double()


def mean_and_error(log_values: Tensor, about: float) -> tuple[float, float]:
    """Of p(y) / exp(about)."""
    ratio = (log_values - about).exp()
    return float(ratio.mean()), float(ratio.std() / math.sqrt(len(ratio)))


def unbiased(name: str, which: str, count: int = COUNT) -> dict:
    """An estimator's mean p(y) over the exact or the finest, and how many standard errors it is off."""
    torch.set_num_threads(1)
    program, data = drive(name)
    with seeded("evidence", "linearised"):  # its starts are drawn
        linear = float(find_and_smooth(Problem(program, data)).log_likelihood)
    error, about = 0.0, linear
    if name != "cart":
        fine = estimates(name, FINE, True, max(8, count // 10))
        about = float(fine.logsumexp(0)) - math.log(len(fine))
        error = mean_and_error(fine, about)[1]
    if which in FAMILIES:
        with seeded("evidence", which):
            found = log_weights(program, FAMILIES[which], data, DRAWS_A_RUN * count)
    else:
        found = estimates(name, *FILTERS[which], count)
    ratio, own = mean_and_error(found, about)
    return {
        "ratio": ratio,
        "error": math.hypot(own, error),
        "standard_errors": (ratio - 1) / math.hypot(own, error),
        "sd_nats": float(found.std()),
        "linearised_off_nats": linear - about,
    }
