"""Vehicles that move in continuous time: hovercraft, GPS boat, unicycle, pendulum and cart.

The worlds share no code with the engine's dynamics. `continuous_drives.simulate` makes drives of them, in which
effects of `continuous_effects.py` are planted.

    drives = simulate(Hovercraft(effects=(Planted("quadratic_drag", (0.02,)),)), 16, seed=1)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from continuous_drives import World
from continuous_effects import ACTUATORS, LINE, PLANAR, SENSORS, Array, Body


def smooth_commands(random: np.random.Generator, time: Array, shape: tuple[int, int], size: float) -> Array:
    """Return sums of three sinusoids, `(rows, drives, U)`: amplitudes up to `size`, .05 to .4 Hz, random phases."""
    amplitude = random.uniform(0.4, 1.0, (3, *shape)) * size
    rate = 2 * math.pi * random.uniform(0.05, 0.4, (3, *shape))
    phase = random.uniform(0, 2 * math.pi, (3, *shape))
    return (amplitude * np.sin(rate * time[:, None, None, None] + phase)).sum(1)


def paper_commands(random: np.random.Generator, time: Array, drives: int) -> Array:
    """Return the paper's thrusts through random way-points, `(rows, drives, 2)` N; sides swap in 3 drives of 5."""
    at = np.array([0.0, 0.5, 2.0, 3.0, 5.0, 6.0, 9.0, 10.0, 12.0, 15.0])
    left = np.array([0.0, 1.0, 0.0, 0.7, 1.1, 0.0, 0.4, 0.0, 0.0, 0.0])
    right = np.array([0.0, 0.4, 0.0, 0.5, 0.5, 0.0, 1.0, 0.5, 0.0, 0.0])
    left_sd = 0.5 * np.array([0.0, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.0])
    right_sd = 0.5 * np.array([0.0, 0.1, 0.1, 0.1, 0.1, 0.1, 0.2, 0.2, 0.1, 0.0])
    points = np.stack(
        [
            left + left_sd * random.standard_normal((drives, len(at))),
            right + right_sd * random.standard_normal((drives, len(at))),
        ],
        -1,
    )
    swap = random.uniform(size=drives) < 0.6
    points[swap] = points[swap][..., ::-1]
    return np.stack([[np.interp(time, at, one[:, side]) for side in (0, 1)] for one in points]).transpose(2, 0, 1)


@dataclass(frozen=True)
class TwinThruster(World):
    """Two thrusters in the plane: pose and velocity in the world frame.

    Attributes:
        mass: kg.
        turning: yaw acceleration of a newton, rad/s².
    """

    states: ClassVar = ("x", "y", "heading", "vx", "vy", "yaw_rate")
    controls: ClassVar = ("left", "right")

    mass: float = 1.0
    turning: float = 1.0

    def derivative(self, state: Array, control: Array, noise: Array) -> Array:
        _, _, heading, vx, vy, yaw_rate = state
        left, right = control
        cos, sin = np.cos(heading), np.sin(heading)
        body = Body(cos * vx + sin * vy, cos * vy - sin * vx, yaw_rate, cos, sin, left, right)
        forward = (left + right) / self.mass + noise[0]
        lateral = noise[1]
        yaw = self.turning * (right - left) + noise[2]
        for one in self.effects:
            if one.name in PLANAR:
                more = PLANAR[one.name](body, one.size, one.options)
                forward, lateral, yaw = forward + more[0], lateral + more[1], yaw + more[2]
        return np.stack([vx, vy, yaw_rate, cos * forward - sin * lateral, sin * forward + cos * lateral, yaw])


@dataclass(frozen=True)
class Hovercraft(TwinThruster):
    """The hovercraft of `models/hovercraft.py` without drag, seen by bearings to four landmarks.

    Attributes:
        driven: "paper" for the paper's way-points, "smooth" for sinusoids.
        thrust: factor on the commands.
        bearing_sd: rad.
    """

    measurements: ClassVar = ("bearing_0", "bearing_1", "bearing_2", "bearing_3")
    plantable: ClassVar = (*PLANAR, *ACTUATORS, *SENSORS)
    landmarks: ClassVar = np.array([[12.0, -8.0], [-6.0, -4.0], [-4.0, 10.0], [6.0, 7.0]])

    noise: tuple[float, ...] = (0.08, 0.08, 0.05)
    mass: float = 1.5
    turning: float = 1 / 1.5
    driven: str = "paper"
    thrust: float = 1.0
    bearing_sd: float = math.radians(5)

    def commands(self, random: np.random.Generator, time: Array, drives: int) -> Array:
        if self.driven == "paper":
            return self.thrust * paper_commands(random, time, drives)
        return self.thrust * (0.3 + smooth_commands(random, time, (drives, 2), 0.35))

    def start(self, random: np.random.Generator, commands: Array) -> Array:
        mean = np.array([0.5, 1.0, math.pi / 5, 0.25, 0.1, math.pi / 50])
        sd = np.array([2.0, 2.0, math.pi, 0.3, 0.2, 0.1 * math.pi])
        return mean[:, None] + sd[:, None] * random.standard_normal((6, commands.shape[1]))

    def measured(self, states: Array, random: np.random.Generator) -> Array:
        to_x, to_y = (self.landmarks[:, axis] - states[..., axis : axis + 1] for axis in (0, 1))
        near = np.clip(np.hypot(to_x, to_y) / 0.1, 0.1, 1.0)  # nearer than .1 m the noise grows
        noise = self.bearing_sd / near * random.standard_normal(to_x.shape)
        return wrapped(np.arctan2(to_y, to_x) - states[..., 2:3] + noise + self.size("bearing_bias"))


@dataclass(frozen=True)
class Boat(TwinThruster):
    """The boat of `models/gps_boat.py`, which nothing brakes.

    Attributes:
        gps_sd, compass_sd: m and rad.
    """

    measurements: ClassVar = ("gps_x", "gps_y", "compass")
    plantable: ClassVar = (*PLANAR, *ACTUATORS, "clock_offset")

    noise: tuple[float, ...] = (0.1, 0.1, 0.05)
    duration: float = 20.0
    mass: float = 20.0
    turning: float = 0.05
    gps_sd: float = 0.5
    compass_sd: float = 0.05

    def commands(self, random: np.random.Generator, time: Array, drives: int) -> Array:
        chosen = 10 * random.uniform(size=(int(self.duration / 3) + 1, drives, 2))
        return chosen[np.clip((time / 3 + 1e-9).astype(int), 0, len(chosen) - 1)]

    def start(self, random: np.random.Generator, commands: Array) -> Array:
        sd = np.array([10.0, 10.0, 3.0, 1.0, 1.0, 0.3])
        return sd[:, None] * random.standard_normal((6, commands.shape[1]))

    def measured(self, states: Array, random: np.random.Generator) -> Array:
        return _pose(states, random, self.gps_sd, self.compass_sd)


@dataclass(frozen=True)
class Unicycle(World):
    """A vehicle on wheels without slip: dv/dt = (speed − v) / .3 s, dω/dt = (turn − ω) / .2 s.

    Its states are x, y, heading, v and ω; the lateral velocity is that of the planted constraint, else zero.

    Attributes:
        speed_time, turn_time: s.
        position_sd, heading_sd: m and rad.
    """

    states: ClassVar = ("x", "y", "heading", "vx", "vy", "yaw_rate")
    controls: ClassVar = ("speed", "turn")
    measurements: ClassVar = ("x", "y", "heading")
    wheels: ClassVar = ("lever_arm", "crab_angle", "slip_angle", "steering_offset", "understeer", "caster")
    plantable: ClassVar = (*wheels, "yaw_bias", "clock_offset")

    noise: tuple[float, ...] = (0.1, 0.1)
    speed_time: float = 0.3
    turn_time: float = 0.2
    position_sd: float = 0.02
    heading_sd: float = 0.01

    def commands(self, random: np.random.Generator, time: Array, drives: int) -> Array:
        held = (time / 2 + 1e-9).astype(int)
        speed = random.uniform(0.5, 2.0, (held[-1] + 1, drives))
        turn = speed * random.uniform(-0.6, 0.6, speed.shape)
        return np.stack([speed[held], turn[held]], -1)

    def start(self, random: np.random.Generator, commands: Array) -> Array:
        drives = commands.shape[1]
        still = np.zeros(drives)
        return np.stack([still, still, random.uniform(-3, 3, drives), commands[0, :, 0], commands[0, :, 1]])

    def derivative(self, state: Array, control: Array, noise: Array) -> Array:
        _, _, heading, forward, yaw_rate = state
        speed, turn = self.told(control, forward)
        yaw = (turn - yaw_rate) / self.turn_time + noise[1]
        yaw = yaw + self.size("yaw_bias") - self.size("caster") * forward * yaw_rate
        lateral, cos, sin = self._lateral(forward, yaw_rate), np.cos(heading), np.sin(heading)
        faster = (speed - forward) / self.speed_time + noise[0] + self._downhill(cos, sin)
        return np.stack([cos * forward - sin * lateral, sin * forward + cos * lateral, yaw_rate, faster, yaw])

    def told(self, control: Array, forward: Array) -> tuple[Array, Array]:
        """Return the speed and the turn rate that its commands mean, m/s and rad/s, each `(drives,)`."""
        speed, turn = control
        return speed, turn * (1 - self.size("understeer") * forward**2) + self.size("steering_offset") * forward

    def _downhill(self, cos: Array, sin: Array) -> Array:
        """Return what a planted slope adds ahead, m/s²."""
        x, y = next((one.value for one in self.effects if one.name == "slope"), (0.0, 0.0))
        return cos * x + sin * y

    def logged(self, states: Array) -> Array:
        x, y, heading, forward, yaw_rate = states.transpose(1, 0, 2)
        lateral, cos, sin = self._lateral(forward, yaw_rate), np.cos(heading), np.sin(heading)
        return np.stack(
            [x, y, heading, cos * forward - sin * lateral, sin * forward + cos * lateral, yaw_rate], axis=-1
        )

    def _lateral(self, forward: Array, yaw_rate: Array) -> Array:
        """Return the lateral velocity that the wheels hold, m/s."""
        lever, crab, slip = (self.size(name) for name in ("lever_arm", "crab_angle", "slip_angle"))
        return lever * yaw_rate + crab * forward - slip * forward * yaw_rate

    def measured(self, states: Array, random: np.random.Generator) -> Array:
        return _pose(states, random, self.position_sd, self.heading_sd)


@dataclass(frozen=True)
class OnLine(World):
    """One position and one velocity, which a force moves.

    Attributes:
        gain: acceleration of a unit of the command.
        damping: 1/s.
        sd: of the measured position.
    """

    plantable: ClassVar = (*LINE, "actuator_delay", "actuator_lag", "clock_offset")

    gain: float = 1.0
    damping: float = 0.3
    sd: float = 0.05
    push: float = 1.0  # size of the command's sinusoids
    spread: tuple[float, float] = (1.0, 1.0)  # of the start

    def commands(self, random: np.random.Generator, time: Array, drives: int) -> Array:
        return smooth_commands(random, time, (drives, 1), self.push)

    def start(self, random: np.random.Generator, commands: Array) -> Array:
        return np.array(self.spread)[:, None] * random.standard_normal((2, commands.shape[1]))

    def derivative(self, state: Array, control: Array, noise: Array) -> Array:
        position, velocity = state
        acceleration = self.gain * control[0] - self.damping * velocity + self.restored(position) + noise[0]
        for one in self.effects:
            if one.name in LINE:
                acceleration = acceleration + LINE[one.name](position, velocity, one.size)
        return np.stack([velocity, acceleration])

    def restored(self, position: Array) -> Array:
        """Return the acceleration that the position brings, `(drives,)`."""
        return np.zeros_like(position)

    def measured(self, states: Array, random: np.random.Generator) -> Array:
        return states[..., :1] + self.sd * random.standard_normal((*states.shape[:-1], 1))


@dataclass(frozen=True)
class Cart(OnLine):
    """A cart on a rail: a = force / (2 kg) − .3 v; its position is measured to 5 cm."""

    states: ClassVar = ("position", "velocity")
    controls: ClassVar = ("force",)
    measurements: ClassVar = ("position",)

    noise: tuple[float, ...] = (0.1,)
    gain: float = 0.5
    push: float = 2.0


@dataclass(frozen=True)
class Pendulum(OnLine):
    """A point mass on a rod: a = −9.81 sin(angle) − .2 rate + 5 torque; its angle is measured to 3°, at 20 Hz."""

    states: ClassVar = ("angle", "rate")
    controls: ClassVar = ("torque",)
    measurements: ClassVar = ("angle",)

    noise: tuple[float, ...] = (0.3,)
    step: float = 0.05
    gain: float = 5.0
    damping: float = 0.2
    sd: float = math.radians(3)
    push: float = 0.3
    spread: tuple[float, float] = (0.5, 0.5)

    def restored(self, position: Array) -> Array:
        return -9.81 * np.sin(position)

    def measured(self, states: Array, random: np.random.Generator) -> Array:
        return wrapped(super().measured(states, random))


def wrapped(angle: Array) -> Array:
    """Return the same angle in [−π, π]."""
    return np.angle(np.exp(1j * angle))


def _pose(states: Array, random: np.random.Generator, position_sd: float, heading_sd: float) -> Array:
    """Return x, y and heading with noise, `(rows, drives, 3)`."""
    noisy = states[..., :3] + np.array([position_sd] * 2 + [heading_sd]) * random.standard_normal(
        (*states.shape[:-1], 3)
    )
    return np.concatenate([noisy[..., :2], wrapped(noisy[..., 2:])], -1)
