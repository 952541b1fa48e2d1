"""Worlds of the vehicles of `models/` in continuous time: differential equations in numpy, RK4 in fine steps.

They share no code with the programs: velocities are kept in the body frame, and nothing is averaged over a step.
Commands and noise are held over a row, the noise is one draw a row and channel.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import steady_ppl as st

Array = np.ndarray


@dataclass(frozen=True)
class World:
    """A vehicle in continuous time.

    Attributes:
        truth: the parameters that a fit is to find, but for the noise.
        noise: standard deviations of the channels.
        rates: (state `(D, drives)`, controls `(U, drives)`, noise `(C, drives)`, truth) → rates of change.
        controls: name → lowest and highest value, held for `hold` s each.
        start: mean and standard deviation of each component of the state.
        sensors: column → (reading of the logged states `(rows, drives, D)`, truth; standard deviation).
        fine: the integration step, s.
    """

    truth: Mapping[str, Any]
    noise: Sequence[float]
    rates: Callable[[Array, Array, Array, Mapping[str, Any]], Array]
    controls: Mapping[str, tuple[float, float]]
    start: Sequence[tuple[float, float]]
    sensors: Mapping[str, tuple[Callable[[Array, Mapping[str, Any]], Array], float]]
    step: float = 0.1
    duration: float = 20.0
    hold: float = 2.0
    fine: float = 0.001
    commands: Callable[[np.random.Generator, Array, int], Array] | None = None
    logged: Callable[[Array], Array] = lambda states: states


def path(world: World, count: int, random: np.random.Generator) -> tuple[Array, Array, Array]:
    """Times `(rows,)`, controls `(rows, drives, U)` and logged states `(rows, drives, D)` of drives."""
    rows, each = round(world.duration / world.step) + 1, round(world.step / world.fine)
    time = world.step * np.arange(rows)
    if world.commands is not None:
        controls = world.commands(random, time, count)
    else:
        low, high = np.array(list(world.controls.values())).reshape(-1, 2).T
        held = (time / world.hold + 1e-9).astype(int)
        controls = random.uniform(low, high, (held[-1] + 1, count, len(low)))[held]
    mean, sd = np.array(world.start).T
    state = mean[:, None] + sd[:, None] * random.standard_normal((len(mean), count))
    noise = np.array(world.noise)[:, None] * random.standard_normal((rows, len(world.noise), count))
    states, h = [state], world.fine
    for row in range(rows - 1):
        given = controls[row].T, noise[row], world.truth
        for _ in range(each):
            one = world.rates(state, *given)
            two = world.rates(state + h / 2 * one, *given)
            three = world.rates(state + h / 2 * two, *given)
            four = world.rates(state + h * three, *given)
            state = state + h / 6 * (one + 2 * two + 2 * three + four)
        states.append(state)
    return time, controls, world.logged(np.stack(states)).transpose(0, 2, 1)


def readings(world: World, states: Array) -> Array:
    """What the sensors read without noise, `(rows, drives, K)`."""
    return np.stack([reading(states, world.truth) for reading, _ in world.sensors.values()], -1)


def drives(world: World, count: int, seed: int) -> st.Trajectories:
    """Drives with their measurements and no true states."""
    random = np.random.default_rng(seed)
    time, controls, states = path(world, count, random)
    sd = np.array([one for _, one in world.sensors.values()])
    seen = readings(world, states) + sd * random.standard_normal((*states.shape[:2], len(sd)))
    columns = {f"u.{name}": controls[..., index] for index, name in enumerate(world.controls)}
    columns |= {f"y.{name}": seen[..., index] for index, name in enumerate(world.sensors)}
    return st.from_arrays([{"time": time} | {name: part[:, i] for name, part in columns.items()} for i in range(count)])


# --- the plane --------------------------------------------------------------------------------------------------------


def in_plane(body: Callable[..., tuple[Any, Any, Any]]) -> Callable[..., Array]:
    """The rates of (x, y, heading, u, w, r) of those of the velocities in the body frame."""

    def rates(state: Array, control: Array, noise: Array, truth: Mapping[str, Any]) -> Array:
        _, _, heading, u, w, r = state
        cos, sin = np.cos(heading), np.sin(heading)
        pushes = body(u, w, r, control, truth, heading)
        return np.stack(
            [cos * u - sin * w, sin * u + cos * w, r, *(one + n for one, n in zip(pushes, noise, strict=True))]
        )

    return rates


def to_world(states: Array) -> Array:
    """The states as programs in the plane have them, `(rows, 6, drives)`."""
    x, y, heading, u, w, r = states.transpose(1, 0, 2)
    cos, sin = np.cos(heading), np.sin(heading)
    return np.stack([x, y, heading, cos * u - sin * w, sin * u + cos * w, r], 1)


def of(index: int) -> Callable[[Array, Mapping[str, Any]], Array]:
    return lambda states, truth: states[..., index]


def position(name: str, sd: float) -> dict[str, Any]:
    return {f"{name}_x": (of(0), sd), f"{name}_y": (of(1), sd)}


def wheel(side: float, size: Callable[[Mapping[str, Any]], float]) -> Callable[[Array, Mapping[str, Any]], Array]:
    """What an encoder reads of a wheel on a side, 1 the left one."""

    def reading(states: Array, truth: Mapping[str, Any]) -> Array:
        _, _, heading, vx, vy, r = np.moveaxis(states, -1, 0)
        forward = np.cos(heading) * vx + np.sin(heading) * vy
        return (forward - side * truth["track"] / 2 * r) / size(truth)

    return reading


def car(u, w, r, control, truth, heading):
    speed, steering = control
    yaw = (u * np.tan(steering) / truth["wheelbase"] - r) / 0.1
    return (speed - u) / 0.1, -(w - truth["rear"] * r) / 0.1 + truth["rear"] * yaw, yaw


def differential_drive(u, w, r, control, truth, heading):
    left, right = truth["size"] * control[0], truth["size"] * truth["ratio"] * control[1]
    return ((left + right) / 2 - u) / 0.1, -w / 0.1, ((right - left) / truth["track"] - r) / 0.1


def dynamic_bicycle(u, w, r, control, truth, heading):
    speed, steering = control
    s = np.sqrt(u**2 + 1)
    front = -truth["front"] * (w + 1.2 * r - u * steering) / s
    rear = -truth["rear"] * (w - 1.6 * r) / s
    yaw = (1.2 * front - 1.6 * rear) / truth["gyration"] ** 2
    return (speed - u) / truth["speed_time"], front + rear - u * r, yaw


def thruster_boat(u, w, r, control, truth, heading):
    left, right = control
    (m1, m2, m3), damped = truth["mass"], []
    for x, linear, quadratic in zip((u, w, r), truth["linear"], truth["quadratic"], strict=True):
        damped.append(linear * x + quadratic * x * np.abs(x))
    return (
        (left + right + m2 * w * r - damped[0]) / m1,
        (-m1 * u * r - damped[1]) / m2,
        (0.3 * (right - left) + (m1 - m2) * u * w - damped[2]) / m3,
    )


def ship(u, w, r, control, truth, heading):
    propeller, rudder = control
    driven, s = truth["pitch"] * propeller, np.sqrt(u**2 + 0.25)
    return (
        truth["drag"] * (driven * np.abs(driven) - u * np.abs(u)) + w * r,
        -(w + truth["drift"] * 80 * r) * s / (0.5 * 80),
        (truth["gain"] * u * np.abs(u) / 80 * rudder - s * r) / (truth["turn_time"] * 80),
    )


def planar_quadrotor(u, w, r, control, truth, heading):
    left, right = control
    return (
        -truth["drag"] * u - 9.81 * np.sin(heading) + w * r,
        (left + right) / truth["mass"] - 9.81 * np.cos(heading) - u * r,
        0.15 * (right - left) / truth["inertia"],
    )


def swinging(random: np.random.Generator, time: Array, count: int) -> Array:
    """Thrusts about hovering that swing the tilt."""
    size, rate, sign = random.uniform(0.5, 1.5, count), random.uniform(2.5, 4, count), random.choice([-1, 1], count)
    difference = 0.01 * rate**2 * sign * size * np.cos(rate * time[:, None])
    hover = 9.81 / 4 * (1 + 0.2 * np.sin(rate / 2 * time[:, None]))
    return np.stack([hover - difference, hover + difference], -1)


# --- other systems ----------------------------------------------------------------------------------------------------


def motor_joint(state: Array, control: Array, noise: Array, truth: Mapping[str, Any]) -> Array:
    return np.stack([state[1], (control[0] - truth["friction"] * state[1]) / truth["inertia"] + noise[0]])


def tumbling_body(state: Array, control: Array, noise: Array, truth: Mapping[str, Any]) -> Array:
    """The rotation matrix from body to world, its columns one after the other, and the body rates."""
    columns, (x, y, z) = state[:9].reshape(3, 3, -1), state[9:]
    a, b = truth["inertia"]
    turned = [columns[1] * z - columns[2] * y, columns[2] * x - columns[0] * z, columns[0] * y - columns[1] * x]
    faster = np.stack([(b - 1) / a * y * z, (1 - a) / b * z * x, (a - b) * x * y]) + noise
    return np.concatenate([*turned, faster])


def direction(towards: Sequence[float], axis: int) -> Callable[[Array, Mapping[str, Any]], Array]:
    """A component in the body frame of a direction of the world."""
    return lambda states, truth: states[..., 3 * axis : 3 * axis + 3] @ np.array(towards)


POSE = ((0.0, 2.0), (0.0, 2.0), (0.0, 1.5))
SUN, FIELD = (1.0, 0.0, 0.0), (0.0, 0.6, 0.8)
WORLDS = {
    "car": World(
        truth={"wheelbase": 2.8, "rear": 1.3},
        noise=(1.0, 0.5, 0.3),
        rates=in_plane(car),
        controls={"speed": (1, 5), "steering": (-0.4, 0.4)},
        start=(*POSE, (2.0, 1.0), (0.0, 0.1), (0.0, 0.1)),
        sensors={**position("gps", 0.3), "gyro": (of(5), 0.02)},
        logged=to_world,
    ),
    "differential_drive": World(
        truth={"track": 0.4, "size": 0.97, "ratio": 1.02},
        noise=(0.5, 0.3, 0.5),
        rates=in_plane(differential_drive),
        controls={"left_wheel": (0.2, 0.8), "right_wheel": (0.2, 0.8)},
        start=(*POSE, (0.3, 0.3), (0.0, 0.1), (0.0, 0.1)),
        sensors={
            **position("tag", 0.05),
            "gyro": (of(5), 0.02),
            "left_encoder": (wheel(1, lambda truth: truth["size"]), 0.02),
            "right_encoder": (wheel(-1, lambda truth: truth["size"] * truth["ratio"]), 0.02),
        },
        logged=to_world,
    ),
    "dynamic_bicycle": World(
        truth={"front": 50.0, "rear": 60.0, "gyration": 1.4, "speed_time": 1.0},
        noise=(0.5, 0.5, 0.2),
        rates=in_plane(dynamic_bicycle),
        controls={"speed": (8, 18), "steering": (-0.05, 0.05)},
        start=(*POSE, (2.0, 1.0), (0.0, 0.2), (0.0, 0.1)),
        sensors={**position("gps", 0.3), "compass": (of(2), 0.02), "gyro": (of(5), 0.01)},
        logged=to_world,
    ),
    "thruster_boat": World(
        truth={"mass": (25.0, 30.0, 4.0), "linear": (6.0, 40.0, 4.0), "quadratic": (6.0, 40.0, 4.0)},
        noise=(0.05, 0.05, 0.05),
        rates=in_plane(thruster_boat),
        controls={"left": (-1, 9), "right": (-1, 9)},
        start=(*POSE, (0.5, 0.3), (0.0, 0.2), (0.0, 0.2)),
        sensors={**position("gps", 0.3), "compass": (of(2), 0.03)},
        duration=30.0,
        hold=3.0,
        logged=to_world,
    ),
    "ship": World(
        truth={"pitch": 4.0, "drag": 0.002, "gain": 1.5, "turn_time": 2.0, "drift": 0.4},
        noise=(0.01, 0.01, 1e-4),
        rates=in_plane(ship),
        controls={"propeller": (1, 2), "rudder": (-0.3, 0.3)},
        start=((0.0, 50.0), (0.0, 50.0), (0.0, 1.0), (5.0, 1.0), (0.0, 0.3), (0.0, 0.005)),
        sensors={**position("gps", 2.0), "compass": (of(2), 0.01), "gyro": (of(5), 0.001)},
        step=1.0,
        duration=300.0,
        hold=50.0,
        fine=0.02,
        logged=to_world,
    ),
    "motor_joint": World(
        truth={"inertia": 0.05, "friction": 0.2},
        noise=(1.0,),
        rates=motor_joint,
        controls={"torque": (-1, 1)},
        start=((0.0, 1.0), (0.0, 1.0)),
        sensors={"encoder": (of(0), 0.01 / 12**0.5)},
        step=0.02,
        duration=6.0,
        hold=0.5,
    ),
    "planar_quadrotor": World(
        truth={"mass": 0.5, "inertia": 0.004, "drag": 0.3},
        noise=(0.2, 0.2, 0.5),
        rates=in_plane(planar_quadrotor),
        controls={"left": (0, 0), "right": (0, 0)},
        start=((0.0, 1.0), (0.0, 1.0), (0.0, 0.2), (0.0, 0.3), (0.0, 0.3), (0.0, 0.2)),
        sensors={**position("marker", 0.01), "tilt": (of(2), 0.01), "gyro": (of(5), 0.02)},
        step=0.05,
        duration=6.0,
        commands=swinging,
        logged=to_world,
    ),
    "tumbling_body": World(
        truth={"inertia": (0.6, 0.8)},
        noise=(0.02, 0.02, 0.02),
        rates=tumbling_body,
        controls={},
        start=(*((float(value), 0.0) for value in np.eye(3).flatten()), *[(0.0, 1.0)] * 3),
        sensors={f"gyro_{axis}": (of(9 + index), 0.02) for index, axis in enumerate("xyz")}
        | {
            f"{name}_{axis}": (direction(towards, index), 0.05)
            for name, towards in (("sun", SUN), ("field", FIELD))
            for index, axis in enumerate("xyz")
        },
        duration=20.0,
    ),
}
