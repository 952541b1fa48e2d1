"""Compiled methods are the program: the same numbers from the same noise, whatever its parameters become."""

from __future__ import annotations

import math
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import drives, example
from oracles import assert_mean

from steady_ppl import (
    Constant,
    FilterError,
    GaussianGuide,
    SMCGuide,
    particle_filter,
    seeded,
)
from steady_ppl.gaussian.linearize import ReferencePath, linearize
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.gaussian.twisted_proposal import Twist
from steady_ppl.guides import linearized
from steady_ppl.kernels import jit, rows as rows_by_kernels
from steady_ppl.smc.backends import CompiledStepping, Stepping, stepping_for

HovercraftTruth = type(example("hovercraft:HovercraftTruth"))
EXAMPLES = [
    "hovercraft",
    "hovercraft.py:HovercraftTruth",
    "truck",
    "pendulum",
    "linear_gaussian",
    "neural_vehicle.py:NeuralHovercraft",
    "neural_vehicle.py:NeuralTruck",
    "neural_vehicle.py:AuthorsHovercraft",
]


def single(name: str):
    """A program in single precision, its parameters moved away from zero."""
    program = example(name, torch.float32)
    with seeded("moved", name), torch.no_grad():
        for parameter in program.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return program


def stepping(program, data, particles: int = 40, weight: float | torch.Tensor = 0.7):
    """Its kernels and its own lines, and some states."""
    size = len(program.states)
    states = 2 * torch.randn(particles, len(data), size)
    compiled, reason = stepping_for(Stepping(program, data, weight), states)
    assert isinstance(compiled, CompiledStepping), reason
    return compiled, Stepping(program, data, weight), states


def assert_same(compiled: CompiledStepping, plain: Stepping, states: torch.Tensor, row: int = 2) -> None:
    noise = torch.randn(*states.shape[:2], compiled.methods.channels)
    ancestors = torch.randint(len(states), states.shape[:2])
    moved, values = compiled.transition(row, states, ancestors, noise)
    expected, sites = plain.transition(row, states, ancestors, noise)
    torch.testing.assert_close(moved, expected, rtol=1e-4, atol=2e-5)
    assert values.keys() == sites.keys() and compiled.event_dims == plain.event_dims
    for site, value in values.items():
        torch.testing.assert_close(value, sites[site].expand_as(value), rtol=1e-4, atol=2e-5)
    density = plain.log_density(row, states)
    torch.testing.assert_close(compiled.log_density(row, states), density, rtol=1e-4, atol=2e-3)


@pytest.mark.parametrize("name", EXAMPLES)
def test_kernels_come_to_the_numbers_of_the_programs_own_lines(name):
    program = single(name)
    data = drives(program, 3, 6, gaps=True)
    torch.manual_seed(1)
    assert_same(*stepping(program, data))


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_kernels_jacobians_are_those_of_torch(name, monkeypatch):
    program = single(name)
    data = drives(program, 3, 9, gaps=True)
    torch.manual_seed(1)
    states, noise = 2 * torch.randn(9, 3, len(program.states)), torch.randn(8, 3, len(program.channels))
    by_torch = linearize(program, data, ReferencePath(states, noise))
    monkeypatch.setattr(rows_by_kernels, "ROWS_WORTH_COMPILING", 1)
    by_kernel = linearize(program, data, ReferencePath(states, noise))
    assert by_kernel.in_plain_torch is None and jit._COMPILED[type(program)]
    for part in ("offset", "state", "noise", "residual", "measurement", "precision", "log_scale"):
        torch.testing.assert_close(getattr(by_kernel, part), getattr(by_torch, part), rtol=1e-4, atol=2e-5)


def test_a_program_has_kernels_for_the_filter_and_for_its_jacobians(monkeypatch):
    monkeypatch.setattr(rows_by_kernels, "ROWS_WORTH_COMPILING", 1)
    program = single("hovercraft")
    data = drives(program, 2, 9)
    path = ReferencePath(torch.randn(9, 2, 6), torch.randn(8, 2, 3))
    for _ in range(2):
        assert linearize(program, data, path).in_plain_torch is None
        assert particle_filter(program, data, particles=32, kernels=True).in_plain_torch is None


def test_jacobians_that_cannot_be_compiled_come_from_torch_and_the_guide_says_why(monkeypatch):
    monkeypatch.setattr(linearized, "GUIDE_ROWS_WORTH_COMPILING", 1)
    data = drives(example("hovercraft", torch.float32), 2, 12)
    guide = GaussianGuide(Switching(), draws=3, known_start=True)
    with seeded("plain"):
        guide.refresh(data, 1.0)
    assert "reads a number out of a tensor" in guide.in_plain_torch
    other = GaussianGuide(single("hovercraft"), draws=3, known_start=True)
    with seeded("plain"):
        other.refresh(data, 1.0)
    assert other.in_plain_torch is None


def test_jacobians_that_have_fallen_behind_their_program_are_found_out(monkeypatch):
    monkeypatch.setattr(rows_by_kernels, "ROWS_WORTH_COMPILING", 1)
    program = Stale()
    data = drives(example("hovercraft", torch.float32), 2, 31)
    path = ReferencePath(torch.randn(31, 2, 6), torch.randn(30, 2, 3))
    assert linearize(program, data, path).in_plain_torch is None
    with torch.no_grad():
        for parameter in program.parameters():
            parameter += 0.1
    assert "different numbers" in linearize(program, data, path).in_plain_torch


def test_every_trajectory_may_have_an_observation_weight_of_its_own():
    program = single("hovercraft")
    data = drives(program, 3, 6)
    torch.manual_seed(1)
    weights = torch.tensor([0.7, 0.1, 0.0])
    compiled, plain, states = stepping(program, data, weight=weights)
    assert_same(compiled, plain, states)
    once = Stepping(program, data, 1.0).log_density(2, states)
    torch.testing.assert_close(plain.log_density(2, states), weights * once)


def test_parameters_that_move_are_read_afresh():
    program = single("hovercraft.py:HovercraftTruth")
    data = drives(program, 2, 5)
    torch.manual_seed(1)
    before, _, states = stepping(program, data)
    with torch.no_grad():
        for parameter in program.parameters():
            parameter += 0.5
    after, plain, _ = stepping(program, data)
    assert_same(after, plain, states)
    noise = torch.randn(*states.shape[:2], 3)
    assert not torch.allclose(before.transition(1, states, None, noise)[0], after.transition(1, states, None, noise)[0])


def test_other_settings_and_other_tensors_are_traced_anew():
    program = single("neural_vehicle.py:NeuralHovercraft")
    data = drives(program, 2, 5)
    torch.manual_seed(1)
    stepping(program, data)
    program.input_sd = torch.full_like(program.input_sd, 3.0)
    program.hidden_out = torch.nn.Linear(64, 3)
    program.absolute_heading = False
    program.landmarks = ((1.0, 2.0), *program.landmarks[1:])
    assert_same(*stepping(program, data))


@pytest.mark.parametrize("look_ahead", [False, True])
@pytest.mark.parametrize("gaps", [False, True])
def test_a_filter_estimates_the_same_with_kernels_as_without(look_ahead, gaps):
    program = single("hovercraft.py:HovercraftTruth")
    data = drives(program, 2, 9, gaps=gaps)
    many = data.subset(torch.arange(2).repeat_interleave(100))
    proposal = Twist(find_and_smooth(program, many, known_start=True)) if look_ahead else None
    ratios = []
    for kernels in (True, False):
        with seeded("filter", int(kernels)):
            found = particle_filter(program, many, particles=128, known_start=True, proposal=proposal, kernels=kernels)
        assert found.in_plain_torch is None
        paths = found.paths(4)
        assert paths.states.shape == (4, 9, 200, 6) and paths.noise["acceleration"].shape == (4, 8, 200, 3)
        ratios.append(found.log_likelihood.view(2, 100))
    level = ratios[1].mean(1, keepdim=True)
    likelihood = [(ratio - level).exp() for ratio in ratios]
    # the difference of independent estimates of p(y) has mean zero
    assert_mean((likelihood[0] - likelihood[1]).t(), 0.0)


def test_paths_of_a_compiled_filter_are_paths_of_the_program():
    program = single("hovercraft.py:HovercraftTruth")
    data = drives(program, 3, 8)
    guide = SMCGuide(program, particles=1000, draws=5, tempering=Constant(1.0), known_start=True)
    with seeded("paths"):
        guide.refresh(data, 1.0)
    assert guide.in_plain_torch is None and guide.paths is not None
    states, noise = guide.paths.states, guide.paths.noise["acceleration"]
    moved = program.integrate(states[:, :-1], noise, data.steps)
    torch.testing.assert_close(moved, states[:, 1:], rtol=1e-5, atol=1e-5)


def test_a_program_that_blows_up_is_said_to_have_done_so():
    program = single("hovercraft.py:HovercraftTruth")
    data = drives(program, 2, 6)
    controls = data.controls.clone()
    controls[2, 1] = math.inf
    with pytest.raises(FilterError, match="trajectory 2 at .* that is a number"):
        particle_filter(program, replace(data, controls=controls), particles=64, known_start=True, kernels=True)


class Switching(HovercraftTruth):
    """Reads a number out of a parameter."""

    def transition(self, state, control, time, step):
        return super().transition(state, control * (2 if float(self.mass.detach()) > 1 else 1), time, step)


class Stale(HovercraftTruth):
    """Takes a parameter in a way that no trace sees."""

    def transition(self, state, control, time, step):
        return super().transition(state, control * self.mass.detach().numpy().item(), time, step)


class HeavyTailed(HovercraftTruth):
    """Noise that is not normal."""

    def transition(self, state, control, time, step):
        jerk = pyro.sample("acceleration", dist.StudentT(4.0, torch.zeros(3), self.noise).to_event(1))
        return self.integrate(state, jerk.expand(*state.shape[:-1], 3), step)


class ByTrajectory(HovercraftTruth):
    """Has a gain for each of two trajectories, which a kernel, traced for one, cannot know."""

    def __init__(self):
        super().__init__()
        self.register_buffer("gain", torch.tensor([1.0, 1.2]))

    def transition(self, state, control, time, step):
        return super().transition(state, control * self.gain[:, None], time, step)


@pytest.mark.parametrize(
    ("program", "says"),
    [
        (Switching, "reads a number out of a tensor"),
        (HeavyTailed, "StudentT"),
        (ByTrajectory, "mixes particles or trajectories"),
    ],
)
def test_what_cannot_be_compiled_runs_as_written_and_says_why(program, says):
    data = drives(example("hovercraft", torch.float32), 2, 6)
    with seeded("plain"):
        found = particle_filter(program(), data, particles=100, known_start=True, kernels=True)
    assert says in found.in_plain_torch
    with seeded("plain"):
        plain = particle_filter(program(), data, particles=100, known_start=True)
    assert plain.in_plain_torch is None
    assert torch.equal(found.log_likelihood, plain.log_likelihood)


def test_a_kernel_that_has_fallen_behind_its_program_is_found_out():
    program = Stale()
    data = drives(example("hovercraft", torch.float32), 2, 31)
    assert particle_filter(program, data, particles=50, known_start=True, kernels=True).in_plain_torch is None
    with torch.no_grad():
        for parameter in program.parameters():
            parameter += 0.1
    found = particle_filter(program, data, particles=50, known_start=True, kernels=True)
    assert "different numbers" in found.in_plain_torch


class Counting(HovercraftTruth):
    """Counts how often it is run."""

    calls = 0

    def transition(self, state, control, time, step):
        self.calls += 1
        return super().transition(state, control, time, step)


def test_a_program_whose_settings_never_rest_is_not_compiled_for_ever():
    program, data = Counting(), drives(example("hovercraft", torch.float32), 2, 4)
    reasons = [particle_filter(program, data, particles=20, kernels=True).in_plain_torch for _ in range(jit.TRACES + 1)]
    assert reasons[0] is None and "change from run to run" in reasons[-1]


def test_kernels_are_for_single_precision_and_more_than_a_few_particles():
    program = example("hovercraft", torch.float64)
    data = drives(program, 2, 6)
    assert "float64" in particle_filter(program, data, particles=50, kernels=True).in_plain_torch
    program = single("hovercraft")
    data = drives(program, 2, 6)
    assert "fewer than" in particle_filter(program, data, particles=5, kernels=True).in_plain_torch
