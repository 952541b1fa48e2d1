"""Sensors that measure the vehicle itself: where it is, where it points, how fast it moves and turns."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from steady_ppl.errors import ProgramError
from steady_ppl.model.planar_vehicle import stack, turned
from steady_ppl.sensors.sensor import Sensor, Setting, setting


@dataclass(frozen=True)
class Position(Sensor):
    """Where its antenna or marker is, m in the world frame: GPS, motion capture, a tag.

    Attributes:
        offset: the antenna's place, m ahead of the tracked point and to its left.
    """

    offset: Setting | None = None

    kind = "position"

    def __post_init__(self) -> None:
        super().__post_init__()
        is_pair = isinstance(self.offset, Sequence) and len(self.offset) == 2
        if not (self.offset is None or isinstance(self.offset, str) or is_pair):
            what = f"offset is two numbers, m ahead and to the left, got {self.offset!r}"
            raise ProgramError(f"sensor {self.name}: {what}", site="sensors")

    def columns(self, program: Any) -> tuple[str, ...]:
        return f"{self.name}_x [m]", f"{self.name}_y [m]"

    def tells(self, readings: Tensor) -> dict[str, Tensor]:
        return {"x": readings[..., 0], "y": readings[..., 1]}

    def reading(self, program: Any, state: Tensor) -> Tensor:
        if self.offset is None:
            return state[..., :2]
        x, y = turned(state[..., 2], *setting(program, self.offset, state).unbind(-1))
        return stack(state[..., 0] + x, state[..., 1] + y)


@dataclass(frozen=True)
class Heading(Sensor):
    """Where it points, rad from the x axis anticlockwise: compass, motion capture, two antennas.

    Attributes:
        from_north: it reads from the y axis clockwise, as a compass does where y points north.
    """

    from_north: bool = False

    kind = "heading"
    of_circle = True

    def columns(self, program: Any) -> tuple[str, ...]:
        return (f"{self.name} [rad]",)

    def tells(self, readings: Tensor) -> dict[str, Tensor]:
        heading = readings[..., 0]
        return {"heading": 0.5 * math.pi - heading if self.from_north else heading}

    def reading(self, program: Any, state: Tensor) -> Tensor:
        heading = state[..., 2:3]
        return 0.5 * math.pi - heading if self.from_north else heading


class YawRate(Sensor):
    """How fast it turns, rad/s anticlockwise: a gyroscope."""

    kind = "yaw rate"

    def columns(self, program: Any) -> tuple[str, ...]:
        return (f"{self.name} [rad/s]",)

    def tells(self, readings: Tensor) -> dict[str, Tensor]:
        return {"yaw_rate": readings[..., 0]}

    def reading(self, program: Any, state: Tensor) -> Tensor:
        return state[..., 5:6]


class BodyVelocity(Sensor):
    """Its velocity ahead and to its left, m/s: a Doppler log, optical flow, two measuring wheels."""

    kind = "velocity"

    def columns(self, program: Any) -> tuple[str, ...]:
        return f"{self.name}_forward [m/s]", f"{self.name}_lateral [m/s]"

    def reading(self, program: Any, state: Tensor) -> Tensor:
        forward, lateral, _ = program.body_velocity(state)
        return stack(forward, lateral)


@dataclass(frozen=True)
class WheelSpeed(Sensor):
    """The speed of a wheel over the ground along its own axis, m/s.

    Attributes:
        left: m that the wheel stands to the left of the tracked point.
        size: its radius over the one that the encoder takes it to have; the reading is as much smaller.
    """

    left: Setting = 0.0
    size: Setting = 1.0

    kind = "wheel speed"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_positive("size")

    def columns(self, program: Any) -> tuple[str, ...]:
        return (f"{self.name} [m/s]",)

    def reading(self, program: Any, state: Tensor) -> Tensor:
        forward, _, yaw_rate = program.body_velocity(state)
        left, size = (setting(program, value, state) for value in (self.left, self.size))
        return ((forward - left * yaw_rate) / size).unsqueeze(-1)
