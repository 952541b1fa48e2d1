"""The tracked program against the exact Kalman filter and the exact posterior."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from examples import drives, example
from oracles import CartPosterior, cart_parameters, kalman
from paths import anywhere

from steady_ppl.gaussian.kalman import filter_and_smooth, track
from steady_ppl.gaussian.linearize import linearize
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.model.problem import Problem


@pytest.mark.parametrize("known_start", [False, True])
def test_the_filter_is_kalmans(cart, uneven, known_start):
    exact = kalman(uneven, cart_parameters(cart), known_start=known_start)
    tracked = track(Problem(cart, uneven, known_start), anywhere(cart, uneven), passes=1)
    rows = uneven.rows
    torch.testing.assert_close(tracked.states[rows], exact.means[rows])
    torch.testing.assert_close(tracked.covariances[rows], exact.covariances[rows])
    torch.testing.assert_close(tracked.log_likelihood, exact.log_likelihood)


@pytest.mark.parametrize("known_start", [False, True])
def test_smoothed_states_and_noise_are_the_exact_posteriors(cart, uneven, known_start):
    tracked = track(Problem(cart, uneven, known_start), anywhere(cart, uneven), passes=1)
    for trajectory in range(len(uneven)):
        exact = CartPosterior(uneven, trajectory, cart_parameters(cart), known_start=known_start)
        rows = int(uneven.lengths[trajectory])
        torch.testing.assert_close(tracked.smoothed[:rows, trajectory], exact.states_mean)
        velocity, push = exact.states_mean[:-1, 1], uneven.controls[: rows - 1, trajectory, 0]
        mean = cart.gain * push - cart.damping * velocity
        acceleration = exact.latent_mean[2:]
        torch.testing.assert_close(tracked.noise[: rows - 1, trajectory, 0], (acceleration - mean) / cart.noise)


def test_scores_are_the_slopes_of_the_log_likelihood(cart, uneven):
    path, size = anywhere(cart, uneven), 1e-4
    linear = linearize(Problem(cart, uneven), path)
    tracked = filter_and_smooth(linear)
    seen = uneven.observed[5].all(-1)
    shifted = linear.residual.clone()
    shifted[5] -= size * seen.unsqueeze(-1)  # what a sensor that reads more adds is taken off
    change = filter_and_smooth(replace(linear, residual=shifted)).log_likelihood - tracked.log_likelihood
    torch.testing.assert_close(change / size, tracked.reading[5, :, 0], rtol=1e-3, atol=1e-3)
    pushed = linear.offset.clone()
    pushed[4, :, 1] += size
    change = filter_and_smooth(replace(linear, offset=pushed)).log_likelihood - tracked.log_likelihood
    torch.testing.assert_close(change / size, tracked.arrival[5, :, 1], rtol=1e-3, atol=1e-3)


def test_it_agrees_with_the_lookahead_on_a_hovercraft():
    program = example("hovercraft").requires_grad_(False)
    data = drives(program, 3, 15, gaps=True)
    ahead = find_and_smooth(Problem(program, data, True))
    tracked = filter_and_smooth(ahead.linearization)
    mine, theirs = tracked.path(data), ahead.path(data)
    torch.testing.assert_close(mine.states, theirs.states, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(mine.noise, theirs.noise, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(tracked.log_likelihood, ahead.log_likelihood)
