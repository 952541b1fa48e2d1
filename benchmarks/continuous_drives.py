"""Drives of a world that moves in continuous time, and what a world is.

A world is a differential equation in numpy, integrated by the midpoint rule in steps of 1 ms for all drives at once.
Commands and noise are held over a logged row; the noise is one draw a row and channel. Of the engine nothing but the
table of drives is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from continuous_effects import Array, Planted, acting

from steady_ppl import Trajectories

FINE, ROW = 0.001, 0.1  # s: the integration step, and the row for which noise is given
COMMANDS, START, NOISE, MEASURED = range(4)  # random streams, so that an effect does not change any draw


@dataclass(frozen=True)
class World:
    """A vehicle in continuous time.

    Attributes:
        effects: planted.
        noise: standard deviations of the channels' accelerations, for draws held over .1 s.
        duration, step: of a drive and of a logged row, s.
    """

    states: ClassVar[tuple[str, ...]]
    controls: ClassVar[tuple[str, ...]]
    measurements: ClassVar[tuple[str, ...]]
    plantable: ClassVar[tuple[str, ...]]

    effects: tuple[Planted, ...] = ()
    noise: tuple[float, ...] = ()
    duration: float = 10.0
    step: float = 0.1

    def __post_init__(self) -> None:
        unknown = [one.name for one in self.effects if one.name not in self.plantable]
        if unknown:
            raise ValueError(f"{type(self).__name__} has no {', '.join(unknown)}; it has {', '.join(self.plantable)}")

    def commands(self, random: np.random.Generator, time: Array, drives: int) -> Array:
        """Return the commands of each row, `(rows, drives, U)`."""
        raise NotImplementedError

    def start(self, random: np.random.Generator, commands: Array) -> Array:
        """Return the first states, `(D, drives)`, as `derivative` has them."""
        raise NotImplementedError

    def derivative(self, state: Array, control: Array, noise: Array) -> Array:
        """Return the rate of change, `(D, drives)`, of states `(D, drives)` at acting controls `(U, drives)`."""
        raise NotImplementedError

    def logged(self, states: Array) -> Array:
        """Return the program's states, `(rows, drives, D)`, of `(rows, D', drives)`."""
        return states.transpose(0, 2, 1)

    def measured(self, states: Array, random: np.random.Generator) -> Array:
        """Return the measurements of the program's states, `(rows, drives, K)`."""
        raise NotImplementedError

    def size(self, name: str) -> float:
        """Return the coefficient of a planted effect, zero where it is not planted."""
        return next((one.value[0] for one in self.effects if one.name == name), 0.0)


def simulate(world: World, drives: int, *, seed: int, fine: float = FINE) -> Trajectories:
    """Return drives with measurements and true states, in double precision.

    Args:
        world: what moves.
        drives: how many.
        seed: the same seed gives the same commands, starts and noise, whatever is planted and whatever `fine` is.
        fine: the integration step, s; a row is a whole number of them.
    """
    rows = round(world.duration / world.step) + 1
    time = world.step * np.arange(rows)
    streams = [np.random.default_rng([seed, stream]) for stream in (COMMANDS, START, NOISE, MEASURED)]
    commands = world.commands(streams[COMMANDS], time, drives)
    offset = world.size("clock_offset")
    later = math.ceil(max(0.0, -offset) / world.step)  # rows after the end that a clock which is ahead shows
    held = np.concatenate([commands, np.repeat(commands[-1:], later, axis=0)])
    noise = streams[NOISE].standard_normal((rows + later, len(world.noise), drives))
    noise *= np.array(world.noise)[:, None] * math.sqrt(ROW / world.step)
    path = integrate(world, world.start(streams[START], commands), held, noise, fine)
    each = round(world.step / fine)
    states = world.logged(path[::each][:rows])
    seen = world.logged(_at(path, (time - offset) / fine)) if offset else states
    return _trajectories(world, time, commands, world.measured(seen, streams[MEASURED]), states)


def integrate(world: World, start: Array, commands: Array, noise: Array, fine: float = FINE) -> Array:
    """Return the states after each fine step by the midpoint rule, `(rows · step / fine + 1, D, drives)`.

    Args:
        world: what moves.
        start: `(D, drives)`.
        commands: `(rows, drives, U)`, held.
        noise: `(rows, C, drives)`, held.
        fine: s.
    """
    each = round(world.step / fine)
    if each < 1 or abs(each * fine - world.step) > 1e-9:
        raise ValueError(f"a row of {world.step} s is not a whole number of steps of {fine} s")
    control = np.ascontiguousarray(acting(commands, world.step, fine, world.effects).transpose(0, 2, 1))
    path = np.empty((len(control) + 1, *start.shape))
    path[0] = state = start
    for index, told in enumerate(control):
        draw = noise[index // each]
        middle = state + 0.5 * fine * world.derivative(state, told, draw)
        path[index + 1] = state = state + fine * world.derivative(middle, told, draw)
    if not np.isfinite(path).all():
        raise ValueError(f"{type(world).__name__} diverges")
    return path


def _at(path: Array, index: Array) -> Array:
    """Return the states at fractional indices, `(rows, D, drives)`; beyond the ends at the velocity there."""
    before = np.clip(np.floor(index).astype(int), 0, len(path) - 2)
    share = (index - before)[:, None, None]
    return path[before] + share * (path[before + 1] - path[before])


def _trajectories(world: World, time: Array, commands: Array, measured: Array, states: Array) -> Trajectories:
    drives = commands.shape[1]
    measurements = torch.from_numpy(np.ascontiguousarray(measured))
    return Trajectories(
        time=torch.from_numpy(time)[:, None].repeat(1, drives),
        controls=torch.from_numpy(np.ascontiguousarray(commands)),
        measurements=measurements,
        observed=torch.ones_like(measurements, dtype=torch.bool),
        lengths=torch.full((drives,), len(time)),
        states=torch.from_numpy(np.ascontiguousarray(states)),
        control_names=world.controls,
        measurement_names=world.measurements,
        state_names=world.states,
    )
