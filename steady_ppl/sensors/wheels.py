"""Sensors of a wheel, which rolls along the vehicle's own axis: how fast it rolls, and how far it rolled."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from steady_ppl.sensors.sensor import Sensor, Setting, setting


@dataclass(frozen=True)
class _OnWheel(Sensor):
    """A sensor of a wheel, which rolls along the vehicle's own axis.

    Attributes:
        left: m that the wheel stands to the left of the tracked point.
        size: its radius over the one that the encoder takes it to have; the reading is as much smaller.
    """

    left: Setting = 0.0
    size: Setting = 1.0

    def rolled(self, program: Any, ahead: Tensor, turned: Tensor | None, state: Tensor) -> Tensor:
        """What the wheel makes of the vehicle's movement ahead and of its turn, `(..., 1)`."""
        left, size = (setting(program, value, state) for value in (self.left, self.size))
        return ((ahead if turned is None else ahead - left * turned) / size).unsqueeze(-1)


class WheelSpeed(_OnWheel):
    """The speed of a wheel over the ground along its own axis, m/s."""

    kind = "wheel speed"

    def columns(self, program: Any) -> tuple[str, ...]:
        return (f"{self.name} [m/s]",)

    def reading(self, program: Any, state: Tensor) -> Tensor:
        forward, _, yaw_rate = program.body_velocity(state)
        return self.rolled(program, forward, yaw_rate, state)


class Encoder(_OnWheel):
    """How far a wheel rolled over the ground since the row before, m."""

    kind = "encoder"

    @property
    def keeps(self) -> tuple[str, ...]:
        return ("travelled",) if self.left == 0 else ("travelled", "turned")

    def columns(self, program: Any) -> tuple[str, ...]:
        return (f"{self.name} [m]",)

    def reading(self, program: Any, state: Tensor) -> Tensor:
        way, *turn = (program.kept(state, name).squeeze(-1) for name in self.keeps)
        return self.rolled(program, way, turn[0] if turn else None, state)
