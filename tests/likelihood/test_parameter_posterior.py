"""Draws of parameters: those of a posterior that is known, and what is said where they cannot be trusted."""

from __future__ import annotations

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import example
from pyro.distributions import constraints
from pyro.nn import PyroParam

import steady_ppl as st


class Drift(st.Program):
    """A position that drifts at an unknown rate, seen at once: the rate's posterior is that of a regression."""

    states = ("position [m]",)
    measurements = ("position [m]",)
    channels = ("step [m]",)
    duration, step = 2.0, 0.1

    def __init__(self) -> None:
        super().__init__()
        self.rate = PyroParam(torch.tensor(0.5))

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(1), torch.ones(1)).to_event(1))

    def transition(self, state, control, time, step):
        return state + pyro.sample("step", dist.Normal((self.rate * step)[..., None], 1e-4).to_event(1))

    def observe(self, state):
        pyro.sample("position", dist.Normal(state, 0.2).to_event(1))

    def example_controls(self, time):
        return time.new_zeros((*time.shape, 0))


class Believed(Drift):
    """The same, of which something is believed."""

    priors = {"rate": dist.Normal(0.8, 0.05)}


class Scaled(Drift):
    """A rate that is positive, whose prior is flat on itself and not on its logarithm."""

    def __init__(self) -> None:
        super().__init__()
        self.rate = PyroParam(torch.tensor(0.5), constraints.positive)


def exact(program: st.Program, table: st.Trajectories) -> tuple[float, float]:
    """Mean and standard deviation of the rate: least squares on a start that is normal and a slope."""
    t, y = table.time[:, 0], table.measurements[..., 0]
    one = torch.ones_like(t)
    noise = 0.2**2 * torch.eye(len(t)).double() + torch.outer(one, one)  # the start's, of variance one
    noise = noise + 1e-8 * torch.minimum(t[:, None], t) / 0.1
    weight = torch.linalg.solve(noise, t)
    information, score = len(table) * float(t @ weight), float((weight @ y).sum())
    if program.priors:
        information, score = information + 1 / 0.05**2, score + 0.8 / 0.05**2
    return score / information, math.sqrt(1 / information)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", [Drift, Believed, Scaled])
def test_the_rate_of_a_drift_has_the_posterior_of_a_regression(kind):
    program, draws = kind(), 2000
    table = st.simulate(program, 8, seed=1)
    found = st.parameter_posterior(program, table, draws=draws, proposals=1600)
    mean, sd = exact(program, table)
    values = found.draws[:, 0]
    assert found.names == ("rate",) and found.is_reliable
    error = sd / math.sqrt(400)  # 800 weighed values, of which at least every other counts
    assert abs(float(values.mean()) - mean) < 4 * error
    assert abs(float(values.std()) / sd - 1) < 4 / math.sqrt(2 * 400)
    low, high = found.interval(0.9)["rate"]
    assert low == pytest.approx(mean - 1.645 * sd, abs=6 * error) and high == pytest.approx(
        mean + 1.645 * sd, abs=6 * error
    )


@pytest.mark.exhaustive
def test_the_program_stays_as_it_is_and_the_same_seed_draws_the_same():
    program = example("hovercraft:HovercraftTruth", torch.float32)
    table = st.simulate(program, 2, seed=1)
    before = {name: value.clone() for name, value in program.state_dict().items()}
    one, two = (st.parameter_posterior(program, table, proposals=40, draws=20, seed=3) for _ in range(2))
    assert all(torch.equal(before[name], value) for name, value in program.state_dict().items())
    assert torch.equal(one.draws, two.draws) and one.names[:3] == ("mass", "inertia", "drag[0]")
    assert (one.draws > 0).all()


@pytest.mark.slow
def test_draws_are_told_to_be_untrustworthy_where_they_are():
    program = example("hovercraft:HovercraftTruth", torch.float32)
    found = st.parameter_posterior(program, st.simulate(program, 1, seed=1), proposals=20, draws=20)
    assert not found.is_reliable


def test_arviz_reads_them():
    program = Drift()
    found = st.parameter_posterior(program, st.simulate(program, 2, seed=1), proposals=40, draws=30).to_arviz()
    assert found.posterior["rate"].shape == (1, 30)


@pytest.mark.slow
def test_a_network_has_too_many_numbers_to_be_drawn():
    program = example("neural_vehicle:NeuralHovercraft", torch.float32)
    with pytest.raises(st.UsageError, match="learnable numbers"):
        st.parameter_posterior(program, st.simulate(program, 1, seed=1))
    with pytest.raises(st.UsageError, match="proposals"):
        st.parameter_posterior(Drift(), st.simulate(Drift(), 1, seed=1), proposals=3)
