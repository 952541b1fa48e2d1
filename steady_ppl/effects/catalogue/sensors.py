"""What lies between the vehicle and its measurements: offsets, scales, clocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.catalogue.planar_forces import no_bearings
from steady_ppl.effects.declaration import Effect, declare, power_of_two_below
from steady_ppl.model.planar_vehicle import PlanarVehicle
from steady_ppl.model.program import Program


def _each(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    return [{"component": index, "at": name} for index, name in enumerate(program.measurement_names)]


def _each_of_its_size(program: Program, data: Trajectories | None) -> Sequence[Mapping[str, Any]]:
    return [{**choice, "scale": _spread(data, choice["component"])} for choice in _each(program, data)]


def _spread(data: Trajectories | None, component: int) -> float:
    """Of a measurement, over all drives."""
    if data is None:
        return 1.0
    values = data.measurements[..., component][data.observed[..., component]].double()
    return power_of_two_below(float(values.std()) if len(values) > 1 else 0.0)


def _one_landmark(program: Program) -> str | None:
    if isinstance(program, PlanarVehicle) and len(program.measurements) == 1:
        return "there is one landmark: its bias is that of all"
    return no_bearings(program)


def _bearings(program: Program) -> str | None:
    seen = isinstance(program, PlanarVehicle) and program.sees_bearings
    return "of bearings to landmarks it is bearing_bias or landmark_bias" if seen else None


def _units_differ(program: Program) -> str | None:
    same = len(set(program.measurement_units)) == 1
    return None if same else "the measurements have different units"


def _no_motion(program: Program) -> str | None:
    return None if program.derivatives else "no state component is known to be the velocity of another (`motion`)"


SENSORS: list[Effect] = []
_on_readings = partial(declare, SENSORS, "measured")


@_on_readings("rad", typical=0.035, limit=0.5, lacks=no_bearings)
def bearing_bias(self: Any, state: Tensor, measured: Tensor, c: Tensor) -> Tensor:
    r"""y → y + c, every bearing

    equation: y \to y + c
    feels: the sensor is screwed on askew
    occurs: a camera or an antenna that is turned on its mount, a compass with a wrong declination
    """
    return measured + c


@_on_readings("rad", typical=0.06, limit=0.5, choices=_each, lacks=_one_landmark)
def landmark_bias(self: Any, state: Tensor, measured: Tensor, c: Tensor, component: Any) -> Tensor:
    r"""y_i → y_i + c, one landmark

    equation: y_i \to y_i + c
    feels: one landmark is not where the map has it
    occurs: a landmark that was surveyed badly or moved, one receiver of an array that is off
    """
    bias = measured.new_zeros(measured.shape[-1])
    bias[component] = 1.0
    return measured + c * bias


@_on_readings("of the measurement", typical=0.05, limit=1.0, choices=_each_of_its_size, lacks=_bearings)
def sensor_bias(self: Any, state: Tensor, measured: Tensor, c: Tensor, component: Any) -> Tensor:
    r"""y_i → y_i + c, one measurement

    equation: y_i \to y_i + c
    feels: reads too much (or too little) by the same amount
    occurs: amplifiers and strain gauges after a change of temperature, a zero that was never set
    """
    return landmark_bias(self, state, measured, c, component)


@_on_readings("1", typical=0.03, limit=0.3, lacks=_units_differ)
def sensor_scale(self: Any, state: Tensor, measured: Tensor, c: Tensor) -> Tensor:
    r"""y → (1 + c) y

    equation: y \to (1 + c)\,y
    feels: reads a few per cent too much, at any size
    occurs: a lens with a wrong focal length, a range finder with a wrong speed of sound
    """
    return measured * (1 + c)


@declare(SENSORS, "viewpoint", "s", typical=0.12, limit=1.0, lacks=_no_motion)
def clock_offset(self: Any, state: Tensor, c: Tensor) -> Tensor:
    r"""y(t) → y(t - c)

    equation: y(t) \to y(t - c)
    feels: measurements show where it was a moment ago; below zero, commands are logged later than they act
    occurs: cameras with a long exposure, sensors that are stamped when their message arrives, computers without a
        common clock
    """
    return self.earlier(state, c)
