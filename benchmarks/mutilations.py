"""What `discover` says of drives that are spoiled at random: a verdict, one clear line, or a traceback, which is wrong.

    python benchmarks/mutilations.py [--cases 500] [--seed 0] [--only demo boat] [--results [FILE]] [--workers 2]

Short drives of the demo's hovercraft and of the boat are spoiled in one to three ways that a log may be: jumps,
dropouts, swapped columns, sensors that saturate or freeze, and so on. Each table is written and read again, as the
command does. Four of five searches are interrupted after some seconds, as `--minutes` does. Resumable. Exits with 1
where one case ends with a traceback or not within its time.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from resumable import Record, digest, run
from torch import Tensor

import steady_ppl
from steady_ppl import Program, Trajectories, discover, load_program, read_table, simulate, write_table
from steady_ppl.effects import catalogue
from steady_ppl.errors import SteadyError
from steady_ppl.utils.files import finite_json

ROOT = Path(__file__).parents[1]
RESULT = Path(__file__).parent / "results" / "mutilations.jsonl"
DRIVES, ROWS, SIMULATIONS = 10, 17, 50
ALL_SHARE, CURVES_SHARE = 0.1, 0.3  # of cases that look for every effect, and of the others for curves: both take long
FEW = 5  # effects that the others look for
MAX_WAYS = 3  # in which one table is spoiled
SECONDS = 600  # that one case may take, where nothing else is said
INTERRUPTED_SHARE, INTERRUPT = 0.8, 10.0  # of cases that Ctrl-C ends after so many seconds of processor time
TABLES = {
    "demo": ("hovercraft.py", "HovercraftTruth", 1, True),
    "boat": ("gps_boat.py", "GpsBoatTruth", 3, False),
}  # program, truth, seed of its drives, whether their start is known
WALL, PROCESSOR = (signal.ITIMER_REAL, signal.SIGALRM), (signal.ITIMER_VIRTUAL, signal.SIGVTALRM)
OUTCOMES = ("verdict", "line", "traceback", "time")
Way = Callable[[Trajectories, np.random.Generator], Trajectories]
WAYS: dict[str, Way] = {}


class TimeIsUp(BaseException):
    """A case takes too long; no handler of errors catches it."""


def way(function: Way) -> Way:
    """Add a way of spoiling a table, under its name in words."""
    WAYS[function.__name__.replace("_", " ")] = function
    return function


def some_drives(data: Trajectories, random: np.random.Generator) -> list[int]:
    """One drive, some or all."""
    count = int(random.choice([1, max(1, len(data) // 3), len(data)]))
    return sorted(random.choice(len(data), count, replace=False).tolist())


def some_columns(count: int, random: np.random.Generator) -> list[int]:
    """One column, or all."""
    return [int(random.integers(count))] if random.random() < 0.6 else list(range(count))


def stretch(data: Trajectories, drive: int, random: np.random.Generator) -> slice:
    """Rows of a drive that follow one another: one, some, or as far as its end."""
    rows = int(data.lengths[drive])
    first = int(random.integers(rows))
    count = int(random.choice([1, 2, max(1, rows // 5), rows]))
    return slice(first, min(rows, first + count))


def spread_of(values: Tensor) -> float:
    """How far a column's values lie apart."""
    return float(values.std()) or 1.0


def size(random: np.random.Generator, least: float, most: float) -> float:
    """A number between two, each order of magnitude as likely as another, of either sign."""
    return float(random.choice([-1, 1]) * 10 ** random.uniform(math.log10(least), math.log10(most)))


def changed(data: Trajectories) -> Trajectories:
    """A copy whose tensors may be written to."""
    return replace(
        data,
        time=data.time.clone(),
        controls=data.controls.clone(),
        measurements=data.measurements.clone(),
        observed=data.observed.clone(),
        lengths=data.lengths.clone(),
    )


@way
def jumps(data: Trajectories, random: np.random.Generator) -> Trajectories:
    for drive in some_drives(data, random):
        rows = stretch(data, drive, random)
        for column in some_columns(data.measurements.shape[-1], random):
            data.measurements[rows, drive, column] += size(random, 0.1, 1e3) * spread_of(data.measurements[..., column])
    return data


@way
def dropouts(data: Trajectories, random: np.random.Generator) -> Trajectories:
    share = random.random()
    for drive in some_drives(data, random):
        rows = stretch(data, drive, random)
        for column in some_columns(data.measurements.shape[-1], random):
            if random.random() < 0.5:
                data.observed[rows, drive, column] = False
            else:
                data.observed[:, drive, column] &= torch.tensor(random.random(len(data.time)) > share)
    return data


@way
def swapped_measurements(data: Trajectories, random: np.random.Generator) -> Trajectories:
    one, other = random.choice(data.measurements.shape[-1], 2, replace=False).tolist()
    for drive in some_drives(data, random):
        rows = stretch(data, drive, random)
        for values in (data.measurements, data.observed):
            values[rows, drive] = values[rows, drive][..., _exchange(values.shape[-1], one, other)]
    return data


def _exchange(count: int, one: int, other: int) -> list[int]:
    order = list(range(count))
    order[one], order[other] = other, one
    return order


@way
def swapped_controls(data: Trajectories, random: np.random.Generator) -> Trajectories:
    drives = some_drives(data, random)
    data.controls[:, drives] = data.controls[:, drives].flip(-1)
    return data


@way
def saturated_sensor(data: Trajectories, random: np.random.Generator) -> Trajectories:
    low, high = sorted(random.random(2).tolist())
    for column in some_columns(data.measurements.shape[-1], random):
        values = data.measurements[..., column]
        seen = values[data.observed[..., column]]
        if seen.numel():
            data.measurements[..., column] = values.clamp(float(seen.quantile(low)), float(seen.quantile(high)))
    return data


@way
def frozen_sensor(data: Trajectories, random: np.random.Generator) -> Trajectories:
    for drive in some_drives(data, random):
        rows = stretch(data, drive, random)
        for column in some_columns(data.measurements.shape[-1], random):
            data.measurements[rows, drive, column] = data.measurements[rows.start, drive, column].clone()
    return data


@way
def repeated_rows(data: Trajectories, random: np.random.Generator) -> Trajectories:
    often = int(random.choice([2, 3, 10]))
    for drive in some_drives(data, random):
        held = torch.arange(len(data.time)) // often * often
        data.measurements[:, drive] = data.measurements[held, drive]
        data.controls[:, drive] = data.controls[held, drive]
    return data


@way
def constant_control(data: Trajectories, random: np.random.Generator) -> Trajectories:
    level = float(random.choice([0.0, float(data.controls.mean()), 1e3]))
    drives = some_drives(data, random)
    for column in some_columns(data.controls.shape[-1], random):
        data.controls[:, drives, column] = level
    return data


@way
def spikes_of_control(data: Trajectories, random: np.random.Generator) -> Trajectories:
    for drive in some_drives(data, random):
        column = int(random.integers(data.controls.shape[-1]))
        data.controls[stretch(data, drive, random), drive, column] = size(random, 10, 1e6)
    return data


@way
def short_drives(data: Trajectories, random: np.random.Generator) -> Trajectories:
    lengths = data.lengths.clone()
    for drive in some_drives(data, random):
        lengths[drive] = int(random.integers(1, 6))
    return replace(data, lengths=lengths)


@way
def huge_outliers(data: Trajectories, random: np.random.Generator) -> Trajectories:
    for drive in some_drives(data, random):
        for _ in range(int(random.integers(1, 4))):
            row, column = random.integers(data.lengths[drive]), random.integers(data.measurements.shape[-1])
            data.measurements[row, drive, column] = size(random, 1e3, 1e9)
    return data


@way
def jitter_of_times(data: Trajectories, random: np.random.Generator) -> Trajectories:
    share = float(random.choice([0.1, 0.5, 0.999]))
    for drive in some_drives(data, random):
        steps = data.time[:, drive].diff() * torch.tensor(1 + share * random.uniform(-1, 1, len(data.time) - 1))
        if random.random() < 0.3:
            steps[int(random.integers(len(steps)))] *= float(random.choice([1e-6, 30.0, 1e4]))
        data.time[1:, drive] = data.time[0, drive] + steps.cumsum(0)
    return data


@way
def offset_of_times(data: Trajectories, random: np.random.Generator) -> Trajectories:
    return replace(data, time=data.time + size(random, 1.0, 1.7e9))


@way
def wrapped_angles(data: Trajectories, random: np.random.Generator) -> Trajectories:
    """Turns added to some, all of them positive, or degrees."""
    turn, column = 2 * math.pi, -1 if data.measurement_names[-1] == "compass" else slice(None)
    values = data.measurements[..., column]
    how = random.integers(3)
    if how == 0:
        values = values + turn * torch.tensor(random.integers(-3, 4, tuple(values.shape)))
    else:
        values = values % turn if how == 1 else torch.rad2deg(values)
    data.measurements[..., column] = values.to(data.measurements)
    return data


@way
def scaled_column(data: Trajectories, random: np.random.Generator) -> Trajectories:
    for column in some_columns(data.measurements.shape[-1], random):
        data.measurements[..., column] *= float(random.choice([0.0, -1.0, size(random, 1e-4, 1e4)]))
    return data


@way
def scaled_control(data: Trajectories, random: np.random.Generator) -> Trajectories:
    for column in some_columns(data.controls.shape[-1], random):
        data.controls[..., column] *= float(random.choice([0.0, -1.0, size(random, 1e-4, 1e4)]))
    return data


@way
def noise(data: Trajectories, random: np.random.Generator) -> Trajectories:
    more = torch.tensor(random.standard_normal(tuple(data.measurements.shape))).to(data.measurements)
    for column in some_columns(data.measurements.shape[-1], random):
        data.measurements[..., column] += size(random, 0.01, 100) * more[..., column]
    return data


@way
def late_measurements(data: Trajectories, random: np.random.Generator) -> Trajectories:
    rows = int(random.integers(1, 6))
    for column in some_columns(data.measurements.shape[-1], random):
        data.measurements[..., column] = data.measurements[..., column].roll(rows, 0)
    return data


@way
def few_drives(data: Trajectories, random: np.random.Generator) -> Trajectories:
    return data.subset(range(int(random.integers(1, len(data)))))


@way
def equal_drives(data: Trajectories, random: np.random.Generator) -> Trajectories:
    one, other = random.choice(len(data), 2, replace=False).tolist()
    for values in (data.controls, data.measurements, data.observed):
        values[:, other] = values[:, one]
    return data


def spoiled(table: str, case: int, random: np.random.Generator) -> tuple[Trajectories, list[str]]:
    """Drives that are spoiled, and in which ways."""
    path, truth, made_from, _ = TABLES[table]
    program = load_program(f"{ROOT / 'models' / path}:{truth}")
    program.duration = (ROWS - 1) * program.step
    data = simulate(program, DRIVES, seed=made_from + case).without_truth(keep_start=True)
    chosen = random.choice(list(WAYS), int(random.integers(1, MAX_WAYS + 1)), replace=False).tolist()
    for name in chosen:
        data = WAYS[name](changed(data), random)
    return _cut(data), chosen


def _cut(data: Trajectories) -> Trajectories:
    """The same without what lies behind the end of a drive."""
    rows = data.rows.unsqueeze(-1)
    controls, measurements = (torch.where(rows, values, 0.0) for values in (data.controls, data.measurements))
    return replace(data, controls=controls, measurements=measurements, observed=data.observed & rows)


def searched_for(program: Program, random: np.random.Generator) -> dict[str, list[str]]:
    """Which effects and kinds a search is told to leave out, and to keep to."""
    effects = catalogue(program)
    if random.random() < ALL_SHARE:
        return {"withheld": [], "only": []}
    few = set(random.choice([effect.name for effect in effects], FEW, replace=False).tolist())
    kinds = sorted({effect.verdict for effect in effects if effect.name in few})
    withheld = [effect.name for effect in effects if effect.name not in few]
    return {"withheld": withheld, "only": [] if random.random() < CURVES_SHARE else kinds}


@contextlib.contextmanager
def within(seconds: float, of: tuple[int, int], raised: type[BaseException]) -> Iterator[None]:
    """Raise an exception in the block when a timer (and its signal) has counted these seconds; never if infinite."""

    def end(*_: object) -> None:
        raise raised

    timer, number = of
    before = signal.signal(number, end)
    signal.setitimer(timer, seconds if math.isfinite(seconds) else 0)
    try:
        yield
    finally:
        signal.setitimer(timer, 0)
        signal.signal(number, before)


def work(table: str, case: int, seed: int, most: float = SECONDS) -> Record:
    """The record of a case, which may take so many seconds."""
    random = np.random.default_rng([seed, case, list(TABLES).index(table)])
    data, chosen = spoiled(table, case, random)
    path, _, _, known_start = TABLES[table]
    program = load_program(ROOT / "models" / path)
    sought = searched_for(program, random)
    interrupt = INTERRUPT if random.random() < INTERRUPTED_SHARE else math.inf
    record: Record = {"table": table, "ways": chosen, **sought, "interrupted": math.isfinite(interrupt)}
    began = time.perf_counter()
    with warnings.catch_warnings(record=True) as warned, tempfile.TemporaryDirectory() as folder:
        warnings.simplefilter("always")
        try:
            with within(most, WALL, TimeIsUp), within(interrupt, PROCESSOR, KeyboardInterrupt):
                write_table(data, Path(folder) / "drives.csv")
                drives = read_table(Path(folder) / "drives.csv")
                found = discover(program, drives, known_start=known_start, simulations=SIMULATIONS, **sought)
                finite_json(found.figures, "the figures")
                said = {"outcome": "verdict", "verdict": found.verdict, "said": str(found).splitlines()[0]}
                said["notes"] = [*found.doubts, *found.notes]
        except SteadyError as error:
            said = {"outcome": "line", "said": str(error).replace(folder, "…")}
        except KeyboardInterrupt as stop:
            said = {"outcome": "line", "said": f"interrupted: {stop}"}
        except TimeIsUp:
            said = {"outcome": "time", "said": f"more than {most:.0f} s", "where": traceback.format_exc()}
        except Exception as error:
            said = {"outcome": "traceback", "said": f"{type(error).__name__}: {error}", "where": traceback.format_exc()}
    seconds = round(time.perf_counter() - began, 1)
    kinds = sorted({f"{warning.category.__name__}: {warning.message}" for warning in warned})
    return record | said | {"seconds": seconds, "warnings": kinds}


def page(records: list[Record]) -> str:
    """The outcomes by table and by way, and what went wrong."""
    lines = ["# `discover` on spoiled drives", "", f"| spoiled by | {' | '.join(OUTCOMES)} |", "|---" * 5 + "|"]

    def row(name: str, some: list[Record]) -> str:
        counts = Counter(record["outcome"] for record in some)
        return f"| {name} | {' | '.join(str(counts[outcome]) for outcome in OUTCOMES)} |"

    lines += [row(name, [record for record in records if name in record["ways"]]) for name in WAYS]
    lines += [row(f"**{table}**", [record for record in records if record["table"] == table]) for table in TABLES]
    lines += [row("**all**", records), ""]
    wrong = [record for record in records if record["outcome"] in ("traceback", "time")]
    return "\n".join(
        [*lines, *(f"- {record['set']} ({', '.join(record['ways'])}): {record['said']}" for record in wrong)]
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", choices=TABLES, default=list(TABLES))
    parser.add_argument("--results", type=Path, nargs="?", const=RESULT, default=RESULT)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="that one case may take")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    names = [(arguments.only[case % len(arguments.only)], case) for case in range(arguments.cases)]
    jobs = {f"{table} {case}": (table, case, arguments.seed, arguments.seconds) for table, case in names}
    version = digest(Path(steady_ppl.__file__).parent, files=[Path(__file__)])
    told = lambda record: f"{record['seconds']:.0f} s  {record['outcome']}: {record['said'][:100]}"  # noqa: E731
    records = run(work, jobs, arguments.results, version=version, workers=arguments.workers, said=told)
    text = page([record for record in records if "failed" not in record])
    print(text)
    if arguments.results == RESULT:
        RESULT.with_suffix(".md").write_text(text + "\n")
    return int(any(record.get("outcome", "traceback") in ("traceback", "time") for record in records))


if __name__ == "__main__":
    sys.exit(main())
