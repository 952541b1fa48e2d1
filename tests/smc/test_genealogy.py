"""Whole trajectories traced back through a filter's genealogy."""

from __future__ import annotations

from contextlib import ExitStack

import pyro
import pytest
import torch
from examples import copies, drives, example
from oracles import CartPosterior, assert_mean, cart_parameters

from steady_ppl import particle_filter, seeded
from steady_ppl.model.handlers import Replaying
from steady_ppl.model.substeps import sample_row

PROGRAMS = ("linear_gaussian", "hovercraft", "hovercraft:HovercraftTruth", "truck", "pendulum")


@pytest.mark.parametrize("resample_below", [0.5, 1.0])
def test_paths_have_the_moments_of_the_exact_smoother(cart, uneven, resample_below):
    runs = 60
    with seeded("smoother"):
        filtered = particle_filter(cart, copies(uneven, runs), particles=2000, resample_below=resample_below)
        paths = filtered.paths(500)
    for trajectory, rows in enumerate(uneven.lengths.tolist()):
        states = paths.states.view(500, -1, 3, runs, 2)[:, :rows, trajectory]
        exact = CartPosterior(uneven, trajectory, cart_parameters(cart))
        assert_mean(states.mean(0).transpose(0, 1), exact.states_mean)
        centred = states - exact.states_mean[:, None]
        within = (centred[..., :, None] * centred[..., None, :]).mean(0).transpose(0, 1)
        assert_mean(within, torch.stack([exact.states_covariance[t, :, t] for t in range(rows)]))
        lagged = (centred[:, 1:, ..., :, None] * centred[:, :-1, ..., None, :]).mean(0).transpose(0, 1)
        assert_mean(lagged, torch.stack([exact.states_covariance[t + 1, :, t] for t in range(rows - 1)]))


@pytest.mark.parametrize("name", PROGRAMS)
def test_paths_obey_the_transition_given_their_noise(name):
    program = example(name).requires_grad_(False)
    data = drives(program, 3, 12, gaps=True)
    with seeded("ancestry"):
        filtered = particle_filter(program, data, particles=300, resample_below=1.0)
        paths = filtered.paths(40)
    assert sum(ancestors is not None for ancestors in filtered.ancestors) >= 9
    assert len(paths.states[:, 0].unique(dim=0)) < 40  # lineages have coalesced: the ancestors did something
    with ExitStack() as stack:
        for dim, size in enumerate((3, 11, 40), start=1):
            stack.enter_context(pyro.plate(f"dim_{dim}", size, dim=-dim))
        stack.enter_context(Replaying(paths.noise))
        after = sample_row(program, paths.states[:, :-1], data.controls[:-1], data.elapsed[:-1], data.steps)
    torch.testing.assert_close(after, paths.states[:, 1:], rtol=1e-12, atol=1e-12)
    assert torch.equal(paths.start["start"], paths.states[:, :1])


def test_draws_need_not_be_as_many_as_particles(cart, even):
    filtered = particle_filter(cart, even, particles=20)
    for draws in (1, 7, 20, 90):
        paths = filtered.paths(draws)
        assert paths.states.shape == (draws, 12, 3, 2)
        assert paths.start["start"].shape == (draws, 1, 3, 2)
        assert paths.noise["acceleration"].shape == (draws, 11, 3)
    assert paths.event_dims == {"states": 1, "start": 1, "acceleration": 0}


def test_roots_count_the_first_rows_particles_with_descendants(cart, even):
    with seeded("roots"):
        filtered = particle_filter(cart, even, particles=200, resample_below=1.0)
    index = torch.arange(200)[:, None].expand(-1, 3)
    for ancestors in filtered.ancestors[::-1]:
        index = index if ancestors is None else ancestors.gather(0, index)
    alive = [len(index[:, b].unique()) for b in range(3)]
    assert all(1 <= count < 100 for count in alive)
    assert filtered.roots.tolist() == alive


def test_a_known_start_holds_for_every_path(cart, uneven):
    paths = particle_filter(cart, uneven, particles=50, known_start=True).paths(10)
    assert torch.equal(paths.states[:, 0], uneven.states[0].expand(10, 3, 2))
    assert torch.equal(paths.start["start"][:, 0], uneven.states[0].expand(10, 3, 2))
