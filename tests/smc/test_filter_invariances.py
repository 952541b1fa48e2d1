"""What must not change a particle filter's log p(y), and what must."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from examples import cut, drives, elsewhere, example

from steady_ppl import particle_filter, seeded
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.gaussian.twisted_proposal import Twist
from steady_ppl.model.problem import Problem
from steady_ppl.smc.proposal import Proposal
from steady_ppl.smc.resampling import systematic


@pytest.mark.parametrize("resample_below", [0.0, 1.0])
def test_trajectories_do_not_touch_each_other(cart, uneven, resample_below):
    def run(data):
        with seeded("alone"):
            return particle_filter(cart, data, particles=100, resample_below=resample_below)

    other = replace(uneven, measurements=uneven.measurements * torch.tensor([1.0, 5.0, 1.0])[:, None])
    a, b = run(uneven), run(other)
    same = torch.tensor([0, 2])
    assert a.log_likelihood[1] != b.log_likelihood[1]
    assert torch.equal(a.log_likelihood[same], b.log_likelihood[same])
    assert torch.equal(a.states[-1][:, same], b.states[-1][:, same])


def test_labels_and_the_clock_change_nothing(cart, uneven):
    with seeded("labels"):
        a = particle_filter(cart, uneven, particles=50)
    with seeded("labels"):
        b = particle_filter(cart, replace(uneven, labels=("x", "y", "z"), time=uneven.time + 2.0**20), particles=50)
    torch.testing.assert_close(a.log_likelihood, b.log_likelihood, rtol=0, atol=1e-6)  # 2²⁰ s leave 2⁻³³ s


def test_what_stands_in_a_missing_cell_changes_nothing(cart, uneven):
    rubbish = torch.where(uneven.observed, uneven.measurements, 1e6)
    with seeded("missing"):
        a = particle_filter(cart, uneven, particles=50)
    with seeded("missing"):
        b = particle_filter(cart, replace(uneven, measurements=rubbish), particles=50)
    assert torch.equal(a.log_likelihood, b.log_likelihood)


def test_a_trajectory_scores_the_same_alone_as_padded(cart, uneven):
    short = uneven.subset([1])
    with seeded("padded"):
        a = particle_filter(cart, short, particles=100, resample_below=1.0)
    with seeded("padded"):
        b = particle_filter(cart, cut(short, 10), particles=100, resample_below=1.0)
    torch.testing.assert_close(a.log_likelihood, b.log_likelihood, rtol=1e-12, atol=1e-12)


@pytest.fixture(scope="module")
def hovercraft():
    return example("hovercraft:HovercraftTruth").requires_grad_(False)


@pytest.fixture(scope="module")
def bearings(hovercraft):
    return drives(hovercraft, 3, 21, gaps=True)


def hovercraft_evidence(program, data, **settings) -> torch.Tensor:
    with seeded("world"):
        return particle_filter(program, data, particles=500, known_start=True, **settings).log_likelihood


@pytest.mark.parametrize("turn", [0.5, math.pi, 4.0])
def test_turning_and_moving_the_world_changes_nothing(hovercraft, bearings, turn):
    program, moved, _ = elsewhere(hovercraft, bearings, turn)
    here, there = hovercraft_evidence(hovercraft, bearings), hovercraft_evidence(program, moved)
    torch.testing.assert_close(here, there.detach(), rtol=1e-9, atol=1e-9)


def test_whole_turns_of_the_heading_change_nothing(hovercraft, bearings):
    turned = bearings.states.clone()
    turned[..., 2] += math.pi * torch.tensor([2, -4, 6], dtype=torch.float64)
    here, there = (hovercraft_evidence(hovercraft, d) for d in (bearings, replace(bearings, states=turned)))
    torch.testing.assert_close(here, there, rtol=1e-9, atol=1e-9)


def test_whole_turns_of_a_bearing_change_nothing(hovercraft, bearings):
    turned = bearings.measurements + 2 * math.pi * torch.tensor([1, -2, 0, 3], dtype=torch.float64)
    here, there = (hovercraft_evidence(hovercraft, d) for d in (bearings, replace(bearings, measurements=turned)))
    torch.testing.assert_close(here, there, rtol=1e-9, atol=1e-9)


def test_the_order_of_the_landmarks_changes_nothing(hovercraft, bearings):
    order = [2, 0, 3, 1]

    class Shuffled(type(hovercraft)):
        landmarks = [hovercraft.landmarks[i] for i in order]

    shuffled = replace(bearings, measurements=bearings.measurements[..., order], observed=bearings.observed[..., order])
    here, there = hovercraft_evidence(hovercraft, bearings), hovercraft_evidence(Shuffled().double(), shuffled)
    torch.testing.assert_close(here, there.detach(), rtol=1e-9, atol=1e-9)


class InOrder(Proposal):
    """A proposal's noise, given to the particles in another order: particle i is the other filter's particle order[i].

    Without a lookahead it is the program's own noise.
    """

    def __init__(self, order: torch.Tensor, ahead: Twist | None) -> None:
        self.order, self.back, self.ahead = order, order.argsort(), ahead
        self.looks_ahead = ahead is not None

    def start(self, particles):
        return self._reordered(self.ahead.start(particles) if self.ahead else self._own(particles, 6))

    def step(self, row, state):
        return self._reordered(self.ahead.step(row, state[self.back]) if self.ahead else self._own(len(state), 3))

    def log_future(self, row, state):
        return self.ahead.log_future(row, state)

    def systematic(self, weights, draws):
        """Resampling of particles that are told apart by their place in the other filter."""
        index = self.back[systematic(weights[self.back], draws)]
        return index[self.order] if draws == len(self.order) else index

    def _own(self, particles, components):
        noise = torch.randn(particles, 3, components, dtype=torch.float64)
        return noise, torch.zeros(particles, 3, dtype=torch.float64)

    def _reordered(self, drawn):
        noise, log_ratio = drawn
        return noise[self.order], log_ratio[self.order]


@pytest.mark.parametrize("look_ahead", [False, True])
@pytest.mark.parametrize("resample_below", [0.0, 1.0])
def test_the_order_of_the_particles_changes_nothing(hovercraft, bearings, resample_below, look_ahead, monkeypatch):
    ahead = Twist(find_and_smooth(Problem(hovercraft, bearings)), untwisted=0.3) if look_ahead else None
    order, runs = torch.randperm(60), []
    for proposal in (InOrder(torch.arange(60), ahead), InOrder(order, ahead)):
        monkeypatch.setattr("steady_ppl.smc.genealogy.systematic", proposal.systematic)
        settings = {"resample_below": resample_below, "resampler": proposal.systematic}
        with seeded("particles"):
            filtered = particle_filter(hovercraft, bearings, particles=60, proposal=proposal, **settings)
            runs.append((filtered, filtered.paths(25)))
    (ours, our_paths), (theirs, their_paths) = runs
    assert any(ancestors is not None for ancestors in ours.ancestors) == (resample_below > 0)
    assert torch.equal(ours.roots, theirs.roots)
    for our, their in (
        (ours.log_likelihood, theirs.log_likelihood),
        (ours.effective_sizes, theirs.effective_sizes),
        (ours.log_weights[order], theirs.log_weights),
        (torch.stack(ours.states)[:, order], torch.stack(theirs.states)),
        (our_paths.states, their_paths.states),
        (our_paths.noise, their_paths.noise),
    ):
        torch.testing.assert_close(our, their, rtol=1e-9, atol=1e-9)


def test_a_wrong_landmark_costs_many_nats(hovercraft, bearings):
    class Wrong(type(hovercraft)):
        landmarks = ((12.0, -3.0), *hovercraft.landmarks[1:])

    assert (hovercraft_evidence(hovercraft, bearings) - hovercraft_evidence(Wrong().double(), bearings)).min() > 20


def test_reversed_time_costs_many_nats(hovercraft, bearings):
    whole = bearings.subset([0, 2])
    reversed_ = replace(whole, measurements=whole.measurements.flip(0), observed=whole.observed.flip(0))
    assert (hovercraft_evidence(hovercraft, whole) - hovercraft_evidence(hovercraft, reversed_)).sum() > 100
