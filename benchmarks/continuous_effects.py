"""Effects planted in worlds of continuous time, by their names in the catalogue, with their physics written out.

They act on commands, on a body in the plane or on what moves along a line. No code is shared with the engine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray


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
