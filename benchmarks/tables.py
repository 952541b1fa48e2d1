"""What the doctor says of tables that are spoiled in every way it looks for, and of tables that are not.

    python benchmarks/tables.py [--clean 200] [--cases FOLDER] [--rows 1000000] [--seed 0]

Drives of six vehicles, at their own or other rates and units of noise, are written as tables. Clean ones are examined
as they are, with the program and without; logs of FOLDER too. Each way to spoil one is tried at three sizes: found is
what names the kind and the column. Prints a table and the seconds for a long one. Exits with 1 where a must is missed:
95 % named, false findings on 1 % of the clean tables, 5 s.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from steady_ppl import Program, load_program, seeded, simulate
from steady_ppl.data.doctor import Examination
from steady_ppl.data.table import to_frame
from steady_ppl.runs.diagnostics import doctor

ROOT = Path(__file__).parents[1]
VEHICLES = {
    "hovercraft": "hovercraft.py:HovercraftTruth",
    "boat": "gps_boat.py",
    "braked boat": "gps_boat.py:GpsBoatTruth",
    "pendulum": "pendulum.py",
    "cart": "linear_gaussian.py",
    "truck": "discovered_truck.py",
}
LOGS = {"victoria_park": "test.csv", "mrclam": "test.csv", "emps": "test.csv", "exact_unicycle": "test.csv"}
MUST_FIND, MUST_NOT, MUST_SECONDS = 0.95, 0.01, 5.0
Spoil = Callable[[pd.DataFrame, float, np.random.Generator], tuple[pd.DataFrame, str]]


def drives(vehicle: str, seed: int) -> tuple[Program, pd.DataFrame]:
    """Some drives at a rate of their own."""
    program = load_program(f"{ROOT / 'models' / VEHICLES[vehicle]}")
    rng = np.random.default_rng(seed)
    program.step *= float(rng.choice([0.5, 1.0, 1.0, 2.0]))
    with seeded(seed, "tables"):
        data = simulate(program, int(rng.integers(3, 9)), seed=seed)
    frame = to_frame(data if rng.random() < 0.3 else data.without_truth())
    seen = [column for column in frame if column.startswith("y.")]
    for column in seen:  # dropouts, which are no fault
        frame.loc[rng.random(len(frame)) < float(rng.choice([0.0, 0.05, 0.4])), column] = np.nan
    if rng.random() < 0.3:
        frame["time"] += 1_700_000_000.0
    if rng.random() < 0.3:
        frame[seen] = frame[seen].round(3)
    return program, frame


def _column(frame: pd.DataFrame, kind: str, rng: np.random.Generator) -> str:
    return str(rng.choice([column for column in frame if column.startswith(kind)]))


def _some(frame: pd.DataFrame, column: str, share: float, rng: np.random.Generator) -> np.ndarray:
    rows = np.flatnonzero(frame[column].notna())
    return rng.choice(rows, max(3, round(share * len(rows))), replace=False)


def code(value: float) -> Spoil:
    def spoil(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
        column = _column(frame, "y.", rng)
        frame.loc[_some(frame, column, 0.1 * size, rng), column] = value
        return frame, column

    return spoil


def zeros(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    """Of a range or a position far from the origin."""
    column = _column(frame, "y.", rng)
    frame[column] += 40 * frame[column].std()
    frame.loc[_some(frame, column, 0.1 * size, rng), column] = 0.0
    return frame, column


def degrees(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    column = next(c for c in frame if c in ("y.compass", "y.bearing_0", "y.angle"))
    frame[column] = np.rad2deg(frame[column]) % 360 if size < 1 else np.rad2deg(frame[column])
    return frame, column


def clockwise(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    turned = (
        np.pi / 2 - frame["y.compass"]
        if size < 0.5
        else -frame["y.compass"]
        if size < 1
        else frame["y.compass"] - np.pi / 2
    )
    frame["y.compass"] = np.angle(np.exp(1j * turned))
    return frame, "y.compass"


def swapped(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    return frame.rename(columns={"y.gps_x": "y.gps_y", "y.gps_y": "y.gps_x"}), "y.gps_x"


def times(factor: float, epoch: float) -> Spoil:
    def spoil(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
        since = frame["time"] - frame["time"].min()
        frame["time"] = ((since + epoch) * factor).round()
        return frame, "time"

    return spoil


def dates(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    stamps = pd.to_datetime((frame["time"] - frame["time"].min() + 1.7e9) * 1e9)
    frame["time"] = stamps.dt.strftime("%Y-%m-%dT%H:%M:%S.%f" if size < 1 else "%Y-%m-%d %H:%M:%S.%f+00:00")
    return frame, "time"


def frozen(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    column = _column(frame, "y.", rng)
    begin, count = int(rng.integers(5, 20)), round(15 + 40 * size)
    frame.loc[begin : begin + count, column] = frame[column].dropna().iloc[0]
    return frame, column


def interpolated(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    column = _column(frame, "y.", rng)
    begin, count = int(rng.integers(5, 20)), round(15 + 40 * size)
    first, last = frame[column].dropna().iloc[[0, 5]]
    stamps = frame["time"].iloc[begin : begin + count]
    share = (stamps - stamps.iloc[0]) / (stamps.iloc[-1] - stamps.iloc[0])
    frame.loc[stamps.index, column] = first + share * (last - first)
    return frame, column


def constant(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    column = _column(frame, "u.", rng)
    frame[column] = 0.0 if size < 1 else frame[column].dropna().iloc[0]
    return frame, column


def outlier(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    """A jump of one row to eight rows."""
    column = _column(frame, "y.", rng)
    rows = np.flatnonzero(frame[column].notna() & (frame["trajectory"] == frame["trajectory"].iloc[0]))[8:-12]
    begin = int(rng.integers(0, max(1, len(rows) - 8)))
    frame.loc[rows[begin : begin + max(1, round(8 * size * size))], column] += (
        60 * frame[column].diff().abs().median() + 8 * frame[column].std()
    )
    return frame, column


def copy(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    column = _column(frame, "u." if size < 0.5 else "y.", rng)
    frame[f"{column}_again"] = frame[column] * (1.0 if size < 1 else 3.6)
    return frame, f"{column}_again"


def one_row(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    first = frame.iloc[: 1 + round(2 * size)].copy()
    first["trajectory"] = [f"single {i}" for i in range(len(first))]
    return pd.concat([first, frame], ignore_index=True), "single 0"


def apart(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    """Rows of all trajectories by their time."""
    since = frame["time"] - frame.groupby("trajectory")["time"].transform("first")
    return frame.iloc[np.argsort(since, kind="stable")].reset_index(drop=True), str(frame["trajectory"].iloc[0])


def overlap(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    one = frame[frame["trajectory"] == frame["trajectory"].iloc[0]]
    again = one.iloc[-max(10, round(len(one) * size)) :].assign(trajectory="again")
    return pd.concat([frame, again], ignore_index=True), "again"


def back(frame: pd.DataFrame, size: float, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    for row in rng.choice(np.arange(5, 30), max(1, round(3 * size)), replace=False):
        frame.loc[row, "time"] = frame.loc[row - 2, "time"]
    return frame, "time"


SPOILED: dict[str, tuple[str, Spoil, tuple[str, ...]]] = {  # name: the kind that is right, how, and of which vehicles
    "-9999": ("code", code(-9999.0), tuple(VEHICLES)),
    "65535": ("code", code(65535.0), tuple(VEHICLES)),
    "1e30": ("code", code(1e30), tuple(VEHICLES)),
    "zeros": ("code", zeros, tuple(VEHICLES)),
    "degrees": ("degrees", degrees, ("hovercraft", "boat", "truck")),
    "heading": ("heading", clockwise, ("boat", "braked boat")),
    "axes": ("axes", swapped, ("boat", "braked boat")),
    "milliseconds": ("time unit", times(1e3, 0.0), tuple(VEHICLES)),
    "microseconds": ("time unit", times(1e6, 0.0), tuple(VEHICLES)),
    "epoch, nanoseconds": ("time unit", times(1e9, 1.7e9), tuple(VEHICLES)),
    "epoch, milliseconds": ("time unit", times(1e3, 1.7e9), tuple(VEHICLES)),
    "dates": ("dates", dates, tuple(VEHICLES)),
    "frozen": ("frozen", frozen, tuple(VEHICLES)),
    "interpolated": ("frozen", interpolated, tuple(VEHICLES)),
    "constant": ("constant", constant, tuple(VEHICLES)),
    "outlier": ("outlier", outlier, tuple(VEHICLES)),
    "copy": ("copy", copy, tuple(VEHICLES)),
    "one row": ("one row", one_row, tuple(VEHICLES)),
    "apart": ("apart", apart, tuple(VEHICLES)),
    "overlap": ("overlap", overlap, tuple(VEHICLES)),
    "times go back": ("time", back, tuple(VEHICLES)),
}
SIZES = (0.25, 0.6, 1.0)


def written(file: Path, name: str, frame: pd.DataFrame) -> None:
    """A table as other programs write it."""
    text = frame.to_csv(index=False)
    header, _, rest = text.partition("\n")
    units = ",".join("-" if c == "trajectory" else "s" if c == "time" else "m" for c in frame)
    match name:
        case "units row":
            text = f"{header}\n{units}\n{rest}"
        case "comment lines":
            text = f"# a log\n# of a drive\n{text}"
        case "blanks":
            text = f"{header.replace(',', ' , ')}\n{rest}"
        case "last separator":
            text = "".join(f"{line},\n" for line in text.splitlines())
        case "semicolons":
            text = text.replace(",", ";")
    file.write_bytes(text.encode("utf-16" if name == "UTF-16" else "utf-8"))


WRITTEN = {
    "units row": "a row of units",
    "comment lines": "comment line",
    "blanks": "blanks around",
    "last separator": "a separator at the end",
    "semicolons": "semicolons",
    "UTF-16": "UTF-16",
}


def names(found: Examination, kind: str, place: str) -> bool:
    """Whether the doctor names a kind, and the column or the trajectory."""
    kinds = {kind, "heading"} if kind == "axes" else {kind}

    def is_named(one: object) -> bool:
        return place == one.column or place in one.trajectories or (kind == "axes" and place in one.why)

    return any(one.kind in kinds and is_named(one) for one in found.findings)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clean", type=int, default=200)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--cases", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    right, tried, false, lines = 0, 0, 0, []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "drives.csv"
        for index, (name, (kind, spoil, vehicles)) in enumerate(SPOILED.items()):
            named = []
            for order, size in enumerate(SIZES):
                seed = given.seed + 1000 * index + order
                program, frame = drives(vehicles[(index + order) % len(vehicles)], seed)
                frame, place = spoil(frame, size, np.random.default_rng(seed))
                written(file, "", frame)
                found = doctor(file, program if order else None)
                named.append(names(found, kind, place))
                if not named[-1]:
                    lines.append(f"missed: {name} at {size} of {type(program).__name__}, {place}: {found}")
            right, tried = right + sum(named), tried + len(named)
            print(f"{name:22} {sum(named)} of {len(named)}")
        for index, (name, told) in enumerate(WRITTEN.items()):
            _, frame = drives(list(VEHICLES)[index % len(VEHICLES)], given.seed + 50_000 + index)
            written(file, name, frame)
            is_told = any(told in one for one in doctor(file).dialect.notes)
            right, tried = right + is_told, tried + 1
            print(f"{name:22} {int(is_told)} of 1")
        for index in range(given.clean):
            program, frame = drives(list(VEHICLES)[index % len(VEHICLES)], given.seed + 100_000 + index)
            written(file, "", frame)
            found = doctor(file, program if index % 2 else None)
            if found.findings:
                false += 1
                lines.append(f"false: {type(program).__name__}, set {index}: {found}")
        for case, table in LOGS.items() if given.cases else ():
            if (given.cases / case / table).is_file() and (found := doctor(given.cases / case / table)).findings:
                lines.append(f"of the log {case}: {found}")
        long = pd.DataFrame({"trajectory": np.arange(given.rows) // 1000, "time": np.arange(given.rows) % 1000 * 0.1})
        values = np.random.default_rng(0).normal(size=(given.rows, 5)).cumsum(0)
        long[["u.speed", "u.turn", "y.x", "y.y", "y.heading"]] = values
        written(file, "", long)
        begin = time.perf_counter()
        doctor(file)
        spent = time.perf_counter() - begin
    print(*lines, sep="\n")
    print(f"named {right} of {tried}; false findings on {false} of {given.clean} clean tables")
    print(f"{given.rows} rows in {spent:.1f} s")
    return int(right < MUST_FIND * tried or false > MUST_NOT * given.clean or spent > MUST_SECONDS)


if __name__ == "__main__":
    sys.exit(main())
