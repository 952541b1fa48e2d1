"""Angles in a linearised program: on whichever turn the program, its path or its start keeps them."""

from __future__ import annotations

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import cut, drives, example

from steady_ppl import WrappedNormal, particle_filter, seeded, stack, wrap
from steady_ppl.gaussian.information_filter import Lookahead
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.gaussian.twisted_proposal import Twist
from steady_ppl.model.problem import Problem

Truth = type(example("hovercraft:HovercraftTruth"))


class OnTheCircle(Truth):
    """Keeps its heading between −π and π."""

    def transition(self, state, control, time, step):
        x, y, heading, *rest = super().transition(state, control, time, step).unbind(-1)
        return stack(x, y, wrap(heading), *rest)


class Compass(Truth):
    """Sees its heading besides."""

    reading = WrappedNormal
    measurements = property(lambda self: (*super().measurements, "compass [rad]"))

    def observe(self, state):
        super().observe(state)
        pyro.sample("compass", self.reading(state[..., 2], torch.full_like(state[..., 2], 0.05)))


class CountsTurns(Compass):
    """Its compass goes on after a whole turn."""

    reading = dist.Normal


class CountsTurnsUndeclared(CountsTurns):
    """Its heading is a number like any other."""

    angles = ()


class Starts(Truth):
    """Begins with a heading of another standard deviation."""

    sd = math.pi

    def initial(self):
        mean = torch.tensor([0.5, 1.0, math.pi / 5, 0.25, 0.1, math.pi / 50])
        sd = torch.tensor([2.0, 2.0, self.sd, 0.3, 0.2, 0.1 * math.pi])
        return pyro.sample("start", dist.Normal(mean.to(self.noise), sd.to(self.noise)).to_event(1))


def found(program, data, known_start: bool = False) -> Lookahead:
    with seeded("found"):
        return find_and_smooth(Problem(program.double().requires_grad_(False), data, known_start))


@pytest.fixture(scope="module")
def turning():
    """Drives of which some cross the end of the circle."""
    data = drives(example("hovercraft:HovercraftTruth").requires_grad_(False), 6, 61)
    headings = wrap(data.states[..., 2])
    assert ((headings[1:] - headings[:-1]).abs().amax(0) > math.pi).any()
    return data


@pytest.mark.slow
@pytest.mark.parametrize("known_start", [False, True])
def test_a_program_may_keep_its_angles_on_the_circle(turning, known_start):
    straight, circle = found(Truth(), turning, known_start), found(OnTheCircle(), turning, known_start)
    torch.testing.assert_close(circle.log_likelihood, straight.log_likelihood, rtol=0, atol=0.05)
    headings = circle.linearization.path.states[..., 2]
    assert ((headings[1:] - headings[:-1]).abs().amax(0) > math.pi).any()  # its paths jump
    with seeded("circle"):
        filtered = particle_filter(
            OnTheCircle().double(), turning, particles=100, known_start=known_start, proposal=Twist(circle)
        )
    assert float(filtered.effective_sizes.mean()) > 80


def test_an_angle_whose_turns_are_counted_is_a_number_like_any_other():
    data = drives(CountsTurns().double().requires_grad_(False), 4, 31)
    counts, undeclared = found(CountsTurns(), data), found(CountsTurnsUndeclared(), data)
    assert counts.linearization.angles == () and len(counts.windings) == 1
    torch.testing.assert_close(counts.log_likelihood, undeclared.log_likelihood, rtol=0, atol=1e-6)
    _, states, _ = counts.draws(50)
    assert (states[..., 2] - data.states[..., 2]).abs().max() < 1
    assert found(Compass(), data).linearization.angles == (2,)


@pytest.mark.parametrize(("sd", "turns"), [(0.1, 1), (0.7, 1), (1.0, 3), (math.pi, 5), (10.0, 13)])
def test_a_start_covers_the_turns_within_four_deviations(sd, turns, turning):
    program = Starts()
    program.sd = sd
    ahead = found(program, cut(turning, 21))
    assert len(ahead.windings) == turns and ahead.windings[:, 2].unique().numel() == turns
    masses = ahead.winding_masses.exp()
    torch.testing.assert_close(masses.sum(0), torch.ones(6, dtype=torch.float64))
    if turns > 5:  # the mass of a turn is that of the prior, the measurements being the same
        heading = ahead.means()[0][0, :, 2] + ahead.linearization.start_turn[:, 2]
        on = heading + ahead.windings[:, 2:3]
        prior = dist.Normal(math.pi / 5, sd).log_prob(on).softmax(0)
        torch.testing.assert_close(masses, prior, rtol=0.1, atol=1e-3)
