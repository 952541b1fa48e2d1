"""Sensors that measure the vehicle itself: where it is, where it points, how fast it moves and turns."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from steady_ppl.model.planar_vehicle import stack, turned
from steady_ppl.sensors.sensor import Sensor, Setting, Several, setting


@dataclass(frozen=True)
class Position(Sensor):
    """Where its antenna or marker is, m in the world frame: GPS, motion capture, a tag.

    Attributes:
        offset: the antenna's place, m ahead of the tracked point and to its left.
    """

    offset: Setting | None = None

    kind = "position"

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
        angle: rad that it is turned anticlockwise on its mount.
    """

    from_north: bool = False
    angle: Setting = 0.0

    kind = "heading"
    of_circle = True

    def columns(self, program: Any) -> tuple[str, ...]:
        return (f"{self.name} [rad]",)

    def tells(self, readings: Tensor) -> dict[str, Tensor]:
        if not isinstance(self.angle, float | int):  # it is learned
            return {}
        heading = 0.5 * math.pi - readings[..., 0] if self.from_north else readings[..., 0]
        return {"heading": heading - self.angle}

    def reading(self, program: Any, state: Tensor) -> Tensor:
        heading = state[..., 2:3] + setting(program, self.angle, state)
        return 0.5 * math.pi - heading if self.from_north else heading


@dataclass(frozen=True, kw_only=True)
class Pose(Several):
    """Where its marker is and where that points: motion capture, a tag in a camera's image, scan matching.

    Attributes:
        sd: of the place, m.
        heading_sd: rad.
        offset: the marker's place, m ahead of the tracked point and to its left.
        angle: rad that the marker is turned anticlockwise on the vehicle.
    """

    heading_sd: Setting
    offset: Setting | None = None
    angle: Setting = 0.0

    kind = "pose"

    @property
    def parts(self) -> tuple[Sensor, ...]:
        heading = Heading(self.heading_sd, f"{self.name}_heading", angle=self.angle)
        return Position(self.sd, self.name, self.offset), heading


class YawRate(Sensor):
    """How fast it turns, rad/s anticlockwise: a gyroscope."""

    kind = "yaw rate"

    def columns(self, program: Any) -> tuple[str, ...]:
        return (f"{self.name} [rad/s]",)

    def tells(self, readings: Tensor) -> dict[str, Tensor]:
        return {"yaw_rate": readings[..., 0]}

    def reading(self, program: Any, state: Tensor) -> Tensor:
        return state[..., 5:6]


@dataclass(frozen=True)
class BodyVelocity(Sensor):
    """Its velocity ahead and to its left, m/s: a Doppler log, optical flow, two measuring wheels.

    Attributes:
        angle: rad that it is turned anticlockwise on its mount.
    """

    angle: Setting = 0.0

    kind = "velocity"

    def columns(self, program: Any) -> tuple[str, ...]:
        return f"{self.name}_forward [m/s]", f"{self.name}_lateral [m/s]"

    def reading(self, program: Any, state: Tensor) -> Tensor:
        forward, lateral, _ = program.body_velocity(state)
        return on_mount(program, self.angle, forward, lateral)


@dataclass(frozen=True)
class Accelerometer(Sensor):
    """Its specific force ahead and to its left, m/s², the mean over the row that ends with the reading.

    A mean is what a logger keeps of a faster sensor, and does not depend on the program's time step. Specific force is
    acceleration less that of free fall. On level ground these are one; a slope or a heel of the vehicle is left out.

    Attributes:
        offset: its place, m ahead of the tracked point and to its left.
        angle: rad that it is turned anticlockwise on its mount.
        gravity: of free fall along x and y, m/s²; (0, -9.81) where the plane is upright and y points up.
    """

    offset: Setting | None = None
    angle: Setting = 0.0
    gravity: Setting | None = None

    kind = "accelerometer"

    @property
    def keeps(self) -> tuple[str, ...]:
        more = {"turning": self.offset, "direction": self.gravity}
        return "acceleration", *(name for name, what in more.items() if what is not None)

    def columns(self, program: Any) -> tuple[str, ...]:
        return f"{self.name}_forward [m/s²]", f"{self.name}_lateral [m/s²]"

    def reading(self, program: Any, state: Tensor) -> Tensor:
        forward, lateral = program.kept(state, "acceleration").unbind(-1)
        if self.offset is not None:
            yaw, square = program.kept(state, "turning").unbind(-1)
            ahead, left = setting(program, self.offset, state).unbind(-1)
            forward, lateral = forward - yaw * left - square * ahead, lateral + yaw * ahead - square * left
        if self.gravity is not None:
            cosine, sine = program.kept(state, "direction").unbind(-1)
            x, y = setting(program, self.gravity, state).unbind(-1)
            forward, lateral = forward - cosine * x - sine * y, lateral + sine * x - cosine * y
        return on_mount(program, self.angle, forward, lateral)


def on_mount(program: Any, angle: Setting, forward: Tensor, lateral: Tensor) -> Tensor:
    """A vector in the axes of a sensor that is turned on its mount, `(..., 2)`."""
    if angle == 0:
        return stack(forward, lateral)
    return stack(*turned(-torch.as_tensor(setting(program, angle, forward)).to(forward), forward, lateral))
