"""Vehicles that move in continuous time: hovercraft, GPS boat, unicycle, pendulum and cart.

The worlds share no code with the engine's dynamics. Each is a differential equation in numpy, integrated by the
midpoint rule in steps of 1 ms for all drives at once. Commands and noise are held over a logged row; the noise is one
draw a row and channel. Effects are planted by their names in the catalogue, with their physics written out here.

    drives = simulate(Hovercraft(effects=(Planted("quadratic_drag", (0.02,)),)), 16, seed=1)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch

from steady_ppl import Trajectories

Array = np.ndarray
FINE, ROW = 0.001, 0.1  # s: the integration step, and the row for which noise is given
COMMANDS, START, NOISE, MEASURED = range(4)  # random streams, so that an effect does not change any draw


@dataclass(frozen=True)
class Planted:
    """An effect of the catalogue at a size.

    Attributes:
        name: in the catalogue, with its place after a colon where it has several.
        value: the coefficient, one number or two.
        options: knee, lead or drag.
    """

    name: str
    value: tuple[float, ...]
    options: Mapping[str, float] = field(default_factory=dict)

    @property
    def size(self) -> Any:
        """The coefficient as the equations take it: a float, or two."""
        return self.value[0] if len(self.value) == 1 else self.value


# --- commands ---------------------------------------------------------------------------------------------------------


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


# --- actuators --------------------------------------------------------------------------------------------------------


def acting(commands: Array, step: float, fine: float, effects: Sequence[Planted]) -> Array:
    """Return what acts of held commands: means over each fine step, `(rows · step / fine, drives, U)`.

    Args:
        commands: `(rows, drives, U)`, each held for `step`; the first was held for ever before.
        step, fine: s.
        effects: those on controls act, the others are left out; the second control is the one that steers, or the
            right one.
    """
    sizes = {one.name: one for one in effects}
    if "gain_error:wheels" in sizes:
        commands = commands * (1 + sizes["gain_error:wheels"].size)
    if "wheel_radius_difference" in sizes:
        commands = commands * (1 + 0.5 * sizes["wheel_radius_difference"].size * np.array([-1.0, 1.0]))
    if "track_width" in sizes:
        mean = commands.mean(-1, keepdims=True)
        commands = mean + (1 + sizes["track_width"].size) * (commands - mean)
    if "steering_asymmetry" in sizes:
        commands = commands + sizes["steering_asymmetry"].size * np.abs(commands) * np.array([0.0, 1.0])
    if "backlash" in sizes:
        commands = _loose(commands, sizes["backlash"].size * np.array([0.0, 1.0]))
    if "thrust_asymmetry" in sizes:
        commands = commands * (1 + sizes["thrust_asymmetry"].size * np.array([0.0, 1.0]))
    if "thrust_saturation" in sizes:
        chosen = sizes["thrust_saturation"]
        beyond = np.maximum(np.abs(commands) - chosen.options["knee"], 0)
        commands = commands - chosen.size * np.sign(commands) * beyond
    fine_commands = _delayed(commands, step, fine, sizes["actuator_delay"].size if "actuator_delay" in sizes else 0.0)
    return _lagged(fine_commands, fine, sizes["actuator_lag"].size) if "actuator_lag" in sizes else fine_commands


def _loose(commands: Array, gap: Array) -> Array:
    """Return where a pin is that commands `(rows, drives, U)` drag along through a gap `(U,)` on either side."""
    pin, found = commands[0], []
    for told in commands:
        pin = np.clip(pin, told - gap, told + gap)
        found.append(pin)
    return np.stack(found)


def _delayed(commands: Array, step: float, fine: float, delay: float) -> Array:
    """Return the means of u(t − delay) over each fine step, exact for held commands."""
    each = round(step / fine)
    if delay == 0:
        return np.repeat(commands, each, axis=0)
    integral = np.concatenate([np.zeros_like(commands[:1]), np.cumsum(step * commands, axis=0)])
    time = fine * np.arange(len(commands) * each + 1) - delay
    row = np.clip(np.floor(time / step).astype(int), 0, len(commands) - 1)
    total = integral[row] + (time - row * step)[:, None, None] * commands[row]
    return np.diff(total, axis=0) / fine


def _lagged(commands: Array, fine: float, constant: float) -> Array:
    """Return the means over each fine step of du_acting/dt = (u − u_acting) / constant, exact for held commands."""
    stays = math.exp(-fine / constant)
    share, state, means = constant / fine * (1 - stays), commands[0], np.empty_like(commands)
    for index, told in enumerate(commands):
        means[index] = told + (state - told) * share
        state = told + (state - told) * stays
    return means


# --- forces -----------------------------------------------------------------------------------------------------------


class Body(NamedTuple):
    """How a vehicle in the plane moves, each `(drives,)`: m/s and rad/s in the body frame, rad, N."""

    forward: Array
    lateral: Array
    yaw_rate: Array
    cos: Array
    sin: Array
    left: Array
    right: Array

    def seen(self, vector: tuple[float, float]) -> tuple[Array, Array]:
        """Return a vector of the world frame in the body frame."""
        x, y = vector
        return self.cos * x + self.sin * y, self.cos * y - self.sin * x


Force = Callable[[Body, Any, Mapping[str, float]], tuple[Any, Any, Any]]


def _friction(velocity: Array) -> Array:
    return velocity / np.sqrt(velocity**2 + 0.05**2)


def _slope(body: Body, c: Any, options: Mapping[str, float]) -> tuple[Any, Any, Any]:
    return (*body.seen(c), 0.0)


def _wind(body: Body, c: Any, options: Mapping[str, float]) -> tuple[Any, Any, Any]:
    """The wind's share of a quadratic drag, which the vehicle has besides."""
    along, across = body.seen(c)
    changes = []
    for velocity, air in ((body.forward, along), (body.lateral, across)):
        through = velocity - air
        changes.append(options["drag"] * (velocity * np.abs(velocity) - through * np.abs(through)))
    return changes[0], changes[1], 0.0


# forward and lateral m/s², yaw rad/s²
PLANAR: dict[str, Force] = {
    "linear_drag": lambda b, c, o: (-c * b.forward, -c * b.lateral, 0.0),
    "quadratic_drag": lambda b, c, o: (-c * b.forward * np.abs(b.forward), -c * b.lateral * np.abs(b.lateral), 0.0),
    "coulomb_friction": lambda b, c, o: (-c * _friction(b.forward), -c * _friction(b.lateral), 0.0),
    "yaw_linear_drag": lambda b, c, o: (0.0, 0.0, -c * b.yaw_rate),
    "yaw_quadratic_drag": lambda b, c, o: (0.0, 0.0, -c * b.yaw_rate * np.abs(b.yaw_rate)),
    "yaw_bias": lambda b, c, o: (0.0, 0.0, c),
    "side_slip": lambda b, c, o: (0.0, -c * (b.lateral - o.get("lead", 0.2) * b.yaw_rate), 0.0),
    "magnus": lambda b, c, o: (0.0, -c * b.forward * b.yaw_rate, 0.0),
    "added_mass": lambda b, c, o: (c * b.lateral * b.yaw_rate, 0.0, 0.0),
    "cross_flow": lambda b, c, o: (0.0, -c * b.lateral * np.abs(b.lateral), 0.0),
    "caster": lambda b, c, o: (0.0, 0.0, -c * b.forward * b.yaw_rate),
    "weathervane": lambda b, c, o: (0.0, 0.0, -c * b.forward * b.lateral),
    "lateral_coupling": lambda b, c, o: (0.0, c * (b.left - b.right), 0.0),
    "slope": _slope,
    "wind": _wind,
}
# acceleration along a line of (position, velocity, c)
LINE: dict[str, Callable[[Array, Array, Any], Any]] = {
    "quadratic_drag": lambda x, v, c: -c * v * np.abs(v),
    "coulomb_friction": lambda x, v, c: -c * _friction(v),
    "stiffness": lambda x, v, c: -c * x,
    "cubic_stiffness": lambda x, v, c: -c * x**3,
    "acceleration_bias": lambda x, v, c: c,
}
ACTUATORS = ("actuator_delay", "actuator_lag", "thrust_saturation", "thrust_asymmetry")
SENSORS = ("bearing_bias", "clock_offset")


# --- worlds -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class World:
    """A vehicle in continuous time.

    Attributes:
        effects: planted.
        noise: standard deviations of the channels' accelerations, for draws held over .1 s.
        duration, step: of a drive and of a logged row, s.
    """

    states: ClassVar[tuple[str, ...]]
    controls: ClassVar[tuple[str, ...]]
    measurements: ClassVar[tuple[str, ...]]
    plantable: ClassVar[tuple[str, ...]]

    effects: tuple[Planted, ...] = ()
    noise: tuple[float, ...] = ()
    duration: float = 10.0
    step: float = 0.1

    def __post_init__(self) -> None:
        unknown = [one.name for one in self.effects if one.name not in self.plantable]
        if unknown:
            raise ValueError(f"{type(self).__name__} has no {', '.join(unknown)}; it has {', '.join(self.plantable)}")

    def commands(self, random: np.random.Generator, time: Array, drives: int) -> Array:
        """Return the commands of each row, `(rows, drives, U)`."""
        raise NotImplementedError

    def start(self, random: np.random.Generator, commands: Array) -> Array:
        """Return the first states, `(D, drives)`, as `derivative` has them."""
        raise NotImplementedError

    def derivative(self, state: Array, control: Array, noise: Array) -> Array:
        """Return the rate of change, `(D, drives)`, of states `(D, drives)` at acting controls `(U, drives)`."""
        raise NotImplementedError

    def logged(self, states: Array) -> Array:
        """Return the program's states, `(rows, drives, D)`, of `(rows, D', drives)`."""
        return states.transpose(0, 2, 1)

    def measured(self, states: Array, random: np.random.Generator) -> Array:
        """Return the measurements of the program's states, `(rows, drives, K)`."""
        raise NotImplementedError

    def size(self, name: str) -> float:
        """Return the coefficient of a planted effect, zero where it is not planted."""
        return next((one.value[0] for one in self.effects if one.name == name), 0.0)


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


# --- drives -----------------------------------------------------------------------------------------------------------


def simulate(world: World, drives: int, *, seed: int, fine: float = FINE) -> Trajectories:
    """Return drives with measurements and true states, in double precision.

    Args:
        world: what moves.
        drives: how many.
        seed: the same seed gives the same commands, starts and noise, whatever is planted and whatever `fine` is.
        fine: the integration step, s; a row is a whole number of them.
    """
    rows = round(world.duration / world.step) + 1
    time = world.step * np.arange(rows)
    streams = [np.random.default_rng([seed, stream]) for stream in (COMMANDS, START, NOISE, MEASURED)]
    commands = world.commands(streams[COMMANDS], time, drives)
    offset = world.size("clock_offset")
    later = math.ceil(max(0.0, -offset) / world.step)  # rows after the end that a clock which is ahead shows
    held = np.concatenate([commands, np.repeat(commands[-1:], later, axis=0)])
    noise = streams[NOISE].standard_normal((rows + later, len(world.noise), drives))
    noise *= np.array(world.noise)[:, None] * math.sqrt(ROW / world.step)
    path = integrate(world, world.start(streams[START], commands), held, noise, fine)
    each = round(world.step / fine)
    states = world.logged(path[::each][:rows])
    seen = world.logged(_at(path, (time - offset) / fine)) if offset else states
    return _trajectories(world, time, commands, world.measured(seen, streams[MEASURED]), states)


def integrate(world: World, start: Array, commands: Array, noise: Array, fine: float = FINE) -> Array:
    """Return the states after each fine step by the midpoint rule, `(rows · step / fine + 1, D, drives)`.

    Args:
        world: what moves.
        start: `(D, drives)`.
        commands: `(rows, drives, U)`, held.
        noise: `(rows, C, drives)`, held.
        fine: s.
    """
    each = round(world.step / fine)
    if each < 1 or abs(each * fine - world.step) > 1e-9:
        raise ValueError(f"a row of {world.step} s is not a whole number of steps of {fine} s")
    control = np.ascontiguousarray(acting(commands, world.step, fine, world.effects).transpose(0, 2, 1))
    path = np.empty((len(control) + 1, *start.shape))
    path[0] = state = start
    for index, told in enumerate(control):
        draw = noise[index // each]
        middle = state + 0.5 * fine * world.derivative(state, told, draw)
        path[index + 1] = state = state + fine * world.derivative(middle, told, draw)
    if not np.isfinite(path).all():
        raise ValueError(f"{type(world).__name__} diverges")
    return path


def _at(path: Array, index: Array) -> Array:
    """Return the states at fractional indices, `(rows, D, drives)`; beyond the ends at the velocity there."""
    before = np.clip(np.floor(index).astype(int), 0, len(path) - 2)
    share = (index - before)[:, None, None]
    return path[before] + share * (path[before + 1] - path[before])


def _trajectories(world: World, time: Array, commands: Array, measured: Array, states: Array) -> Trajectories:
    drives = commands.shape[1]
    measurements = torch.from_numpy(np.ascontiguousarray(measured))
    return Trajectories(
        time=torch.from_numpy(time)[:, None].repeat(1, drives),
        controls=torch.from_numpy(np.ascontiguousarray(commands)),
        measurements=measurements,
        observed=torch.ones_like(measurements, dtype=torch.bool),
        lengths=torch.full((drives,), len(time)),
        states=torch.from_numpy(np.ascontiguousarray(states)),
        control_names=world.controls,
        measurement_names=world.measurements,
        state_names=world.states,
    )
