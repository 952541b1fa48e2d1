"""Vehicles in the plane: their state, their step, and the sensors that they list."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor, nn

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import ProgramError, UsageError
from steady_ppl.model.distributions import WrappedNormal
from steady_ppl.model.kept import KEEPING, MOVING, kept_columns
from steady_ppl.model.program import Program, names

NEAREST = 1e-6  # m, that a landmark is away at least, so that its distance has a slope
LANDMARK_UNITS = {"bearing": "rad", "range": "m"}  # of measurements that are called so, one a landmark


class _OfClass:
    """What a vehicle's class has by what it keeps."""

    def __init__(self, make: Callable[[Any], tuple[str, ...]]) -> None:
        self.make = make

    def __get__(self, vehicle: Any, kind: Any) -> tuple[str, ...]:
        return self.make(kind)


def _kept(kind: Any) -> tuple[str, ...]:
    return tuple(column for columns in kept_columns(kind).values() for column in columns)


class PlanarVehicle(Program):
    """A vehicle with state (x, y, heading, vx, vy, yaw_rate): pose and velocity in the world frame.

    A subclass samples the body-frame accelerations and returns `self.integrate(state, acceleration, step)`.

    Attributes:
        landmarks: positions that bearings and ranges are measured to, m.
        sensors: what it carries, of `steady_ppl.sensors`; its measurements and its `observe` are then theirs.
        keeps: what its own `observe` asks for by `self.kept`, by names of `steady_ppl.model.kept.QUANTITIES`; these and
            what its sensors keep are states behind the six, which its own `initial` and `transition` do not see.
        bearing_sd: standard deviation of a bearing, rad; 5° unless a program says otherwise, or learns it.
        slips: whether the lateral velocity is free; False where the program takes it back, with the centripetal term
            that a turn needs: `a_lateral = −w / settling + v · yaw_rate`.
        settling: time constant in which a program that does not slip takes its lateral velocity back, and wheels reach
            their command, s; None where it is the step.
    """

    states: Any = _OfClass(lambda kind: (*MOVING, *_kept(kind)))
    resting: Any = _OfClass(_kept)
    kept_names: Any = _OfClass(lambda kind: names(_kept(kind)))
    channels = ("forward [m/s²]", "lateral [m/s²]", "yaw [rad/s²]")
    angles: Any = _OfClass(lambda kind: ("heading", *({"before_heading"} & {*names(_kept(kind))})))
    error_groups = {
        "location": ("x", "y"),
        "angle": ("heading",),
        "velocity": ("vx", "vy"),
        "yaw_rate": ("yaw_rate",),
    }
    derivatives = {"x": "vx", "y": "vy", "heading": "yaw_rate"}
    axes = {"translation": ("forward", "lateral"), "yaw": ("yaw",)}
    landmarks: Sequence[Sequence[float]] = ()
    sensors: Sequence[Any] = ()
    keeps: Sequence[str] = ()
    bearing_sd: float
    settling: float | None = None
    slips: bool = True

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for method, keeping in KEEPING.items():
            if cls.outermost(method) is vars(cls).get(method):
                setattr(cls, method, keeping(vars(cls)[method]))

    @classmethod
    def outermost(cls, method: str) -> Any:
        """A method as the first class has it that is no program's with an effect."""
        written = (vars(kind) for kind in cls.__mro__ if "_attached" not in vars(kind))
        return next(methods[method] for methods in written if method in methods)

    def __init__(self) -> None:
        super().__init__()
        if not hasattr(type(self), "bearing_sd"):  # not a constant of the class, so that a program may learn it
            self.bearing_sd = math.radians(5)

    @property
    def measurements(self) -> tuple[str, ...]:  # type: ignore[override]
        """The columns of its sensors; where it lists none, one bearing a landmark."""
        if self.sensors:
            return tuple(column for sensor in self._listed for column in sensor.columns(self))
        return self._bearings

    @property
    def sensor_columns(self) -> Mapping[str, tuple[int, ...]]:
        """Name of each of `sensor_parts` → its measurements' indices; a vehicle whose own `observe` leaves some of
        them out does not carry these."""
        return self._places({part.name: names(part.columns(self)) for part in self.sensor_parts})

    @property
    def sensor_parts(self) -> tuple[Any, ...]:
        """The sensors that it lists, those in one housing one by one."""
        return tuple(part for sensor in self._listed for part in sensor.parts)

    @property
    def since_row_before(self) -> tuple[str, ...]:  # type: ignore[override]
        """The columns of sensors whose readings are of the way from the row before."""
        return tuple(column for sensor in self._listed if sensor.keeps for column in sensor.columns(self))

    def observe(self, state: Tensor) -> None:
        """Sample what its sensors read; a vehicle that lists none has an `observe` of its own."""
        if not self.sensors:
            super().observe(state)
        for sensor in self._listed:
            sensor.observe(self, state)

    @property
    def _listed(self) -> Sequence[Any]:
        """Its sensors; ProgramError where something else is listed."""
        sensors = self.sensors if isinstance(self.sensors, Sequence) else [self.sensors]
        wrong = [one for one in sensors if isinstance(one, type) or not hasattr(one, "parts")]
        if wrong or not isinstance(self.sensors, Sequence):
            about = f"`sensors` is a list of sensors, as `(Ranges(sd=0.1),)`, got {(wrong or [self.sensors])[0]!r}"
            raise ProgramError(f"model {type(self).__name__}: {about}", site="sensors")
        if lost := [one for one in sensors if not kept_columns(type(self)).keys() >= {*one.keeps}]:
            keeps = f"its sensor {lost[0].name} keeps {', '.join(lost[0].keeps)}"
            about = f"{keeps}: list `sensors` in the body of the class"
            raise ProgramError(f"model {type(self).__name__}: {about}", site="sensors")
        return sensors

    def kept(self, state: Tensor, quantity: str) -> Tensor:
        """Something that the vehicle keeps of the row that ends with a state, `(..., n)`; zero in the first row.

        Args:
            state: `(..., D)`, as `observe` has it.
            quantity: acceleration: mean forward and lateral one, m/s²; turning: mean yaw acceleration, rad/s², and
                squared yaw rate, rad²/s²; direction: mean cosine and sine of the heading; travelled: way ahead, m;
                turned: rad; control: the row's, as it acted; before: x, y, heading, vx, vy and yaw_rate in the row
                before.

        Raises:
            ProgramError: the vehicle does not keep it.
        """
        begins = len(MOVING)
        for name, columns in kept_columns(type(self)).items():
            if name == quantity:
                return state[..., begins : begins + len(columns)]
            begins += len(columns)
        about = f"it does not keep {quantity!r}: name it in `keeps`"
        raise ProgramError(f"model {type(self).__name__}: {about}", site="keeps")

    def _places(self, columns: Mapping[str, Sequence[str]]) -> dict[str, tuple[int, ...]]:
        """The indices of measurements by their names, of those that stand side by side."""
        measured, found = list(self.measurement_names), {}
        for name, wanted in columns.items():
            begins = measured.index(wanted[0]) if wanted and wanted[0] in measured else 0
            if wanted and measured[begins : begins + len(wanted)] == list(wanted):
                found[name] = tuple(range(begins, begins + len(wanted)))
        return found

    @property
    def sees_bearings(self) -> bool:
        """Whether a bearing to each landmark, and nothing else, is measured."""
        return len(self.landmarks) > 0 and self.measurement_names == names(self._bearings)

    @property
    def landmark_columns(self) -> Mapping[str, tuple[int, ...]]:
        """Kind of what is read of landmarks → the measurements `bearing_0 [rad]`, … or `range_0 [m]`, …, where there is
        one a landmark, in order."""
        found = self._places({kind: [f"{kind}_{i}" for i in range(len(self.landmarks))] for kind in LANDMARK_UNITS})
        return {kind: at for kind, at in found.items() if self.measurement_units[at[0]] == LANDMARK_UNITS[kind]}

    @property
    def _bearings(self) -> tuple[str, ...]:
        return tuple(f"bearing_{i} [rad]" for i in range(len(self.landmarks)))

    def told(self, data: Trajectories) -> dict[str, tuple[Tensor, Tensor]]:
        """Also what listed sensors tell; a range tells that the vehicle is as near its nearest landmark."""
        readings = torch.where(data.observed, data.measurements, torch.nan)
        columns, found = self.sensor_columns, dict[str, tuple[Tensor, Tensor]]()
        listed = [(one, readings[..., list(columns[one.name])]) for one in self.sensor_parts if one.name in columns]
        for sensor, its in listed:
            for name, values in sensor.tells(its).items():
                found.setdefault(name, (values, torch.zeros_like(values)))
        listed_cells = torch.zeros_like(data.observed)  # their sensors speak for these, not their names
        for at in columns.values():
            listed_cells[..., list(at)] = data.observed[..., list(at)]
        by_name = super().told(data.without(listed_cells))
        found = {name: told for name, told in by_name.items() if not bool(told[0].isnan().all())} | found
        ranges = [its for sensor, its in listed if sensor.kind == "range"]
        ranges += [readings[..., list(at)] for kind, at in self.landmark_columns.items() if kind == "range"]
        if ranges and "x" not in found and not isinstance(self.landmarks, Tensor):  # a learned map tells nothing
            nearest = ranges[0].nan_to_num(math.inf).min(-1)
            away = torch.where(nearest.values.isinf(), torch.nan, nearest.values)
            places = away.new_tensor(self.landmarks)[nearest.indices] + 0 * away.unsqueeze(-1)
            found |= {"x": (places[..., 0], away), "y": (places[..., 1], away)}
        return found

    def integrate(self, state: Tensor, acceleration: Tensor, step: Tensor) -> Tensor:
        """Return the next state, `(..., 6)`, under an acceleration held in the body frame, to second order in the step.

        The acceleration acts at the heading in the middle of the step, averaged over the turn; the pose moves by the
        mean of the old and the new velocity.

        Args:
            state: `(..., 6)`.
            acceleration: `(..., 3)` forward, lateral (m/s²) and yaw (rad/s²), in the body frame.
            step: `(...)` s.
        """
        x, y, heading, vx, vy, yaw_rate = state.unbind(-1)
        forward, lateral, yaw = acceleration.unbind(-1)
        turn = (yaw_rate + 0.5 * yaw * step) * step
        # a turning push adds up to sin(turn / 2) / (turn / 2) of a straight one: so for small turns, bounded for large
        gained = step / (1 + turn * turn / 24)
        cos, sin = (heading + 0.5 * turn).cos() * gained, (heading + 0.5 * turn).sin() * gained
        more_vx, more_vy = cos * forward - sin * lateral, sin * forward + cos * lateral
        return stack(
            x + (vx + 0.5 * more_vx) * step,
            y + (vy + 0.5 * more_vy) * step,
            heading + turn,
            vx + more_vx,
            vy + more_vy,
            yaw_rate + yaw * step,
        )

    def halfway(self, state: Tensor, acceleration: Tensor, step: Tensor) -> Tensor:
        """Return the state in the middle of a step, `(..., 6)`: a step whose forces are taken there is of second order
        in them too."""
        return self.integrate(state, acceleration, 0.5 * step)

    def body_velocity(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Forward and lateral velocity (m/s) and yaw rate (rad/s), each `(...)`."""
        _, _, heading, vx, vy, yaw_rate = state[..., :6].unbind(-1)
        cos, sin = heading.cos(), heading.sin()
        return cos * vx + sin * vy, cos * vy - sin * vx, yaw_rate

    def velocities(self, state: Tensor) -> dict[str, Tensor]:
        """Velocity in the body frame and yaw rate by channel, each `(...)`."""
        return dict(zip(self.channel_names, self.body_velocity(state), strict=True))

    def settles_in(self, step: Tensor) -> Tensor | float:
        """Time constant of what the program holds, s: `settling`, or the step."""
        return step if self.settling is None else self.settling

    def carried(self, state: Tensor) -> dict[str, Tensor]:
        """Accelerations by channel that turn the velocity with the vehicle, `(...)` m/s²; zero without a `settling`."""
        forward, lateral, yaw_rate = self.body_velocity(state)
        turns = 0.0 if self.settling is None else yaw_rate
        parts = (-lateral * turns, forward * turns, torch.zeros_like(forward))
        return dict(zip(self.channel_names, parts, strict=True))

    def ranges(self, state: Tensor) -> Tensor:
        """Distances from the landmarks, `(..., K)` m."""
        places = _on_device(self.landmarks, state)
        return ((places - state[..., None, :2]).square().sum(-1) + NEAREST**2).sqrt()

    def earlier(self, state: Tensor, ago: Tensor) -> Tensor:
        """The state `ago` seconds before, `(..., D)`, in a steady curve: the velocity turns with the heading."""
        moved = super().earlier(state, ago)
        velocity = torch.stack(turned(-ago * state[..., 5], state[..., 3], state[..., 4]), -1)
        return torch.cat([moved[..., :3], velocity, moved[..., 5:]], -1)


def turned(angle: Tensor, ahead: Tensor, left: Tensor) -> tuple[Tensor, Tensor]:
    """A vector's components in axes from which its own are turned by an angle, rad anticlockwise; each `(...)`."""
    cos, sin = angle.cos(), angle.sin()
    return cos * ahead - sin * left, sin * ahead + cos * left


def stack(*components: Tensor) -> Tensor:
    """Stack components along the last dimension, laid out component by component so that each stays contiguous."""
    return torch.stack(torch.broadcast_tensors(*components)).movedim(0, -1)


def dense(layer: nn.Linear, inputs: Tensor) -> Tensor:
    """Apply a layer to inputs `(..., I)` that are laid out component by component, as its outputs `(..., O)` are.

    The numbers are those of `layer(inputs)` but for rounding. Products of few rows and many columns take half the time,
    their gradients a third.
    """
    if inputs.dim() < 2 or layer.bias is None:
        return layer(inputs)
    columns = inputs.movedim(-1, 0).flatten(1)
    outputs = torch.addmm(layer.bias.unsqueeze(-1), layer.weight, columns)
    return outputs.view(-1, *inputs.shape[:-1]).movedim(0, -1)


def bearings_to(
    landmarks: Sequence[Sequence[float]] | Tensor, state: Tensor, sd: float | Tensor, near: float = 0.1
) -> dist.Independent:
    """Return the distribution of bearings to landmarks relative to the heading, `(..., K)` rad, with independent noise.

    Nearer than `near` the noise grows as `near` over the distance, at most tenfold.

    Args:
        landmarks: `(K, 2)` m.
        state: `(..., 6)`, x, y and heading first.
        sd: rad.
        near: m.
    """
    places = _on_device(landmarks, state)
    x, y, heading = state[..., 0], state[..., 1], state[..., 2]
    to_x, to_y = places[:, 0] - x.unsqueeze(-1), places[:, 1] - y.unsqueeze(-1)
    nearness = (to_x * to_x + to_y * to_y).clamp(0.01 * near**2, near**2).rsqrt() * near
    bearing = torch.atan2(to_y, to_x) - heading.unsqueeze(-1)
    return WrappedNormal(bearing, sd * nearness).to_event(1)


def _on_device(landmarks: Sequence[Sequence[float]] | Tensor, state: Tensor) -> Tensor:
    """The landmarks beside the states; on a device they are kept, as copying there would wait for it at every step."""
    if isinstance(landmarks, Tensor) or state.device.type == "cpu":
        return torch.as_tensor(landmarks, dtype=state.dtype, device=state.device)
    return _kept_on_device(tuple((x, y) for x, y in landmarks), state.dtype, state.device)


@lru_cache(maxsize=16)
def _kept_on_device(landmarks: tuple[tuple[float, float], ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(landmarks, dtype=dtype, device=device)


class ExplicitEuler(PlanarVehicle):
    """A vehicle that takes the explicit Euler step of STEADY's authors, in simulation as well, for the paper's tables.

    It is put before a vehicle: `class AuthorsVehicle(ExplicitEuler, Hovercraft)`.
    """

    substeps = 1
    simulated_step = math.inf

    def integrate(self, state: Tensor, acceleration: Tensor, step: Tensor) -> Tensor:
        """With the old pose and velocity."""
        x, y, heading, vx, vy, yaw_rate = state.unbind(-1)
        forward, lateral, yaw = acceleration.unbind(-1)
        cos, sin = heading.cos(), heading.sin()
        return stack(
            x + vx * step,
            y + vy * step,
            heading + yaw_rate * step,
            vx + (cos * forward - sin * lateral) * step,
            vy + (sin * forward + cos * lateral) * step,
            yaw_rate + yaw * step,
        )

    def halfway(self, state: Tensor, acceleration: Tensor, step: Tensor) -> Tensor:
        return state


class UnknownMap(PlanarVehicle):
    """A vehicle whose landmarks are not where they were declared: they are learned together with its dynamics.

    It is put before a vehicle that declares them: `class Mine(UnknownMap, Hovercraft)`. Bearings alone leave the frame
    open: a map is learned only with known starts, with two `surveyed` landmarks, with a listed sensor of the position,
    or relative to where trajectories begin (`framed_by_start`), which is worth as much as `initial` is narrow.

    Attributes:
        surveyed: which landmarks are where they are declared, by index.
        framed_by_start: where and how trajectories begin is known well enough by `initial` alone.
        map: `(K, 2)` m, learnable.
    """

    surveyed: Sequence[int] = ()
    framed_by_start = False
    declared: Tensor
    stays: Tensor

    def __init__(self) -> None:
        super().__init__()
        declared = super().landmarks
        if not len(declared):
            example = "class Mine(UnknownMap, Hovercraft)"
            about = f"UnknownMap stands before the vehicle that declares landmarks, as in {example}"
            raise ProgramError(f"model {type(self).__name__}: {about}", site="__init__")
        for index in self.surveyed:
            if not 0 <= index < len(declared):
                about = f"surveyed names landmark {index}, there are 0 to {len(declared) - 1}"
                raise ProgramError(f"model {type(self).__name__}: {about}", site="surveyed")
        stays = torch.zeros(len(declared), 1, dtype=torch.bool)
        stays[list(self.surveyed)] = True
        self.register_buffer("declared", torch.as_tensor(declared, dtype=torch.get_default_dtype()), persistent=False)
        self.register_buffer("stays", stays, persistent=False)
        self.map = nn.Parameter(self.declared.clone())

    @property
    def landmarks(self) -> Tensor:  # type: ignore[override]
        """Where they are taken to be, `(K, 2)` m."""
        return torch.where(self.stays, self.declared, self.map)

    @property
    def surveyed_frame(self) -> bool:
        """Whether two landmarks, which fix the map's frame, are where they are declared."""
        return len(set(self.surveyed)) >= 2

    def prepare(self, data: Trajectories, known_start: bool) -> None:
        """Refuse, by UsageError, to learn a map whose frame nothing fixes."""
        sees_position = any(part.kind == "position" for part in self.sensor_parts)
        if not (known_start or self.surveyed_frame or self.framed_by_start or sees_position):
            raise UsageError(
                f"model {type(self).__name__}: nothing fixes the frame of its map: give known starts "
                "(--known-start), name two landmarks that are `surveyed`, list a sensor of the position, or set "
                "`framed_by_start = True` where `initial` is narrow"
            )
        super().prepare(data, known_start)
