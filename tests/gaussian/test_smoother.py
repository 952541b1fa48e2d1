"""A path is found from measurements alone, and smoothed until it rests."""

from __future__ import annotations

import math
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import drives, example
from oracles import CartPosterior, cart_parameters
from paths import anywhere, at_its_mode, near_the_truth

from steady_ppl import for_program, seeded, simulate
from steady_ppl.gaussian import smoother
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import _penalty, find_and_smooth, find_path, smooth
from steady_ppl.likelihood.evidence import neglected
from steady_ppl.model.problem import Problem
from steady_ppl.utils.angles import wrap


@pytest.mark.parametrize("known_start", [False, True])
def test_a_path_is_found_from_the_measurements_alone(hovercraft, bearings, known_start):
    blind = bearings.without_truth(keep_start=known_start)
    with seeded("find"):
        path = find_path(Problem(hovercraft, blind, known_start))
    found = smooth(Problem(hovercraft, blind, known_start), path, passes=40, tolerance=1e-11).means()[0]
    apart = found - at_its_mode(hovercraft, bearings, known_start=known_start).means()[0]
    # one turn further on the broad prior pulls the heading by 2π (.05 / π)², its posterior deviation being below .05
    assert max(wrap(apart[..., 2])[bearings.rows].abs().max(), apart[bearings.rows][:, [0, 1]].abs().max()) < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 10])
def test_a_path_is_found_from_sharp_bearings_without_a_start(every):
    program = example("hovercraft:HovercraftTruth").requires_grad_(False)
    program.bearing_sd = math.radians(1.25)
    data = for_program(program, simulate(program, 16, seed=1011)).observed_every(every)
    with seeded("sharp"):
        path = find_path(Problem(program, data))
    found = smooth(Problem(program, data), path).log_likelihood
    best = smooth(Problem(program, data), near_the_truth(program, data), passes=30).log_likelihood
    assert (found > best - 0.5).all()  # drives on a wrong path are off by thousands of nats


@pytest.mark.slow
def test_steps_that_go_too_far_are_halved():
    """A drive past two landmarks under an untrained network: whole steps never settle, and end anywhere from -6987 to
    140; a bootstrap filter of 20,000 particles says 148."""
    truth = example("hovercraft:HovercraftTruth", torch.float32).requires_grad_(False)
    truth.landmarks = truth.landmarks[:2]
    with seeded(1, "program"):
        program = example("neural_vehicle:NeuralHovercraft", torch.float32).requires_grad_(False)
    program.landmarks = truth.landmarks
    drive = for_program(program, simulate(truth, 16, seed=11)).subset([12])
    for seed in range(3):
        with seeded("path", seed):
            assert float(find_and_smooth(Problem(program, drive, True)).log_likelihood) > 140


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_drive_past_a_beacon_three_centimetres_off_comes_to_rest_where_a_filter_can_follow(seed):
    """Every step changes the bearing's derivative by its own size. By whole steps, taken back only where log p(y) fell,
    the last drive ended where a filter is 115 and 135 nats below the linearised program."""
    program = example("hovercraft").requires_grad_(False)
    program.noise, program.bearing_sd = torch.tensor([0.07, 0.5, 0.05]).double(), math.radians(5)
    before = drives(program, 4, 81, seed=2).states
    program.landmarks = tuple(tuple((before[40, drive, :2] + torch.tensor([0.03, 0.0])).tolist()) for drive in range(4))
    data = drives(program, 4, 81, seed=2)
    with seeded(seed, "path"):
        path = find_path(Problem(program, data, True))
    ahead = smooth(Problem(program, data, True), path, passes=15, tolerance=0.02)
    with seeded(0, "judge"):
        beyond = neglected(program, data, known_start=True, ahead=ahead)
    assert (beyond.abs() < 5).all()


def test_a_path_that_does_not_begin_at_a_known_start_is_led_there(cart, uneven):
    path = find_path(Problem(cart, uneven))
    path.states[0] += 0.3
    found = smooth(Problem(cart, uneven, True), path, tolerance=1e-9)
    torch.testing.assert_close(found.means()[0][0], uneven.known_start, rtol=0, atol=1e-9)
    exact = smooth(Problem(cart, uneven, True), find_path(Problem(cart, uneven, True)), tolerance=1e-9)
    torch.testing.assert_close(found.log_likelihood, exact.log_likelihood, rtol=0, atol=1e-9)


def test_a_path_smooths_alike_alone_and_padded_whatever_its_padding_holds(hovercraft, bearings):
    path = find_path(Problem(hovercraft, bearings, True))
    short = int(bearings.lengths.argmin())
    rows = int(bearings.lengths[short])
    assert rows < len(path.states)
    path.noise[rows - 1 :, short] = 1e3
    path = ReferencePath(path.states + 0.2, path.noise)
    together = smooth(Problem(hovercraft, bearings, True), path, passes=3, tolerance=0)
    path.noise[rows - 1 :, short] = 0.0
    alone = smooth(Problem(hovercraft, bearings.subset([short]), True), path.subset([short]), passes=3, tolerance=0)
    torch.testing.assert_close(together.log_likelihood[[short]], alone.log_likelihood, rtol=0, atol=1e-9)


def test_steps_on_a_linear_program_never_cost_more(cart, uneven):
    """Whole steps are taken there from any path: one pass more is the exact mean."""
    path = find_path(Problem(cart, uneven))
    far = ReferencePath(path.states + 5.0, path.noise - 3.0)
    once, settled = (smooth(Problem(cart, uneven), far, passes=passes) for passes in (2, 20))
    torch.testing.assert_close(once.means()[0], settled.means()[0], rtol=0, atol=1e-8)


def test_a_found_path_on_the_cart_is_the_exact_mean(cart, uneven):
    path = find_path(Problem(cart, uneven), particles=50, tempering=(1.0, 0.1))
    for trajectory, rows in enumerate(uneven.lengths.tolist()):
        exact = CartPosterior(uneven, trajectory, cart_parameters(cart))
        torch.testing.assert_close(path.states[:rows, trajectory], exact.states_mean, rtol=0, atol=1e-9)


def test_one_trajectory_that_blows_up_does_not_stop_the_passes_of_the_others(hovercraft, bearings):
    path = at_its_mode(hovercraft, bearings).linearization.path
    far = replace(path, states=path.states + torch.tensor([0.3, -0.3, 0.1, 0.0, 0.0, 0.0]).double())
    alone = smooth(Problem(hovercraft, bearings.subset([1, 2]), True), far.subset([1, 2]), passes=4, tolerance=1e-9)
    far.states[:, 0] = torch.nan
    together = smooth(Problem(hovercraft, bearings, True), far, passes=4, tolerance=1e-9)
    assert not torch.isfinite(together.log_likelihood[0])
    torch.testing.assert_close(together.log_likelihood[1:], alone.log_likelihood, rtol=0, atol=1e-9)


@pytest.mark.parametrize("known_start", [False, True])
@pytest.mark.parametrize("drive", ["even", "uneven"])
def test_the_smoother_is_exact_from_any_path(cart, drive, known_start, request):
    data = request.getfixturevalue(drive)
    ahead = smooth(Problem(cart, data, known_start), anywhere(cart, data), passes=2, tolerance=0.0)
    (states, noise), (covariances, *_) = ahead.means(), ahead.covariances()
    for trajectory, rows in enumerate(data.lengths.tolist()):
        exact = CartPosterior(data, trajectory, cart_parameters(cart), known_start=known_start)
        torch.testing.assert_close(states[:rows, trajectory], exact.states_mean, rtol=0, atol=1e-10)
        expected = torch.stack([exact.states_covariance[row, :, row] for row in range(rows)])
        torch.testing.assert_close(covariances[:rows, trajectory], expected, rtol=0, atol=1e-10)
        push, velocity = data.controls[: rows - 1, trajectory, 0], exact.states_mean[:-1, 1]
        excess = exact.latent_mean[2:] - cart.gain * push + cart.damping * velocity
        torch.testing.assert_close(noise[: rows - 1, trajectory, 0], excess / cart.noise, rtol=0, atol=1e-9)
        torch.testing.assert_close(ahead.log_likelihood[trajectory], exact.log_likelihood, rtol=0, atol=1e-10)


class Squared(type(example("linear_gaussian"))):
    """The cart, the square of whose position is measured."""

    def observe(self, state):
        pyro.sample("position", dist.Normal(state[..., 0].square(), self.measurement_sd))


@pytest.mark.parametrize(("known_start", "below"), [(True, 0.8), (True, 1.2), (False, 0.1)])
def test_a_path_that_swings_about_its_mode_comes_to_rest(known_start, below, even):
    """Squares that are read below zero bend the posterior more than its linearization knows: whole steps go back by
    more than they went, for ever."""
    program = Squared().double().requires_grad_(False)
    data = replace(even, measurements=torch.full_like(even.measurements, -below))
    ahead = smooth(Problem(program, data, known_start), near_the_truth(program, even), passes=40, tolerance=1e-6)
    torch.testing.assert_close(ahead.path(data).noise, ahead.linearization.path.noise, rtol=0, atol=1e-5)


def test_a_defects_price_is_twice_the_pull_of_all_measurements(uneven, cart):
    problem = Problem(cart, uneven)
    with seeded(0, "path"):
        path = find_path(problem)
    ahead = smooth(problem, path, passes=1)
    moved = ahead.path(uneven)
    linear = ahead.linearization
    away = (moved.states - linear.path.states).double()
    apart = linear.residual - torch.einsum("tbkd,tbd->tbk", linear.measurement, away)
    now = torch.einsum("tbkd,tbk->tbd", linear.measurement, linear.precision * apart)
    later = ahead.information - torch.einsum("tbde,tbe->tbd", ahead.precision, away)
    torch.testing.assert_close(_penalty(ahead, moved), 2 * (now + later).abs())


def test_a_drive_whose_path_ended_far_off_is_searched_again(monkeypatch) -> None:
    """Filters of a boat that begins anywhere led one drive of eight hundred to a wrong heading."""
    boat = example("gps_boat", torch.float32)
    boat.duration = 3.0
    problem = Problem(boat, for_program(boat, simulate(boat, 5, seed=5)), False)
    with seeded(0):
        right = find_path(problem)
    found, asked = smoother._most_likely_path, []

    def astray(problem, **given):
        asked.append((len(problem.data), given["particles"]))
        path, likely = found(problem, **given)
        if len(asked) > 1:
            return path, likely
        off = torch.arange(5) == 3
        return replace(path, states=torch.where(off[:, None], path.states + 1.0, path.states)), likely - 1e5 * off

    monkeypatch.setattr(smoother, "_most_likely_path", astray)
    with seeded(0):
        again = find_path(problem)
    assert asked == [(5, 250), (1, 250 * smoother.MORE_PARTICLES)]
    others = [0, 1, 2, 4]
    assert torch.equal(again.states[:, others], right.states[:, others])
    assert torch.allclose(again.states[:, 3], right.states[:, 3], atol=0.05)
