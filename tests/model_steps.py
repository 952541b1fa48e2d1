"""Every shipped program, and one step of it from states of no drive in particular."""

from __future__ import annotations

import ast

import numpy as np
import torch
from examples import MODELS

from steady_ppl import ExplicitEuler
from steady_ppl.model.handlers import Recording, Replaying

ABSTRACT = {"NeuralVehicle"}
PROGRAMS = [
    f"{file.name}:{node.name}"
    for file in sorted(MODELS.glob("*.py"))
    for node in ast.parse(file.read_text()).body
    if isinstance(node, ast.ClassDef) and node.name not in ABSTRACT
]


def stirred(program):
    """The program with its parameters a little off: a network's heads no longer zero, so that all gradients show."""
    with torch.no_grad():
        for parameter in program.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return program


def some_states(count: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """States, controls, accelerations and steps of no drive in particular."""
    random = np.random.default_rng(0)
    states = random.normal(size=(count, 6)) * [5, 5, 3, 1, 1, 1]
    return states, random.uniform(0, 1.5, (count, 2)), random.normal(size=(count, 3)), random.uniform(0.05, 0.2, count)


def by_hand(states: np.ndarray, acceleration: np.ndarray, step: np.ndarray) -> np.ndarray:
    """One step of second order: pushed along the heading in its middle, moved by the mean of old and new velocity."""
    place, heading, velocity, w = (
        states[:, 0] + 1j * states[:, 1],
        states[:, 2],
        states[:, 3] + 1j * states[:, 4],
        states.T[5],
    )
    forward, lateral, yaw = acceleration.T
    turn = w * step + yaw * step**2 / 2
    faster = velocity + np.exp(1j * (heading + turn / 2)) * (forward + 1j * lateral) * step / (1 + turn**2 / 24)
    there = place + (velocity + faster) / 2 * step
    return np.stack([there.real, there.imag, heading + turn, faster.real, faster.imag, w + yaw * step], -1)


def by_euler(states: np.ndarray, acceleration: np.ndarray, step: np.ndarray) -> np.ndarray:
    """One explicit Euler step of section 1 of the facts, with old values on the right."""
    x, y, heading, vx, vy, w = states.T
    forward, lateral, yaw = acceleration.T
    turned = np.exp(1j * heading) * (forward + 1j * lateral)
    moved = [x + vx * step, y + vy * step, heading + w * step, vx + turned.real * step, vy + turned.imag * step]
    return np.stack([*moved, w + yaw * step], -1)


def stepped(program):
    """The step that a program takes, by hand."""
    return by_euler if isinstance(program, ExplicitEuler) else by_hand


def run_once(program, states, controls, acceleration, step) -> tuple[np.ndarray, torch.distributions.Distribution]:
    recording = Recording()
    given = [torch.from_numpy(values) for values in (states, controls, step, step)]
    with recording, Replaying({"acceleration": torch.from_numpy(acceleration)}):
        after = program.transition(*given)
    return after.detach().numpy(), recording.distributions["acceleration"]
