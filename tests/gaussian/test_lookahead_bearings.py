"""Looking ahead with bearings: as a large bootstrap filter says, the same in any world, and from a broad start."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from examples import copies, drives, elsewhere, example
from oracles import CartPosterior, assert_mean, cart_parameters
from torch import Tensor

from steady_ppl import FilterError, for_program, particle_filter, seeded, simulate
from steady_ppl.gaussian.information_filter import Lookahead, look_ahead
from steady_ppl.gaussian.linearize import ReferencePath, linearize
from steady_ppl.gaussian.smoother import find_and_smooth, find_path, smooth
from steady_ppl.gaussian.twisted_proposal import Twist
from steady_ppl.likelihood.evidence import neglected, run_filter
from steady_ppl.model.handlers import Standardised, running
from steady_ppl.model.problem import Problem
from steady_ppl.utils.angles import wrap


def near_the_truth(program, data) -> ReferencePath:
    """The true states, with no noise; finite also past a trajectory's end."""
    states = torch.where(data.rows[..., None], data.states, data.states[:1])
    return ReferencePath(states, states.new_zeros((*data.steps.shape, len(program.channels))))


# --- against a large bootstrap filter ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hovercraft():
    return example("hovercraft:HovercraftTruth").requires_grad_(False)


class Coarse(type(example("hovercraft:HovercraftTruth"))):
    """Bearings to 20°: some hundred of ten thousand particles from the broad prior fit them."""

    bearing_sd = math.radians(20)


@pytest.mark.parametrize(("known_start", "rows", "blind"), [(True, 8, 3000), (False, 5, 10_000)])
def test_looking_ahead_agrees_with_a_large_bootstrap_filter(hovercraft, known_start, rows, blind):
    runs = 40
    program = hovercraft if known_start else Coarse().double().requires_grad_(False)
    data = copies(drives(program, 1, rows), runs)
    found = []
    for ahead, particles in ((False, blind), (True, 300)):
        with seeded("either"):
            filtered = run_filter(program, data, particles=particles, known_start=known_start, look_ahead=ahead)
            states = filtered.paths(300).states.mean(0).transpose(0, 1)
        evidence = filtered.log_likelihood
        found.append(torch.cat([evidence[:, None] + evidence.var() / 2, states[:, 1:].flatten(1)], -1))
    assert_mean(found[0] - found[1], torch.zeros_like(found[0][0]))
    assert found[1][:, 0].std() < found[0][:, 0].std()


# --- invariances ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bearings(hovercraft):
    return drives(hovercraft, 3, 21, gaps=True)


def smoothed(program, data, *, known_start=True, **settings) -> Lookahead:
    """At the mode, so that it does not matter how one got there."""
    settings = {"passes": 40, "tolerance": 1e-11} | settings
    return smooth(Problem(program, data, known_start), near_the_truth(program, data), **settings)


@pytest.mark.parametrize("turn", [0.5, math.pi, 4.0])
def test_turning_and_moving_the_world_changes_nothing(hovercraft, bearings, turn):
    other, moved, place = elsewhere(hovercraft, bearings, turn)
    here, there = smoothed(hovercraft, bearings), smoothed(other, moved)
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
    here, there = smoothed(hovercraft, bearings), smoothed(hovercraft, replace(bearings, states=turned))
    torch.testing.assert_close(here.log_likelihood, there.log_likelihood, rtol=0, atol=1e-6)


def test_whole_turns_of_a_bearing_change_nothing(hovercraft, bearings):
    turns = 2 * math.pi * torch.tensor([1, -2, 0, 3], dtype=torch.float64)
    turned = replace(bearings, measurements=bearings.measurements + turns)
    here, there = smoothed(hovercraft, bearings), smoothed(hovercraft, turned)
    torch.testing.assert_close(here.log_likelihood, there.log_likelihood, rtol=0, atol=1e-6)


def test_the_order_of_trajectories_and_landmarks_changes_nothing(hovercraft, bearings):
    order, places = [2, 0, 3, 1], [1, 2, 0]

    class Shuffled(type(hovercraft)):
        landmarks = [hovercraft.landmarks[i] for i in order]

    shuffled = replace(bearings, measurements=bearings.measurements[..., order], observed=bearings.observed[..., order])
    here = smoothed(hovercraft, bearings).log_likelihood
    there = smoothed(Shuffled().double(), shuffled.subset(places)).log_likelihood
    torch.testing.assert_close(here[places], there, rtol=0, atol=1e-6)
    assert (here - here[places]).abs().min() > 1e-3


def test_a_filters_particles_on_another_turn_than_the_path_weigh_the_same(hovercraft, bearings):
    ahead = smoothed(hovercraft, bearings)
    turned = bearings.states.clone()
    turned[..., 2] += math.pi * torch.tensor([2, -4, 6], dtype=torch.float64)
    runs = []
    for data in (bearings, replace(bearings, states=turned)):
        with seeded("turned"):
            filtered = particle_filter(hovercraft, data, particles=50, known_start=True, proposal=Twist(ahead))
        runs.append(filtered.log_likelihood)
    torch.testing.assert_close(runs[0], runs[1], rtol=1e-9, atol=1e-9)


def test_a_trajectory_scores_the_same_alone_as_padded(hovercraft, bearings):
    alone = bearings.subset([1])
    rows = int(alone.lengths[0])
    names = ("time", "controls", "measurements", "observed", "states")
    cut = replace(alone, **{name: getattr(alone, name)[:rows] for name in names})
    padded, whole = (smoothed(hovercraft, data).log_likelihood for data in (alone, cut))
    torch.testing.assert_close(padded, whole, rtol=0, atol=1e-9)


def test_a_wrong_landmark_costs_many_nats(hovercraft, bearings):
    class Wrong(type(hovercraft)):
        landmarks = ((12.0, -3.0), *hovercraft.landmarks[1:])

    right, wrong = (smoothed(program, bearings).log_likelihood for program in (hovercraft, Wrong().double()))
    assert (right - wrong).min() > 20


def test_reversed_time_costs_many_nats(hovercraft, bearings):
    whole = bearings.subset([0, 2])
    reversed_ = replace(whole, measurements=whole.measurements.flip(0), observed=whole.observed.flip(0))
    right, wrong = (smoothed(hovercraft, data).log_likelihood for data in (whole, reversed_))
    assert (right - wrong).sum() > 100


# --- a broad start ----------------------------------------------------------------------------------------------------


def test_a_broad_start_counts_the_neighbouring_turns(hovercraft, bearings):
    ahead = smoothed(hovercraft, bearings, known_start=False)
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
    path = smoothed(hovercraft, bearings, known_start=False).linearization.path
    turn = 2 * math.pi * (torch.arange(6) == 2).double()
    turned = ReferencePath(path.states + turn, path.noise)
    here, there = (look_ahead(linearize(Problem(hovercraft, bearings), p)).log_likelihood for p in (path, turned))
    # a turn that is left out on one side has a thousandth of the mass: more than 4 prior deviations off
    torch.testing.assert_close(here, there, rtol=0, atol=0.002)


def test_draws_from_a_broad_start_are_on_the_turns_that_their_masses_say(hovercraft, bearings):
    ahead = smoothed(hovercraft, bearings, known_start=False)
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


# --- finding a path ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("known_start", [False, True])
def test_a_path_is_found_from_the_measurements_alone(hovercraft, bearings, known_start):
    blind = bearings.without_truth(keep_start=known_start)
    with seeded("find"):
        path = find_path(Problem(hovercraft, blind, known_start))
    found = smooth(Problem(hovercraft, blind, known_start), path, passes=40, tolerance=1e-11).means()[0]
    apart = found - smoothed(hovercraft, bearings, known_start=known_start).means()[0]
    # one turn further on the broad prior pulls the heading by 2π (.05 / π)², its posterior deviation being below .05
    assert max(wrap(apart[..., 2])[bearings.rows].abs().max(), apart[bearings.rows][:, [0, 1]].abs().max()) < 2e-3


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
    alone = smooth(Problem(hovercraft, bearings.subset([short]), True), of(path, [short]), passes=3, tolerance=0)
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


# --- what goes wrong --------------------------------------------------------------------------------------------------


def test_a_drive_without_measurements_has_no_evidence_whatever_the_turns(hovercraft, bearings):
    unseen = replace(bearings, observed=torch.zeros_like(bearings.observed))
    ahead = smoothed(hovercraft, unseen, known_start=False)
    torch.testing.assert_close(ahead.log_likelihood, torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-9)


def test_one_trajectory_that_blows_up_does_not_stop_the_passes_of_the_others(hovercraft, bearings):
    path = smoothed(hovercraft, bearings).linearization.path
    far = replace(path, states=path.states + torch.tensor([0.3, -0.3, 0.1, 0.0, 0.0, 0.0]).double())
    alone = smooth(Problem(hovercraft, bearings.subset([1, 2]), True), of(far, [1, 2]), passes=4, tolerance=1e-9)
    far.states[:, 0] = torch.nan
    together = smooth(Problem(hovercraft, bearings, True), far, passes=4, tolerance=1e-9)
    assert not torch.isfinite(together.log_likelihood[0])
    torch.testing.assert_close(together.log_likelihood[1:], alone.log_likelihood, rtol=0, atol=1e-9)


def of(path: ReferencePath, trajectories: list[int]) -> ReferencePath:
    return ReferencePath(path.states[:, trajectories], path.noise[:, trajectories])


def test_a_program_that_blows_up_names_the_trajectory(hovercraft, bearings):
    broken = replace(bearings, controls=bearings.controls.clone())
    broken.controls[3, 1] = torch.nan
    with pytest.raises(FilterError, match="trajectory 2"):
        run_filter(hovercraft, broken, particles=50, known_start=True, look_ahead=True)
