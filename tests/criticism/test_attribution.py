"""Who is at fault, of figures that are drawn here."""

from __future__ import annotations

import numpy as np

from steady_ppl.criticism.attribution import Scored, attribute
from steady_ppl.criticism.check import _scatter
from steady_ppl.criticism.residual_maps import Residuals

SETS, REPEATS, LEVEL = 100, 1000, 0.001


def p_value_of_noise(seed: int, log_sd: float) -> float:
    """Of a right model whose noise a fit leaves open by a factor: the real set is one of the simulated."""
    random = np.random.default_rng(seed)
    scale = np.exp(random.normal(0, log_sd, (1 + SETS, 1, 1, 1)))
    values = scale * random.normal(size=(1 + SETS, 20, 5, 1))
    residuals = Residuals(["speed"], values, np.ones(values.shape, bool))
    scores = Scored(["dynamics"], ["push"], random.normal(size=(1 + SETS, 1)), np.eye(1), np.ones((1 + SETS, 1)))
    return attribute(scores, scores, _scatter(residuals), random.uniform(size=1 + SETS)).p_values["noise"]


def test_noise_that_a_fit_leaves_open_is_reported_at_the_nominal_rate() -> None:
    for log_sd in (0.0, 0.6):
        reported = sum(p_value_of_noise(seed, log_sd) <= LEVEL for seed in range(REPEATS))
        assert reported <= LEVEL * REPEATS + 3 * (LEVEL * (1 - LEVEL) * REPEATS) ** 0.5  # of the number of repeats
