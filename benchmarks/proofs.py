"""What `prove` says first: of ten pairs in which neither program is a model, ten that particles deny, ten good ones.

    python benchmarks/proofs.py [--results FILE]

*No models*: the programs of `continuous_programs.py` and of the folder `models`, with numbers or commands that are far
off, on drives of `continuous_worlds.py`. The one after is the less wrong: log p(y) and errors fall, and both still
lose to a vehicle that keeps its velocity or to the last measurement.

*Denied*: a pendulum that hangs nearly still is seen by how high it is, and a boat below a beacon by its distance. The
sensor reads a little too little. Such readings pull the path to where a reading does not change with the state, and a
linearised program cannot see that its noise throws it about. The one after has less noise of the sensor and a process
noise that is far too large.

*Good*: the right program and one whose commands act 1.1 times too strongly, on the drives of the first.

Asked for: the first sentence names what counts, and says of no good program that it is
not yet a model. Writes `results/proofs.md`; exits with 1 when one is missed.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from continuous_drives import simulate
from continuous_groups import GROUPS, user_program
from continuous_programs import PendulumProgram
from torch import tensor

from steady_ppl import Program, Trajectories, prove

RESULT = Path(__file__).parent / "results" / "proofs.md"
DRIVES = 12
NO_MODELS = ("hovercraft paper x1 known", "boat", "cart", "pendulum", "unicycle")
FACTORS = (8.0, 25.0)  # by which what answers the commands is too strong
NOISES = (4.0, 5.0, 6.0, 8.0, 10.0)  # rad/s² or m/s²: process noise of the program after
FINE, ROWS, STEP = 1e-3, 80, 0.05  # s of the simulation, rows of a drive, s of a row
HEIGHT_SD, DISTANCE_SD = 0.01, 0.05  # m; readings are too low by one of them


class Pair(NamedTuple):
    """Programs before and after, drives, and whether a sentence says what counts."""

    name: str
    before: Program
    after: Program
    drives: Trajectories
    is_said: Callable[[str], bool]


class HangingProgram(PendulumProgram):
    """A pendulum of 1 m that is seen by how high it hangs."""

    measurements = ("height [m]",)

    def __init__(self, noise: float, sd: float):
        super().__init__()
        self.noise, self.sd = tensor(noise), tensor(sd)

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(2), tensor([0.02, 0.02])).to_event(1))

    def observe(self, state):
        pyro.sample("height", dist.Normal(1 - state[..., :1].cos(), self.sd).to_event(1))


class MooredProgram(Program):
    """A boat held by a spring below a beacon 2 m above it, whose distance it measures."""

    states = ("x [m]", "speed [m/s]")
    controls = ("force [N]",)
    measurements = ("distance [m]",)
    channels = ("forward [m/s²]",)
    motion = {"forward": ("x", "speed")}
    step = STEP

    def __init__(self, noise: float, sd: float):
        super().__init__()
        self.noise, self.sd = tensor(noise), tensor(sd)

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(2), tensor([0.02, 0.02])).to_event(1))

    def transition(self, state, control, time, step):
        x, speed = state.unbind(-1)
        forward = pyro.sample("forward", dist.Normal(control[..., 0] - 4 * x - speed, self.noise))
        faster = speed + forward * step
        return torch.stack([x + 0.5 * (speed + faster) * step, faster], -1)

    def observe(self, state):
        pyro.sample("distance", dist.Normal((state[..., :1].square() + 4.0).sqrt(), self.sd).to_event(1))


def hanging(program: Program, seed: int) -> Trajectories:
    """A pendulum with small torques, in steps of 1 ms."""
    return _nearly_still(
        program, seed, lambda x, v, u: -9.81 * np.sin(x) - 0.2 * v + 5 * u, lambda x: 1 - np.cos(x), HEIGHT_SD
    )


def moored(program: Program, seed: int) -> Trajectories:
    """A boat with small forces below its beacon, in steps of 1 ms."""
    return _nearly_still(program, seed, lambda x, v, u: u - 4 * x - v, lambda x: np.sqrt(x**2 + 4), DISTANCE_SD)


def _nearly_still(
    program: Program, seed: int, acceleration: Callable[..., np.ndarray], reading: Callable[..., np.ndarray], sd: float
) -> Trajectories:
    random = np.random.default_rng(seed)
    every = round(STEP / FINE)
    commands = 0.02 * np.sin(STEP * np.arange(ROWS)[:, None] + random.uniform(0, 2 * math.pi, DRIVES))
    x, v, seen = random.normal(0, 0.01, DRIVES), random.normal(0, 0.01, DRIVES), []
    for row in range(ROWS):
        seen.append(reading(x) + random.normal(-sd, sd, DRIVES))
        for _ in range(every):
            v = v + FINE * acceleration(x, v, commands[row]) + random.normal(0, 0.02 * FINE**0.5, DRIVES)
            x = x + FINE * v
    time = torch.arange(ROWS)[:, None].expand(ROWS, DRIVES) * STEP
    values = tensor(np.stack(seen)).float()[..., None]
    is_there = torch.ones_like(values, dtype=torch.bool)
    names = {"control_names": program.control_names, "measurement_names": program.measurement_names}
    given = tensor(commands).float()[..., None]
    return Trajectories(time, given, values, is_there, torch.full((DRIVES,), ROWS), **names)


def pairs() -> Iterator[Pair]:
    """All of them."""
    for seed, vehicle in enumerate(NO_MODELS):
        drives = simulate(GROUPS[vehicle].world, DRIVES, seed=seed)
        for factor in FACTORS:
            before, after = (_too_strong(user_program(GROUPS[vehicle]), size) for size in (1.5 * factor, factor))
            yield Pair(f"{vehicle}, commands × {factor:g}", before, after, drives, _says_no_models)
        for other, is_right in enumerate((False, True)):
            drives = simulate(GROUPS[vehicle].world, DRIVES, seed=10 * (other + 1) + seed)
            before, after = _too_strong(user_program(GROUPS[vehicle]), 1.1), user_program(GROUPS[vehicle])
            pair = (after, before) if is_right else (before, after)
            yield Pair(
                f"{vehicle}, commands × {'1' if is_right else '1.1'} before", *pair, drives, _says_nothing_of_models
            )
    for seed, noise in enumerate(NOISES):
        for kind, world, sd in ((HangingProgram, hanging, HEIGHT_SD), (MooredProgram, moored, DISTANCE_SD)):
            before, after = kind(0.1, 1.6 * sd), kind(noise, 1.4 * sd)
            yield Pair(f"{kind.__name__}, noise {noise:g}", before, after, world(after, 100 + seed), _says_particles)


def _too_strong(program: Program, factor: float) -> Program:
    """The program with everything that it does `factor` times faster than the vehicle."""
    base = type(program)

    class TooStrong(base):  # type: ignore[valid-type]
        def transition(self, state, control, time, step):
            return super().transition(state, control * factor, time, step)

    program.__class__ = TooStrong
    return program


def _says_no_models(said: str) -> bool:
    return said.startswith("Neither before nor after is yet a model")


def _says_nothing_of_models(said: str) -> bool:
    return "yet a model" not in said


def _says_particles(said: str) -> bool:
    """A sentence on what is no model may come before."""
    compared = said.partition("ahead it errs more than ")[2].partition(". ")[2] or said
    is_worse = compared.startswith(
        ("after is worse than before: ", "after fits worse and predicts better than before: ")
    )
    return is_worse and "log p(y) by particles (linearised +" in compared


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=RESULT)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    lines, missed, total = ["# What `prove` says first", "", "| pair | said | as it should |", "|---|---|---|"], 0, 0
    for pair in pairs():
        said = prove({"before": pair.before, "after": pair.after}, pair.drives).figures["verdict"]
        met = pair.is_said(said)
        total, missed = total + 1, missed + (not met)
        lines.append(f"| {pair.name} | {said} | {'yes' if met else '**no**'} |")
        print(lines[-1], flush=True)
    lines += ["", f"{total - missed} of {total} pairs."]
    print(lines[-1])
    arguments.results.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
