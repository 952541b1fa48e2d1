"""What lies between the vehicle and its measurements, and what noise can be besides normal, constant and white."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.catalogue.forces import PLANAR
from steady_ppl.effects.catalogue.wheels import COMMANDED
from steady_ppl.effects.declaration import Choices, Effect, Names, Need, Pushes, declare, needs, power_of_two_below
from steady_ppl.model.planar_vehicle import PlanarVehicle
from steady_ppl.model.program import Program

BEARINGS: Need = (
    lambda program: program.sees_bearings,
    "it acts on bearings to landmarks, and the program measures something else",
)
LANDMARKS: Need = (lambda program: len(program.measurements) != 1, "there is one landmark: its bias is that of all")
OTHER_SENSORS: Need = (
    lambda program: not (isinstance(program, PlanarVehicle) and program.sees_bearings),
    "of bearings to landmarks it is bearing_bias or landmark_bias",
)
ONE_UNIT: Need = (lambda program: len(set(program.measurement_units)) == 1, "the measurements have different units")
RATES: Need = (
    lambda program: program.derivatives,
    "no state component is known to be the velocity of another (`motion`)",
)
CHANNELS: Need = (lambda program: program.channels, "the program has no noise channels")
MOTION: Need = (
    lambda program: isinstance(program, PlanarVehicle) or program.motion,
    "the program does not say which channels move what (`motion`)",
)
MEASURED: Need = (lambda program: program.measurements, "the program measures nothing")


def _each(program: Program, data: Trajectories | None) -> Choices:
    return [{"component": index, "at": name} for index, name in enumerate(program.measurement_names)]


def _each_of_its_size(program: Program, data: Trajectories | None) -> Choices:
    choices = []
    for index, choice in enumerate(_each(program, data)):
        seen = torch.empty(0) if data is None else data.measurements[..., index][data.observed[..., index]].double()
        choices.append({**choice, "scale": power_of_two_below(float(seen.std()) if len(seen) > 1 else 0.0)})
    return choices


def _groups(program: Program, data: Trajectories | None) -> Choices:
    if len(program.axes) <= 1:
        return [{"channels": program.channel_names}]
    return [{"channels": channels, "at": name} for name, channels in program.axes.items()]


SENSORS_AND_NOISE: list[Effect] = []
_noise = partial(declare, SENSORS_AND_NOISE)
_on_readings = partial(declare, SENSORS_AND_NOISE, "measured")


@_on_readings("rad", typical=0.035, limit=0.5, lacks=needs(PLANAR, BEARINGS))
def bearing_bias(self: Any, state: Tensor, measured: Tensor, c: Tensor) -> Tensor:
    r"""y → y + c, every bearing

    equation: y \to y + c
    feels: the sensor is screwed on askew
    occurs: a camera or an antenna that is turned on its mount, a compass with a wrong declination
    """
    return measured + c


@_on_readings("rad", typical=0.06, limit=0.5, choices=_each, lacks=needs(PLANAR, LANDMARKS, BEARINGS))
def landmark_bias(self: Any, state: Tensor, measured: Tensor, c: Tensor, component: Any) -> Tensor:
    r"""y_i → y_i + c, one landmark

    equation: y_i \to y_i + c
    feels: one landmark is not where the map has it
    occurs: a landmark that was surveyed badly or moved, one receiver of an array that is off
    """
    bias = measured.new_zeros(measured.shape[-1])
    bias[component] = 1.0
    return measured + c * bias


@_on_readings("of the measurement", typical=0.05, limit=1.0, choices=_each_of_its_size, lacks=needs(OTHER_SENSORS))
def sensor_bias(self: Any, state: Tensor, measured: Tensor, c: Tensor, component: Any) -> Tensor:
    r"""y_i → y_i + c, one measurement

    equation: y_i \to y_i + c
    feels: reads too much (or too little) by the same amount
    occurs: amplifiers and strain gauges after a change of temperature, a zero that was never set
    """
    return landmark_bias(self, state, measured, c, component)


@_on_readings("1", typical=0.03, limit=0.3, lacks=needs(ONE_UNIT))
def sensor_scale(self: Any, state: Tensor, measured: Tensor, c: Tensor) -> Tensor:
    r"""y → (1 + c) y

    equation: y \to (1 + c)\,y
    feels: reads a few per cent too much, at any size
    occurs: a lens with a wrong focal length, a range finder with a wrong speed of sound
    """
    return measured * (1 + c)


@declare(SENSORS_AND_NOISE, "viewpoint", "s", typical=0.12, limit=1.0, lacks=needs(RATES))
def clock_offset(self: Any, state: Tensor, c: Tensor) -> Tensor:
    r"""y(t) → y(t - c)

    equation: y(t) \to y(t - c)
    feels: measurements show where it was a moment ago; below zero, commands are logged later than they act
    occurs: cameras with a long exposure, sensors that are stamped when their message arrives, computers without a
        common clock
    """
    return self.earlier(state, c)


@_noise("tails", "1", typical=1 / 3, limit=0.5, sign=1, between=(0.0, 0.49))
def heavy_tails(self: Any, c: Tensor) -> Tensor:
    r"""Student t measurement noise with ν = 1/c degrees of freedom

    equation: y \sim t_\nu,\quad c = 1/\nu
    feels: now and then a measurement is far off
    occurs: reflections (multipath), wrong associations of detections, a loose contact
    """
    return c.clamp(0.005, 0.49)


@_noise("blur", "1", typical=1.5, limit=2.0, sign=1, null=1.0, lacks=needs(MEASURED))
def measurement_noise(self: Any, state: Tensor, c: Tensor) -> Tensor:
    r"""σ → c σ of every measurement

    equation: \sigma \to c\,\sigma
    feels: sees worse (or better) than its data sheet says
    occurs: a data sheet for other light, distance or temperature than the sensor has
    """
    return c.expand(*state.shape[:-1], len(self.measurements))


@_noise("blur", "1/m", typical=0.1, limit=1.0, sign=1, lacks=needs(PLANAR, BEARINGS))
def range_dependent_noise(self: Any, state: Tensor, c: Tensor) -> Tensor:
    r"""σ → σ (1 + c r), r the distance

    equation: \sigma \to \sigma\,(1 + c\,r)
    feels: far landmarks are seen worse
    occurs: cameras (a pixel covers more), radios (less signal), stereo depth
    """
    return (1 + c * self.ranges(state)).clamp(min=0.05)


@_noise("spread", "1", typical=2.0, limit=2.0, sign=1, null=1.0, choices=_groups, lacks=needs(CHANNELS))
def process_noise(self: Any, *_: Tensor, c: Tensor, channels: Names) -> Pushes:
    r"""σ → c σ of a channel

    equation: \sigma \to c\,\sigma
    feels: rougher (or smoother) than the program says
    occurs: a floor, a sea or a wind that is rougher than was thought; whatever else a program leaves out
    """
    return dict.fromkeys(channels, c)


@_noise("spread", "s/m", typical=1.0, limit=5.0, sign=1, lacks=needs(COMMANDED, PLANAR))
def command_noise(self: Any, state: Tensor, control: Tensor, *_: Tensor, c: Tensor) -> Pushes:
    r"""σ → σ (1 + c |command - state|)

    equation: \sigma \to \sigma\,(1 + c\,|u - v|)
    feels: erratic while it catches up with its command
    occurs: speed controllers that slip and jerk while they accelerate
    """
    forward, _, yaw_rate = self.body_velocity(state)
    speed, turn = control[..., self.control_index("speed")], control[..., self.control_index("turn")]
    slow, askew = (speed - forward).abs(), (turn - yaw_rate).abs()
    return {"forward": (1 + c * slow).clamp(min=0.05), "yaw": (1 + c * askew).clamp(min=0.05)}


@_noise("colour", "1", typical=0.6, limit=0.9, between=(-0.99, 0.99), choices=_groups, lacks=needs(MOTION))
def coloured_noise(self: Any, c: Tensor, channels: Names) -> Pushes:
    r"""noise(t+1) = c noise(t) + sqrt(1 - c²) σ ε

    equation: n_{t+1} = c\,n_t + \sqrt{1 - c^2}\,\sigma\,\varepsilon
    feels: is pushed for seconds, not shaken
    occurs: gusts, waves and turbulence, whose pushes last; ground that undulates
    """
    return {channel: c.clamp(-0.99, 0.99) for channel in channels}
