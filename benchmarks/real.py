"""What the parts for vehicles and sensors say of two published logs, beside what is known of these vehicles.

    python benchmarks/real.py --cases FOLDER [--only car …] [--results FILE] [--workers 1]

FOLDER has `victoria_park` (a car with speed, steering angle and GPS) and `mrclam` (a robot with speed, turn rate,
ranges and bearings, and motion capture). Programs are put together of the vehicles in `models/` and of
`steady_ppl.sensors`. No fit sees the motion capture, but for the starts where landmarks are unknown. Resumable. Writes
`results/real.md` if all cases go to the usual file. Exits with 1 when something is not as it should be.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import pyro
import pyro.distributions as dist
import torch
from others import Asked, concluded, page
from resumable import Record, digest, run
from torch import Tensor, tensor

import steady_ppl
from inference import likelihood
from models.car import Car
from models.unicycle import Unicycle
from steady_ppl import (
    Fit,
    Trajectories,
    UnknownMap,
    discover,
    for_program,
    load_program,
    read_table,
    seeded,
)
from steady_ppl.gaussian.smoother import find_path, smooth
from steady_ppl.model.problem import Problem
from steady_ppl.sensors import Bearings, Position, Ranges

ROOT = Path(__file__).parents[1]
RESULT = Path(__file__).parent / "results" / "real.jsonl"
STEPS = 100  # of a fit
ANTENNA, WHEELBASE, STEERING = (3.4, 3.7), (2.73, 2.93), (0.0, 0.01)  # m, m, rad: robust least squares, the car's maker
CAPTURED = {
    "speed gain": 0.925,
    "turn gain": 0.905,
    "turn response, s": 0.25,  # a lag of .17 s and a delay of .08 s
    "range scale": -0.019,
    "bearing bias, rad": -0.016,
    "sd of a range at 6 m, m": 0.18,  # .03 m at 1.2 m
}
NEAR = 0.25  # of which a figure may be off, with the right sign
MAX_AWAY, MAX_MAP = 0.1, 0.15  # m
RANGE_SD = 0.09  # m, as declared
WRONG_BY = 1.0  # m, of every landmark where they are unknown
EFFECTS = {
    "turn response, s": "response_time:yaw",
    "range scale": "sensor_scale:range",
    "bearing bias, rad": "bearing_bias",
    "sd of a range at 6 m, m": "range_dependent_noise:range",
}
OF_NOISE = ("measurement_noise", "heavy_tails", "process_noise")  # which say nothing false of the robot


class VictoriaPark(Car):
    """The utility car; its GPS jumps."""

    sensors = (Position(sd=0.3, name="gps", offset="antenna"),)
    start = "first measurements"
    effects = ("steering_offset=0.0", "heavy_tails=0.2")


class Robot(Unicycle):
    """A robot among barcodes, whose places `landmarks_of` reads."""

    sensors = (Ranges(sd=RANGE_SD), Bearings(sd=0.03))
    duration = 20.0

    def initial(self) -> Tensor:
        mean, sd = tensor([2.5, 0.0, 0.0, 0.0, 0.0, 0.0]), tensor([3.0, 4.0, 2.0, 0.1, 0.1, 0.3])
        return pyro.sample("start", dist.Normal(mean.to(self.noise), sd.to(self.noise)).to_event(1))


class KnownRobot(Robot):
    """The robot with what motion capture shows of it, to be estimated."""

    effects = (
        "response_time:yaw=0.1",
        "sensor_scale:range=0.0",
        "bearing_bias=0.0",
        "range_dependent_noise:range=0.1",
        "measurement_noise:range=0.5",
        "heavy_tails=0.2",
    )


def robot(kind: type[Robot], cases: Path, *above: type) -> Robot:
    """A program of the robot among the barcodes of its case, with classes put before it."""
    landmarks = load_program(cases / "mrclam" / "robot.py").landmarks
    placed = type(kind.__name__, (kind,), {"landmarks": landmarks, "__doc__": kind.__doc__})
    return type(kind.__name__, (*above, placed), {"__doc__": kind.__doc__})()


def drives(cases: Path, case: str) -> Iterator[Trajectories]:
    """Of training, validation and test."""
    return (read_table(cases / case / f"{name}.csv") for name in ("train", "valid", "test"))


def fitted(program: steady_ppl.Program, train: Trajectories, known_start: bool = False) -> Fit:
    return likelihood.fit(program, train, known_start=known_start, steps=STEPS)


def within(what: str, value: float, limits: tuple[float, float], unit: str) -> Asked:
    low, high = limits
    return Asked(f"{what} {low:g} to {high:g} {unit}", f"{value:.4g}", low <= value <= high)


def car(cases: Path) -> Iterator[Asked]:
    train, *_ = drives(cases, "victoria_park")
    program = fitted(VictoriaPark(), train).program
    yield within("antenna ahead of the rear axle", program.antenna[0].item(), ANTENNA, "m")
    yield within("wheelbase", program.wheelbase.item(), WHEELBASE, "m")
    yield within("steering offset", program.steering_offset.item(), STEERING, "rad")


def captured(program: Robot, sizes: dict[str, float]) -> dict[str, float]:
    """The figures of `CAPTURED` by a program, as far as it has them; `sizes` are those of its effects."""
    found = {"speed gain": program.speed_gain.item(), "turn gain": program.turn_gain.item()}
    found |= {name: sizes[effect] for name, effect in EFFECTS.items() if effect in sizes}
    if (response := "turn response, s") in found:
        found[response] += program.settling
    if (spread := "sd of a range at 6 m, m") in found:
        wider = sizes.get("measurement_noise:range", sizes.get("measurement_noise", 1.0))
        found[spread] = RANGE_SD * wider * (1 + 6.0 * found[spread])
    return found


def is_near(name: str, value: float) -> bool:
    return abs(value / CAPTURED[name] - 1) <= NEAR


def robot_estimated(cases: Path) -> Iterator[Asked]:
    train, _, test = drives(cases, "mrclam")
    program = fitted(robot(KnownRobot, cases), train).program
    for name, value in captured(program, sizes_of(program)).items():
        yield Asked(f"{name}, motion capture {CAPTURED[name]:g}", f"{value:.4g}", is_near(name, value))
    away = locations_off(program, test)
    told = f"{float(away.median()):.3f} m, at most {float(away.max()):.3f}"
    yield Asked(f"location, median per trajectory ≤ {MAX_AWAY:g} m", told, float(away.median()) <= MAX_AWAY)


def sizes_of(program: Robot) -> dict[str, float]:
    """The effects of `KnownRobot` as they are in a program."""
    names = [text.partition("=")[0] for text in KnownRobot.effects]
    return {name: getattr(program, name.replace(":", "_")).item() for name in names}


def locations_off(program: Robot, test: Trajectories) -> Tensor:
    """How far smoothed locations are from motion capture: the median of each trajectory, m."""
    data = for_program(program, test)
    problem = Problem(program, data)
    with seeded(0, "paths"), torch.no_grad():
        states = smooth(problem, find_path(problem)).path(data).states
    away = (states[..., :2] - data.states[..., :2]).norm(dim=-1)
    return torch.stack([away[:rows, drive].median() for drive, rows in enumerate(data.lengths.tolist())])


def robot_mapping(cases: Path) -> Iterator[Asked]:
    train, *_ = drives(cases, "mrclam")
    program = robot(KnownRobot, cases, UnknownMap)
    true = program.declared.clone()
    with seeded(1, "wrong map"), torch.no_grad():
        turn = 2 * math.pi * torch.rand(len(true))
        program.map += WRONG_BY * torch.stack([turn.cos(), turn.sin()], -1)
    program = fitted(program, train, known_start=True).program
    off = off_when_aligned(program.map.detach(), true)
    what = f"landmarks, each {WRONG_BY:g} m off at first, known starts: rms when aligned ≤ {MAX_MAP:g} m"
    yield Asked(what, f"{off:.3f} m", off <= MAX_MAP)


def off_when_aligned(found: Tensor, true: Tensor) -> float:
    """Root mean square distance of points `(K, 2)` from true ones, moved and turned upon them as well as may be."""
    found, true = found - found.mean(0), true - true.mean(0)
    left, _, right = torch.linalg.svd(found.T @ true)
    mirror = torch.diag(torch.stack([left.new_ones(()), torch.det(left @ right).sign()]))
    return float((found @ (left @ mirror @ right) - true).square().sum(-1).mean().sqrt())


def robot_searched(cases: Path) -> Iterator[Asked]:
    train, valid, _ = drives(cases, "mrclam")
    found = discover(robot(Robot, cases), train, valid)
    effects = found.figures["effects"]
    sizes = {one["effect"]: one["coefficient"][0] for one in effects}
    values = captured(found.after.program, sizes)
    near = [name for name, value in values.items() if is_near(name, value)]
    told = "; ".join(f"{name} {value:.3g}" for name, value in values.items())
    yield Asked(f"four of six within {NEAR:.0%} of motion capture", told, len(near) >= 4)
    right = (*EFFECTS.values(), *OF_NOISE)
    false = [one["effect"] for one in effects if not one["effect"].startswith(right)]
    yield Asked("nothing else", ", ".join(false) or "nothing", not false)


CASES: dict[str, Callable[[Path], Iterator[Asked]]] = {
    "car": car,
    "robot": robot_estimated,
    "robot, landmarks unknown": robot_mapping,
    "robot, discover": robot_searched,
}


def work(name: str, cases: str) -> Record:
    """The record of a case."""
    torch.set_num_threads(1)
    began = time.process_time()
    asked = [one._asdict() for one in CASES[name](Path(cases))]
    return {"asked": asked, "cost": {"all": {"cpu": time.process_time() - began}}}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--only", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--results", type=Path, default=RESULT)
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    folder = given.cases.resolve()
    absent = [name for name in ("victoria_park", "mrclam") if not (folder / name).is_dir()]
    if absent:
        print(f"left out: {folder.name} has no folder {' and none '.join(absent)}", file=sys.stderr)
        return 0
    version = digest(*(ROOT / place for place in ("steady_ppl", "models", "inference")), files=[Path(__file__)])
    records = run(
        work, {name: (name, str(folder)) for name in given.only}, given.results, version=version, workers=given.workers
    )
    text = page(records, "Two published logs", CASES)
    return concluded(records, text, RESULT if given.results == RESULT and set(given.only) == set(CASES) else None)


if __name__ == "__main__":
    sys.exit(main())
