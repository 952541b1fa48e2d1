"""Tests of uniformity notice what they must."""

from __future__ import annotations

import numpy as np
import pytest
from uniformity import inside, near, ranks, together, uniform

DRAWS, DRIVES = 99, 1000


def p_value(offset: float = 0.0, scale: float = 1.0, seed: int = 1) -> float:
    """Of truths beside draws that are off by an offset and a factor."""
    random = np.random.default_rng(seed)
    truth, draws = random.normal(size=DRIVES), offset + scale * random.normal(size=(DRAWS, DRIVES))
    return uniform(ranks(truth, draws), DRAWS)


def test_ranks_are_uniform_only_where_draws_are_right():
    assert np.mean([p_value(seed=seed) < 0.05 for seed in range(200)]) < 0.05 + 4 * np.sqrt(0.05 * 0.95 / 200)
    assert p_value(offset=0.3) < 1e-6
    assert p_value(scale=0.7) < 1e-6
    assert p_value(scale=1.4) < 1e-6


def test_ranks_must_fall_into_equal_bins():
    with pytest.raises(ValueError, match="multiple of 20"):
        uniform(np.zeros(10, dtype=int), 50)


def test_many_p_values_are_one_however_they_depend():
    random = np.random.default_rng(2)
    alone, alike = random.uniform(size=(400, 30)), np.repeat(random.uniform(size=(400, 1)), 30, 1)
    for values in (alone, alike):
        assert np.mean([together(row) < 0.05 for row in values]) < 0.05 + 4 * np.sqrt(0.05 * 0.95 / 400)
    assert together(np.array([1e-12, *[0.5] * 30])) < 1e-9
    assert 0 < together(np.zeros(3)) < 1e-200 and together(np.ones(3)) > 0.99


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_an_interval_holds_its_share_of_uniform_ranks(share):
    assert inside(np.arange(DRAWS + 1), DRAWS, share).mean() == pytest.approx(share, abs=2 / (DRAWS + 1))


def test_a_share_is_near_within_three_standard_errors():
    values = np.repeat([0.0, 1.0], [10, 90])
    assert near(values, 0.9) == ("90.0% ± 3.0%", True)
    assert not near(values, 0.5)[1]
