"""The bound on what drives tell of a program's numbers."""

from __future__ import annotations

import math

import pytest
import torch
from examples import drives, example
from information_bound import information_bound
from oracles import cart_parameters, kalman


@pytest.mark.exhaustive
def test_the_bound_of_a_linear_program_is_kalmans() -> None:
    """The gain moves the measurements' mean in proportion: minus the second difference of log p(y) in it is its
    information, whatever was measured, and at a gain of one that of its logarithm, which is what is learned."""
    cart = example("linear_gaussian")
    for name, value in cart.named_parameters():
        value.requires_grad_(name == "gain_unconstrained")
    data = drives(cart, 150, 12)
    values = cart_parameters(cart)

    def likelihood(gain: float) -> float:
        return float(
            kalman(data, values | {"gain": torch.tensor(gain).double()}, known_start=True).log_likelihood.sum()
        )

    information = (2 * likelihood(1.0) - likelihood(1.5) - likelihood(0.5)) / 0.25 / len(data) * 16
    bound, sd = information_bound(cart, data, "gain_unconstrained", drives=16, draws=50)
    assert sd < 0.15 * bound and abs(bound - 1 / math.sqrt(information)) < 3 * sd
