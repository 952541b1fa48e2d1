"""The example programs and small drives of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from steady_ppl import Trajectories, load_program, seeded, simulate, stack
from steady_ppl.model.program import Program, for_program

MODELS = Path(__file__).parent.parent / "models"
VEHICLES = (
    "car",
    "differential_drive",
    "dynamic_bicycle",
    "thruster_boat",
    "ship",
    "motor_joint",
    "planar_quadrotor",
    "tumbling_body",
)  # of several kinds, in `models/`


def example(name: str, dtype: torch.dtype = torch.float64) -> Program:
    """A program of `models/`, for example "hovercraft" or "hovercraft.py:HovercraftTruth", or `TwoWheels`."""
    if name == "two_wheels":
        return TwoWheels().to(dtype)
    file, _, program = name.partition(":")
    source = MODELS / f"{file.removesuffix('.py')}.py"
    return load_program(f"{source}:{program}" if program else source).to(dtype)


def each_effect_once_slow(pairs: Sequence[tuple[str, str]]) -> list[Any]:
    """Programs and effects as parameters: slow with an effect's first program, exhaustive with the others."""
    first = {effect: name for name, effect in reversed(pairs)}
    marks = (pytest.mark.slow if first[effect] == name else pytest.mark.exhaustive for name, effect in pairs)
    return [pytest.param(*pair, id="-".join(pair), marks=mark) for pair, mark in zip(pairs, marks, strict=True)]


def short(name: str, rows: int = 9) -> Program:
    """An example program whose drives have so many rows."""
    program = example(name)
    program.duration = (rows - 1) * program.step
    return program


def drives(program: Program, trajectories: int, rows: int, *, gaps: bool = False, seed: int = 0) -> Trajectories:
    """Drives for `program`, simulated at its own time step, so that it is right about them, and read by it: all cells
    measured on an even clock, or, with `gaps`, every other trajectory two rows shorter, a fifth of the cells missing
    and every interval of another length."""
    program.duration = (rows - 1) * program.step
    table = simulate(program, trajectories, seed=seed, substeps=program.substeps)
    if gaps:
        with seeded(seed, "gaps"):
            time = program.step * (0.5 + torch.rand(table.time.shape, dtype=torch.float64)).cumsum(0)
            lengths = torch.where(torch.arange(trajectories) % 2 == 1, rows - 2, rows)
            inside = torch.arange(rows)[:, None] < lengths
            observed = (torch.rand(table.observed.shape) < 0.8) & inside[..., None]
        controls = torch.where(inside[..., None], table.controls, 0.0)
        table = replace(table, time=time, controls=controls, lengths=lengths, observed=observed)
        table = simulate(program, seed=seed, like=table, substeps=program.substeps)
    return for_program(program, table)


def copies(data: Trajectories, count: int) -> Trajectories:
    """Each trajectory `count` times: `count` independent runs of a filter in one."""
    return data.subset(torch.arange(len(data)).repeat_interleave(count))


def cut(data: Trajectories, rows: int) -> Trajectories:
    """The first `rows` rows only."""
    return replace(
        data,
        time=data.time[:rows],
        controls=data.controls[:rows],
        measurements=data.measurements[:rows],
        observed=data.observed[:rows],
        lengths=data.lengths.clamp(max=rows),
        states=None if data.states is None else data.states[:rows],
    )


def elsewhere(program: Program, data: Trajectories, turn: float) -> tuple[Program, Trajectories, Callable]:
    """A planar vehicle and its drives in a world turned and moved, and what moves a place, `(..., 2)`, there."""
    cos, sin, away = math.cos(turn), math.sin(turn), torch.tensor([3.0, -8.0], dtype=torch.float64)
    rotation = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)

    class Elsewhere(type(program)):
        landmarks = (torch.tensor(program.landmarks, dtype=torch.float64) @ rotation.T + away).tolist()

    def place(there: Tensor) -> Tensor:
        return there @ rotation.T + away

    states = data.states
    parts = [place(states[..., :2]), states[..., 2:3] + turn, states[..., 3:5] @ rotation.T, states[..., 5:]]
    return Elsewhere().double(), replace(data, states=torch.cat(parts, -1)), place


class TwoWheels(type(load_program(MODELS / "unicycle.py"))):
    """The unicycle, told the speeds of its wheels: speed (left + right) / 2, turn (right − left) / .5 m."""

    controls = ("port [m/s]", "starboard [m/s]")
    roles = {"port": "left_wheel", "starboard": "right_wheel"}

    def transition(self, state, control, time, step):
        left, right = control.unbind(-1)
        return super().transition(state, stack(0.5 * (left + right), 2 * (right - left)), time, step)

    def example_controls(self, time):
        speed, turn = super().example_controls(time).unbind(-1)
        return stack(speed - 0.25 * turn, speed + 0.25 * turn)


class HeavyTailed(type(load_program(MODELS / "hovercraft.py"))):
    """Accelerations of Student's distribution."""

    def transition(self, state, control, time, step):
        pushed = stack(control.sum(-1), torch.zeros_like(time), control[..., 1] - control[..., 0])
        acceleration = pyro.sample("acceleration", dist.StudentT(4.0, pushed / self.mass, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)
