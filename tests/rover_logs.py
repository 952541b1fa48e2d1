"""A rover that drives in a world of milliseconds, and what its autopilot logs of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from log_writing import Kind, Sent, dataflash, ulog

ORIGIN = (47.3977420, 8.5455938)  # degrees
BOOT = 5_000_000  # µs on the log's clock when the world begins
SETTLING = 0.1  # s
Numbers = tuple[float, ...]
EQUATOR, SQUARED = 6378137.0, 0.00669437999014  # WGS 84


class World(NamedTuple):
    """What is so every millisecond, `(milliseconds,)` each."""

    commands: np.ndarray  # (milliseconds, 2): speed, m/s, and turn rate, rad/s, or steering angle, rad
    x: np.ndarray  # m east
    y: np.ndarray  # m north
    heading: np.ndarray  # rad from east, anticlockwise, continuous
    turning: np.ndarray  # rad/s


def world(
    seconds: float, seed: int = 0, *, wheelbase: float | None = None, gains: tuple[float, float] = (1, 1)
) -> World:
    """Commands held for two seconds, which the rover reaches exponentially; with a wheelbase it steers."""
    count, dice = round(seconds * 1000), np.random.default_rng(seed)
    held = np.stack([dice.uniform(0.5, 3.0, count // 2000 + 1), dice.uniform(-0.4, 0.4, count // 2000 + 1)], -1)
    commands = held[np.arange(count) // 2000]
    decay, speed, turning = np.exp(-0.001 / SETTLING), np.zeros(count), np.zeros(count)
    for i in range(1, count):
        wanted, turn = commands[i - 1] * gains
        speed[i] = wanted + (speed[i - 1] - wanted) * decay
        goal = turn if wheelbase is None else speed[i] * np.tan(turn) / wheelbase
        turning[i] = goal + (turning[i - 1] - goal) * decay
    heading = 2.0 + np.cumsum(turning) * 0.001
    x, y = np.cumsum(speed * np.cos(heading)) * 0.001, np.cumsum(speed * np.sin(heading)) * 0.001
    return World(commands, x, y, heading, turning)


def geodetic(east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Degrees of points that lie in the plane of `ORIGIN`, by iterating towards them (Bowring, a fixed point)."""
    phi, lam = np.radians(ORIGIN)
    n = EQUATOR / np.sqrt(1 - SQUARED * np.sin(phi) ** 2)
    along = -np.sin(phi) * north  # away from the axis
    a, b = n * np.cos(phi) + along, east
    x, y = np.cos(lam) * a - np.sin(lam) * b, np.sin(lam) * a + np.cos(lam) * b
    z = n * (1 - SQUARED) * np.sin(phi) + np.cos(phi) * north
    p, found = np.hypot(x, y), np.full(np.shape(east), phi)
    for _ in range(8):
        n = EQUATOR / np.sqrt(1 - SQUARED * np.sin(found) ** 2)
        found = np.arctan2(z + SQUARED * n * np.sin(found), p)
    return np.degrees(found), np.degrees(np.arctan2(y, x))


def attitude(heading: np.ndarray) -> np.ndarray:
    """PX4's quaternion (w, x, y, z) of a vehicle that is level: from its own axes to north, east, down."""
    yaw = np.pi / 2 - heading
    return np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], -1)


def every(seconds: float, world: World, first: float = 0.0) -> np.ndarray:
    """Milliseconds of the world at a rate."""
    return np.arange(round(first * 1000), len(world.x), round(seconds * 1000))


def px4(
    world: World,
    *,
    seed: int = 0,
    noise: Numbers = (0, 0, 0),
    old: bool = False,
    armed: Sequence[tuple[float, float]] = ((0.0, 1e9),),
    delay: np.ndarray | int = 0,
    fix: np.ndarray | int = 3,
    extra: bytes = b"",
) -> bytes:
    """A ULog. GPS at 10 Hz, two receivers, the second a metre east; attitude at 20 Hz, sampled 3 to 23 ms before it is
    logged; commands at 50 Hz as normalised outputs, of speeds of 4 m/s and steering angles of .5 rad, NaN where it is
    not armed, the second motor's against the steering; and as setpoints of an acceleration, north and east, and a rate.
    `noise` are standard deviations, m, rad and rad/s; `armed` spans, s; `delay` that of GPS, µs."""
    dice = np.random.default_rng(seed)
    gps, quick, driven = every(0.1, world), every(0.05, world), every(0.02, world)
    latitude, longitude = geodetic(_noisy(world.x[gps], noise[0], dice), _noisy(world.y[gps], noise[0], dice))
    _, other = geodetic(world.x[gps] + 1.0, world.y[gps])
    late = dice.integers(3000, 23000, len(quick))
    received = gps * 1000 + BOOT + delay
    own = 1_700_000_000_000_000 + np.rint(gps * 1000 * (1 + 5e-5)).astype(np.int64)
    is_armed = np.any([(driven >= a * 1000) & (driven < b * 1000) for a, b in armed], 0)
    outputs = np.where(is_armed[:, None], world.commands[driven] / [4.0, -0.5], np.nan)
    flags = sorted({0.0, *(t for pair in armed for t in pair if t < len(world.x) / 1000)})
    states = [2 if any(a <= t < b for a, b in armed) else 1 for t in flags]
    heading = _noisy(world.heading[quick], noise[1], dice)
    turning = _noisy(world.turning[quick], noise[2], dice)

    def fixes(longitude: np.ndarray, instance: int) -> Sent:
        degrees = {"latitude_deg": ("double", latitude), "longitude_deg": ("double", longitude)}
        whole = {"lat": ("int32_t", np.rint(latitude * 1e7)), "lon": ("int32_t", np.rint(longitude * 1e7))}
        rest = {"time_utc_usec": ("uint64_t", own), "fix_type": ("uint8_t", np.broadcast_to(fix, len(gps)))}
        times = {"timestamp": ("uint64_t", received), "timestamp_sample": ("uint64_t", 0 * received)}
        return Sent("vehicle_gps_position", times | (whole if old else degrees) | rest, instance)

    def sampled(name: str, **fields: tuple[str, np.ndarray]) -> Sent:
        stamps = {"timestamp": ("uint64_t", quick * 1000 + BOOT + late)}
        return Sent(name, stamps | {"timestamp_sample": ("uint64_t", quick * 1000 + BOOT)} | fields)

    motors, servos = np.full((len(driven), 12), np.nan), np.full((len(driven), 8), np.nan)
    motors[:, :2], servos[:, 0] = outputs * [1, -1], outputs[:, 1]
    setpoints = np.concatenate([world.commands[driven], np.zeros((len(driven), 1))], 1)
    when = {"timestamp": ("uint64_t", driven * 1000 + BOOT)}
    topics = [
        fixes(longitude, 0),
        fixes(other, 1),
        sampled("vehicle_attitude", q=("float", attitude(heading))),
        sampled("vehicle_angular_velocity", xyz=("float", np.stack([0 * turning, 0 * turning, -turning], -1))),
        Sent("actuator_motors", when | {"control": ("float", motors)}),
        Sent("actuator_servos", when | {"control": ("float", servos)}),
        Sent("vehicle_local_position_setpoint", when | {"acceleration": ("float", setpoints)}),
        Sent("vehicle_rates_setpoint", when | {"yaw": ("float", setpoints[:, 1])}),
        Sent(
            "vehicle_status",
            {
                "timestamp": ("uint64_t", [round(t * 1e6) + BOOT for t in flags]),
                "arming_state": ("uint8_t", states),
            },
        ),
    ]
    return ulog(topics, BOOT, extra)


def ardupilot(world: World, *, seed: int = 0, noise: Numbers = (0, 0, 0)) -> bytes:
    """A DataFlash log of a rover commanded by a speed and a turn rate; its outputs are those of `px4`."""
    dice = np.random.default_rng(seed)
    gps, quick, driven = every(0.1, world), every(0.05, world), every(0.02, world)
    latitude, longitude = geodetic(_noisy(world.x[gps], noise[0], dice), _noisy(world.y[gps], noise[0], dice))
    _, other = geodetic(world.x[gps] + 1.0, world.y[gps])
    heading = np.degrees(np.pi / 2 - _noisy(world.heading[quick], noise[1], dice)) % 360
    turning = -_noisy(world.turning[quick], noise[2], dice)
    speed, turn = world.commands[driven].T
    pwm = np.rint(1500 + 500 * world.commands[driven] / [4.0, -0.5]).astype(int)

    def stamps(at: np.ndarray) -> list[int]:
        return (at * 1000 + BOOT).tolist()

    def whole(degrees: np.ndarray) -> list[int]:
        return np.rint(degrees * 1e7).astype(int).tolist()

    week, within = divmod(1_700_000_000_000 - 315964800_000, 604800_000)
    fixes = [
        (t, instance, 3, within + int(at), week, 12, 90, lat, lng, 0)
        for instance, lngs in ((0, whole(longitude)), (1, whole(other)))
        for t, at, lat, lng in zip(stamps(gps), gps, whole(latitude), lngs, strict=True)
    ]
    zeros, first = [0.0] * len(quick), [0] * len(quick)
    outputs = [(t, steering, 0, throttle) for t, (throttle, steering) in zip(stamps(driven), pwm, strict=True)]
    return dataflash(
        [
            Kind("GPS", "QBBIHBcLLi", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt", fixes, "s#-s-S-DUm"),
            Kind("ATT", "Qff", "TimeUS,Roll,Yaw", list(zip(stamps(quick), zeros, heading, strict=True))),
            Kind("IMU", "QBf", "TimeUS,I,GyrZ", list(zip(stamps(quick), first, turning, strict=True)), "s#E"),
            Kind("THR", "Qf", "TimeUS,DesSpeed", list(zip(stamps(driven), speed, strict=True))),
            Kind("STER", "Qf", "TimeUS,DesTurnRate", list(zip(stamps(driven), np.degrees(-turn), strict=True))),
            Kind("RCOU", "QHHH", "TimeUS,C1,C2,C3", outputs),
            Kind("ARM", "QBH", "TimeUS,ArmState,ArmChecks", [(BOOT, 1, 0)]),
            Kind("MSG", "QZ", "TimeUS,Message", [(BOOT, b"ArduRover V4.5.0")]),
        ]
    )


def _noisy(values: np.ndarray, sd: float, dice: np.random.Generator) -> np.ndarray:
    return values + sd * dice.normal(size=len(values))
