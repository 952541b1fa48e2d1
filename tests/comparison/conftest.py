"""A cart and drives of it."""

import pytest
import torch
from examples import drives, example


@pytest.fixture(scope="module")
def cart():
    return example("linear_gaussian").requires_grad_(False)


@pytest.fixture(scope="module")
def still():
    """A cart whose noise is next to nothing: from a known start its filter is a plain recursion."""
    program = example("linear_gaussian").requires_grad_(False)
    program.noise = torch.tensor(1e-9, dtype=torch.float64)
    return program


@pytest.fixture(scope="module")
def data(cart):
    return drives(cart, 4, 24, gaps=True)
