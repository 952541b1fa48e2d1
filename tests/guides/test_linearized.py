"""E steps that linearise: exact scores and draws on the cart, what blows up, and which filter judges."""

from __future__ import annotations

import math
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import copies, drives, example
from oracles import CartPosterior, assert_mean, cart_parameters, kalman
from pyro.infer import Trace_ELBO
from torch import Tensor

from steady_ppl import (
    Constant,
    FilterError,
    Fit,
    GaussianGuide,
    Joint,
    LookaheadGuide,
    PathGuide,
    log_likelihood,
    seeded,
    stack,
)
from steady_ppl.comparison.evaluate import evaluate
from steady_ppl.gaussian.smoother import find_path, smooth, smoother_paths
from steady_ppl.model.handlers import AtMean, Recording, Replaying, Standardised, running
from steady_ppl.model.problem import Problem

GUIDES = (GaussianGuide, LookaheadGuide)
Cart = type(example("linear_gaussian"))


class HeavyTailed(Cart):
    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        kick = pyro.sample("kick", dist.StudentT(5.0, self.gain * control[..., 0] - self.damping * velocity, 0.6))
        return stack(position + velocity * step, velocity + kick * step)


def gradient_of_q(program, guide: PathGuide, data, *, known_start: bool) -> Tensor:
    """Of the M step's objective with respect to the logarithms of the cart's parameters, `(4,)`."""
    elbo = Trace_ELBO(num_particles=guide.draws, vectorize_particles=guide.draws > 1, max_plate_nesting=2)
    loss = elbo.differentiable_loss(Joint(program, known_start=known_start), guide, data)
    return -torch.stack(torch.autograd.grad(loss, list(program.parameters())))


# --- the E step on the cart -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("guide", GUIDES)
@pytest.mark.parametrize("known_start", [False, True])
@pytest.mark.parametrize("case", ["even", "uneven"])
def test_the_m_steps_gradient_is_the_exact_score(guide, case, known_start):
    program = example("linear_gaussian")
    data = drives(program, 3, 12, gaps=case == "uneven")
    with torch.no_grad():
        for parameter in program.parameters():
            parameter += 0.2  # away from the truth, where the score is large
    evidence = kalman(data, cart_parameters(program), known_start=known_start).log_likelihood.sum()
    score = torch.stack(torch.autograd.grad(evidence, list(program.parameters())))
    stepped = guide(program, draws=50, tempering=Constant(), known_start=known_start)
    found = []
    for run in range(20):
        with seeded("score", run):
            stepped.refresh(data, 0.0)
        found.append(gradient_of_q(program, stepped, data, known_start=known_start))
    assert_mean(torch.stack(found), score)


@pytest.mark.parametrize("known_start", [False, True])
def test_a_gaussian_guides_draws_have_the_moments_of_the_exact_smoother(known_start):
    program = example("linear_gaussian").requires_grad_(False)
    data = drives(program, 3, 12, gaps=True)
    guide = GaussianGuide(program, draws=3000, tempering=Constant(), known_start=known_start)
    assert guide.refresh(data, 0.0).keys() == {"observation_weight", "log_evidence"}
    assert torch.equal(guide.paths.start["start"].expand(3000, 1, 3, 2), guide.paths.states[:, :1]) or not known_start
    torch.testing.assert_close(guide.paths.start["start"], guide.paths.states[:, :1], rtol=0, atol=1e-10)
    for trajectory, rows in enumerate(data.lengths.tolist()):
        exact = CartPosterior(data, trajectory, cart_parameters(program), known_start=known_start)
        states = guide.paths.states[:, :rows, trajectory]
        assert_mean(states, exact.states_mean)
        centred = states - exact.states_mean
        within = centred[..., :, None] * centred[..., None, :]
        assert_mean(within, torch.stack([exact.states_covariance[t, :, t] for t in range(rows)]))
        lagged = centred[:, 1:, :, None] * centred[:, :-1, None, :]
        assert_mean(lagged, torch.stack([exact.states_covariance[t + 1, :, t] for t in range(rows - 1)]))
        accelerations = guide.paths.noise["acceleration"][:, : rows - 1, trajectory]
        assert_mean(accelerations, exact.latent_mean[2:])
        squares = (accelerations - exact.latent_mean[2:]).square()
        assert_mean(squares, exact.latent_covariance.diagonal()[2:])


@pytest.mark.slow
@pytest.mark.parametrize("guide", GUIDES)
def test_a_tempered_guide_draws_from_the_power_posterior(guide):
    program = example("linear_gaussian").requires_grad_(False)
    data = drives(program, 1, 12)
    # a weight of 1/4 on normal measurements is twice the measurement's standard deviation
    wide = cart_parameters(program) | {"measurement_sd": 2 * program.measurement_sd}
    tempered = guide(program, draws=100, tempering=Constant(0.25))
    means = []
    for run in range(25):
        with seeded("power", run):
            assert tempered.refresh(data, 0.0)["observation_weight"] == 0.25
        means.append(tempered.paths.states[:, :, 0].mean(0))
    assert_mean(torch.stack(means), CartPosterior(data, 0, wide).states_mean)


@pytest.mark.parametrize("guide", GUIDES)
def test_the_paths_obey_the_carts_transition_given_their_noise(guide):
    program = example("linear_gaussian").requires_grad_(False)
    data = drives(program, 3, 12, gaps=True)
    stepped = guide(program, draws=20)
    stepped.refresh(data, 1.0)
    states = stepped.paths.states
    with running(20, 11, 3), Replaying(stepped.paths.noise):
        after = program.transition(states[:, :-1], data.controls[:-1], data.elapsed[:-1], data.steps)
    inside = data.transitions
    torch.testing.assert_close(after[:, inside], states[:, 1:][:, inside], rtol=0, atol=1e-10)


def test_a_lookahead_filter_on_the_cart_loses_no_particle_worth_speaking_of():
    program = example("linear_gaussian").requires_grad_(False)
    guide = LookaheadGuide(program, particles=100, tempering=Constant())
    figures = guide.refresh(drives(program, 3, 12, gaps=True), 0.0)
    # only the untwisted hundredth that a row draws can be lost to the measurements
    assert figures["ess"] > 80 and figures["roots"] > 80


# --- draws of a curved program ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["hovercraft:HovercraftTruth", "neural_vehicle:NeuralHovercraft"])
def test_gaussian_draws_obey_the_density_of_the_channels(name):
    program = example(name).requires_grad_(False)
    with seeded("weights"):
        for parameter in program.parameters():
            if name.startswith("neural"):
                parameter.normal_(0, 0.2)
    data = drives(program, 2, 12, gaps=True)
    path = find_path(Problem(program, data, True))
    ahead = smooth(Problem(program, data, True), path)
    with seeded("draws"):
        paths = smoother_paths(Problem(program, data, True), ahead, 20)
    with seeded("draws"):
        _, states, white = ahead.draws(20)
    torch.testing.assert_close(paths.states[:, data.rows], states[:, data.rows])
    seen = Recording()
    with running(20, 11, 2), seen, AtMean():
        program.transition(states[:, :-1], data.controls[:-1], data.elapsed[:-1], data.steps)
    density = seen.distributions["acceleration"]
    expected, inside = density.mean + density.stddev * white, data.transitions
    torch.testing.assert_close(paths.noise["acceleration"][:, inside], expected[:, inside], rtol=1e-9, atol=1e-9)
    assert white[:, inside].std() > 0.5 and torch.equal(paths.start["start"][:, 0], data.states[0].expand(20, 2, 6))


def test_gaussian_draws_agree_with_the_transition_to_first_order():
    program = example("hovercraft:HovercraftTruth").requires_grad_(False)
    data = drives(program, 2, 12)
    ahead = smooth(Problem(program, data, True), find_path(Problem(program, data, True)), passes=40, tolerance=0)
    mean = ahead.path(data)
    _, states, noise = ahead.draws(50)

    def gap(share: float) -> Tensor:
        """How far the program leads from the next state, the draws being a share of themselves off the mean."""
        moved, shaken = mean.states + share * (states - mean.states), mean.noise + share * (noise - mean.noise)
        with running(50, 11, 2), Standardised(shaken):
            after = program.transition(moved[:, :-1], data.controls[:-1], data.elapsed[:-1], data.steps)
        return (after - moved[:, 1:]).abs()

    assert gap(1.0)[..., [2, 5]].max() < 1e-9  # heading and yaw rate are linear
    assert 1e-6 < gap(1.0).max() < 0.01 * (states[:, 1:] - states[:, :-1]).abs().max()
    # what is left is of second order: a tenth of the deviation leaves a hundredth, up to its own tenth (third order)
    assert float(gap(0.1).max() / gap(1.0).max()) == pytest.approx(0.01, rel=0.2)


# --- what blows up ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("measured", [6, 2])
@pytest.mark.parametrize("guide", GUIDES)
def test_a_program_that_blows_up_names_the_trajectory(guide, measured):
    program = example("linear_gaussian").requires_grad_(False)
    data = drives(program, 2, 6)
    data.controls[3, 1] = math.inf  # the velocity of row 4, seen or not
    data = replace(data, observed=data.observed & (torch.arange(6) < measured)[:, None, None])
    with pytest.raises(FilterError, match=r"trajectory 2.* blown up|trajectory 2.* weight is zero") as error:
        guide(program).refresh(data, 1.0)
    assert error.value.trajectory == "2"


@pytest.mark.parametrize("guide", GUIDES)
def test_a_program_that_blows_up_later_names_the_trajectory(guide):
    program = example("linear_gaussian").requires_grad_(False)
    data = drives(program, 2, 6)
    stepped = guide(program)
    stepped.refresh(data, 1.0)
    data.controls[3, 1] = math.inf
    with pytest.raises(FilterError, match="trajectory 2"):
        stepped.refresh(data, 1.0)


@pytest.mark.parametrize(
    "guide",
    [
        GaussianGuide,
        LookaheadGuide,
    ],
)
def test_what_blows_up_in_a_trajectorys_padding_does_no_harm(guide):
    program = example("linear_gaussian").requires_grad_(False)
    data = drives(program, 2, 6, gaps=True)
    assert data.lengths.tolist() == [6, 4]
    data.controls[3, 1] = math.inf
    stepped = guide(program, draws=10)
    stepped.refresh(data, 1.0)
    stepped.refresh(data, 1.0)
    assert stepped.paths.states.isfinite().all()
    assert all(value.isfinite().all() for value in stepped.memory.values())


# --- which filter judges ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("known_start", [False, True])
def test_looking_ahead_gives_kalmans_log_likelihood_of_every_nth_row(known_start):
    program = example("linear_gaussian").requires_grad_(False)
    data = drives(program, 3, 12, gaps=True)
    exact = kalman(data.observed_every(4), cart_parameters(program), known_start=known_start).log_likelihood
    settings = {"known_start": known_start, "every": 4}
    for look_ahead, particles in ((True, 20), (False, 100)):
        found = log_likelihood(program, copies(data, 200), particles=particles, look_ahead=look_ahead, **settings)
        assert_mean((found.view(3, 200).T - exact).exp(), torch.ones(3))


def test_looking_ahead_agrees_with_looking_back_on_a_hovercraft():
    program = example("hovercraft:HovercraftTruth").requires_grad_(False)
    data = copies(drives(program, 2, 12, gaps=True), 30)
    ahead, blind = (
        log_likelihood(program, data, particles=n, known_start=True, every=3, look_ahead=look).view(2, 30).T
        for n, look in ((100, True), (1000, False))
    )
    assert_mean((ahead + ahead.var(0) / 2) - (blind + blind.var(0) / 2), torch.zeros(2))
    assert (ahead.std(0) < blind.std(0)).all()


@pytest.mark.parametrize(
    ("program", "says"),
    [(Cart, "lookahead"), (HeavyTailed, "bootstrap (site 'kick' is StudentT with event shape ()")],
)
def test_an_evaluation_looks_ahead_where_the_program_allows_and_says_why_not(program, says):
    judged = program().requires_grad_(False)
    table = drives(judged, 2, 32).to(torch.float64)
    result = evaluate(Fit(judged, "hand", known_start=True), table, particles=100, rollouts=5)
    assert result["filter"].startswith(says)
    assert math.isfinite(result["log_likelihood"]) and result["state_estimation"]
    chosen = evaluate(Fit(judged, "hand", known_start=True), table, particles=100, rollouts=5, look_ahead=False)
    assert chosen["filter"] == "bootstrap (as asked)"
    # 100 particles from a known start, four measured rows: the two filters are within some tenths of a nat
    assert chosen["log_likelihood"] == pytest.approx(result["log_likelihood"], abs=1.0)


def test_a_program_that_blows_up_is_said_and_not_drawn_from():
    program = example("hovercraft:HovercraftTruth").requires_grad_(False)
    data = drives(program, 3, 12)
    looking = GaussianGuide(program, draws=4, known_start=True, tempering=Constant(), search_again=math.inf)
    looking.refresh(data, 0.0)
    program.noise = torch.full((3,), math.nan, dtype=torch.float64)
    with pytest.raises(FilterError, match=r"not finite|no path|cannot|blown"):
        looking.refresh(data, 0.5)
