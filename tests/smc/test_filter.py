"""The bootstrap filter against exact answers, and its errors."""

from __future__ import annotations

import math
from dataclasses import replace

import pyro
import pytest
import torch
from examples import copies, drives, example
from oracles import assert_mean, cart_parameters, kalman

from steady_ppl import DataError, FilterError, ProgramError, particle_filter, roll_out, seeded
from steady_ppl.model.handlers import AtMean
from steady_ppl.model.program import Program
from steady_ppl.smc.filter import ParticleFilter
from steady_ppl.smc.proposal import Proposal
from steady_ppl.smc.resampling import multinomial, stratified, systematic, take


def estimates(program, data, runs: int, particles: int, **settings) -> torch.Tensor:
    """log p(y) of each trajectory by `runs` independent filters, `(runs, B)`."""
    with seeded("estimates"):
        filtered = particle_filter(program, copies(data, runs), particles=particles, keep_history=False, **settings)
    return filtered.log_likelihood.view(len(data), runs).T


# --- log p(y) -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_log_likelihood_agrees_with_kalman(cart, uneven, dtype):
    runs = estimates(example("linear_gaussian", dtype), uneven.to(dtype), 60, 2000)
    bias = -runs.var(0) / 2  # of the logarithm of an unbiased, nearly log-normal estimate
    assert_mean(runs - bias, kalman(uneven, cart_parameters(cart)).log_likelihood)


@pytest.mark.parametrize("resample_below", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("drive", ["even", "uneven"])
def test_evidence_is_unbiased(cart, drive, resample_below, request):
    data = request.getfixturevalue(drive)
    runs = estimates(cart, data, 1000, 50, resample_below=resample_below)
    exact = kalman(data, cart_parameters(cart)).log_likelihood
    assert_mean((runs - exact).exp(), torch.ones(3))


@pytest.mark.parametrize("known_start", [False, True])
@pytest.mark.parametrize("weight", [0.1, 0.6])
def test_tempered_evidence_is_that_of_the_power_posterior(cart, uneven, weight, known_start):
    runs = estimates(cart, uneven, 500, 100, observation_weight=weight, known_start=known_start)
    exact = kalman(uneven, cart_parameters(cart), weight=weight, known_start=known_start).log_likelihood
    assert_mean((runs - exact).exp(), torch.ones(3))


def test_evidence_from_a_known_start_is_unbiased(cart, uneven):
    runs = estimates(cart, uneven, 1000, 50, known_start=True)
    exact = kalman(uneven, cart_parameters(cart), known_start=True).log_likelihood
    assert_mean((runs - exact).exp(), torch.ones(3))


class Shifted(Proposal):
    """Normal noise that is moved and widened, on states as they come; keeps what it is shown."""

    def __init__(self, trajectories: int, shift: float = 0.4, width: float = 1.2) -> None:
        self.trajectories, self.shift, self.width = trajectories, shift, width
        self.shown: list[torch.Tensor] = []

    def start(self, particles):
        return self._drawn(particles, 2)

    def step(self, row, state):
        self.shown.append(state)
        return self._drawn(len(state), 1)

    def _drawn(self, particles, channels):
        white = torch.randn(particles, self.trajectories, channels, dtype=torch.float64)
        noise = self.shift + self.width * white
        return noise, (math.log(self.width) + (white.square() - noise.square()) / 2).sum(-1)


@pytest.mark.slow
@pytest.mark.parametrize("known_start", [False, True])
@pytest.mark.parametrize("resample_below", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("drive", ["even", "uneven"])
def test_a_proposal_that_does_not_look_ahead_is_unbiased(cart, drive, resample_below, known_start, request):
    data, settings = request.getfixturevalue(drive), {"resample_below": resample_below, "known_start": known_start}
    runs = estimates(cart, data, 1000, 50, proposal=Shifted(3 * 1000), **settings)
    exact = kalman(data, cart_parameters(cart), known_start=known_start).log_likelihood
    assert_mean((runs - exact).exp(), torch.ones(3))


def test_a_proposals_weights_sum_to_one_where_the_last_row_is_not_measured(cart, even):
    unseen = replace(even, observed=even.observed & (torch.arange(12) < 11)[:, None, None])
    filtered = particle_filter(cart, unseen, particles=50, proposal=Shifted(3))
    torch.testing.assert_close(filtered.log_weights.exp().sum(0), torch.ones(3, dtype=torch.float64))


def test_a_proposal_is_shown_the_states_that_it_moves(cart, uneven):
    proposal = Shifted(3)
    filtered = particle_filter(cart, uneven, particles=50, proposal=proposal, resample_below=1.0)
    assert len(proposal.shown) == 11
    for shown, states, ancestors in zip(proposal.shown, filtered.states, filtered.ancestors, strict=False):
        assert torch.equal(shown, take(states, ancestors))


@pytest.mark.parametrize("resampler", [systematic, stratified, multinomial])
def test_evidence_is_unbiased_with_every_resampler(cart, uneven, resampler):
    runs = estimates(cart, uneven, 1000, 50, resample_below=1.0, resampler=resampler)
    exact = kalman(uneven, cart_parameters(cart)).log_likelihood
    assert_mean((runs - exact).exp(), torch.ones(3))


def test_steps_by_hand_are_the_filter(cart, uneven):
    with seeded("steps"):
        filtered = particle_filter(cart, uneven, particles=50)
    with seeded("steps"), torch.no_grad():
        by_hand = ParticleFilter(cart, uneven, particles=50)
        state, evidence = by_hand.init(), []
        for row, states in enumerate(filtered.states):
            assert torch.equal(state.states, states)
            state, step = by_hand.step(state, row)
            assert torch.equal(step.effective_sizes, filtered.effective_sizes[row])
            evidence.append(step.evidence)
    assert torch.equal(torch.stack(evidence).sum(0), filtered.log_likelihood)
    assert torch.equal(state.log_weights, filtered.log_weights)


def test_variance_falls_as_one_over_the_number_of_particles():
    vague = example("linear_gaussian").requires_grad_(False)
    vague.measurement_sd = torch.tensor(1.0, dtype=torch.float64)  # far from degenerate at 64 particles
    data, sizes = drives(vague, 3, 12), (64, 256, 1024)
    y = torch.stack([estimates(vague, data, 300, size).var(0).log().mean() for size in sizes])
    x = torch.tensor(sizes, dtype=torch.float64).log()
    slope = float(((x - x.mean()) * y).sum() / (x - x.mean()).square().sum())
    # a log-variance of 900 runs has standard error √(2 / 900), the slope .017; the rest is the next order in 1/N
    assert slope == pytest.approx(-1, abs=0.15)


def test_the_first_row_counts_at_a_known_start_exactly(cart, even):
    only_first = replace(even, observed=even.observed & (torch.arange(12) == 0)[:, None, None])
    filtered = particle_filter(cart, only_first, particles=7, known_start=True)
    density = torch.distributions.Normal(even.states[0, :, 0], cart.measurement_sd)
    torch.testing.assert_close(filtered.log_likelihood, density.log_prob(even.measurements[0, :, 0]))


def test_the_first_row_is_worth_what_kalman_says(cart, even):
    without = replace(even, observed=even.observed & (torch.arange(12) > 0)[:, None, None])
    parameters = cart_parameters(cart)
    worth = kalman(even, parameters).log_likelihood - kalman(without, parameters).log_likelihood
    assert worth.abs().max() > 0.5
    with_it, without_it = estimates(cart, even, 60, 2000), estimates(cart, without, 60, 2000)
    assert_mean(with_it + with_it.var(0) / 2 - without_it - without_it.var(0) / 2, worth)


def test_effective_sizes_and_weights_of_the_last_row(cart, even):
    with seeded("weights"):
        filtered = particle_filter(cart, even, particles=100, resample_below=0.0)
    torch.testing.assert_close(filtered.log_weights.exp().sum(0), torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(filtered.effective_sizes[-1], 1 / filtered.log_weights.exp().square().sum(0))
    assert torch.equal(filtered.roots, torch.full((3,), 100.0, dtype=torch.float64))


def test_nothing_observed_leaves_prior_weights_and_no_evidence(cart, even):
    filtered = particle_filter(cart, replace(even, observed=torch.zeros_like(even.observed)), particles=10)
    assert torch.equal(filtered.log_likelihood, torch.zeros(3, dtype=torch.float64))
    assert torch.equal(filtered.effective_sizes, torch.full((12, 3), 10.0, dtype=torch.float64))


# --- filtered and smoothed states -----------------------------------------------------------------------------------


def test_filtered_means_and_covariances_agree_with_kalman(cart, uneven):
    runs, rows = 60, uneven.time.shape[0]
    before, after = [], []

    def on_frame(row, states, log_before, log_after):
        for log_weights, moments in ((log_before, before), (log_after, after)):
            weights = log_weights.exp()[..., None]
            mean = (weights * states).sum(0)
            square = (weights[..., None] * states[..., :, None] * states[..., None, :]).sum(0)
            moments.append(torch.cat([mean, square.flatten(-2)[:, [0, 1, 3]]], -1))

    with seeded("moments"):
        particle_filter(cart, copies(uneven, runs), particles=2000, keep_history=False, on_frame=on_frame)
    exact = kalman(uneven, cart_parameters(cart))
    for moments, means, covariances in (
        (before, exact.predicted_means, exact.predicted_covariances),
        (after, exact.means, exact.covariances),
    ):
        squares = covariances + means[..., :, None] * means[..., None, :]
        expected = torch.cat([means, squares.flatten(-2)[..., [0, 1, 3]]], -1)
        found = torch.stack(moments).view(rows, 3, runs, 5).movedim(2, 0)
        inside = uneven.rows
        assert_mean(found[:, inside], expected[inside])


def test_no_history_without_keep_history_and_the_same_estimate(cart, even):
    with seeded("history"):
        with_it = particle_filter(cart, even, particles=50)
    with seeded("history"):
        without = particle_filter(cart, even, particles=50, keep_history=False)
    assert torch.equal(with_it.log_likelihood, without.log_likelihood)
    assert without.states == [] and without.noise == {}


# --- errors ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_impossible_measurement_names_trajectory_and_time(even, dtype):
    program = example("linear_gaussian", dtype)
    data = replace(even, time=even.time + 100.0, labels=("a", "b", "c"))
    data.measurements[7, 1] = 1e300
    with pytest.raises(FilterError, match=r"trajectory b at 0.7 s: every particle's weight is zero") as error:
        particle_filter(program, data.to(dtype), particles=20)
    assert error.value.trajectory == "b"
    assert error.value.time == pytest.approx(0.7)
    data.measurements[7, 1] = 0.0


def test_a_state_that_is_not_a_number_names_trajectory_and_time(cart, even):
    controls = even.controls.clone()
    controls[2, 2] = math.nan  # the velocity and the position of row 3
    with pytest.raises(FilterError, match=r"trajectory 3 at 0.3 s: no particle is left that is a number") as error:
        particle_filter(cart, replace(even, controls=controls, time=even.time + 100.0), particles=20)
    assert error.value.trajectory == "3"
    assert error.value.time == pytest.approx(0.3)


def test_a_single_particle_that_blows_up_explains_nothing_and_is_counted(cart, even):
    class Broken(type(cart)):
        def transition(self, state, control, time, step):
            after = super().transition(state, control, time, step)
            after[5, :, 1] = torch.where(time[:, 1] > 0.55, math.nan, 1.0)[..., None] * after[5, :, 1]
            return after

    runs = []
    for program in (cart, Broken().double().requires_grad_(False)):
        with seeded("broken"):
            runs.append(particle_filter(program, even, particles=20, resample_below=0.0))
    whole, broken = runs
    assert whole.blown_up.tolist() == [0, 0, 0]
    assert broken.blown_up[1] > 0 and broken.blown_up[[0, 2]].tolist() == [0, 0]
    others = torch.arange(20) != 5
    lost = whole.log_weights[5, 1].exp()  # what the others' share of the evidence lacks
    torch.testing.assert_close(broken.log_likelihood[1], whole.log_likelihood[1] + (1 - lost).log())
    torch.testing.assert_close(broken.log_weights[others, 1].exp(), whole.log_weights[others, 1].exp() / (1 - lost))
    assert float(broken.log_weights[5, 1]) == -math.inf and broken.paths(30).states.isfinite().all()
    torch.testing.assert_close(broken.log_likelihood[[0, 2]], whole.log_likelihood[[0, 2]])


def test_a_parameter_that_is_not_a_number_is_an_error(even):
    program = example("linear_gaussian")
    with torch.no_grad():
        program.damping_unconstrained.fill_(math.nan)
    with pytest.raises(FilterError, match="trajectory 1 at 0.1 s"):
        particle_filter(program, even, particles=20)


def test_a_known_start_without_truth_is_an_error(cart, even):
    with pytest.raises(DataError, match="true states"):
        particle_filter(cart, even.without_truth(), particles=20, known_start=True)


def test_a_known_start_needs_the_whole_state_as_one_site(even):
    class Split(Program):
        states, controls, measurements = ("position", "velocity"), ("push",), ("position",)

        def initial(self):
            parts = [pyro.sample(name, pyro.distributions.Normal(0.0, 1.0)) for name in ("p", "v")]
            return torch.stack(parts, -1)

    with pytest.raises(ProgramError, match="whole state as one site") as error:
        particle_filter(Split(), even, particles=20, known_start=True)
    assert error.value.site == "p"


def test_200_000_float32_particles_never_throw():
    program = example("hovercraft", torch.float32).requires_grad_(False)
    data = drives(program, 1, 16)
    assert data.controls.dtype == torch.float32
    with seeded("large"):
        filtered = particle_filter(program, data, particles=200_000, resample_below=1.0, keep_history=False)
    assert filtered.log_likelihood.isfinite().all()
    assert filtered.roots.min() >= 1 and filtered.roots.max() <= 200_000
    assert filtered.effective_sizes.min() > 0.999 and filtered.effective_sizes.max() < 200_000.1


# --- roll-outs --------------------------------------------------------------------------------------------------------


def test_roll_out_without_noise_is_the_mean_recursion(cart, uneven):
    state = uneven.states[:1]
    found = torch.cat(
        list(
            roll_out(
                cart,
                state,
                uneven.controls[:-1, None],
                uneven.elapsed[:-1, None],
                uneven.steps[:, None],
                handler=AtMean(),
            )
        )
    )
    position, velocity = state[0].unbind(-1)
    for row, step in enumerate(uneven.steps):
        acceleration = cart.gain * uneven.controls[row, :, 0] - cart.damping * velocity
        position = position + velocity * step + acceleration * step**2 / 2
        velocity = velocity + acceleration * step
        torch.testing.assert_close(found[row], torch.stack([position, velocity], -1), rtol=1e-12, atol=1e-12)
