"""What lies between the vehicle and its measurements."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.catalogue.forces import PLANAR
from steady_ppl.effects.declaration import Choices, Effect, Need, coefficient, declare, effects_of, needs
from steady_ppl.model.planar_vehicle import PlanarVehicle, turned
from steady_ppl.model.program import Program

SEES_LANDMARKS = ("bearing", "range")  # kinds of sensors
# kinds whose readings may be too large
SCALED = ("bearing", "range", "velocity", "wheel speed", "yaw rate", "accelerometer", "encoder")
MOUNTED = ("velocity", "accelerometer")  # kinds that read components in their own axes
# kinds whose readings a moment ago follow from the state
OF_POSE = ("bearing", "range", "position", "heading", "pose", "range and bearing")


def sensors_of(program: Program, *kinds: str) -> dict[str, tuple[int, ...]]:
    """Name of each sensor of some kinds that a program lists, or of any kind → the columns of its readings.

    Of a program that lists none and does not see bearings alone, those that are called as landmarks' are.
    """
    if not isinstance(program, PlanarVehicle) or (program.sees_bearings and not program.sensors):
        return {}
    if not program.sensors:
        seen = program.landmark_columns
        return {kind: seen[kind] for kind in seen if not kinds or kind in kinds}
    columns = program.sensor_columns
    of_kinds = [one.name for one in program.sensor_parts if not kinds or one.kind in kinds]
    return {name: columns[name] for name in of_kinds if name in columns}


def lists_sensors(program: Program) -> bool:
    """Whether a program lists sensors that it carries."""
    return isinstance(program, PlanarVehicle) and bool(program.sensors) and bool(program.sensor_columns)


def among(columns: tuple[int, ...], like: Tensor) -> Tensor:
    """One in some columns and zero in the others, `(K,)`; ones where none is named."""
    every = range(like.shape[-1])
    return torch.tensor([float(index in (columns or every)) for index in every]).to(like)


def beside(values: Tensor, columns: tuple[int, ...], count: int) -> Tensor:
    """Values `(..., k)` of neighbouring columns among `count`, `(..., count)`, zero in the others."""
    left = [values.new_zeros(*values.shape[:-1], n) for n in (columns[0], count - columns[-1] - 1)]
    return torch.cat([left[0], values, left[1]], -1)


def each_sensor(*kinds: str) -> Callable[[Program, Trajectories | None], Choices]:
    """Every sensor of some kinds, at its name; one choice for all readings of a program that lists no sensors."""

    def choices(program: Program, data: Trajectories | None) -> Choices:
        return [{"columns": columns, **at} for at, columns in _named(sensors_of(program, *kinds))] or [{}]

    return choices


def _named(sensors: Mapping[str, tuple[int, ...]]) -> Iterator[tuple[dict[str, str], tuple[int, ...]]]:
    """Sensors' columns, and where an effect is at: the sensor's name, unless there is one only."""
    for name, columns in sensors.items():
        yield ({"at": name} if len(sensors) > 1 else {}), columns


BEARINGS: Need = (
    lambda program: program.sees_bearings or sensors_of(program, "bearing"),
    "it acts on bearings to landmarks, and the model measures something else",
)
ALONE_OR_LISTED: Need = (
    lambda program: program.sees_bearings or lists_sensors(program),
    "beside other readings of a model's own it is sensor_bias",
)
LANDMARKS: Need = (
    lambda program: program.sees_bearings or sensors_of(program, *SEES_LANDMARKS),
    "it acts on bearings or distances to landmarks, and the model measures something else",
)
TWO_LANDMARKS: Need = (lambda program: len(program.landmarks) != 1, "there is one landmark: its bias is that of all")
OTHER_SENSORS: Need = (
    lambda program: not (isinstance(program, PlanarVehicle) and program.sees_bearings),
    "of bearings to landmarks it is bearing_bias or landmark_bias",
)
ONE_UNIT: Need = (
    lambda program: lists_sensors(program) or sensors_of(program) or len(set(program.measurement_units)) == 1,
    "the measurements have different units",
)
WITH_SCALE: Need = (
    lambda program: not lists_sensors(program) or sensors_of(program, *SCALED),
    "of positions and headings no size is measured",
)
LISTED: Need = (lists_sensors, "the model lists no `sensors`")
POSE: Need = (
    lambda program: _each_in_pose(program, None),
    "what its sensors read a moment ago does not follow from the state",
)
ANTENNA: Need = (
    lambda program: _antennas(program, None),
    "no position is measured by a listed sensor (`sensors`) whose offset is not learned",
)
MOUNT: Need = (
    lambda program: _mounted(program, None),
    "no velocity or acceleration is measured by a listed sensor (`sensors`) whose angle is not learned",
)
RATES: Need = (
    lambda program: program.derivatives,
    "no state component is known to be the velocity of another (`motion`)",
)


def _that_learn_no(setting: str, program: Program, *kinds: str) -> Choices:
    """Every listed sensor of some kinds but those of which the program learns a setting."""
    parts = program.sensor_parts if lists_sensors(program) else ()
    learned = {one.name for one in parts if isinstance(getattr(one, setting, None), str)}
    found = {name: at for name, at in sensors_of(program, *kinds).items() if parts and name not in learned}
    return [{"columns": columns, **at} for at, columns in _named(found)]


def _antennas(program: Program, data: Trajectories | None) -> Choices:
    return _that_learn_no("offset", program, "position")


def _mounted(program: Program, data: Trajectories | None) -> Choices:
    return _that_learn_no("angle", program, *MOUNTED)


def _each_in_pose(program: Program, data: Trajectories | None) -> Choices:
    """Every listed sensor of some kinds, those in one housing together."""
    columns = program.sensor_columns if lists_sensors(program) else {}
    every = [one for one in program.sensors if one.kind in OF_POSE] if columns else []
    found = {one.name: [columns.get(part.name, ()) for part in one.parts] for one in every}
    return [{"columns": sum(at, ()), "sensor": name, "at": name} for name, at in found.items() if all(at)]


def _one_by_one(program: Program, columns: Iterable[int]) -> Choices:
    return [{"component": index, "at": program.measurement_names[index]} for index in columns]


def _each_bearing(program: Program, data: Trajectories | None) -> Choices:
    bearings = [index for columns in sensors_of(program, "bearing").values() for index in columns]
    return _one_by_one(program, bearings or range(len(program.measurements)))


def _each_other(program: Program, data: Trajectories | None) -> Choices:
    """Each reading, of listed sensors not the bearings', and all distances of a sensor together."""
    listed = sensors_of(program, "bearing") if lists_sensors(program) else {}
    bearings = {index for columns in listed.values() for index in columns}
    alone = _one_by_one(program, (index for index in range(len(program.measurements)) if index not in bearings))
    ranges = [(name, columns) for name, columns in sensors_of(program, "range").items() if len(columns) > 1]
    return [*alone, *({"component": columns[0], "columns": columns, "at": name} for name, columns in ranges)]


SENSORS: list[Effect] = []
_on_readings = partial(declare, SENSORS, "measured")
Columns = tuple[int, ...]  # of readings; all where none is named


@_on_readings("rad", typical=0.035, limit=0.5, choices=each_sensor("bearing"), lacks=needs(PLANAR, BEARINGS))
def bearing_bias(self: Program, state: Tensor, measured: Tensor, c: Tensor, columns: Columns = ()) -> Tensor:
    r"""y → y + c, every bearing

    equation: y \to y + c
    feels: the sensor is screwed on askew
    occurs: a camera or an antenna that is turned on its mount, a compass with a wrong declination
    """
    return measured + (c * among(columns, measured) if columns else c)


@_on_readings(
    "rad", typical=0.06, limit=0.5, choices=_each_bearing, lacks=needs(PLANAR, TWO_LANDMARKS, BEARINGS, ALONE_OR_LISTED)
)
def landmark_bias(self: Program, state: Tensor, measured: Tensor, c: Tensor, component: Any) -> Tensor:
    r"""y_i → y_i + c, one landmark

    equation: y_i \to y_i + c
    feels: one landmark is not where the map has it
    occurs: a landmark that was surveyed badly or moved, one receiver of an array that is off
    """
    return measured + c * among((component,), measured)


@_on_readings("of the measurement", typical=0.05, limit=1.0, choices=_each_other, lacks=needs(OTHER_SENSORS))
def sensor_bias(
    self: Program, state: Tensor, measured: Tensor, c: Tensor, component: Any, columns: Columns = ()
) -> Tensor:
    r"""y_i → y_i + c, one measurement, or all distances

    equation: y_i \to y_i + c
    feels: reads too much (or too little) by the same amount
    occurs: amplifiers and strain gauges after a change of temperature, a zero that was never set
    """
    return measured + c * among(columns or (component,), measured)


@_on_readings("1", typical=0.03, limit=0.3, choices=each_sensor(*SCALED), lacks=needs(ONE_UNIT, WITH_SCALE))
def sensor_scale(self: Program, state: Tensor, measured: Tensor, c: Tensor, columns: Columns = ()) -> Tensor:
    r"""y → (1 + c) y

    equation: y \to (1 + c)\,y
    feels: reads a few per cent too much, at any size
    occurs: a lens with a wrong focal length, a range finder with a wrong speed of sound
    """
    return measured * (1 + (c * among(columns, measured) if columns else c))


@_on_readings(
    "m",
    typical=(0.3, 0.1),
    limit=5.0,
    components=("ahead", "left"),
    choices=_antennas,
    lacks=needs(ANTENNA),
)
def antenna_offset(self: Program, state: Tensor, measured: Tensor, c: Tensor, columns: Columns) -> Tensor:
    r"""y → y + R(θ) c, one position

    equation: y \to y + R(\theta)\,c
    feels: the measured point swings around the vehicle in turns
    occurs: a GPS antenna on the bow or the roof, a marker that is not above the axle
    """
    moved = torch.stack(turned(state[..., 2], *c.unbind(-1)), -1)
    return measured + beside(moved, columns, measured.shape[-1])


@_on_readings("rad", typical=0.1, limit=0.8, choices=_mounted, lacks=needs(MOUNT))
def mounting_angle(self: Program, state: Tensor, measured: Tensor, c: Tensor, columns: Columns) -> Tensor:
    r"""y → R(-c) y, one velocity or acceleration

    equation: y \to R(-c)\,y
    feels: reads a sideways movement when it goes straight on
    occurs: a Doppler log, a camera or an IMU that is turned on its mount
    """
    own = measured[..., list(columns)]
    return measured + beside(torch.stack(turned(-c, *own.unbind(-1)), -1) - own, columns, measured.shape[-1])


@_on_readings("s", typical=0.1, limit=1.0, choices=_each_in_pose, lacks=needs(LISTED, POSE))
def sensor_delay(self: Program, state: Tensor, measured: Tensor, c: Tensor, columns: Columns, sensor: str) -> Tensor:
    r"""y(t) → y(t - c), one sensor

    equation: y(t) \to y(t - c)
    feels: one sensor shows where it was a moment ago
    occurs: images that are processed before they are stamped, receivers that filter, messages that wait
    """
    (late,) = (one for one in self.sensors if one.name == sensor)
    before = self.earlier(state, c)
    measured = measured + beside(late.reading(self, before) - late.reading(self, state), columns, measured.shape[-1])
    for other in effects_of(type(self), "measured"):
        if other.effect.name != "sensor_delay" and set(other.options.get("columns", ())) & set(columns):
            there, here = (other(self, at, measured, c=coefficient(self, other)) for at in (before, state))
            measured = measured + (there - here)
    return measured


@declare(SENSORS, "viewpoint", "s", typical=0.12, limit=1.0, lacks=needs(RATES))
def clock_offset(self: Program, state: Tensor, c: Tensor) -> Tensor:
    r"""y(t) → y(t - c), of what depends on the pose

    equation: y(t) \to y(t - c)
    feels: measurements show where it was a moment ago; below zero, commands are logged later than they act
    occurs: cameras with a long exposure, sensors that are stamped when their message arrives, computers without a
        common clock
    """
    return self.earlier(state, c)
