"""What every sensor is: columns of a table, and a distribution of its readings given the state."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from steady_ppl.errors import ProgramError
from steady_ppl.model.distributions import WrappedNormal

Setting = float | Sequence[float] | str
"""A number, or the name of one of the model's parameters or constants, which may then be learned."""


def _is_number(value: Any) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool) and math.isfinite(value)


def _is_positive(value: Any) -> bool:
    numbers = value if isinstance(value, Sequence) else (value,)
    return all(_is_number(one) and one > 0 for one in numbers)


def _is_place(value: Any) -> bool:
    return value is None or (isinstance(value, Sequence) and len(value) == 2 and all(map(_is_number, value)))


_SETTINGS = {
    **dict.fromkeys(("sd", "heading_sd", "bearing_sd", "size"), (_is_positive, "a number above zero")),
    **dict.fromkeys(("angle", "left"), (_is_number, "a finite number")),
    "offset": (_is_place, "two numbers, m ahead and to the left"),
    "gravity": (_is_place, "two numbers, m/s² along x and y"),
    "from_north": (lambda value: isinstance(value, bool), "True or False"),
}


@dataclass(frozen=True)
class Sensor(ABC):
    """A sensor of a vehicle in the plane. A reading that is missing in a row is an empty cell of the table.

    Attributes:
        sd: standard deviation of a reading, in its unit.
        name: of the sensor; its site's, and the beginning of its columns' names.
    """

    sd: Setting
    name: str = ""

    kind: ClassVar[str]  # what is measured
    of_circle: ClassVar[bool] = False  # whether readings are angles

    @property
    def keeps(self) -> tuple[str, ...]:
        """What its vehicle keeps of a row for it, see `PlanarVehicle.kept`; its cell of the first row is not read."""
        return ()

    @property
    def parts(self) -> tuple[Sensor, ...]:
        """The sensors in its housing, each with a site of its own; itself where it is one."""
        return (self,)

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", self.kind.replace(" ", "_"))
        if not (isinstance(self.name, str) and self.name.isidentifier()):
            raise ProgramError(f"a sensor's name is one word, got {self.name!r}", site="sensors")
        for what, value in vars(self).items():
            holds, expected = _SETTINGS.get(what, (None, ""))
            if holds and not ((isinstance(value, str) and what != "from_north") or holds(value)):
                raise ProgramError(f"sensor {self.name}: {what} is {expected}, got {value!r}", site="sensors")

    @abstractmethod
    def columns(self, program: Any) -> tuple[str, ...]:
        """Its `K` columns, as "name [unit]"."""

    @abstractmethod
    def reading(self, program: Any, state: Tensor) -> Tensor:
        """What it would read without noise, `(..., K)`."""

    def tells(self, readings: Tensor) -> dict[str, Tensor]:
        """State components that its readings `(..., K)` give directly, but for noise and offsets: name → `(...)`."""
        return {}

    def distribution(self, program: Any, state: Tensor) -> dist.Independent:
        """Of its readings, `(..., K)`."""
        kind = WrappedNormal if self.of_circle else dist.Normal
        reading, sd = self.reading(program, state), setting(program, self.sd, state)
        if isinstance(sd, Tensor) and sd.dim() and sd.shape[-1] not in (1, reading.shape[-1]):
            about = f"sensor {self.name} has {sd.shape[-1]} standard deviations for {reading.shape[-1]} columns"
            raise ProgramError(f"model {type(program).__name__}: its {about}", site="sensors")
        return kind(reading, sd).to_event(1)

    def observe(self, program: Any, state: Tensor) -> None:
        """Sample its readings at the site of its name."""
        pyro.sample(self.name, self.distribution(program, state))


class Several(Sensor):
    """Sensors in one housing, which are late together; each has its own site, noise and effects."""

    def columns(self, program: Any) -> tuple[str, ...]:
        return tuple(column for part in self.parts for column in part.columns(program))

    def reading(self, program: Any, state: Tensor) -> Tensor:
        return torch.cat([part.reading(program, state) for part in self.parts], -1)

    def observe(self, program: Any, state: Tensor) -> None:
        for part in self.parts:
            part.observe(program, state)


def setting(program: Any, value: Setting, like: Tensor) -> Any:
    """A setting's value for a program: a number, or a tensor like the states."""
    if isinstance(value, str):
        if not hasattr(program, value):
            said = f"its sensor names {value!r}, which it does not have"
            raise ProgramError(f"model {type(program).__name__}: {said}", site="sensors")
        value = getattr(program, value)
    return value if isinstance(value, float | int | Tensor) else like.new_tensor(value)
