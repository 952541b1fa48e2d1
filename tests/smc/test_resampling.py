"""Resampling is unbiased, ordered and within range, whatever the weights."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings, strategies as st
from oracles import assert_mean

from steady_ppl import seeded
from steady_ppl.smc.resampling import (
    effective_sample_size,
    multinomial,
    normalise,
    stratified,
    systematic,
    systematic_in_parallel,
    take,
)

weights = st.lists(st.one_of(st.just(0.0), st.floats(1e-12, 1.0)), min_size=1, max_size=12).filter(any)
draws = st.integers(1, 30)
uniforms = st.floats(0, 1, exclude_max=True)


every = pytest.mark.parametrize("resampler", [systematic, stratified, multinomial])


def normalised(values: list[float]) -> torch.Tensor:
    """`(N, 1)`."""
    return normalise(torch.tensor(values, dtype=torch.float64).log()[:, None])[0]


def counts(index: torch.Tensor, particles: int) -> torch.Tensor:
    """How often each particle is drawn, `(N, B)`."""
    return torch.zeros(particles, index.shape[1]).scatter_add_(0, index, torch.ones(index.shape))


@given(weights, draws, uniforms)
@settings(deadline=None, derandomize=True)
def test_each_particle_is_drawn_floor_or_ceiling_of_its_share(values, draws, uniform):
    w = normalised(values)
    drawn = counts(systematic(w, draws, torch.tensor([uniform], dtype=torch.float64)), len(values))
    share = draws * w
    assert (drawn >= (share - 1e-9).floor()).all()
    assert (drawn <= (share + 1e-9).ceil()).all()


@given(weights, draws)
@settings(deadline=None, derandomize=True)
def test_the_mean_number_of_offspring_is_the_weight(values, draws):
    w, grid = normalised(values), 1000
    uniform = (torch.arange(grid, dtype=torch.float64) + 0.5) / grid
    index = systematic(w.expand(-1, grid), draws, uniform)
    mean = counts(index, len(values)).double().mean(1)
    # the number of offspring is a step function of u with at most two steps, each at most one grid cell off
    assert ((mean - draws * w[:, 0]).abs() <= 2 / grid).all()


@every
@given(values=weights, draws=draws)
@settings(deadline=None, derandomize=True)
def test_indices_ascend_stay_within_range_and_have_weight(resampler, values, draws):
    index = resampler(normalised(values).expand(-1, 20), draws)
    assert index.shape == (draws, 20)
    assert (index.diff(dim=0) >= 0).all()
    assert index.min() >= 0 and index.max() < len(values)
    assert (torch.tensor(values)[index] > 0).all()


@given(weights, draws, st.floats(0, 1 - 1e-9))
@settings(deadline=None, derandomize=True)
def test_whatever_the_uniform_indices_ascend_stay_within_range_and_have_weight(values, draws, uniform):
    index = systematic(normalised(values), draws, torch.tensor([uniform], dtype=torch.float64))
    assert index.shape == (draws, 1)
    assert (index.diff(dim=0) >= 0).all()
    assert index.min() >= 0 and index.max() < len(values)
    assert (torch.tensor(values)[index] > 0).all()


@every
@pytest.mark.parametrize("values", [[0.25, 0.35, 0.4], [0.0, 0.02, 0.0, 0.9, 0.08, 0.0], [1.0]])
@pytest.mark.parametrize("draws", [1, 5])
def test_the_mean_number_of_offspring_is_the_draws_times_the_weight(resampler, values, draws):
    w = normalised(values)
    with seeded("offspring"):
        drawn = counts(resampler(w.expand(-1, 4000), draws), len(values))
    assert_mean(drawn.double().T, draws * w[:, 0])


def test_systematic_offspring_vary_least_and_multinomial_ones_as_the_binomial():
    w, draws = normalised([0.05, 0.12, 0.33, 0.21, 0.29]), 10
    with seeded("spread"):
        drawn = [counts(r(w.expand(-1, 20_000), draws), 5).double() for r in (systematic, stratified, multinomial)]
    share, spread = draws * w[:, 0], [offspring.var(1) for offspring in drawn]
    assert_mean((drawn[2].T - share).square(), share * (1 - w[:, 0]))
    assert ((drawn[1].T - share).abs() < 2).all()
    assert spread[0].sum() < spread[1].sum() < spread[2].sum()


@pytest.mark.parametrize("resampler", [stratified, multinomial])
def test_a_point_that_rounds_to_one_draws_a_particle_of_weight(resampler, monkeypatch):
    largest = 1 - 2.0**-53
    monkeypatch.setattr(torch, "rand", lambda *size, **kind: torch.full(size, largest, dtype=torch.float64))
    assert resampler(normalised([1.0, 0.0]), 3).max() == 0


def test_a_particle_of_weight_zero_is_not_drawn_by_the_largest_uniform_either():
    index = systematic(normalised([1.0, 0.0]), 3, torch.tensor([1 - 2.0**-52], dtype=torch.float64))
    assert index[:, 0].tolist() == [0, 0, 0]


def test_offspring_of_a_hand_computed_case():
    # cumulative weights times four are 0.4, 2.0, 4.0; the four points at u + 0, 1, 2, 3 for u = 0.3 and for u = 0.5
    index = systematic(normalised([0.1, 0.4, 0.5]).expand(3, 2), 4, torch.tensor([0.3, 0.5], dtype=torch.float64))
    assert index.t().tolist() == [[0, 1, 2, 2], [1, 1, 2, 2]]


@given(weights, draws, uniforms)
@settings(deadline=None, derandomize=True)
def test_one_after_the_other_and_in_parallel_the_same_are_drawn(values, draws, uniform):
    w, u = normalised(values).expand(-1, 2), torch.tensor([uniform, 1 - uniform / 2], dtype=torch.float64)
    assert torch.equal(systematic(w, draws, u), systematic_in_parallel(w.t(), draws, u).t())


@given(weights, draws, uniforms)
@settings(deadline=None, derandomize=True)
def test_systematic_draws_are_counted_up_to_the_ceilings_of_cumulative_weights(values, draws, uniform):
    w, total = normalised(values)[:, 0].tolist(), 0.0
    for weight in w:
        total += weight
    cumulative, expected = 0.0, list[int]()
    for particle, weight in enumerate(w):
        cumulative += weight
        share = cumulative / total
        until = math.ceil(share * draws - uniform) if share < 1 else draws
        expected += [particle] * (until - len(expected))
    index = systematic(normalised(values), draws, torch.tensor([uniform], dtype=torch.float64))
    assert index[:, 0].tolist() == expected


def test_weights_that_are_no_numbers_give_indices_within_range():
    for broken in (math.nan, math.inf):
        weights = torch.tensor([[0.5], [broken], [0.5]], dtype=torch.float64)
        index = systematic(weights, 5)
        assert index.min() >= 0 and index.max() <= 2


def test_each_trajectory_has_its_own_weights_and_uniform():
    both = torch.cat([normalised([0.7, 0.2, 0.1]), normalised([0.1, 0.1, 0.8])], 1)
    uniform = torch.tensor([0.1, 0.9], dtype=torch.float64)
    alone = [systematic(both[:, [b]], 7, uniform[[b]]) for b in range(2)]
    assert torch.equal(systematic(both, 7, uniform), torch.cat(alone, 1))


@every
def test_drawn_uniforms_are_independent_between_trajectories(resampler):
    w, runs = normalised([0.25, 0.35, 0.4]), 4000
    with seeded("resampling"):
        drawn = counts(resampler(w.expand(-1, runs), 1), 3)
    pairs = drawn[0, ::2] * drawn[0, 1::2]
    assert_mean(pairs, 0.25**2)


@pytest.mark.parametrize("spread", [0.0, 1.0, 30.0, 300.0])
def test_200_000_float32_particles_never_give_an_index_out_of_range(spread):
    particles = 200_000
    with seeded("extreme", int(spread)):
        w = normalise(spread * torch.randn(particles, 4))[0]
        assert w.dtype == torch.float32
        for uniform in (torch.zeros(4), torch.full((4,), 1 - 2**-24), torch.rand(4)):
            index = systematic(w, particles, uniform.double())
            assert index.min() >= 0 and index.max() < particles
            share = particles * w.double() / w.double().sum(0)
            assert ((counts(index, particles) - share).abs() < 1 + 1e-6).all()


@every
def test_one_particle_may_hold_all_the_weight(resampler):
    w = torch.zeros(200_000, 3)
    w[0, 0], w[77_777, 1], w[-1, 2] = 1.0, 1.0, 1.0
    index = resampler(w, 200_000)
    assert index.unique(dim=0).tolist() == [[0, 77_777, 199_999]]


def test_effective_sample_size_is_one_over_the_sum_of_squares():
    w = torch.cat([normalised(w) for w in ([1, 1, 1, 1], [1, 0, 0, 0], [0.5, 0.5, 0, 0], [4, 3, 2, 1])], 1)
    expected = torch.tensor([4, 1, 2, 100 / 30], dtype=torch.float64)
    torch.testing.assert_close(effective_sample_size(w), expected)


def test_normalise_returns_the_log_of_the_sum_however_small():
    double = torch.float64
    w, log_sum = normalise(torch.tensor([[-2000.0, 3.0], [-2000.0, -math.inf]], dtype=double))
    torch.testing.assert_close(log_sum, torch.tensor([math.log(2) - 2000, 3.0], dtype=double))
    torch.testing.assert_close(w, torch.tensor([[0.5, 1.0], [0.5, 0.0]], dtype=double))


def test_take_picks_particles_of_each_trajectory():
    values = torch.arange(12).view(3, 2, 2)
    index = torch.tensor([[2, 0], [0, 1]])
    assert take(values, index).tolist() == [[[8, 9], [2, 3]], [[0, 1], [6, 7]]]
