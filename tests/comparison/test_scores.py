"""Paired intervals of sums over drives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from steady_ppl.comparison.scores import Sums, paired


def test_the_interval_of_a_mean_is_nearly_students():
    for count in (8, 30):
        values, other = np.random.default_rng(3).normal(size=(2, count))
        ones = np.ones(count)
        found = paired(Sums(values, ones), Sums(other, ones), seed=0)
        low, high = stats.t.interval(0.95, count - 1, (values - other).mean(), stats.sem(values - other))
        assert found.difference == pytest.approx((values - other).mean())
        assert found.interval == pytest.approx((low, high), abs=0.12 * (high - low))


def test_drives_weigh_by_their_cells():
    ours, theirs = np.array([4.0, 4, 4, 4, 36]), np.ones(5)
    counts = np.array([1.0, 1, 1, 1, 9])
    found = paired(Sums(ours, counts, root=True), Sums(theirs * counts, counts, root=True), seed=0)
    assert found.difference == pytest.approx(1) and found.interval == pytest.approx((1, 1))
    assert found.relative == pytest.approx(1)


def test_a_figure_of_too_few_drives_or_not_finite_has_no_interval():
    ones = np.ones(6)
    few = Sums(ones, np.array([1.0, 1, 1, 1, 0, 0]))
    assert paired(few, Sums(ones, ones), seed=0) is None
    blown = Sums(np.array([1.0, 1, 1, 1, 1, np.inf]), ones)
    assert paired(blown, Sums(ones, ones), seed=0) is None and blown.value is None
