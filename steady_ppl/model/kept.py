"""What a vehicle in the plane keeps of the row that it has just gone through, as states beside its own six.

`observe` sees the state alone. A mean acceleration, a way or the row's controls are in it where something asks for it.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any, NamedTuple

import torch
from torch import Tensor

from steady_ppl.errors import ProgramError
from steady_ppl.model.substeps import row_begins

MOVING = ("x [m]", "y [m]", "heading [rad]", "vx [m/s]", "vy [m/s]", "yaw_rate [rad/s]")


class Substep(NamedTuple):
    """A substep of a vehicle: the six states before and after it, `(..., 6)`."""

    vehicle: Any
    before: Tensor
    after: Tensor
    control: Tensor  # (..., U), as it acts
    step: Tensor  # (...) s
    begins: bool  # whether it is the first of its row

    @property
    def turn(self) -> Tensor:
        """rad."""
        return 0.5 * (self.before[..., 5] + self.after[..., 5]) * self.step

    @property
    def accelerations(self) -> tuple[Tensor, Tensor, Tensor]:
        """Mean forward, lateral (m/s²) and yaw acceleration (rad/s²), in the axes of the middle of the turn."""
        change = (self.after[..., 3:] - self.before[..., 3:]) / self.step.unsqueeze(-1)
        heading = (self.before[..., 2] + 0.5 * self.turn).unsqueeze(-1)
        return self.vehicle.body_velocity(torch.cat([self.before[..., :2], heading, change], -1))


class Quantity(NamedTuple):
    """Something that is kept: its states and what a substep adds to them, which begin at zero in every row."""

    columns: Callable[[Any], Sequence[str]]  # of the vehicle's class, as "name [unit]"
    added: Callable[[Substep], Sequence[Tensor]]


def _acceleration(of: Substep) -> Sequence[Tensor]:
    forward, lateral, _ = of.accelerations
    return _mean(of, forward, lateral)


def _turning(of: Substep) -> Sequence[Tensor]:
    first, last = of.before[..., 5], of.after[..., 5]
    return _mean(of, of.accelerations[2], (first * first + first * last + last * last) / 3)


def _direction(of: Substep) -> Sequence[Tensor]:
    heading = of.before[..., 2] + 0.5 * of.turn
    return _mean(of, heading.cos(), heading.sin())


def _travelled(of: Substep) -> Sequence[Tensor]:
    speeds = (of.vehicle.body_velocity(state)[0] for state in (of.before, of.after))
    return (0.5 * sum(speeds) * of.step,)


def _before(of: Substep) -> Sequence[Tensor]:
    return (of.before if of.begins else torch.zeros_like(of.before)).unbind(-1)


def _mean(of: Substep, *values: Tensor) -> Sequence[Tensor]:
    return [value / of.vehicle.substeps for value in values]


QUANTITIES = {
    "acceleration": Quantity(lambda kind: ("mean_forward [m/s²]", "mean_lateral [m/s²]"), _acceleration),
    "turning": Quantity(lambda kind: ("mean_yaw [rad/s²]", "mean_squared_yaw_rate [rad²/s²]"), _turning),
    "direction": Quantity(lambda kind: ("mean_cosine [1]", "mean_sine [1]"), _direction),
    "travelled": Quantity(lambda kind: ("travelled [m]",), _travelled),
    "turned": Quantity(lambda kind: ("turned [rad]",), lambda of: (of.turn,)),
    "control": Quantity(
        lambda kind: [f"mean_{name}" for name in kind.controls], lambda of: _mean(of, *of.control.unbind(-1))
    ),
    "before": Quantity(lambda kind: [f"before_{name}" for name in MOVING], _before),
}


def kept_columns(kind: Any) -> dict[str, Sequence[str]]:
    """Name of each quantity that a vehicle's class keeps, for its own lines and for its sensors → its states."""
    if isinstance(kind.keeps, str) or not isinstance(kind.keeps, Sequence):
        what = f"keeps is {kind.keeps!r}; one quantity is ('acceleration',)"
        raise ProgramError(f"model {kind.__name__}: {what}", site="keeps")
    listed = kind.sensors if isinstance(kind.sensors, Sequence) else ()
    asked = (getattr(one, "keeps", ()) for one in listed if not isinstance(one, type))
    wanted = dict.fromkeys([*kind.keeps, *(name for names in asked for name in names)])
    for name in wanted:
        if name not in QUANTITIES:
            what = f"keeps names {name!r}; a vehicle can keep {', '.join(QUANTITIES)}"
            raise ProgramError(f"model {kind.__name__}: {what}", site="keeps")
    return {name: QUANTITIES[name].columns(kind) for name in wanted}


def moves_six(transition: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """A `transition` of the vehicle's own six states, as one that is given what is kept too and returns it anew."""

    @wraps(transition)
    def wrapped(self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
        count = _count(self)
        if not count or state.shape[-1] != len(MOVING) + count:  # of an inner call, or with states of an effect
            return transition(self, state, control, time, step)
        before, last = state[..., : len(MOVING)], state[..., len(MOVING) :]
        after = transition(self, before, control, time, step)
        of = Substep(self, before.expand_as(after), after, control, step, row_begins())
        added = [part for name in kept_columns(type(self)) for part in QUANTITIES[name].added(of)]
        kept = torch.stack([part.expand(after.shape[:-1]) for part in added], -1)
        return torch.cat([after, kept if of.begins else kept + last], -1)

    return wrapped


def begins_six(initial: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """An `initial` of the vehicle's own six states, as one after which what is kept is zero."""

    @wraps(initial)
    def wrapped(self: Any) -> Tensor:
        start = initial(self)
        if type(self).outermost("initial") is not wrapped or not (count := _count(self)):
            return start
        return torch.cat([start, start.new_zeros((*start.shape[:-1], count))], -1)

    return wrapped


def _count(vehicle: Any) -> int:
    return sum(map(len, kept_columns(type(vehicle)).values()))


KEEPING: Mapping[str, Callable[[Callable[..., Tensor]], Callable[..., Tensor]]] = {
    "transition": moves_six,
    "initial": begins_six,
}
