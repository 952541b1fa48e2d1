"""Looking ahead: exact on the cart, with bearings the same in any world, and from a broad start."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from examples import elsewhere
from oracles import START_MEAN, START_SD, CartPosterior, assert_mean, cart_parameters, kalman
from paths import anywhere, at_its_mode
from torch import Tensor

from steady_ppl import particle_filter, seeded
from steady_ppl.gaussian.information_filter import look_ahead
from steady_ppl.gaussian.linearize import ReferencePath, linearize
from steady_ppl.gaussian.smoother import smooth
from steady_ppl.gaussian.twisted_proposal import Twist
from steady_ppl.model.handlers import Standardised, running
from steady_ppl.model.problem import Problem

# --- exact on the cart ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("known_start", [False, True])
@pytest.mark.parametrize("weight", [1.0, 0.6, 0.1])
@pytest.mark.parametrize("drive", ["even", "uneven"])
def test_the_log_likelihood_is_kalmans(cart, drive, weight, known_start, request):
    data = request.getfixturevalue(drive)
    problem, path = Problem(cart, data, known_start), anywhere(cart, data)
    ahead = smooth(problem, path, observation_weight=weight, passes=2, tolerance=0.0)
    exact = kalman(data, cart_parameters(cart), weight=weight, known_start=known_start).log_likelihood
    torch.testing.assert_close(ahead.log_likelihood, exact, rtol=0, atol=1e-10)
    assert torch.equal(ahead.winding_masses, torch.zeros(1, 3, dtype=torch.float64))


def test_the_first_lookahead_is_exact_wherever_it_is_taken(cart, uneven):
    ahead = look_ahead(linearize(Problem(cart, uneven), anywhere(cart, uneven)))
    exact = kalman(uneven, cart_parameters(cart)).log_likelihood
    # the path is some 15 measurement deviations off: its cost of some thousand nats cancels
    torch.testing.assert_close(ahead.log_likelihood, exact, rtol=0, atol=1e-8)


@pytest.mark.parametrize("known_start", [False, True])
@pytest.mark.parametrize("drive", ["even", "uneven"])
def test_draws_have_the_moments_of_the_exact_smoother(cart, drive, known_start, request):
    data = request.getfixturevalue(drive)
    ahead = smooth(Problem(cart, data, known_start), anywhere(cart, data), passes=2)
    start, states, _ = ahead.draws(3000)
    if not known_start:
        torch.testing.assert_close(states[:, 0], START_MEAN + START_SD * start, rtol=0, atol=1e-10)
    for trajectory, rows in enumerate(data.lengths.tolist()):
        exact = CartPosterior(data, trajectory, cart_parameters(cart), known_start=known_start)
        drawn = states[:, :rows, trajectory]
        assert_mean(drawn, exact.states_mean)
        centred = drawn - exact.states_mean
        within = centred[..., :, None] * centred[..., None, :]
        assert_mean(within, torch.stack([exact.states_covariance[t, :, t] for t in range(rows)]))
        lagged = centred[:, 1:, :, None] * centred[:, :-1, None, :]
        assert_mean(lagged, torch.stack([exact.states_covariance[t + 1, :, t] for t in range(rows - 1)]))


def test_the_noise_of_draws_leads_from_each_state_to_the_next(cart, uneven):
    _, states, noise = smooth(Problem(cart, uneven), anywhere(cart, uneven), passes=2).draws(50)
    with running(50, 11, 3), Standardised(noise):
        after = cart.transition(states[:, :-1], uneven.controls[:-1], uneven.elapsed[:-1], uneven.steps)
    inside = uneven.transitions
    torch.testing.assert_close(after[:, inside], states[:, 1:][:, inside], rtol=0, atol=1e-10)


# --- invariances ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turn", [0.5, math.pi, 4.0])
def test_turning_and_moving_the_world_changes_nothing(hovercraft, bearings, turn):
    other, moved, place = elsewhere(hovercraft, bearings, turn)
    here, there = at_its_mode(hovercraft, bearings), at_its_mode(other, moved)
    torch.testing.assert_close(here.log_likelihood, there.log_likelihood, rtol=0, atol=1e-6)
    (ours, our_noise), (theirs, their_noise) = here.means(), there.means()
    torch.testing.assert_close(our_noise, their_noise, rtol=0, atol=1e-6)
    torch.testing.assert_close(place(ours[..., :2]), theirs[..., :2], rtol=0, atol=1e-6)
    drawn = []
    for ahead, data, program in ((here, bearings, hovercraft), (there, moved, other)):
        with seeded("world"):
            filtered = particle_filter(program, data, particles=50, known_start=True, proposal=Twist(ahead))
            drawn.append((filtered.log_likelihood, filtered.paths(20).noise["acceleration"]))
    torch.testing.assert_close(drawn[0], tuple(value.detach() for value in drawn[1]), rtol=0, atol=1e-5)


def test_whole_turns_of_the_heading_change_nothing(hovercraft, bearings):
    turned = bearings.states.clone()
    turned[..., 2] += math.pi * torch.tensor([2, -4, 6], dtype=torch.float64)
    here, there = at_its_mode(hovercraft, bearings), at_its_mode(hovercraft, replace(bearings, states=turned))
    torch.testing.assert_close(here.log_likelihood, there.log_likelihood, rtol=0, atol=1e-6)


def test_whole_turns_of_a_bearing_change_nothing(hovercraft, bearings):
    turns = 2 * math.pi * torch.tensor([1, -2, 0, 3], dtype=torch.float64)
    turned = replace(bearings, measurements=bearings.measurements + turns)
    here, there = at_its_mode(hovercraft, bearings), at_its_mode(hovercraft, turned)
    torch.testing.assert_close(here.log_likelihood, there.log_likelihood, rtol=0, atol=1e-6)


def test_the_order_of_trajectories_and_landmarks_changes_nothing(hovercraft, bearings):
    order, places = [2, 0, 3, 1], [1, 2, 0]

    class Shuffled(type(hovercraft)):
        landmarks = [hovercraft.landmarks[i] for i in order]

    shuffled = replace(bearings, measurements=bearings.measurements[..., order], observed=bearings.observed[..., order])
    here = at_its_mode(hovercraft, bearings).log_likelihood
    there = at_its_mode(Shuffled().double(), shuffled.subset(places)).log_likelihood
    torch.testing.assert_close(here[places], there, rtol=0, atol=1e-6)
    assert (here - here[places]).abs().min() > 1e-3


def test_a_trajectory_scores_the_same_alone_as_padded(hovercraft, bearings):
    alone = bearings.subset([1])
    rows = int(alone.lengths[0])
    names = ("time", "controls", "measurements", "observed", "states")
    cut = replace(alone, **{name: getattr(alone, name)[:rows] for name in names})
    padded, whole = (at_its_mode(hovercraft, data).log_likelihood for data in (alone, cut))
    torch.testing.assert_close(padded, whole, rtol=0, atol=1e-9)


def test_a_wrong_landmark_costs_many_nats(hovercraft, bearings):
    class Wrong(type(hovercraft)):
        landmarks = ((12.0, -3.0), *hovercraft.landmarks[1:])

    right, wrong = (at_its_mode(program, bearings).log_likelihood for program in (hovercraft, Wrong().double()))
    assert (right - wrong).min() > 20


def test_reversed_time_costs_many_nats(hovercraft, bearings):
    whole = bearings.subset([0, 2])
    reversed_ = replace(whole, measurements=whole.measurements.flip(0), observed=whole.observed.flip(0))
    right, wrong = (at_its_mode(hovercraft, data).log_likelihood for data in (whole, reversed_))
    assert (right - wrong).sum() > 100


# --- a broad start ----------------------------------------------------------------------------------------------------


def test_a_broad_start_counts_the_neighbouring_turns(hovercraft, bearings):
    ahead = at_its_mode(hovercraft, bearings, known_start=False)
    masses = ahead.winding_masses.exp()
    torch.testing.assert_close(masses.sum(0), torch.ones(3, dtype=torch.float64))
    assert ((masses > 1e-3).sum(0) > 1).all()

    class OneTurn(type(hovercraft)):
        """Its prior some turns further on, and no component known as an angle."""

        angles = ()
        turns = 0

        def initial(self):
            start = super().initial()
            return start + 2 * math.pi * self.turns * (torch.arange(6) == 2).to(start)

    single = OneTurn().double().requires_grad_(False)
    found = ahead.linearization
    path = replace(found.path, states=found.path.states + found.start_turn)  # on the turn of its prior
    alone = {}
    for turns in (0, 1, -1, 2, -2):  # those that begin within four deviations of π
        single.turns = turns
        alone[turns] = look_ahead(linearize(Problem(single, bearings), path)).log_likelihood
    assert (ahead.log_likelihood - alone[0]).min() > 0.01
    together = torch.stack(list(alone.values()))
    torch.testing.assert_close(ahead.log_likelihood, together.logsumexp(0), rtol=0, atol=1e-9)
    torch.testing.assert_close(masses.sort(0).values, together.softmax(0).sort(0).values, rtol=0, atol=1e-9)


def test_whole_turns_of_the_path_change_nothing_from_a_broad_start(hovercraft, bearings):
    path = at_its_mode(hovercraft, bearings, known_start=False).linearization.path
    turn = 2 * math.pi * (torch.arange(6) == 2).double()
    turned = ReferencePath(path.states + turn, path.noise)
    here, there = (look_ahead(linearize(Problem(hovercraft, bearings), p)).log_likelihood for p in (path, turned))
    # a turn that is left out on one side has a thousandth of the mass: more than 4 prior deviations off
    torch.testing.assert_close(here, there, rtol=0, atol=0.002)


def test_draws_from_a_broad_start_are_on_the_turns_that_their_masses_say(hovercraft, bearings):
    ahead = at_its_mode(hovercraft, bearings, known_start=False)
    start, states, _ = ahead.draws(3000)
    mean, sd = began(hovercraft, torch.zeros(1, 6).double()), began(hovercraft, torch.ones(1, 6).double())
    torch.testing.assert_close(states[:, 0], mean + (sd - mean) * start, rtol=0, atol=1e-9)
    away = (states[..., 2] - (ahead.means()[0] + ahead.linearization.start_turn)[..., 2]) / (2 * math.pi)
    assert (away.round() == away[:, :1].round())[:, bearings.rows].all()  # the whole drive is on the start's turn
    counted = away[:, 0].round() == ahead.windings[:, None, None, 2] / (2 * math.pi)
    assert ahead.windings.shape == (5, 6)
    masses = ahead.winding_masses.exp()
    often = masses > 0.005  # fifteen of the draws
    assert_mean(counted.transpose(0, 1).double()[:, often], masses[often])


def began(program, noise: Tensor) -> Tensor:
    with running(*noise.shape[:-1]), Standardised(noise):
        return program.initial()


# --- what goes wrong --------------------------------------------------------------------------------------------------


def test_a_drive_without_measurements_has_no_evidence_whatever_the_turns(hovercraft, bearings):
    unseen = replace(bearings, observed=torch.zeros_like(bearings.observed))
    ahead = at_its_mode(hovercraft, unseen, known_start=False)
    torch.testing.assert_close(ahead.log_likelihood, torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-9)
