"""Whether `discover` finds the same in any unit: the demo, the boat and two cases, each in eleven systems of units.

    python benchmarks/scalings.py [--cases FOLDER] [--only demo boat …] [--results [FILE]] [--workers 2]

The demo's and the boat's drives are simulated here; EMPS and Silverbox are read from FOLDER, and skipped without it.
Time, lengths, commands and what sensors say are multiplied by 1000 or divided by it, one by one and together, and the
program's numbers with them. Asked for: the same verdict and effects, coefficients to 1 %, and nats by which effects
raise log p(y) to .1. Writes `results/scalings.md` and exits with 1 when one differs by more.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import pyro
import pyro.distributions as dist
import torch
from resumable import Record, digest, run
from torch import Tensor, tensor

import steady_ppl
from steady_ppl import (
    PlanarVehicle,
    Program,
    Trajectories,
    WrappedNormal,
    bearings_to,
    discover,
    load_program,
    simulate,
)
from steady_ppl.effects import Variant

ROOT = Path(__file__).parents[1]
RESULT = Path(__file__).parent / "results" / "scalings.jsonl"
SIMULATIONS = 100  # sets, for the calibration
MAX_COEFFICIENT, MAX_NATS = 0.01, 0.1  # that may differ, of a coefficient and of log p(y)


class Units(NamedTuple):
    """By what numbers are multiplied."""

    time: float = 1.0
    length: float = 1.0
    command: float = 1.0
    measured: float = 1.0  # of a length or a voltage that a sensor says

    @property
    def acceleration(self) -> float:
        return self.length / self.time**2


SYSTEMS = {
    "as it is": Units(),
    "time × 1000": Units(time=1e3),
    "time ÷ 1000": Units(time=1e-3),
    "length × 1000": Units(length=1e3),
    "length ÷ 1000": Units(length=1e-3),
    "command × 1000": Units(command=1e3),
    "command ÷ 1000": Units(command=1e-3),
    "measurement × 1000": Units(measured=1e3),
    "measurement ÷ 1000": Units(measured=1e-3),
    "mixed, small time": Units(1e-3, 1e3, 1e-3, 1e3),
    "mixed, large time": Units(1e3, 1e-3, 1e3, 1e-3),
}
Case = tuple[Program, Trajectories, Trajectories, bool]  # program, drives to test, drives to choose by, known start


@torch.no_grad()
def _multiply(program: Program, factors: Mapping[str, Any]) -> None:
    """Multiply a program's parameters, of those that it has."""
    for name, factor in factors.items():
        if hasattr(program, name):
            setattr(program, name, getattr(program, name) * factor)


def _vehicle(base: type[PlanarVehicle], units: Units) -> PlanarVehicle:
    """A vehicle in the plane whose lengths, times and forces are in other units."""

    class Scaled(base):  # type: ignore[misc, valid-type]
        step, duration = base.step * units.time, base.duration * units.time
        landmarks = tuple((units.length * x, units.length * y) for x, y in base.landmarks)

        def __init__(self) -> None:
            super().__init__()
            rate = tensor([units.acceleration, units.acceleration, 1 / units.time**2])
            turns = units.command * units.time**2
            mass = units.command / units.acceleration
            _multiply(self, {"noise": rate, "mass": mass, "inertia": turns, "arm": 1 / turns})

        def initial(self) -> Tensor:
            one, speed = units.length, units.length / units.time
            sizes = tensor([one, one, 1.0, speed, speed, 1 / units.time])
            with pyro.poutine.block(), pyro.poutine.trace() as seen:
                super().initial()
            start = seen.trace.nodes["start"]["fn"].base_dist
            return pyro.sample("start", dist.Normal(start.loc * sizes, start.scale * sizes).to_event(1))

        def observe(self, state: Tensor) -> None:
            if self.landmarks:
                near = 0.1 * units.length
                pyro.sample("bearing", bearings_to(self.landmarks, state, sd=self.bearing_sd, near=near))
                return
            said = units.measured * state[..., :2]
            pyro.sample("gps", dist.Normal(said, 0.5 * units.length * units.measured).to_event(1))
            pyro.sample("compass", WrappedNormal(state[..., 2:3], 0.05).to_event(1))

    return Scaled()


def _vehicle_drives(data: Trajectories, units: Units, reads_lengths: bool) -> Trajectories:
    speed = units.length / units.time
    states = tensor([units.length, units.length, 1.0, speed, speed, 1 / units.time]).to(data.controls)
    read = tensor([units.length * units.measured] * 2 + [1.0]).to(data.controls) if reads_lengths else 1.0
    return replace(
        data,
        time=data.time * units.time,
        controls=data.controls * units.command,
        measurements=data.measurements * read,
        states=None if data.states is None else data.states * states,
    )


def _vehicles(path: str, truth: str, seed: int, units: Units) -> Case:
    made = load_program(f"{ROOT / 'models' / path}:{truth}")
    base = next(kind for kind in type(made).__mro__ if kind.__name__ == truth.removesuffix("Truth"))
    drives = [simulate(made, 16, seed=seed + index) for index in (0, 1)]
    reads = not base.landmarks
    train, valid = (_vehicle_drives(data, units, reads) for data in drives)
    return _vehicle(base, units), train, valid, not reads


def demo(units: Units, cases: Path) -> Case:
    return _vehicles("hovercraft.py", "HovercraftTruth", 1, units)


def boat(units: Units, cases: Path) -> Case:
    return _vehicles("gps_boat.py", "GpsBoatTruth", 3, units)


def _oscillator(program: Program, folder: Path, units: Units, names: tuple[str, str], sd: float) -> Case:
    """A program of one axis, whose position is read with a standard deviation."""
    base = type(program)
    factors: dict[str, float] = {
        "stiffness": 1 / units.time**2,
        "damping": 1 / units.time,
        "gain": units.acceleration / units.command,
        "mass": units.command / units.acceleration,
        "noise": units.acceleration,
    }

    class Scaled(base):  # type: ignore[misc, valid-type]
        step, duration = base.step * units.time, base.duration * units.time

        def __init__(self) -> None:
            super().__init__()
            _multiply(self, factors)

        def initial(self) -> Tensor:
            sizes = tensor([units.length, units.length / units.time])
            with pyro.poutine.block(), pyro.poutine.trace() as seen:
                super().initial()
            start = seen.trace.nodes["start"]["fn"].base_dist
            return pyro.sample("start", dist.Normal(start.loc * sizes, start.scale * sizes).to_event(1))

        def observe(self, state: Tensor) -> None:
            scale = units.length * units.measured * sd
            pyro.sample(self.measurement_names[0], dist.Normal(units.measured * state[..., :1], scale).to_event(1))

    def scaled(split: str) -> Trajectories:
        data = steady_ppl.read_table(folder / f"{split}.csv")
        return replace(
            data,
            time=data.time * units.time,
            controls=data.controls * units.command,
            measurements=data.measurements * (units.length * units.measured),
        )

    return Scaled(), scaled("train"), scaled("valid"), False


def emps(units: Units, cases: Path) -> Case:
    return _oscillator(load_program(cases / "emps" / "emps.py"), cases / "emps", units, ("position", "velocity"), 2e-5)


def silverbox(units: Units, cases: Path) -> Case:
    folder = cases / "silverbox"
    return _oscillator(load_program(folder / "silverbox.py"), folder, units, ("y", "rate"), 3e-4)


CASES: dict[str, Callable[[Units, Path], Case]] = {"demo": demo, "boat": boat, "emps": emps, "silverbox": silverbox}
NEED_FILES = ("emps", "silverbox")


def unit_of(variant: Variant, units: Units) -> float:
    """By what a coefficient is multiplied."""
    declared = variant.effect.unit
    if variant.unit == "rad":
        return 1.0
    if declared in ("of the control", "of the measurement"):
        return units.command if declared == "of the control" else units.length * units.measured
    if declared == "1/kg":
        return units.acceleration / units.command
    above, _, below = variant.unit.partition("/")

    def size(text: str) -> float:
        powers = re.findall(r"(?<![a-z])(m|V|s)(?![a-z])(²|³)?", text)
        of = {"m": units.length, "V": units.length, "s": units.time}
        return math.prod(of[name] ** {"": 1, "²": 2, "³": 3}[power] for name, power in powers)

    return size(above) / size(below)


def work(case: str, system: str, cases: str) -> Record:
    """The record of a search."""
    units = SYSTEMS[system]
    program, train, valid, known_start = CASES[case](units, Path(cases))
    found = discover(program, train, valid, known_start=known_start, simulations=SIMULATIONS)
    effects = {
        one.variant.name: [value / unit_of(one.variant, units) for value in one.coefficient] for one in found.findings
    }
    gain = found.search.gain
    record = {"case": case, "units": system, "verdict": found.verdict, "effects": effects, "gain": gain}
    return record | {"p_value": found.p_value, "substeps": found.after.program.substeps, "notes": found.notes}


def differences(base: Record, other: Record) -> Iterator[str]:
    """What is not the same in other units, in words."""
    if "failed" in other:
        yield other["failed"]
        return
    for name in ("verdict", "substeps"):
        if base[name] != other[name]:
            yield f"{name} {other[name]}"
    if set(base["effects"]) != set(other["effects"]):
        yield "effects " + ", ".join(other["effects"])
    for name, values in base["effects"].items():
        there = other["effects"].get(name, values)
        size = max(map(abs, values))
        away = max(abs(one - two) for one, two in zip(values, there, strict=True)) / size
        if away > MAX_COEFFICIENT:
            yield f"{name} {there} for {values}"
    if abs(base["gain"] - other["gain"]) > MAX_NATS:
        yield f"{other['gain']:.2f} nats"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=Path)
    parser.add_argument("--only", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--results", type=Path, nargs="?", const=RESULT, default=RESULT)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    left_out = [name for name in arguments.only if name in NEED_FILES and arguments.cases is None]
    if left_out:
        print(f"{' and '.join(left_out)}: skipped, for --cases says no folder")
    chosen = [name for name in arguments.only if name not in left_out]
    folder = str((arguments.cases or Path()).resolve())
    jobs = {f"{case} {system}": (case, system, folder) for case in chosen for system in SYSTEMS}
    version = digest(Path(steady_ppl.__file__).parent, files=[Path(__file__)])
    records = run(work, jobs, arguments.results, version=version, workers=arguments.workers)
    found = {(record["case"], record["units"]): record for record in records if "failed" not in record}
    failed = {record["set"]: record for record in records if "failed" in record}
    lines = [
        "# `discover` in other units",
        "",
        "| case | units | effects | gain, nats | differs |",
        "|---|---|---|---|---|",
    ]
    differ = 0
    for case in chosen:
        for system in SYSTEMS:
            record = found.get((case, system)) or failed.get(f"{case} {system}", {"failed": "no record"})
            base = found.get((case, "as it is"))
            away = list(differences(base, record)) if base else [record.get("failed", "no base")]
            differ += bool(away)
            effects = ", ".join(f"{name} {values}" for name, values in record.get("effects", {}).items())
            gain = f"{record['gain']:.2f}" if "gain" in record else ""
            lines.append(f"| {case} | {system} | {effects} | {gain} | {'; '.join(away) or '–'} |")
    lines += ["", f"{differ} of {len(chosen) * len(SYSTEMS)} differ."]
    page = "\n".join(lines) + "\n"
    print(page)
    if arguments.results == RESULT:
        RESULT.with_suffix(".md").write_text(page)
    return bool(differ)


if __name__ == "__main__":
    sys.exit(main())
