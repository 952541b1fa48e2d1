"""What the table of the case EMPS tells of the mass to a program that knows the rig's friction exactly.

    python benchmarks/emps_mass.py --cases FOLDER [--results FILE]

The case's own `make.py` has the world: the published friction curve, a controller of 1 kHz, a table of its mean force
each 20 ms. Here a program with that very curve is fitted by `likelihood` to the case's table, and to tables that the
same world makes: with other rows, and with the position moved by the mean of old and new velocity in place of the new
one. What is left of the error is the table's, not that of a search. Writes `results/emps-mass.md`.
"""

from __future__ import annotations

import argparse
import ast
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import Tensor, tensor

from steady_ppl import Program, Trajectories, for_program, from_arrays, read_table, seeded, stack, with_substeps
from steady_ppl.likelihood.maximize import fit_by_likelihood
from steady_ppl.likelihood.parameter_posterior import ridged_inverse

RESULT = Path(__file__).parent / "results" / "emps-mass.md"
SECONDS, READING_SD = 2.0, 2e-5  # of a drive, and m
LAPS = 4
"""Of the world's reference; every second drive is fitted, as in the case."""


class Known(Program):
    """The rig with its own friction curve, N at `grid` m/s."""

    states = ("position [m]", "velocity [m/s]")
    controls = ("force [N]",)
    measurements = ("position [m]",)
    channels = ("forward [m/s²]",)
    motion = {"forward": ("position", "velocity")}
    guesses = ("noise",)

    def __init__(self, grid: np.ndarray, friction: np.ndarray):
        super().__init__()
        self.mass = PyroParam(tensor(100.0), constraints.positive)
        self.noise = PyroParam(tensor(0.1), constraints.positive)
        self.least, self.width = float(grid[0]), float(grid[1] - grid[0])
        self.register_buffer("friction", torch.as_tensor(friction, dtype=torch.float32), persistent=False)

    def initial(self) -> Tensor:
        return pyro.sample("start", dist.Normal(torch.zeros(2), tensor([0.3, 0.2])).to_event(1))

    def transition(self, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
        position, velocity = state.unbind(-1)
        place = ((velocity - self.least) / self.width).clamp(0, len(self.friction) - 1.001)
        below = place.detach().floor().long()
        friction = self.friction.to(velocity.dtype)
        braked = torch.lerp(friction[below], friction[below + 1], place - below)
        forward = pyro.sample("forward", dist.Normal((control[..., 0] - braked) / self.mass, self.noise))
        return stack(position + step * velocity + step**2 * forward / 2, velocity + step * forward)

    def observe(self, state: Tensor) -> None:
        pyro.sample("position", dist.Normal(state[..., :1], READING_SD).to_event(1))


def world_of(case: Path) -> dict[str, Any]:
    """The constants that the script of the case's world begins with, and what follows from them: the friction's grid
    `vg` and the reference's acceleration `a` at each of its steps."""
    found: dict[str, Any] = {}
    for line in ast.parse((case / "make.py").read_text()).body:
        if not isinstance(line, ast.Assign):
            continue
        value = line.value.args[0] if isinstance(line.value, ast.Call) and line.value.args else line.value
        with suppress(ValueError):  # it is computed
            constants = ast.literal_eval(value)
            (target,) = line.targets
            several = isinstance(target, ast.Tuple)
            names = [one.id for one in target.elts] if several else [target.id]
            found |= dict(zip(names, constants if several else [constants], strict=True))
    found["vg"] = np.linspace(-found["VM"], found["VM"], len(found["FR"]))
    runs = [np.full(count, 0.0) for count in found["RUNS"]]  # at rest and accelerated in turns
    for run, value in zip(runs[::2], found["ACC"], strict=True):
        run += value
    return found | {"a": np.concatenate(runs), "FR": np.array(found["FR"])}


def drives(world: dict[str, Any], every: int, by_mean: bool, seed: int) -> Trajectories:
    """A table of the world with a row each `every` ms, its drives of 2 s."""
    random = np.random.default_rng(seed)
    step, gain = world["DT"], world["GTAU"]
    q, v = 1.078e-4, 1.343e-2
    wanted, rate, before, held = q, v, q, q
    force, read = [], []
    for k in range(LAPS * len(world["a"])):
        target = wanted
        rate += world["a"][k % len(world["a"])] * step
        wanted += rate * step
        seen = round(q / world["LSB"]) * world["LSB"]
        middle = 0.5 * (seen + before)
        told = np.clip(world["KV"] * (world["KP"] * (target - seen) - (middle - held) / step), -10, 10)
        before, held = seen, middle
        if k % every == 0:
            read.append(seen)
            force.append([])
        force[-1].append(gain * told)
        was = v
        v += step * (gain * told - np.interp(v, world["vg"], world["FR"])) / world["M"]
        v += 0.0002 * random.normal() * step**0.5
        q += step * (0.5 * (v + was) if by_mean else v)
    position = np.array(read) + READING_SD * random.normal(size=len(read))
    rows = round(SECONDS / (every * step))
    pieces = [slice(begin, begin + rows) for begin in range(rows, len(read) - rows + 1, 2 * rows)]
    columns = {"u.force": np.array([np.mean(each) for each in force]), "y.position": position}
    time = np.arange(rows) * every * step
    return from_arrays([{"time": time} | {name: values[piece] for name, values in columns.items()} for piece in pieces])


def mass_of(world: dict[str, Any], table: Trajectories, substeps: int, is_held: bool) -> tuple[float, float]:
    """The mass and its standard deviation, kg, with forces that are held over a row or change within it."""
    program = with_substeps(Known(world["vg"], world["FR"]).double(), substeps)
    if not is_held:
        program = program.with_effect("first_order_hold", 0.5)
    with seeded(0, "paths"):
        found = fit_by_likelihood(program, for_program(program, table))
    share = ridged_inverse(found.information).diagonal()[found.names.index("mass")].sqrt()
    mass = float(program.mass.detach())
    return mass, mass * float(share)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--results", type=Path, default=RESULT)
    given = parser.parse_args()
    torch.set_num_threads(1)
    if not (given.cases / "emps" / "make.py").is_file():
        print(f"{given.cases.name} has no folder emps: nothing to do", file=sys.stderr)
        return 0
    world = world_of(given.cases / "emps")
    lines = [
        "# The mass of EMPS by a program that knows its friction",
        "",
        f"True: {world['M']:.1f} kg.",
        "",
        "| table | substeps | mass, kg, forces held | forces with a slope (`first_order_hold`) |",
        "|---|---|---|---|",
    ]
    tables = [("the case's", 20, read_table(given.cases / "emps" / "train.csv"))]
    for by_mean, how in ((False, "new velocity"), (True, "mean velocity")):
        tables += [
            (f"rows of {every} ms, moved by the {how}", every, drives(world, every, by_mean, 0)) for every in (20, 5, 2)
        ]
    for name, every, table in tables:
        for substeps in (1, 8) if every == 20 else (1, 4):
            cells = []
            for is_held in (True, False)[:substeps]:  # of a row in one step nothing is known of its course
                mass, sd = mass_of(world, table, substeps, is_held)
                cells.append(f"{mass:.2f} ± {sd:.2f}")
            lines.append(f"| {name} | {substeps} | {cells[0]} | {cells[1] if len(cells) > 1 else ''} |")
            print(lines[-1], flush=True)
    given.results.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
