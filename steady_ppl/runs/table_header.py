"""What the columns of a table are, by their names and units: time, controls of a vehicle, readings of sensors."""

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from steady_ppl.data.suspicions import EPOCHS, LONG_STEPS, MAX_TIMES_STEP
from steady_ppl.data.table import from_frame, labels_of, parse_cells, read_cells
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError
from steady_ppl.runs.vehicle_parts import Vehicle, columns_of
from steady_ppl.sensors import Sensor
from steady_ppl.utils.context import UNITS_ROW

TIME = ("time", "t", "timestamp", "stamp", "seconds", "sec", "zeit")
LABELS = ("trajectory", "drive", "run", "lap", "log", "id", "segment", "session", "trial")
CONTROLS = {
    "speed": (
        "speed",
        "v",
        "vel",
        "velocity",
        "spd",
        "cmd_vel",
        "cmd_speed",
        "speed_cmd",
        "linear",
        "linear_x",
        "v_cmd",
    ),
    "turn": ("turn", "omega", "w", "yaw_rate", "yawrate", "turn_rate", "angular", "angular_z", "omega_cmd", "wz"),
    "steering": ("steering", "steer", "delta", "steering_angle", "steer_angle", "phi", "delta_cmd", "wheel_angle"),
    "left": ("left", "l", "thrust_left", "left_thrust", "port", "f_left", "u_left", "motor_left"),
    "right": ("right", "r", "thrust_right", "right_thrust", "starboard", "stbd", "f_right", "u_right", "motor_right"),
    "left_wheel": ("left_wheel", "v_left", "vl", "wheel_left", "left_speed", "speed_left", "left_vel", "left"),
    "right_wheel": ("right_wheel", "v_right", "vr", "wheel_right", "right_speed", "speed_right", "right_vel", "right"),
    "rudder": ("rudder", "rudder_angle", "delta_r", "delta"),
    "propeller": ("propeller", "prop", "rps", "shaft", "n_prop"),
}
"""What people call a vehicle's controls."""
KINDS = {
    "position": ("gps", "gnss", "rtk", "utm", "pos", "tag", "marker", "mocap", "location", "loc", "odom"),
    "pose": ("vicon", "optitrack", "mocap"),
    "heading": ("compass", "hdg", "yaw", "azimuth", "course", "psi", "theta", "tilt", "mag"),
    "yaw rate": ("gyro", "yawrate", "yaw_rate", "omega", "wz", "gz", "gyr"),
    "wheel speed": ("wheel", "wheelspeed", "odo", "odometer", "encoder", "speed"),
    "velocity": ("vel", "dvl", "flow"),
    "accelerometer": ("acc", "accel", "accelerometer", "imu"),
    "bearing": ("brg", "angle", "azimuth"),
    "range": ("dist", "distance", "rng", "rho", "uwb"),
}
"""Words in the names of sensors by kind, beside those of the kind."""
PARTS = {
    "x": ("x", "e", "east", "easting", "px"),
    "y": ("y", "n", "north", "northing", "py"),
    "heading": ("heading", "yaw", "theta", "psi", "hdg"),
    "forward": ("forward", "fwd", "surge", "ahead"),
    "lateral": ("lateral", "lat", "sway", "left"),
}
"""What people call the parts of a reading."""
UNITS = {
    "m": ("m", 1.0),
    "meters": ("m", 1.0),
    "km": ("m", 1000.0),
    "cm": ("m", 0.01),
    "mm": ("m", 0.001),
    "m/s": ("m/s", 1.0),
    "mps": ("m/s", 1.0),
    "km/h": ("m/s", 1 / 3.6),
    "kmh": ("m/s", 1 / 3.6),
    "kph": ("m/s", 1 / 3.6),
    "mph": ("m/s", 0.44704),
    "knots": ("m/s", 1852 / 3600),
    "kn": ("m/s", 1852 / 3600),
    "cm/s": ("m/s", 0.01),
    "mm/s": ("m/s", 0.001),
    "m/s²": ("m/s²", 1.0),
    "m/s^2": ("m/s²", 1.0),
    "m/s2": ("m/s²", 1.0),
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180),
    "degrees": ("rad", math.pi / 180),
    "°": ("rad", math.pi / 180),
    "rad/s": ("rad/s", 1.0),
    "deg/s": ("rad/s", math.pi / 180),
    "°/s": ("rad/s", math.pi / 180),
    "dps": ("rad/s", math.pi / 180),
    "n": ("N", 1.0),
    "rps": ("1/s", 1.0),
    "rpm": ("1/s", 1 / 60),
    "s": ("s", 1.0),
    "sec": ("s", 1.0),
    "ms": ("s", 0.001),
    "us": ("s", 1e-6),
    "ns": ("s", 1e-9),
}
"""As they are written, in small letters → of models, and how many of these one is."""
FINE = {"milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns"}
MIN_READINGS = 20  # by which a standard deviation can be told
SD_OF_THIRD_DIFFERENCE = math.sqrt(20.0)  # of white noise of one
COVERED, SDS_COVERED = 0.9, 1.645  # share of normal readings within so many standard deviations; few are outliers


@dataclass(frozen=True)
class Column:
    """A column of a table as it is called there."""

    raw: str
    group: str  # u, y or x, "" where it is not said
    stem: str  # without group and unit
    factor: float = 1.0  # into the unit of a program
    unit: str = ""  # of a program, or as it is written; "" where it is not

    @classmethod
    def parse(cls, raw: str) -> "Column":
        group, dot, rest = raw.partition(".")
        if not (dot and group in ("u", "y", "x")):
            group, rest = "", raw
        found = re.fullmatch(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*", rest)
        if found:
            unit, factor = UNITS.get(found[2].lower(), (found[2], 1.0))
            return cls(raw, group, found[1], factor, unit)
        stem, _, last = rest.strip().rpartition("_")
        unit, factor = UNITS.get(last.lower(), ("", 1.0))
        is_unit = stem and unit and (factor != 1.0 or not group) and unit != "N"  # which is north
        if not is_unit or (unit == "s" and stem.lower() not in TIME):  # v_ms is in m/s, or in none
            return cls(raw, group, rest)
        return cls(raw, group, stem, factor, unit)

    @property
    def name(self) -> str:
        """In small letters, words joined by underscores."""
        return re.sub(r"\W+", "_", self.stem.strip()).strip("_").lower()

    def called(self, group: str) -> str:
        """Its name in a table that a model reads."""
        return f"{group}.{self.stem if self.group else self.name}"

    def is_called(self, name: str) -> bool:
        return name in (self.name, self.raw, self.stem)

    def may_be_in(self, unit: str) -> bool:
        return not (self.unit and unit) or self.unit == unit


@dataclass
class Header:
    """The columns of a table, and its cells."""

    path: Path
    frame: pd.DataFrame
    columns: list[Column]
    time: str
    label: str | None  # column of the drives' names

    @classmethod
    def read(cls, path: Path) -> "Header":
        frame, _ = read_cells(path, UNITS_ROW.get() or None)
        plain = {Column.parse(str(raw)).name: str(raw) for raw in frame.columns[::-1]}
        time = next((plain[name] for name in TIME if name in plain), None)
        if time is None:
            raise DataError(f"{path.name}: no column is a time, expected time or t among {', '.join(frame.columns)}")
        label = next((plain[name] for name in LABELS if name in plain), None)
        columns = [Column.parse(str(raw)) for raw in frame.columns if raw not in (time, label)]
        return cls(path, frame, columns, time, label)

    @property
    def name(self) -> str:
        return self.path.name

    def of(self, group: str, taken: Collection[str] = ()) -> list[Column]:
        """The columns of a group and of none, but those that are taken."""
        return [one for one in self.columns if one.group in (group, "") and one.raw not in taken]

    def numbers(self, column: str) -> np.ndarray:
        return parse_cells(self.frame[column])[0] * Column.parse(column).factor

    def noise(self, column: str) -> float | None:
        """The standard deviation of a column's readings by how three neighbouring steps of them differ, in the unit of
        programs; None where there are too few, or they do not change."""
        labels = np.zeros(len(self.frame)) if self.label is None else labels_of(self.frame[self.label])[0]
        found = []
        for label in pd.unique(labels):
            values = self.numbers(column)[labels == label]
            found.append(np.diff(values[np.isfinite(values)], 3))
        every = np.abs(np.concatenate([np.empty(0), *found]))
        every = every[every > 0]
        if len(every) < MIN_READINGS:
            return None
        return float(np.quantile(every, COVERED) / SDS_COVERED / SD_OF_THIRD_DIFFERENCE)

    def largest(self, column: str) -> float:
        return float(np.nanmax(np.abs(self.numbers(column))))

    def require_seconds(self, step: float) -> None:
        """Raise DataError where times of no unit look like finer ones, by the limits of `doctor`.

        Args:
            step: s, of a program that reads them.
        """
        times = self.numbers(self.time)
        steps = np.diff(times)
        apart = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        found = [unit for least, unit, _ in EPOCHS if times.min() > least]
        if apart >= MAX_TIMES_STEP * step:
            found += [unit for least, unit, _ in LONG_STEPS if apart >= least]
        if found and not Column.parse(self.time).unit:
            what = f"{self.name}: {self.time} begins at {times.min():.6g}, rows are {apart:.3g} apart"
            how = f"call it {self.time}_{FINE[found[0]]}, or {self.time}_s if these are seconds"
            raise DataError(f"{what}: are these {found[0]}? {how}", column=self.time)

    def as_table(self, names: Mapping[str, str]) -> Trajectories:
        """The table with its columns called as programs do and in their units: own name → `u.…`, `y.…`, `x.…`."""
        frame = pd.DataFrame({"time": self.numbers(self.time)})
        frame.insert(0, "trajectory", "1" if self.label is None else self.frame[self.label].to_numpy())
        for raw, name in names.items():
            frame[name] = self.numbers(raw)
        return from_frame(frame, name=self.name)


def controls_of(vehicle: Vehicle, header: Header, given: Mapping[str, str]) -> list[Column] | None:
    """The columns that are a vehicle's controls, in its order; None where one is not found.

    Args:
        given: the name of a column → the control that it is.
    """
    found = list[Column]()
    for own, unit in zip(vehicle.program.control_names, vehicle.program.control_units, strict=True):
        told = [name for name, control in given.items() if control == own]
        names = told or [name for name in (own, *CONTROLS.get(own, ())) if name not in given]
        open_ = [one for one in header.of("u") if one not in found and one.may_be_in(unit)]
        there = [one for name in names for one in open_ if one.is_called(name)]
        if not there:
            return None
        found.append(there[0])
    return found


@dataclass(frozen=True)
class Seen:
    """A sensor that some columns of a table are of."""

    kind: type[Sensor]
    name: str
    columns: Mapping[str, str]  # the table's → the sensor's
    landmarks: int  # how many it sees, 0 where it sees none
    others: tuple[str, ...] = ()  # kinds that are as likely


def sensors_in(
    header: Header,
    kinds: Collection[type[Sensor]],
    taken: Collection[str],
    name: str = "",
    own: Collection[Sensor] = (),
) -> list[Seen]:
    """The sensors of some kinds that a table's columns are of, the largest where several could be, then the vehicle's
    `own`; of one that is called so, if a name is given, which then need not say what it measures."""
    found, left = list[Seen](), header.of("y", taken)
    while left:
        possible = list(_possible(left, kinds, name, own))
        if not possible:
            break
        score, best = max(possible, key=lambda one: one[0])
        others = [one.kind.kind for least, one in possible if least == score and {*one.columns} == {*best.columns}]
        found.append(replace(best, others=tuple(one for one in others if one != best.kind.kind)))
        left = [one for one in left if one.raw not in best.columns]
    order = [one.raw for one in header.columns]
    return sorted(found, key=lambda one: min(map(order.index, one.columns)))


def _possible(
    left: Sequence[Column], kinds: Collection[type[Sensor]], called: str, own: Collection[Sensor]
) -> Iterator[tuple[tuple[int, ...], Seen]]:
    """Sensors that some of the columns could be of, and how well they fit."""
    for kind in kinds:
        sees_landmarks = len(columns_of(example(kind, "n"), 1)) != len(columns_of(example(kind, "n"), 2))
        for name in [called] if called else _names(left, kind):
            counts = range(len(left), 0, -1) if sees_landmarks else (0,)
            for count in counts:
                wanted = columns_of(example(kind, name), count)
                columns, exact = _matched(left, wanted, name)
                if columns is None:
                    continue
                word = int(bool(called)) or _has_word(kind, name)
                is_own = any(type(one) is kind and one.name == name for one in own)
                is_alone = len(wanted) > 1 and not sees_landmarks and _is_alone(kind, kinds, wanted, name)
                if is_own or word or is_alone:
                    yield (len(wanted), is_own, word, exact), Seen(kind, name, columns, count)
                break


def example(kind: type[Sensor], name: str) -> Sensor:
    """A sensor of a class and a name, of which only the columns are asked."""
    given: dict[str, Any] = dict.fromkeys(required_settings(kind), 1.0)
    return kind(**(given | {"name": name}))


def required_settings(kind: type[Sensor]) -> list[str]:
    """The settings without which there is no sensor of a class."""
    return [field.name for field in fields(kind) if field.default is MISSING]


def _names(left: Sequence[Column], kind: type[Sensor]) -> list[str]:
    """What a sensor may be called: its columns' names or how they begin, and its kind."""
    found = {kind.kind.replace(" ", "_"): None}
    for column in left:
        words = column.name.split("_")
        found |= {"_".join(words[:count]): None for count in range(1, len(words) + 1)}
    return [name for name in found if name.isidentifier()]


def _matched(left: Sequence[Column], wanted: Mapping[str, str], name: str) -> tuple[dict[str, str] | None, int]:
    """The columns that a sensor's are, and how many have its very names; None where one is missing."""
    found, exact = dict[str, str](), 0
    for column, unit in wanted.items():
        fitting = [one for one in left if one.raw not in found and one.may_be_in(unit)]
        part = column.removeprefix(f"{name}_")
        others = [f"{name}_{alias}" for alias in PARTS.get(part, ())]
        if part.isdigit() and not any(one.name == f"{name}_0" for one in left):
            others.append(f"{name}_{int(part) + 1}")  # counted from 1
        others += [alias for alias in (part, *PARTS.get(part, ())) if part in PARTS and len(wanted) > 1]
        called = [one for own in (column, *others) for one in fitting if one.name == own]
        if not called:
            return None, 0
        found[called[0].raw] = column
        exact += called[0].name == column
    return found, exact


def _has_word(kind: type[Sensor], name: str) -> int:
    """How many words of a sensor's name say what it measures."""
    words = {*kind.kind.split(), kind.kind.replace(" ", "_"), *KINDS.get(kind.kind, ())}
    told = sum(re.sub(r"\d+$", "", word) in words for word in name.split("_"))
    return told or int(name in words)


def _is_alone(kind: type[Sensor], kinds: Collection[type[Sensor]], wanted: Collection[str], name: str) -> bool:
    """Whether no other kind has such columns."""
    others = [one for one in kinds if one is not kind]
    return not any(list(columns_of(example(one, name), 1)) == list(wanted) for one in others)
