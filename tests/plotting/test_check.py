"""Pictures of a check."""

from __future__ import annotations

import numpy as np
import pytest
from examples import example
from small import simulated

from steady_ppl import Fit, UsageError, check
from steady_ppl.plotting.check import innovations


@pytest.mark.slow
def test_innovations_are_the_checks_standardised_errors() -> None:
    program, data = example("hovercraft"), simulated(rows=30, trajectories=4)
    data.observed[5, 2, 1] = False
    found = check(Fit(program, "hand", known_start=True), data, simulations=20)
    axes = innovations(found, "3")
    lines = axes.get_lines()
    named = [line.get_label() for line in lines if not line.get_label().startswith("_")]
    assert named == [f"bearing_{i}" for i in range(4)] and axes.get_title() == "trajectory 3"
    scores = found.predictions[1].standardised[:, 2, 1].numpy()
    drawn = lines[1].get_ydata()
    assert np.isnan(drawn[4]) and np.array_equal(np.delete(drawn, 4), np.delete(scores, 4))
    with pytest.raises(UsageError, match="no trajectory '9'; there are 1, 2, 3, 4"):
        innovations(found, "9")
