"""Predictions against the exact Kalman filter, and simulated drives against the moments of their program."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from examples import copies, drives, example
from oracles import assert_mean, cart_parameters, cart_system, kalman
from paths import anywhere

from steady_ppl import for_program, seeded, simulate, with_substeps
from steady_ppl.gaussian.kalman import track
from steady_ppl.gaussian.predict import on_a_circle, predict, simulate_again, simulate_each
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.kernels.rows import kernel_failures
from steady_ppl.model.problem import Problem


@pytest.mark.parametrize("horizon", [1, 4])
def test_predictions_are_kalmans(cart, uneven, horizon):
    exact, system = kalman(uneven, cart_parameters(cart)), cart_system(uneven, cart_parameters(cart))
    starts = uneven.time.shape[0] - horizon
    mean, covariance = exact.means[:starts], exact.covariances[:starts]
    for k in range(horizon):
        matrix = system.matrix[k : k + starts]
        mean = (matrix @ mean[..., None])[..., 0] + system.offset[k : k + starts]
        covariance = matrix @ covariance @ matrix.mT + system.noise[k : k + starts]
    tracked = track(Problem(cart, uneven), anywhere(cart, uneven), passes=1)
    found = predict(cart, uneven, tracked, [horizon])[horizon]
    seen = uneven.observed[horizon:, :, 0]
    assert bool((found.observed[..., 0] == seen).all())
    error = uneven.measurements[horizon:, :, 0] - mean[..., 0]
    torch.testing.assert_close(found.error[..., 0][seen], error[seen])
    variance = covariance[..., 0, 0] + cart.measurement_sd**2
    torch.testing.assert_close(found.variance[..., 0][seen], variance[seen])
    assert bool((found.error[..., 0][~seen] == 0).all() and (found.standardised[..., 0][~seen] == 0).all())


def test_ninety_percent_bands_cover_ninety_percent_of_what_the_program_makes():
    program = example("hovercraft").requires_grad_(False)
    data = drives(program, 40, 41)
    path = find_and_smooth(Problem(program, data, True)).path(data)
    tracked = track(Problem(program, data, True), path)
    for horizon, found in predict(program, data, tracked, [1, 10]).items():
        independent = int(found.observed.sum()) / (1 if horizon == 1 else 4 * horizon)  # errors overlap and go together
        margin = 4 * math.sqrt(0.9 * 0.1 / independent)
        assert float(found.covered().sum() / found.observed.sum()) == pytest.approx(0.9, abs=margin)
        assert margin < 0.11


def test_simulated_drives_have_the_moments_of_the_program(cart, even):
    starts = even.known_start.expand(400, -1, -1)
    with seeded("again"):
        again, truth = simulate_again(cart, even, starts, 1)
    assert len(again) == 400 * 3 and bool((again.observed == copies(even, 1).observed.repeat(1, 400, 1)).all())
    states = truth.states.unflatten(1, (400, 3))
    system, mean = cart_system(even, cart_parameters(cart)), even.known_start
    for matrix, offset in zip(system.matrix, system.offset, strict=True):
        mean = (matrix @ mean[..., None])[..., 0] + offset
    assert_mean(states[-1], mean)
    assert_mean(again.measurements[-1, :, 0].view(400, 3), mean[:, 0])
    assert bool((truth.states[0].view(400, 3, 2) == even.known_start).all())


def test_simulated_drives_have_the_gaps_and_ends_of_the_real_ones(cart, uneven):
    with seeded("gaps"):
        again, truth = simulate_again(cart, uneven, uneven.known_start.expand(5, -1, -1), 1)
    assert bool((again.observed == uneven.observed.repeat(1, 5, 1)).all())
    assert bool((again.measurements[~again.observed] == 0).all())
    assert bool(torch.isfinite(truth.states).all()) and again.states is not None
    assert bool(torch.isnan(again.states[1:]).all())  # the truth stays out of the comparison


def test_bearings_live_on_a_circle_and_positions_do_not(cart, even):
    hovercraft = example("hovercraft").requires_grad_(False)
    data = drives(hovercraft, 2, 5)
    assert on_a_circle(hovercraft, data, data.states).tolist() == [True] * 4
    assert on_a_circle(cart, even, even.states).tolist() == [False]


@pytest.mark.parametrize(
    ("substeps", "drives_of_set"),
    [
        (1, 3),
        pytest.param(1, 1, marks=pytest.mark.slow),
        *(pytest.param(4, of, marks=pytest.mark.slow) for of in (1, 3)),
    ],
)
def test_sets_of_several_programs_are_each_ones_own(substeps: int, drives_of_set: int) -> None:
    """The second program's are by kernels as well, and move as its numbers say."""
    hovercraft = with_substeps(example("hovercraft", torch.float32), substeps).requires_grad_(False)
    other = copy.deepcopy(hovercraft)
    other.mass = torch.tensor(4.0)
    data = for_program(hovercraft, simulate(hovercraft, drives_of_set, seed=0))
    starts = data.known_start.expand(2, -1, -1)
    with seeded("each"), kernel_failures() as why:
        _, both = simulate_each([hovercraft, other], data, [starts[:1], starts[1:]], 3)
    assert not why
    with seeded("each"):
        _, first = simulate_again(hovercraft, data, starts[:1], 3)
        _, second = simulate_again(other, data, starts[1:], 3)
    found, expected = (torch.cat([one.states for one in part], 1) for part in ([both], [first, second]))
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(both.noise, torch.cat([first.noise, second.noise], 1), rtol=0, atol=0)
    apart = (found[-1, :drives_of_set] - found[-1, drives_of_set:]).abs().max()
    assert float(apart) > 0.1
