"""Sensors that see landmarks, each of them or some in a row."""

from dataclasses import dataclass
from typing import Any, ClassVar

import pyro.distributions as dist
from torch import Tensor

from steady_ppl.errors import ProgramError
from steady_ppl.model.handlers import mean_reading
from steady_ppl.model.planar_vehicle import bearings_to
from steady_ppl.sensors.sensor import Sensor, Setting, Several, setting


class _OfLandmarks(Sensor):
    unit: ClassVar[str]

    def columns(self, program: Any) -> tuple[str, ...]:
        if not len(program.landmarks):
            about = f"its sensor {self.name} needs `landmarks`, and it has none"
            raise ProgramError(f"model {type(program).__name__}: {about}", site="sensors")
        return tuple(f"{self.name}_{index} [{self.unit}]" for index in range(len(program.landmarks)))


class Bearings(_OfLandmarks):
    """The bearing of each of the program's landmarks against its heading, rad anticlockwise."""

    kind = "bearing"
    unit = "rad"
    of_circle = True

    def reading(self, program: Any, state: Tensor) -> Tensor:
        return mean_reading(self.distribution(program, state))

    def distribution(self, program: Any, state: Tensor) -> dist.Independent:
        return bearings_to(program.landmarks, state, sd=setting(program, self.sd, state))


class Ranges(_OfLandmarks):
    """The distance of each of the program's landmarks, m."""

    kind = "range"
    unit = "m"

    def reading(self, program: Any, state: Tensor) -> Tensor:
        return program.ranges(state)


@dataclass(frozen=True, kw_only=True)
class RangesBearings(Several):
    """Distance and bearing of each of the program's landmarks: a laser scanner, a radar, tags in a camera's image.

    Its columns are called as those of `Ranges` and `Bearings` are, after its own name if it is given one.

    Attributes:
        sd: of a distance, m.
        bearing_sd: rad.
    """

    bearing_sd: Setting

    kind = "range and bearing"

    @property
    def parts(self) -> tuple[Sensor, ...]:
        prefix = "" if self.name == self.kind.replace(" ", "_") else f"{self.name}_"
        return Ranges(self.sd, f"{prefix}range"), Bearings(self.bearing_sd, f"{prefix}bearing")
