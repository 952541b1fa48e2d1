"""What lies between the vehicle and its measurements."""

from functools import partial
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.catalogue.forces import PLANAR
from steady_ppl.effects.declaration import Choices, Effect, Need, declare, needs
from steady_ppl.model.planar_vehicle import PlanarVehicle
from steady_ppl.model.program import Program

BEARINGS: Need = (
    lambda program: program.sees_bearings,
    "it acts on bearings to landmarks, and the program measures something else",
)
TWO_LANDMARKS: Need = (lambda program: len(program.measurements) != 1, "there is one landmark: its bias is that of all")
OTHER_SENSORS: Need = (
    lambda program: not (isinstance(program, PlanarVehicle) and program.sees_bearings),
    "of bearings to landmarks it is bearing_bias or landmark_bias",
)
ONE_UNIT: Need = (lambda program: len(set(program.measurement_units)) == 1, "the measurements have different units")
RATES: Need = (
    lambda program: program.derivatives,
    "no state component is known to be the velocity of another (`motion`)",
)


def _each(program: Program, data: Trajectories | None) -> Choices:
    return [{"component": index, "at": name} for index, name in enumerate(program.measurement_names)]


SENSORS: list[Effect] = []
_on_readings = partial(declare, SENSORS, "measured")


@_on_readings("rad", typical=0.035, limit=0.5, lacks=needs(PLANAR, BEARINGS))
def bearing_bias(self: Program, state: Tensor, measured: Tensor, c: Tensor) -> Tensor:
    r"""y → y + c, every bearing

    equation: y \to y + c
    feels: the sensor is screwed on askew
    occurs: a camera or an antenna that is turned on its mount, a compass with a wrong declination
    """
    return measured + c


@_on_readings("rad", typical=0.06, limit=0.5, choices=_each, lacks=needs(PLANAR, TWO_LANDMARKS, BEARINGS))
def landmark_bias(self: Program, state: Tensor, measured: Tensor, c: Tensor, component: Any) -> Tensor:
    r"""y_i → y_i + c, one landmark

    equation: y_i \to y_i + c
    feels: one landmark is not where the map has it
    occurs: a landmark that was surveyed badly or moved, one receiver of an array that is off
    """
    return measured + c * torch.tensor([float(index == component) for index in range(measured.shape[-1])]).to(measured)


@_on_readings("of the measurement", typical=0.05, limit=1.0, choices=_each, lacks=needs(OTHER_SENSORS))
def sensor_bias(self: Program, state: Tensor, measured: Tensor, c: Tensor, component: Any) -> Tensor:
    r"""y_i → y_i + c, one measurement

    equation: y_i \to y_i + c
    feels: reads too much (or too little) by the same amount
    occurs: amplifiers and strain gauges after a change of temperature, a zero that was never set
    """
    return landmark_bias(self, state, measured, c, component)


@_on_readings("1", typical=0.03, limit=0.3, lacks=needs(ONE_UNIT))
def sensor_scale(self: Program, state: Tensor, measured: Tensor, c: Tensor) -> Tensor:
    r"""y → (1 + c) y

    equation: y \to (1 + c)\,y
    feels: reads a few per cent too much, at any size
    occurs: a lens with a wrong focal length, a range finder with a wrong speed of sound
    """
    return measured * (1 + c)


@declare(SENSORS, "viewpoint", "s", typical=0.12, limit=1.0, lacks=needs(RATES))
def clock_offset(self: Program, state: Tensor, c: Tensor) -> Tensor:
    r"""y(t) → y(t - c)

    equation: y(t) \to y(t - c)
    feels: measurements show where it was a moment ago; below zero, commands are logged later than they act
    occurs: cameras with a long exposure, sensors that are stamped when their message arrives, computers without a
        common clock
    """
    return self.earlier(state, c)
