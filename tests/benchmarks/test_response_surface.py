"""Likeliest values of numbers of a program, by a surface through the filter's log p(y)."""

from __future__ import annotations

import pytest
import torch
from examples import drives, example
from oracles import cart_parameters, kalman
from response_surface import NoTop, _surface, move_to_likeliest

from steady_ppl import FilterError

SPACINGS = {"gain": 0.09, "damping": 0.1}


@pytest.mark.exhaustive
def test_numbers_end_where_exact_log_p_is_largest_whatever_they_begin_with():
    """The other numbers are held; curvatures are those of the Kalman filter's log p(y)."""
    cart = example("linear_gaussian")
    data = drives(cart, 12, 61)
    exact = cart_parameters(cart)

    def likelihood(point: torch.Tensor) -> torch.Tensor:
        return kalman(data, exact | dict(zip(SPACINGS, point, strict=True))).log_likelihood.sum()

    ends = []
    for gain, damping in ((1.1, 1.0), (0.9, 0.6)):
        cart.gain, cart.damping = torch.tensor(gain).double(), torch.tensor(damping).double()
        found = move_to_likeliest(cart, data, SPACINGS, known_start=False, particles=20, repeats=1)
        end = torch.tensor([*found.values.values()], dtype=torch.float64, requires_grad=True)
        (slope,) = torch.autograd.grad(likelihood(end), end)
        information = -torch.autograd.functional.hessian(likelihood, end.detach())
        covariance = torch.linalg.inv(information)
        sds = covariance.diagonal().sqrt()
        from_the_top = covariance @ slope / sds  # standard deviations
        assert float(from_the_top.abs().max()) < 0.15
        assert [*found.conditional_sds.values()] == pytest.approx(sds.tolist(), rel=0.1)
        assert found.correlation[0][1] == pytest.approx(float(covariance[0, 1] / sds.prod()), abs=0.1)
        assert cart.gain.item() == pytest.approx(found.values["gain"]) and found.scatter < 0.5
        ends.append(end.detach() / sds)
    assert float((ends[0] - ends[1]).abs().max()) < 0.15


def test_a_surface_that_opens_upwards_leads_to_its_highest_point():
    grid = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0]).double()] * 2)
    saddle = _surface(grid, grid[:, 0] - grid[:, 1].square() + 0.5 * grid[:, 0].square())
    assert saddle.lead.tolist() == [1.5, 0.0] and not saddle.has_top and saddle.scatter < 1e-9
    assert saddle.curvature.diagonal().tolist() == pytest.approx([1.0, -2.0])


def test_a_grid_whose_highest_point_is_its_middle_need_not_have_a_top():
    grid = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0]).double()] * 2)
    ridge = _surface(grid, 0.8 * grid[:, 0] * grid[:, 1] + (grid == 0).all(-1))
    assert not ridge.has_top and ridge.lead.tolist() == [0.0, 0.0]


@pytest.mark.exhaustive
@pytest.mark.parametrize("spacings", [{"gain": 0.01, "damping": 0.01}, {"gain": 0.09, "damping": 1e6}])
def test_without_a_top_the_program_is_left_as_it_was(spacings):
    cart = example("linear_gaussian")
    data = drives(cart, 12, 61)
    cart.gain = torch.tensor(1.5).double()
    before = {name: value.clone() for name, value in cart.state_dict().items()}
    with pytest.raises((NoTop, FilterError)):
        move_to_likeliest(cart, data, spacings, known_start=False, particles=20, repeats=1)
    assert all(torch.allclose(value, before[name]) for name, value in cart.state_dict().items())
