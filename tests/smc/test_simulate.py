"""Simulated drives follow their program and their template."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from examples import drives, example
from oracles import START_MEAN, START_SD, assert_mean

from steady_ppl import ProgramError, UsageError, simulate

NAMES = (
    "linear_gaussian",
    "hovercraft",
    "hovercraft:HovercraftTruth",
    "truck",
    "pendulum",
    "neural_vehicle:NeuralTruck",
)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_same_seed_gives_the_same_drives_and_leaves_the_callers_generator_alone(name):
    program = example(name, torch.float32)
    program.duration = 1.0
    before = torch.get_rng_state()
    a, b, c = (simulate(program, 3, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(before, torch.get_rng_state())
    assert torch.equal(a.states, b.states) and torch.equal(a.measurements, b.measurements)
    assert not torch.equal(a.states, c.states) and not torch.equal(a.measurements, c.measurements)
    rows = round(1.0 / program.step) + 1
    assert a.states.shape == (rows, 3, len(program.states))
    assert a.measurements.shape == (rows, 3, len(program.measurements))
    assert a.observed.all() and a.states.isfinite().all() and a.measurements.isfinite().all()
    assert a.labels == ("1", "2", "3")


def test_drives_of_the_cart_have_its_distribution():
    program = example("linear_gaussian").requires_grad_(False)
    data = drives(program, 500, 6)
    position, velocity = data.states.unbind(-1)
    assert_mean(data.states[0], START_MEAN)
    assert_mean((data.states[0] - START_MEAN).square(), START_SD**2)
    middle = (velocity[:-1] + velocity[1:]) / 2
    torch.testing.assert_close(position[1:], position[:-1] + middle * data.steps, rtol=1e-12, atol=1e-12)
    acceleration = (velocity[1:] - velocity[:-1]) / data.steps
    noise = acceleration - (program.gain * data.controls[:-1, :, 0] - program.damping * velocity[:-1])
    error = data.measurements[..., 0] - position
    for drawn, sd in ((noise, program.noise), (error, program.measurement_sd)):
        drawn = drawn.flatten()
        assert_mean(drawn, 0.0)
        assert_mean(drawn.square(), sd**2)
    assert_mean((noise[0] * noise[1]), 0.0)


def test_drives_like_others_have_their_clock_controls_gaps_and_names():
    program = example("hovercraft")
    like = drives(program, 4, 12, gaps=True)
    like = replace(like, time=like.time + 100.0, labels=("a", "b", "c", "d"))
    data = simulate(program, like=like, seed=5)
    for name in ("time", "controls", "observed", "lengths"):
        assert torch.equal(getattr(data, name), getattr(like, name)), name
    assert data.labels == like.labels
    assert data.control_names == like.control_names and data.measurement_names == like.measurement_names
    assert not data.observed.all() and (data.measurements[~data.observed] == 0).all()
    assert data.states[~data.rows].isnan().all() and data.states[data.rows].isfinite().all()
    assert not torch.equal(data.states[0], like.states[0])


def test_no_trajectories_are_refused() -> None:
    with pytest.raises(UsageError, match="trajectories is 0: it must be at least 1"):
        simulate(example("hovercraft"), 0)


def test_a_program_that_blows_up_is_said_to():
    with pytest.raises(ProgramError, match="WithLinearDrag diverges: in trajectory 1, row [0-9]+, its"):
        simulate(example("hovercraft").with_effect("linear_drag", 1e15), 1)
