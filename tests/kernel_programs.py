"""Programs in single precision, which kernels are for, two that no trace follows, and what kernels must come to."""

from __future__ import annotations

import torch
from examples import VEHICLES, example

from steady_ppl import seeded
from steady_ppl.model.handlers import draw_starts
from steady_ppl.smc.compiled import CompiledFilter, compiled_filter, standard_normal
from steady_ppl.smc.proposal import Proposal
from steady_ppl.smc.resampling import systematic
from steady_ppl.smc.stepping import Stepping

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
    *VEHICLES,
]


def single(name: str):
    """A program in single precision, its parameters moved away from zero."""
    program = example(name, torch.float32)
    with seeded("moved", name), torch.no_grad():
        for parameter in program.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return program


class Switching(HovercraftTruth):
    """Reads a number out of a parameter."""

    def transition(self, state, control, time, step):
        return super().transition(state, control * (2 if float(self.mass.detach()) > 1 else 1), time, step)


class Stale(HovercraftTruth):
    """Takes a parameter in a way that no trace sees."""

    def transition(self, state, control, time, step):
        return super().transition(state, control * self.mass.detach().numpy().item(), time, step)


def both(program, data, particles: int = 40, weight: float | torch.Tensor = 0.7):
    """Its kernels and its own lines, and some states."""
    spread = draw_starts(program, 100, 1).std((0, 1))  # a ship turns slower than a hovercraft
    states = 2 * torch.where(spread > 0, spread, 1.0) * torch.randn(particles, len(data), len(program.states))
    plain = Stepping(program, data, weight)
    machine = compiled_filter(plain, states, Proposal(), systematic)
    assert isinstance(machine, CompiledFilter), machine
    return machine, plain, states


def assert_same(machine: CompiledFilter, plain: Stepping, states: torch.Tensor, row: int = 2) -> None:
    uniform = torch.rand(*states.shape[:2], machine.methods.uniforms)
    moved, values, ratio = machine.transition(row, states, uniform)
    expected, sites = plain.transition(row, states, standard_normal(uniform, machine.methods.channels)[0])
    assert (ratio == 0).all() and machine.methods.event_dims == plain.event_dims
    torch.testing.assert_close(moved, expected, rtol=1e-4, atol=2e-5)
    parts = values.split([machine.methods.sizes[site] for site in sites], -1)
    for value, (site, theirs) in zip(parts, sites.items(), strict=True):
        value = value if plain.event_dims[site] else value[..., 0]
        torch.testing.assert_close(value, theirs.expand_as(value), rtol=1e-4, atol=2e-5)
    density = plain.log_density(row, states)
    torch.testing.assert_close(machine.log_density(row, states)[..., 0], density, rtol=1e-4, atol=2e-3)
