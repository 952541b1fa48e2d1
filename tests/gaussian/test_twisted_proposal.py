"""Particles steered by what is ahead: exact on the cart, unbiased wherever the steering aims, right on bearings."""

from __future__ import annotations

import math
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import copies, drives, example
from oracles import CartPosterior, assert_mean, cart_parameters, kalman
from paths import anywhere, at_its_mode
from torch import Tensor

from steady_ppl import FilterError, UsageError, particle_filter, seeded, stack
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import smooth, smoother_paths
from steady_ppl.gaussian.twisted_proposal import Twist
from steady_ppl.likelihood.evidence import run_filter
from steady_ppl.model.problem import Problem


def estimates(program, data, runs: int, particles: int, twist=Twist, *, aim=None, **settings) -> Tensor:
    """log p(y) of each trajectory by `runs` independent filters, `(runs, B)`; `aim` is the program, and a change of
    the data, that the lookahead is of."""
    filter_settings = {name: settings.pop(name) for name in ("resample_below",) if name in settings}
    known_start = settings.pop("known_start", False)
    many = copies(data, runs)
    other, change = aim or (program, {})
    seen = replace(many, **{name: function(many) for name, function in change.items()})
    with seeded("estimates"):
        ahead = smooth(Problem(other, seen, known_start), anywhere(program, many), passes=2)
        filtered = particle_filter(
            program,
            many,
            particles=particles,
            known_start=known_start,
            proposal=twist(ahead, **settings),
            keep_history=False,
            **filter_settings,
        )
    return filtered.log_likelihood.view(len(data), runs).T


@pytest.mark.parametrize("known_start", [False, True])
def test_the_future_of_a_row_is_worth_what_kalman_says_of_it(cart, even, known_start):
    ahead = smooth(Problem(cart, even, known_start), anywhere(cart, even), passes=2)
    future = Twist(ahead).log_future(4, even.states[4].unsqueeze(0))[0]
    rest = replace(
        even,
        time=even.time[4:],
        controls=even.controls[4:],
        measurements=even.measurements[4:],
        observed=even.observed[4:] & (torch.arange(8) > 0)[:, None, None],
        states=even.states[4:],
        lengths=even.lengths - 4,
    )
    exact = kalman(rest, cart_parameters(cart), known_start=True).log_likelihood
    torch.testing.assert_close(future, exact, rtol=0, atol=1e-9)


@pytest.mark.parametrize("known_start", [False, True])
@pytest.mark.parametrize("resample_below", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("drive", ["even", "uneven"])
def test_an_exact_twist_leaves_no_variance(cart, drive, resample_below, known_start, request):
    data = request.getfixturevalue(drive)
    settings = {"resample_below": resample_below, "known_start": known_start}
    runs = estimates(cart, data, 20, 5, untwisted=0.0, **settings)
    exact = kalman(data, cart_parameters(cart), known_start=known_start).log_likelihood
    assert runs.std(0).max() < 1e-10
    torch.testing.assert_close(runs, exact.expand(20, 3), rtol=0, atol=1e-9)


def bad_aim(cart) -> tuple:
    """The lookahead of a cart that is more strongly damped, seen less well, and a little further on."""
    other = example("linear_gaussian").requires_grad_(False)
    other.damping, other.noise, other.measurement_sd = (
        torch.tensor(value, dtype=torch.float64) for value in (1.6, 0.8, 0.3)
    )
    return other, {"measurements": lambda data: data.measurements + 0.1}


@pytest.mark.slow
@pytest.mark.parametrize("known_start", [False, True])
@pytest.mark.parametrize("resample_below", [0.0, 0.5, 1.0])
def test_a_bad_twist_is_unbiased(cart, uneven, resample_below, known_start):
    data = uneven
    settings = {"resample_below": resample_below, "known_start": known_start, "untwisted": 0.1}
    runs = estimates(cart, data, 1000, 20, aim=bad_aim(cart), **settings)
    exact = kalman(data, cart_parameters(cart), known_start=known_start).log_likelihood
    assert runs.std(0).min() > 0.03  # bad, far beyond the rounding of a good one
    assert_mean((runs - exact).exp(), torch.ones(3))


def test_a_twist_towards_tempered_observations_is_unbiased(cart, uneven):
    many = copies(uneven, 1000)
    with seeded("tempered"):
        ahead = smooth(Problem(cart, many), anywhere(cart, many), observation_weight=0.2, passes=2)
        filtered = particle_filter(cart, many, particles=20, proposal=Twist(ahead, untwisted=0.1))
    runs = filtered.log_likelihood.view(3, 1000).T
    assert_mean((runs - kalman(uneven, cart_parameters(cart)).log_likelihood).exp(), torch.ones(3))


@pytest.mark.parametrize("weight", [0.1, 0.6])
def test_a_tempered_filter_that_looks_ahead_estimates_the_power_posteriors_evidence(cart, uneven, weight):
    many = copies(uneven, 500)
    with seeded("power"):
        ahead = smooth(Problem(cart, many), anywhere(cart, many), observation_weight=weight, passes=2)
        proposal = Twist(ahead, untwisted=0.3)
        filtered = particle_filter(cart, many, particles=20, observation_weight=weight, proposal=proposal)
    runs = filtered.log_likelihood.view(3, 500).T
    exact = kalman(uneven, cart_parameters(cart), weight=weight).log_likelihood
    assert_mean((runs - exact).exp(), torch.ones(3))


class Unweighted(Twist):
    """The twist's proposals without their weights."""

    def step(self, row, state):
        return super().step(row, state)[0], 0.0


class Unstarted(Twist):
    """The same, of the start alone."""

    def start(self, particles):
        return super().start(particles)[0], 0.0


@pytest.mark.parametrize("twist", [Unweighted, Unstarted])
def test_proposals_without_their_weights_are_biased(cart, even, twist):
    runs = estimates(cart, even, 200, 20, twist, resample_below=0.5, untwisted=0.1)
    ratio = (runs - kalman(even, cart_parameters(cart)).log_likelihood).exp()
    assert ((ratio.mean(0) - 1).abs() > 10 * ratio.std(0) / math.sqrt(200)).all()


def test_paths_of_a_filter_with_a_bad_twist_have_the_moments_of_the_exact_smoother(cart, uneven):
    runs = 60
    many = copies(uneven, runs)
    other, change = bad_aim(cart)
    with seeded("smoother"):
        ahead = smooth(
            Problem(other, replace(many, measurements=change["measurements"](many))), anywhere(cart, many), passes=2
        )
        filtered = particle_filter(cart, many, particles=1000, proposal=Twist(ahead, untwisted=0.1))
        paths = filtered.paths(300)
    for trajectory, rows in enumerate(uneven.lengths.tolist()):
        states = paths.states.view(300, -1, 3, runs, 2)[:, :rows, trajectory]
        exact = CartPosterior(uneven, trajectory, cart_parameters(cart))
        assert_mean(states.mean(0).transpose(0, 1), exact.states_mean)
        centred = states - exact.states_mean[:, None]
        within = (centred[..., :, None] * centred[..., None, :]).mean(0).transpose(0, 1)
        assert_mean(within, torch.stack([exact.states_covariance[t, :, t] for t in range(rows)]))


@pytest.mark.parametrize("share", [-0.1, 1.0, 1.5, math.nan])
def test_the_untwisted_share_is_below_one(cart, even, share):
    ahead = smooth(Problem(cart, even), anywhere(cart, even), passes=2)
    with pytest.raises(UsageError, match=r"\[0, 1\)"):
        Twist(ahead, untwisted=share)


@pytest.mark.parametrize("weight", [0.0, -0.5, 1.1, math.nan])
def test_the_weight_of_a_tempered_twist_is_at_most_one(cart, even, weight):
    ahead = smooth(Problem(cart, even), anywhere(cart, even), passes=2)
    with pytest.raises(UsageError, match=r"\(0, 1\]"):
        Twist(ahead, tempered=weight)


def test_a_tempered_twist_is_wider_and_the_estimate_stays_unbiased(cart, even):
    ahead = smooth(Problem(cart, even), anywhere(cart, even), passes=2)
    exact, tempered = Twist(ahead), Twist(ahead, tempered=0.5)
    widths = [twist.lookahead.steps.factor.det() for twist in (exact, tempered)]
    assert (widths[1] > widths[0])[:-1].all()
    runs = estimates(cart, even, 500, 20, tempered=0.5)
    assert_mean((runs - kalman(even, cart_parameters(cart)).log_likelihood).exp(), torch.ones(runs.shape[1]))


def test_a_filter_that_looks_ahead_shows_no_frames(cart, even):
    twist = Twist(smooth(Problem(cart, even), anywhere(cart, even), passes=2))
    with pytest.raises(UsageError, match="on_frame"):
        particle_filter(cart, even, particles=5, proposal=twist, on_frame=lambda *_: None)


class TwoKicks(type(example("linear_gaussian"))):
    """The cart, its noise split into a scalar site and a vector site of one component: the same law."""

    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        mean, half = self.gain * control[..., 0] - self.damping * velocity, self.noise / math.sqrt(2)
        first = pyro.sample("first", dist.Normal(mean, half))
        second = pyro.sample("second", dist.Normal(torch.zeros_like(mean).unsqueeze(-1), half).to_event(1))
        acceleration = first + second[..., 0]
        return stack(position + velocity * step + acceleration * step**2 / 2, velocity + acceleration * step)


@pytest.mark.parametrize("known_start", [False, True])
def test_several_noise_sites_are_steered_together(uneven, known_start):
    program = TwoKicks().double().requires_grad_(False)
    exact = kalman(uneven, cart_parameters(program), known_start=known_start).log_likelihood
    ahead = smooth(Problem(program, uneven, known_start), anywhere_of(uneven, channels=2), passes=2)
    torch.testing.assert_close(ahead.log_likelihood, exact, rtol=0, atol=1e-9)
    steered = Twist(ahead, untwisted=0.0)
    found = particle_filter(program, uneven, particles=5, known_start=known_start, proposal=steered)
    torch.testing.assert_close(found.log_likelihood, exact, rtol=0, atol=1e-9)
    paths = smoother_paths(Problem(program, uneven, known_start), ahead, 4000)
    assert paths.noise["first"].shape == (4000, 11, 3) and paths.noise["second"].shape == (4000, 11, 3, 1)
    posterior = CartPosterior(uneven, 0, cart_parameters(program), known_start=known_start)
    both = paths.noise["first"][:, :, 0] + paths.noise["second"][:, :, 0, 0]
    assert_mean(both, posterior.latent_mean[2:])


def anywhere_of(data, channels: int) -> ReferencePath:
    rows, trajectories = data.time.shape
    return ReferencePath(
        torch.zeros(rows, trajectories, 2).double(), torch.zeros(rows - 1, trajectories, channels).double()
    )


class Coarse(type(example("hovercraft:HovercraftTruth"))):
    """Bearings to 20°: some hundred of ten thousand particles from the broad prior fit them."""

    bearing_sd = math.radians(20)


@pytest.mark.slow
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


def test_a_filters_particles_on_another_turn_than_the_path_weigh_the_same(hovercraft, bearings):
    ahead = at_its_mode(hovercraft, bearings)
    turned = bearings.states.clone()
    turned[..., 2] += math.pi * torch.tensor([2, -4, 6], dtype=torch.float64)
    runs = []
    for data in (bearings, replace(bearings, states=turned)):
        with seeded("turned"):
            filtered = particle_filter(hovercraft, data, particles=50, known_start=True, proposal=Twist(ahead))
        runs.append(filtered.log_likelihood)
    torch.testing.assert_close(runs[0], runs[1], rtol=1e-9, atol=1e-9)


def test_a_program_that_blows_up_names_the_trajectory(hovercraft, bearings):
    broken = replace(bearings, controls=bearings.controls.clone())
    broken.controls[3, 1] = torch.nan
    with pytest.raises(FilterError, match="trajectory 2"):
        run_filter(hovercraft, broken, particles=50, known_start=True, look_ahead=True)
