"""Curves of a variable: their heights, their slopes and their prior."""

from __future__ import annotations

import math

import pytest
import torch
from examples import example

from steady_ppl.discovery.curves import (
    HEIGHT_SD,
    _effect,
    by_height,
    height,
    knots_of,
    prior_covariance,
    variables,
)


def test_a_curve_is_straight_between_its_knots():
    knots, heights = (0.0, 1.0, 2.0, 3.0), torch.tensor([0.0, 2.0, -1.0, 1.0]).double()
    at = torch.tensor([-5.0, 0.0, 0.5, 1.75, 3.0, 9.0]).double()
    expected = torch.tensor([0.0, 0.0, 1.0, -0.25, 1.0, 1.0]).double()
    torch.testing.assert_close(height(at, knots, False, heights), expected)


def test_a_curve_over_an_angle_closes():
    knots = knots_of(torch.zeros(1), circular=True)
    heights = torch.randn(len(knots), generator=torch.Generator().manual_seed(0)).double()
    at = torch.linspace(-3, 3, 50).double()
    torch.testing.assert_close(height(at, knots, True, heights), height(at + 4 * math.pi, knots, True, heights))
    just = torch.tensor([math.pi - 1e-9, math.pi + 1e-9]).double()
    assert height(just, knots, True, heights).diff().abs() < 1e-7


def test_heights_have_the_slopes_that_autograd_finds():
    random = torch.Generator().manual_seed(2)
    values, weights = torch.randn(3, 7, 5, generator=random).double(), torch.randn(3, 7, 5, generator=random).double()
    for circular, knots in ((False, (-1.0, -0.5, 0.0, 0.5, 1.0)), (True, knots_of(torch.zeros(1), True))):
        heights = torch.zeros(len(knots), dtype=torch.float64, requires_grad=True)
        whole = (weights * height(values, knots, circular, heights)).sum((0, 1))
        expected = torch.stack([torch.autograd.grad(one, heights, retain_graph=True)[0] for one in whole])
        torch.testing.assert_close(by_height(values, weights, knots, circular), expected)


def test_a_place_that_is_not_a_number_has_none():
    for circular in (False, True):
        slopes = by_height(torch.tensor([[torch.nan, 0.5]]), torch.ones(1, 2), (0.0, 1.0), circular)
        assert torch.isnan(slopes).any(-1).tolist() == [True, False]


def test_curves_may_depend_on_everything_that_a_program_declares():
    program = example("hovercraft")
    state, control, time = torch.randn(6).double(), torch.ones(2).double(), torch.zeros(()).double()
    found = variables(program, state, control, time, {"yaw": torch.ones(()).double()})
    assert set(program.states[0].split()[:1]) <= found.keys()
    assert {
        "heading",
        "forward velocity",
        "forward velocity × yaw velocity",
        "left",
        "commanded yaw",
        "time",
    } <= found.keys()
    pendulum = example("pendulum")
    assert set(variables(pendulum, torch.ones(2), torch.ones(1), time, {})) == {"angle", "rate", "torque", "time"}
    pendulum.resting = ("angle [rad]",)
    assert set(variables(pendulum, torch.ones(2), torch.ones(1), time, {})) == {"rate", "torque", "time"}


def test_a_variable_that_stands_still_has_no_knots():
    assert knots_of(torch.full((100,), 2.0), circular=False) is None


def test_the_prior_of_a_curve_is_a_normal_with_its_covariance():
    effect = _effect("push", "x", [-2.0, 0.0, 1.0, 4.0], 0.3, "m/s²", False)
    covariance = prior_covariance(effect)
    heights = torch.tensor([0.1, -0.4, 0.2, 0.7])
    whole = torch.distributions.MultivariateNormal(torch.zeros(4).double(), covariance)
    assert float(effect.prior.log_prob(heights)) == pytest.approx(float(whole.log_prob(heights.double())), abs=1e-3)
    assert covariance.diagonal().sqrt().tolist() == pytest.approx([HEIGHT_SD * 0.3] * 4, rel=1e-3)


@pytest.mark.parametrize("circular", [False, True])
def test_a_curve_is_straight_between_its_knots_round_a_circle_too(circular: bool):
    knots, heights = (-1.0, 0.0, 1.0, 2.0), torch.tensor([1.0, 3.0, -2.0, 0.5])
    values = torch.tensor([-9.0, -1.0, -0.5, 0.0, 0.25, 1.5, 2.0, 2.5, float("nan")])
    expected = torch.tensor([1.0, 1.0, 2.0, 3.0, 1.75, -0.75, 0.5, 0.5])
    if circular:  # a turn is four: after the last knot comes the first
        expected = torch.tensor([1.0, 1.0, 2.0, 3.0, 1.75, -0.75, 0.5, 0.75])
    found = height(values, knots, circular, heights)
    torch.testing.assert_close(found[:-1], expected)
    assert bool(found[-1].isnan())
