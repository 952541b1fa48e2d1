"""Programs in single precision, which kernels are for, and two that no trace follows."""

from __future__ import annotations

import torch
from examples import example

from steady_ppl import seeded

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
    "car",
    "differential_drive",
    "dynamic_bicycle",
    "thruster_boat",
    "ship",
    "motor_joint",
    "planar_quadrotor",
    "tumbling_body",
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
