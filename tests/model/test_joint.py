"""The density of all times at once equals the density step by step, for every program."""

from __future__ import annotations

from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import VEHICLES, drives, example
from oracles import START_MEAN, START_SD, Stored, all_at_once, step_by_step
from pyro import poutine
from pyro.infer import Trace_ELBO

from steady_ppl import Joint, Paths, Program, particle_filter, seeded, stack

PROGRAMS = (
    "linear_gaussian",
    "hovercraft",
    "hovercraft:HovercraftTruth",
    "truck",
    "neural_vehicle:NeuralHovercraft",
    "neural_vehicle:NeuralTruck",
    "pendulum",
    *VEHICLES,
)


def prepared(name: str) -> Program:
    """A program in double precision, a network with random weights."""
    program = example(name)
    with seeded("weights"), torch.no_grad():
        for parameter in program.parameters():
            if name.startswith("neural"):
                parameter.normal_(0, 0.2)
    return program


@pytest.mark.slow
@pytest.mark.parametrize("draws", [1, 4])
@pytest.mark.parametrize("known_start", [False, True])
@pytest.mark.parametrize("name", PROGRAMS)
def test_all_times_at_once_equals_step_by_step(name, known_start, draws):
    program = prepared(name)
    data = drives(program, 3, 12, gaps=True)
    with seeded("paths"):
        paths = particle_filter(program, data, particles=50, known_start=known_start).paths(draws)
    at_once = all_at_once(program, data, paths, known_start=known_start)
    in_turn = step_by_step(program, data, paths, known_start=known_start)
    torch.testing.assert_close(at_once, in_turn, rtol=1e-10, atol=0)
    parameters = list(program.parameters())
    gradients = [torch.autograd.grad(value, parameters, allow_unused=True) for value in (at_once, in_turn)]
    for ours, theirs in zip(*gradients, strict=True):
        assert (ours is None) == (theirs is None)
        if ours is not None:
            assert ours.isfinite().all()
            torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9 * float(theirs.abs().max()))


def test_the_density_of_the_cart_is_the_sum_of_normals():
    program = example("linear_gaussian").requires_grad_(False)
    data = drives(program, 2, 6)
    paths = particle_filter(program, data, particles=20).paths(3)
    position, velocity = paths.states.unbind(-1)
    mean = program.gain * data.controls[:-1, :, 0] - program.damping * velocity[:, :-1]
    expected = (
        dist.Normal(START_MEAN, START_SD).log_prob(paths.states[:, 0]).sum()
        + dist.Normal(mean, program.noise).log_prob(paths.noise["acceleration"]).sum()
        + dist.Normal(position, program.measurement_sd).log_prob(data.measurements[..., 0]).sum()
    )
    torch.testing.assert_close(all_at_once(program, data, paths), expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("draws", [1, 5])
def test_the_elbo_is_the_mean_density_of_the_draws(draws):
    program = prepared("hovercraft")
    data = drives(program, 3, 12, gaps=True)
    paths = particle_filter(program, data, particles=50).paths(draws)
    elbo = Trace_ELBO(num_particles=draws, vectorize_particles=draws > 1, max_plate_nesting=2)
    loss = elbo.differentiable_loss(Joint(program), Stored(paths), data)
    torch.testing.assert_close(-loss * draws, step_by_step(program, data, paths), rtol=1e-10, atol=0)


@pytest.mark.parametrize("known_start", [False, True])
def test_the_guides_deltas_and_the_states_count_nothing(known_start):
    program = prepared("hovercraft")
    data = drives(program, 3, 12, gaps=True)
    guide = Stored(particle_filter(program, data, particles=50, known_start=known_start).paths(4))
    with pyro.plate("draw", 4, dim=-3):
        guided = poutine.trace(guide).get_trace(data)
        joint = poutine.trace(poutine.replay(Joint(program, known_start=known_start), guided)).get_trace(data)
    assert guided.log_prob_sum() == 0
    joint.compute_log_prob()
    assert (joint.nodes["states"]["log_prob"] == 0).all()
    assert bool((joint.nodes["start"]["log_prob"] == 0).all()) == known_start


def test_what_stands_in_padding_and_missing_cells_counts_nothing():
    program = prepared("hovercraft")
    data = drives(program, 3, 12, gaps=True)
    paths = particle_filter(program, data, particles=50).paths(4)
    rubbish = replace(
        data,
        measurements=torch.where(data.observed, data.measurements, 1e6),
        controls=torch.where(data.rows[..., None], data.controls, 1e3),
    )
    elsewhere = replace(paths, states=torch.where(data.rows[..., None], paths.states, 1e3))
    assert torch.equal(all_at_once(program, data, paths), all_at_once(program, rubbish, elsewhere))


def test_the_order_of_landmarks_draws_and_trajectories_is_irrelevant():
    program = prepared("hovercraft")
    data = drives(program, 3, 12, gaps=True)
    paths = particle_filter(program, data, particles=50).paths(4)
    expected = all_at_once(program, data, paths)
    order = [3, 1, 0, 2]

    class Shuffled(type(program)):
        landmarks = [program.landmarks[i] for i in order]

    shuffled = replace(data, measurements=data.measurements[..., order], observed=data.observed[..., order])
    torch.testing.assert_close(all_at_once(Shuffled().double(), shuffled, paths), expected, rtol=1e-10, atol=0)
    places, draws = [2, 0, 1], [3, 0, 2, 1]
    moved = Paths(
        paths.states[draws][:, :, places],
        {site: value[draws][:, :, places] for site, value in paths.start.items()},
        {site: value[draws][:, :, places] for site, value in paths.noise.items()},
        paths.event_dims,
    )
    torch.testing.assert_close(all_at_once(program, data.subset(places), moved), expected, rtol=1e-10, atol=0)


def test_the_order_of_observed_sites_is_that_of_the_columns():
    cart = type(example("linear_gaussian"))

    class Both(cart):
        measurements = ("position [m]", "velocity [m/s]", "energy [J]")

        def observe(self, state):
            pyro.sample("moving", dist.Normal(state, stack(self.measurement_sd, 3 * self.measurement_sd)).to_event(1))
            pyro.sample("energy", dist.Normal(0.5 * state[..., 1] ** 2, 0.7))

    class OneByOne(cart):
        measurements = ("energy [J]", "velocity [m/s]", "position [m]")

        def observe(self, state):
            pyro.sample("energy", dist.Normal(0.5 * state[..., 1] ** 2, 0.7))
            pyro.sample("velocity", dist.Normal(state[..., 1], 3 * self.measurement_sd))
            pyro.sample("position", dist.Normal(state[..., 0], self.measurement_sd))

    program = Both().double()
    data = drives(program, 3, 8, gaps=True)
    reversed_ = replace(data, measurements=data.measurements.flip(-1), observed=data.observed.flip(-1))
    paths = particle_filter(program, data, particles=50).paths(4)
    expected = all_at_once(program, data, paths)
    torch.testing.assert_close(all_at_once(OneByOne().double(), reversed_, paths), expected, rtol=1e-10, atol=0)
    torch.testing.assert_close(step_by_step(program, data, paths), expected, rtol=1e-10, atol=0)
