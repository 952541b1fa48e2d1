"""Residuals beside those of the program's own drives."""

from __future__ import annotations

import numpy as np
from scipy import stats

from steady_ppl.criticism.residual_maps import _adjusted


def test_adjusted_p_values_are_scipys():
    p_values = np.random.default_rng(0).uniform(0, 1, 300).round(2) ** 2
    np.testing.assert_allclose(_adjusted(p_values), stats.false_discovery_control(p_values), rtol=1e-12)
