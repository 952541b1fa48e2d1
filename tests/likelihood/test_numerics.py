"""Where arithmetic is hard: noise and sensors that vanish, a landmark underfoot, many drives, short numbers."""

from __future__ import annotations

import math

import pytest
import torch
from examples import drives, example
from oracles import cart_parameters, kalman

import steady_ppl as st
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.model.problem import Problem

TRUTH = "hovercraft:HovercraftTruth"


def judged(
    program: st.Program, data: st.Trajectories, *, look_ahead: bool = True, particles: int = 200
) -> torch.Tensor:
    """log p(y) of each drive."""
    with st.seeded("numerics"):
        return st.log_likelihood(program, data, particles=particles, known_start=False, look_ahead=look_ahead, every=1)


@pytest.fixture(scope="module")
def data() -> st.Trajectories:
    return drives(example(TRUTH), 4, 101)


def quiet(sd: float, dtype: torch.dtype = torch.float64) -> st.Program:
    """The hovercraft with hardly any noise."""
    program = example(TRUTH, dtype).requires_grad_(False)
    program.noise_unconstrained.fill_(math.log(sd) if sd else -math.inf)
    return program


# --- noise that vanishes ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_as_noise_vanishes_the_likelihood_has_a_limit():
    data = drives(quiet(1e-4), 4, 101)
    limit = judged(quiet(1e-8), data)
    assert torch.isfinite(limit).all()
    for sd in (1e-6, 1e-10, 1e-12):
        assert (judged(quiet(sd), data) - limit).abs().max() < 0.1


@pytest.mark.slow
def test_no_noise_at_all_is_said(data):
    with pytest.raises(st.FilterError, match=r"log p\(y\) is not finite"):
        judged(quiet(0.0), data)


@pytest.mark.parametrize("sd", [1e-2, 1e-4, 1e-6])
def test_a_sensor_that_is_nearly_exact_leaves_the_smoother_exact(sd):
    """The smoother's information form on the cart, whose Kalman filter is the judge; it has itself no digit left where
    a sensor is 1e8 times as sharp as what is known before."""
    cart = example("linear_gaussian").requires_grad_(False)
    cart.measurement_sd = torch.tensor(sd, dtype=torch.float64)
    data = drives(cart, 3, 40)
    found = find_and_smooth(Problem(cart, data)).log_likelihood
    torch.testing.assert_close(found, kalman(data, cart_parameters(cart)).log_likelihood, rtol=1e-6, atol=1e-6)


# --- a landmark underfoot ---------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("look_ahead", [True, False])
def test_a_vehicle_that_stands_on_a_landmark_has_a_likelihood(look_ahead):
    class Over(type(example(TRUTH))):
        landmarks = ((0.0, 0.0), (12.0, -8.0), (-6.0, -4.0))

        def initial(self):
            super().initial()
            return torch.zeros(6).to(self.noise)

    program = Over().double().requires_grad_(False)
    table = st.simulate(program, 4, seed=1)
    assert (table.states[0] == 0).all() and torch.isfinite(table.measurements).all()
    found = st.log_likelihood(
        program, st.for_program(program, table), particles=500, known_start=True, look_ahead=look_ahead, every=1
    )
    assert torch.isfinite(found).all()


# --- long, many, short numbers ----------------------------------------------------------------------------------------


def test_single_precision_agrees_with_double(data):
    """By less than what twenty of the filter's particles scatter, and paths by a hundredth of their uncertainty."""
    single, double = example(TRUTH, torch.float32), example(TRUTH, torch.float64)
    ahead = {}
    for program in (single, double):
        with st.seeded("numerics"):
            ahead[program] = find_and_smooth(Problem(program, st.for_program(program, data)))
    assert (ahead[single].log_likelihood - ahead[double].log_likelihood).abs().max() < 0.05
    paths = [ahead[program].means()[0].double() for program in (single, double)]
    spread = ahead[double].covariances()[0].diagonal(dim1=-2, dim2=-1).double().sqrt()
    apart = paths[0] - paths[1]
    apart[..., 2] -= 2 * math.pi * (apart[0, :, 2] / (2 * math.pi)).round()  # whole turns are no difference
    assert (apart.abs() / spread).max() < 0.01


@pytest.mark.slow
def test_a_thousand_drives_are_judged_like_four():
    program = example(TRUTH, torch.float32)
    many = drives(program, 1000, 21)
    found = judged(program, many, particles=100)
    assert found.shape == (1000,) and torch.isfinite(found).all()
    few = judged(program, many.subset(torch.arange(4)), particles=100)
    assert (found[:4] - few).abs().max() < 0.2


@pytest.mark.exhaustive
def test_ten_thousand_rows_are_no_other_than_a_thousand():
    """A row's log p(y), by the scatter of twenty drives of a thousand rows; shorter ones feel their unknown start."""
    program = example(TRUTH, torch.float32)
    found = float(judged(program, drives(program, 1, 10_000), particles=100)[0]) / 10_000
    shorter = judged(program, drives(program, 20, 1001, seed=2), particles=100) / 1001
    assert abs(found - float(shorter.mean())) < 4 * float(shorter.std()) * math.sqrt(1 / 20 + 1001 / 10_000)
