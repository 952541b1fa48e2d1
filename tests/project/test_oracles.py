"""The oracles agree with each other and with Pyro's exact hidden Markov model."""

from __future__ import annotations

from dataclasses import replace

import pyro.distributions as dist
import pytest
import torch
from examples import drives, example
from oracles import CartPosterior, cart_parameters, cart_system, kalman, kalman_filter


@pytest.mark.parametrize("known_start", [False, True])
def test_kalman_filter_and_one_big_gaussian_agree(known_start):
    program = example("linear_gaussian")
    data = drives(program, 4, 12, gaps=True)
    parameters = cart_parameters(program)
    filtered = kalman(data, parameters, known_start=known_start)
    for trajectory, rows in enumerate(data.lengths.tolist()):
        whole = CartPosterior(data, trajectory, parameters, known_start=known_start)
        last = whole.states_covariance[-1, :, -1]
        torch.testing.assert_close(whole.log_likelihood, filtered.log_likelihood[trajectory], rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(whole.states_mean[-1], filtered.means[rows - 1, trajectory], rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(last, filtered.covariances[rows - 1, trajectory], rtol=1e-10, atol=1e-10)


def test_kalman_filter_agrees_with_gaussian_hmm():
    program = example("linear_gaussian")
    data = drives(program, 3, 12)
    system = cart_system(data, cart_parameters(program))
    # GaussianHMM has no singular noise, so both sides get a little on the position; its first transition is our start
    system = replace(system, noise=system.noise + 1e-3 * torch.eye(2, dtype=torch.float64))
    matrix = torch.cat([torch.zeros_like(system.matrix[:1]), system.matrix]).transpose(0, 1)
    offset = torch.cat([system.start_mean[None], system.offset]).transpose(0, 1)
    noise = torch.cat([system.start_covariance[None], system.noise]).transpose(0, 1)
    zero, one = torch.zeros(2, dtype=torch.float64), torch.eye(2, dtype=torch.float64)
    hmm = dist.GaussianHMM(
        dist.MultivariateNormal(zero, one),
        matrix.mT,
        dist.MultivariateNormal(offset, noise),
        one[:, :1],
        dist.MultivariateNormal(zero[:1], system.measurement_variance * one[:1, :1]),
    )
    measurements = data.measurements.transpose(0, 1)
    ours = kalman_filter(system, data)
    last = hmm.filter(measurements)
    torch.testing.assert_close(hmm.log_prob(measurements), ours.log_likelihood, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(last.mean, ours.means[-1], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(last.covariance_matrix, ours.covariances[-1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("weight", [0.3, 1.0])
def test_tempered_evidence_is_the_integral_of_the_tempered_density(weight):
    program = example("linear_gaussian")
    data = drives(program, 1, 2)
    data = replace(data, observed=data.observed & (torch.arange(2) == 0)[:, None, None])
    with torch.no_grad():
        sd = program.measurement_sd
        position = torch.linspace(-6, 6, 20001, dtype=torch.float64)
        prior = dist.Normal(0.0, 0.5).log_prob(position)
        density = weight * dist.Normal(position, sd).log_prob(data.measurements[0, 0, 0])
        integral = torch.trapezoid((prior + density).exp(), position).log()
        torch.testing.assert_close(kalman(data, cart_parameters(program), weight=weight).log_likelihood[0], integral)
