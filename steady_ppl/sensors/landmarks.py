"""Sensors that see landmarks, each of them or some in a row."""

from typing import Any

import pyro.distributions as dist
from torch import Tensor

from steady_ppl.model.planar_vehicle import bearings_to
from steady_ppl.sensors.sensor import Sensor, mean_of, setting


class Bearings(Sensor):
    """The bearing of each of the program's landmarks against its heading, rad anticlockwise."""

    kind = "bearing"
    of_circle = True

    def columns(self, program: Any) -> tuple[str, ...]:
        return tuple(f"{self.name}_{index} [rad]" for index in range(len(program.landmarks)))

    def reading(self, program: Any, state: Tensor) -> Tensor:
        return mean_of(self.distribution(program, state))

    def distribution(self, program: Any, state: Tensor) -> dist.Independent:
        return bearings_to(program.landmarks, state, sd=setting(program, self.sd, state))


class Ranges(Sensor):
    """The distance of each of the program's landmarks, m."""

    kind = "range"

    def columns(self, program: Any) -> tuple[str, ...]:
        return tuple(f"{self.name}_{index} [m]" for index in range(len(program.landmarks)))

    def reading(self, program: Any, state: Tensor) -> Tensor:
        return program.ranges(state)
