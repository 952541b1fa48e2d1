"""Vehicles on wheels that move in continuous time and are commanded otherwise than by a turn rate: a car, a robot.

They are `continuous_worlds.Unicycle` with other commands; the car's sensors are those of `models/car.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from continuous_effects import Array
from continuous_worlds import Unicycle


@dataclass(frozen=True)
class ToldOtherwise(Unicycle):
    """A unicycle whose drives begin at the speed and the turn rate that its first commands mean."""

    def start(self, random: np.random.Generator, commands: Array) -> Array:
        first = commands[0].T
        speed, turn = replace(self, effects=()).told(first, first[0])
        return super().start(random, np.stack([speed, turn], -1)[None])


@dataclass(frozen=True)
class Car(ToldOtherwise):
    """A kinematic bicycle commanded by a speed and a steering angle: ω → v tan(steering) / wheelbase.

    The rear axle does not slip; an antenna ahead of it measures where it is.

    Attributes:
        wheelbase, antenna: m.
        gps_sd, gyro_sd: m and rad/s.
    """

    controls: ClassVar = ("speed", "steering")
    measurements: ClassVar = ("gps_x", "gps_y", "gyro")
    plantable: ClassVar = (*Unicycle.plantable, "slope", "steering_asymmetry", "backlash")

    noise: tuple[float, ...] = (0.5, 0.2)
    speed_time: float = 0.1
    turn_time: float = 0.1
    wheelbase: float = 2.8
    antenna: float = 1.0
    gps_sd: float = 0.3
    gyro_sd: float = 0.02

    def commands(self, random: np.random.Generator, time: Array, drives: int) -> Array:
        held = (time / 2 + 1e-9).astype(int)
        speed, steering = (random.uniform(*within, (held[-1] + 1, drives)) for within in ((1.0, 5.0), (-0.4, 0.4)))
        return np.stack([speed[held], steering[held]], -1)

    def told(self, control: Array, forward: Array) -> tuple[Array, Array]:
        speed, steering = control
        steering = steering * (1 - self.size("understeer") * forward**2) + self.size("steering_offset")
        return speed, forward * np.tan(steering) / self.wheelbase

    def measured(self, states: Array, random: np.random.Generator) -> Array:
        x, y, heading, *_, yaw_rate = np.moveaxis(states, -1, 0)
        seen = np.stack([x + self.antenna * np.cos(heading), y + self.antenna * np.sin(heading), yaw_rate], -1)
        return seen + np.array([self.gps_sd, self.gps_sd, self.gyro_sd]) * random.standard_normal(seen.shape)


@dataclass(frozen=True)
class TwoWheels(ToldOtherwise):
    """A robot on two driven wheels: v → (left + right) / 2, ω → (right − left) / track.

    Attributes:
        track: m.
    """

    controls: ClassVar = ("port", "starboard")
    plantable: ClassVar = (*Unicycle.plantable, "wheel_radius_difference", "track_width", "gain_error:wheels")

    track: float = 0.5

    def commands(self, random: np.random.Generator, time: Array, drives: int) -> Array:
        speed, turn = np.moveaxis(super().commands(random, time, drives), -1, 0)
        return np.stack([speed - 0.5 * self.track * turn, speed + 0.5 * self.track * turn], -1)

    def told(self, control: Array, forward: Array) -> tuple[Array, Array]:
        left, right = control
        return 0.5 * (left + right), (right - left) / self.track
