"""What every sensor is: columns of a table, and a distribution of its readings given the state."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import pyro
import pyro.distributions as dist
from torch import Tensor

from steady_ppl.errors import ProgramError
from steady_ppl.model.distributions import WrappedNormal

Setting = float | Sequence[float] | str
"""A number, or the name of one of the program's parameters or constants, which may then be learned."""


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

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", self.kind.replace(" ", "_"))
        if not (isinstance(self.name, str) and self.name.isidentifier()):
            raise ProgramError(f"a sensor's name is one word, got {self.name!r}", site="sensors")
        self._require_positive("sd")

    def _require_positive(self, what: str) -> None:
        value = getattr(self, what)
        numbers = value if isinstance(value, Sequence) else (value,)
        if isinstance(value, str) or all(isinstance(one, float | int) and 0 < one < math.inf for one in numbers):
            return
        raise ProgramError(f"sensor {self.name}: {what} is a number above zero, got {value!r}", site="sensors")

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
        return kind(self.reading(program, state), setting(program, self.sd, state)).to_event(1)

    def observe(self, program: Any, state: Tensor) -> None:
        """Sample its readings at the site of its name."""
        pyro.sample(self.name, self.distribution(program, state))


def setting(program: Any, value: Setting, like: Tensor) -> Any:
    """A setting's value for a program: a number, or a tensor like the states."""
    if isinstance(value, str):
        if not hasattr(program, value):
            said = f"its sensor names {value!r}, which it does not have"
            raise ProgramError(f"program {type(program).__name__}: {said}", site="sensors")
        value = getattr(program, value)
    return value if isinstance(value, float | int | Tensor) else like.new_tensor(value)
