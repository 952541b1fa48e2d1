"""What a filter says of given drives."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest
import torch
from examples import copies, drives, example
from oracles import CartPosterior, assert_mean, cart_parameters, kalman

from steady_ppl import DataError, log_likelihood, smoothed_states
from steady_ppl.likelihood.evidence import in_parts


@pytest.fixture(scope="module")
def cart():
    return example("linear_gaussian").requires_grad_(False)


@pytest.fixture(scope="module")
def data(cart):
    return drives(cart, 3, 12, gaps=True)


@pytest.mark.parametrize("known_start", [False, True])
@pytest.mark.parametrize("every", [1, 4])
def test_log_likelihood_counts_every_nth_row_and_the_first(cart, data, every, known_start):
    counted = data.observed_every(every)
    counts = (torch.arange(12) % every == 0)[:, None, None]
    assert torch.equal(counted.observed, data.observed & counts) and counts[0].all()
    exact = kalman(counted, cart_parameters(cart), known_start=known_start).log_likelihood
    found = log_likelihood(cart, copies(data, 600), particles=100, known_start=known_start, every=every)
    assert_mean((found.view(3, 600).T - exact).exp(), torch.ones(3))


def test_every_tenth_row_is_the_default(cart, data):
    exact = kalman(data.observed_every(10), cart_parameters(cart)).log_likelihood
    found = log_likelihood(cart, copies(data, 600), particles=100, known_start=False)
    assert_mean((found.view(3, 600).T - exact).exp(), torch.ones(3))


def test_smoothed_states_are_the_means_given_all_measurements(cart, data):
    found = smoothed_states(cart, copies(data, 40), known_start=False).view(12, 3, 40, 2)
    for trajectory, rows in enumerate(data.lengths.tolist()):
        exact = CartPosterior(data, trajectory, cart_parameters(cart))
        assert_mean(found[:rows, trajectory].transpose(0, 1), exact.states_mean)
        # the mean of 100 paths, not one of them
        variance = torch.stack([exact.states_covariance[t, :, t].diag() for t in range(rows)])
        assert (found[:rows, trajectory].var(1) < variance / 10).all()


def test_parts_hold_every_trajectory_once_and_in_order(data):
    many = copies(data, 4)
    parts = list(in_parts(many, particles=10, at_once=50))
    assert [len(part) for part in parts] == [5, 5, 2]
    assert torch.equal(torch.cat([part.measurements for part in parts], 1), many.measurements)
    assert [len(part) for part in in_parts(many, particles=1000, at_once=50)] == [1] * 12


def test_log_likelihood_in_parts_is_that_of_each_trajectory(data, monkeypatch):
    still = example("linear_gaussian").requires_grad_(False)
    still.noise = torch.tensor(1e-9, dtype=torch.float64)  # with a known start every particle is the same
    monkeypatch.setattr("steady_ppl.likelihood.evidence.in_parts", partial(in_parts, at_once=20))
    exact = kalman(data, cart_parameters(still), known_start=True).log_likelihood
    found = log_likelihood(still, data, particles=10, known_start=True, every=1)
    torch.testing.assert_close(found, exact, rtol=1e-6, atol=1e-6)


def test_a_drive_without_a_measurement_at_the_counted_rows_is_an_error(cart, data):
    seen = data.observed & (torch.arange(data.time.shape[0]) % 10 == 5)[:, None, None]
    with pytest.raises(DataError, match=r"trajectory 1 is measured at none of the rows 1, 11, 21"):
        log_likelihood(cart, replace(data, observed=seen), particles=10, known_start=False)
