"""Drives of a vehicle that is not as its file says."""

from __future__ import annotations

import pytest
import torch
from examples import example

import steady_ppl as st


@pytest.fixture(scope="module")
def lighter() -> tuple[st.Trajectories, st.Trajectories]:
    """A hovercraft that is lighter and less noisy than its file says."""
    truth = example("hovercraft", torch.float32)
    truth.mass, truth.noise = torch.tensor(1.2), torch.tensor([0.08, 0.08, 0.05])
    truth.duration = 6.0
    return st.simulate(truth, 10, seed=1), st.simulate(truth, 6, seed=2)
