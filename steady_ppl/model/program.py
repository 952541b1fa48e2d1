"""The form of a program: `initial`, `transition` and `observe` on a PyroModule, written for any shape on the left.

The latent variables are the start and the channel noise; the states follow from them, so no density over poses, which
would be singular, is ever needed. The engine runs the same three methods forward in time, for many particles, and for
all times at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, wraps
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NoReturn

import pyro
import torch
from pyro.nn import PyroModule, PyroParam, PyroSample
from torch import Tensor

from steady_ppl.errors import DataError, ProgramError
from steady_ppl.utils import context

if TYPE_CHECKING:
    from steady_ppl.data.trajectories import Trajectories

FIRST_MEASUREMENTS = "first measurements"  # a `start`
MIN_STEP, MAX_STEP = 1e-10, 1e9  # s between two rows; beyond these the time has another unit
MAX_NUMBERS_SHOWN = 12  # numbers of a parameter that are shown one by one


def _with_listed_effects(init: Callable[..., None]) -> Callable[..., None]:
    """An `__init__` after which the program, once the outermost is done, has the effects that its class lists."""

    @wraps(init)
    def wrapped(self: Any, *arguments: Any, **options: Any) -> None:
        outermost = "_begun" not in self.__dict__
        self.__dict__["_begun"] = True
        try:
            init(self, *arguments, **options)
        finally:
            if outermost:
                self.__dict__.pop("_begun", None)
        if outermost and self.effects:
            context.attach_listed(self)

    wrapped.attaches_effects = True  # type: ignore[attr-defined]
    return wrapped


def names(declared: Sequence[str]) -> tuple[str, ...]:
    """The names in a declaration such as `("left [N]", "right [N]")`."""
    return _parsed(tuple(declared))[0]


def units(declared: Sequence[str]) -> tuple[str, ...]:
    """The units in a declaration, empty where none is given."""
    return _parsed(tuple(declared))[1]


@cache
def _parsed(declared: tuple[str, ...]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    parts = [component.partition("[") for component in declared]
    return tuple(name.strip() for name, _, _ in parts), tuple(unit.rstrip("] ") for _, _, unit in parts)


def _components(declared: str) -> tuple[property, property]:
    """The names and the units of what a program declares."""
    named = property(lambda program: names(getattr(program, declared)), doc=f"Names of the `{declared}`.")
    return named, property(lambda program: units(getattr(program, declared)), doc=f"Units of the `{declared}`, or ''.")


class Program(PyroModule):
    """A state-space model as a Pyro program.

    A subclass declares its components as "name [unit]" and writes three methods. `...` is any shape, the same for all
    arguments: times and steps are `(...)`, states `(..., D)`, controls `(..., U)`.

    Example:
        A cart on a rail, pushed and braked, whose place is measured.

        >>> import pyro, torch
        >>> import pyro.distributions as dist
        >>> from pyro.distributions import constraints
        >>> from pyro.nn import PyroParam
        >>> from steady_ppl import Program, simulate, stack
        >>> class Cart(Program):
        ...     states = ("place [m]", "velocity [m/s]")
        ...     controls = ("force [N]",)
        ...     measurements = ("place [m]",)
        ...     channels = ("acceleration [m/s²]",)
        ...     motion = {"acceleration": ("place", "velocity")}
        ...
        ...     def __init__(self):
        ...         super().__init__()
        ...         self.mass = PyroParam(torch.tensor(2.0), constraints.positive)
        ...
        ...     def initial(self):
        ...         start = dist.Normal(torch.zeros(2), torch.tensor([1.0, 0.1]))
        ...         return pyro.sample("start", start.to_event(1))
        ...
        ...     def transition(self, state, control, time, step):
        ...         place, velocity = state.unbind(-1)
        ...         mean = control[..., 0] / self.mass
        ...         acceleration = pyro.sample("acceleration", dist.Normal(mean, 0.1))
        ...         faster = velocity + step * acceleration
        ...         return stack(place + step * (velocity + faster) / 2, faster)
        ...
        ...     def observe(self, state):
        ...         pyro.sample("place", dist.Normal(state[..., :1], 0.05).to_event(1))
        >>> drives = simulate(Cart(), trajectories=3, seed=0)
        >>> len(drives), drives.measurement_names
        (3, ('place',))

    What it is made of:
        states: names and units of the state's components.
        controls: names and units of the controls.
        measurements: names and units of the measurement's components, in the order of the observed sites.
        channels: names and units of the noise channels.
        state_names, state_units, …, channel_units: the same apart, a unit empty where none is given.
        angles: the state components that live on a circle.
        motion: channel → the state components that are its position and its velocity; the generic effects go by it.
        error_groups: what an error is reported for: name → components whose Euclidean norm it is.
        resting: state components that start at zero in every trajectory; a table need not have them.
        kept_names: those of them that are begun anew in every row.
        since_row_before: measurements that a first row cannot have; cells of the table are passed over.
        start: "first measurements" centres the prior of `initial` on each trajectory's first measurements, see
            `steady_ppl.model.starts`; "" leaves it as it is.
        roles: control → what it is, `{"delta": "steering"}`; one called as a role of `model.roles` has it by its name.
        effects: effects that the program has besides what it writes out: `("linear_drag=0.1", "slope=0.05,-0.03")`.
        substeps: in how many steps of `transition` the program takes a row; see `steady_ppl.model.substeps`.

    Hints for a fit, by the names of parameters or their beginnings:
        priors: parameter's name → its prior, a Pyro distribution over the parameter's value.
        guesses: those whose declared value is a guess, from which a fit may depart.
        rates: learning rates relative to the recipe's.
        decays: weight decay relative to the recipe's; only the matrices of `torch.nn.Linear` decay.

    Of a simulated trajectory:
        duration, step: s.
        simulated_step: the longest substep, s.
    """

    states: Sequence[str] = ()
    controls: Sequence[str] = ()
    measurements: Sequence[str] = ()
    channels: Sequence[str] = ()
    angles: Sequence[str] = ()
    motion: Mapping[str, tuple[str, str]] = {}
    error_groups: Mapping[str, Sequence[str]] = {}
    resting: Sequence[str] = ()
    kept_names: Sequence[str] = ()
    since_row_before: Sequence[str] = ()
    start: str = ""
    roles: Mapping[str, str] = {}
    effects: Sequence[str] = ()
    substeps: int = 1

    priors: Mapping[str, Any] = {}
    guesses: Sequence[str] = ()
    rates: Mapping[str, float] = {}
    decays: Mapping[str, float] = {}

    duration: float = 10.0
    step: float = 0.1
    simulated_step: float = 0.005

    @_with_listed_effects
    def __init__(self) -> None:
        # parameters belong to this object, not to Pyro's global store, where a second program would find them
        with pyro.settings.context(module_local_params=True):
            super().__init__()

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if not getattr(cls.__init__, "attaches_effects", False):
            cls.__init__ = _with_listed_effects(cls.__init__)  # type: ignore[method-assign]

    def __setattr__(self, name: str, value: Any) -> None:
        hidden = isinstance(value, PyroParam | PyroSample | torch.nn.Parameter) and hasattr(type(self), name)
        if hidden and not callable(getattr(type(self), name)):
            about = f"{name} is a constant of its class, which would hide the parameter: take another name"
            raise ProgramError(f"model {type(self).__name__}: {about}", site="__init__")
        super().__setattr__(name, value)

    def initial(self) -> Tensor:
        """Sample the start; returns the first state, `(..., D)`."""
        raise ProgramError(f"model {type(self).__name__} lacks the method initial(self)", site="initial")

    def transition(self, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
        """Sample the channel noise and move on by `step`; returns the next state, `(..., D)`."""
        method = "transition(self, state, control, time, step)"
        raise ProgramError(f"model {type(self).__name__} lacks the method {method}", site="transition")

    def observe(self, state: Tensor) -> None:
        """Sample the measurement of `state`, without `obs=`: the engine conditions and masks."""
        raise ProgramError(f"model {type(self).__name__} lacks the method observe(self, state)", site="observe")

    def actuators(self, control: Tensor, time: Tensor) -> Tensor:
        """Return the controls as they act, `(rows, trajectories, U)`: what lag, delay and wear make of commands.

        It is called with whole trajectories before `transition` sees a row of the result.

        Args:
            control: the commands, `(rows, trajectories, U)`.
            time: s since each trajectory's first row, `(rows, trajectories)`.
        """
        return control

    def between_rows(self, control: Tensor, time: Tensor) -> Tensor:
        """Return the commands of all substeps, `(rows · substeps, trajectories, U)`: held over a row.

        Arguments are those of `actuators`, which is given the result.
        """
        return control.repeat_interleave(self.substeps, 0)

    @property
    def acts_on_commands(self) -> bool:
        """Whether `actuators` or `between_rows` is not the one that takes commands as they are."""
        own, plain = type(self), Program
        return own.actuators is not plain.actuators or own.between_rows is not plain.between_rows

    state_names, state_units = _components("states")
    control_names, control_units = _components("controls")
    measurement_names, measurement_units = _components("measurements")
    channel_names, channel_units = _components("channels")
    resting_names = _components("resting")[0]

    @property
    def angle_indices(self) -> tuple[int, ...]:
        """Which state components live on a circle."""
        return tuple(self.state_names.index(name) for name in self.angles)

    @property
    def derivatives(self) -> Mapping[str, str]:
        """State component → the one that is its rate of change."""
        return {position: velocity for position, velocity in self.motion.values() if position and velocity}

    @property
    def axes(self) -> Mapping[str, tuple[str, ...]]:
        """Groups of channels to which one coefficient of a generic effect can belong; each of `motion` alone if not
        overridden."""
        return {channel: (channel,) for channel in self.motion}

    def told(self, data: Trajectories) -> dict[str, tuple[Tensor, Tensor]]:
        """Return what measurements say of single state components, name → values and by what standard deviation these
        may be off beside noise, each `(rows, trajectories)`, NaN where missing.

        A measurement tells the component that has its name and unit (`x`, or `gps_x` at the end of a longer name).
        """
        found: dict[str, tuple[Tensor, Tensor]] = {}
        readings = torch.where(data.observed, data.measurements, torch.nan)
        measured = list(zip(self.measurement_names, self.measurement_units, readings.unbind(-1), strict=True))
        for name, unit in zip(self.state_names, self.state_units, strict=True):
            for column, its_unit, values in measured:
                if unit == its_unit and (column == name or column.endswith(f"_{name}")):
                    found.setdefault(name, (values, torch.zeros_like(values)))
        return found

    def velocities(self, state: Tensor) -> dict[str, Tensor]:
        """The velocity that each channel accelerates, `(...)`."""
        return self._of_motion(state, 1)

    def positions(self, state: Tensor) -> dict[str, Tensor]:
        """The position that each channel moves, `(...)`, where it has one."""
        return self._of_motion(state, 0)

    def _of_motion(self, state: Tensor, which: int) -> dict[str, Tensor]:
        parts = {channel: moved[which] for channel, moved in self.motion.items() if moved[which]}
        return {channel: state[..., self.state_names.index(part)] for channel, part in parts.items()}

    def earlier(self, state: Tensor, ago: Tensor) -> Tensor:
        """The state `ago` seconds before, at its velocity, `(..., D)`."""
        order = self.state_names
        moved = list(state.unbind(-1))
        for position, velocity in self.derivatives.items():
            moved[order.index(position)] = moved[order.index(position)] - ago * state[..., order.index(velocity)]
        return torch.stack(torch.broadcast_tensors(*moved), -1)

    def control_index(self, name: str) -> int:
        """The column of a control."""
        return self.control_names.index(name)

    def chosen_controls(self, chosen: Sequence[str], like: Tensor) -> Tensor:
        """One for the controls that are named and zero for the others, `(U,)`."""
        return like.new_tensor([float(name in chosen) for name in self.control_names])

    def with_effect(
        self, effect: object, value: float | Sequence[float] | Tensor | None = None, **where: object
    ) -> Program:
        """A copy with a physical effect added, its coefficient a learnable parameter; see `effects.attach`."""
        return context.with_effect(self, effect, value, **where)

    def example_controls(self, time: Tensor) -> Tensor:
        """Controls to simulate with, `(rows, trajectories, U)` at times `(rows, trajectories)`; zero by default."""
        return time.new_zeros((*time.shape, len(self.controls)))

    def prepare(self, data: Trajectories, known_start: bool) -> None:
        """Called once before learning, with the training table; a network sets its normalisation here."""

    def extra_repr(self) -> str:
        """The values of the program's own parameters."""
        own = [parameter_name(name) for name, _ in self.named_parameters(recurse=False)]
        return ", ".join(f"{name}={_rounded(getattr(self, name))}" for name in own)


def parameter_name(name: str) -> str:
    """The name under which a program declares what `named_parameters` and `state_dict` call `name`."""
    return name.removesuffix("_unconstrained")


def _rounded(value: Tensor) -> Any:
    values = [float(f"{v:.4g}") for v in value.detach().flatten().tolist()]
    return values[0] if value.dim() == 0 else values


def error_indices(program: Program) -> dict[str, tuple[int, ...]]:
    """What errors are reported for: name → indices of the state components; each component alone by default."""
    order = program.state_names
    groups = program.error_groups or {name: (name,) for name in order}
    return {group: tuple(order.index(name) for name in members) for group, members in groups.items()}


@torch.no_grad()
def parameter_rows(program: Program) -> list[tuple[str, str]]:
    """Name and value of each learnable parameter; of many numbers how many, and their range."""
    rows = []
    for name in dict.fromkeys(parameter_name(name) for name, _ in program.named_parameters()):
        value = attrgetter(name)(program)
        numbers = value.flatten().tolist()
        said = ", ".join(f"{number:.4g}" for number in numbers)
        if len(numbers) > MAX_NUMBERS_SHOWN:
            said = f"{' × '.join(map(str, value.shape))} numbers from {min(numbers):.4g} to {max(numbers):.4g}"
        rows.append((name, said))
    return rows


def unit_of(program: Program, variable: str) -> str:
    """Of what a program declares, time, a channel's velocity or what is commanded of it, or a product of velocities;
    empty where it is not declared."""
    declared = (*program.measurements, *program.controls, *program.states)
    found = {"time": "s"} | dict(zip(names(declared), units(declared), strict=True))
    if variable in found:
        return found[variable]
    of_channel = dict(zip(program.channel_names, program.channel_units, strict=True))
    if variable.startswith("commanded "):
        return of_channel.get(variable.removeprefix("commanded "), "")
    parts = [of_channel.get(part.strip().removesuffix(" velocity"), "") for part in variable.split("×")]
    return " · ".join(unit.replace("/s²", "/s") for unit in parts)


def for_program(program: Program, data: Trajectories) -> Trajectories:
    """The columns that the program reads, in its order, its precision and on its device."""
    chosen = data.select(program.control_names, program.measurement_names, program.state_names)
    if chosen.states is not None and program.resting:
        resting = [program.state_names.index(name) for name in program.resting_names]
        chosen.states[0][..., resting] = 0.0
    if later := names(program.since_row_before):
        chosen.observed[0][..., [name in later for name in program.measurement_names]] = False
    parameter = next(program.parameters(), torch.empty(0, device=data.time.device))
    return _within(chosen.to(parameter.dtype, parameter.device))


def _within(data: Trajectories) -> Trajectories:
    """Refuse numbers that are infinite in the drives' precision (as 1e300 in single) and steps that are no seconds."""

    def refuse(column: str, drive: int, row: int, said: str) -> NoReturn:
        label = data.labels[drive]
        message = f"column {column}, trajectory {label}, its row {row + 1}: {said}"
        raise DataError(message, column=column, trajectory=label)

    blocks = [("u", data.controls, data.control_names), ("y", data.measurements, data.measurement_names)]
    if data.states is not None:
        blocks.append(("x", data.states, data.state_names))
    for prefix, values, columns in blocks:
        for row, drive, index in values.isinf().nonzero()[:1].tolist():
            said = f"the number is beyond {torch.finfo(values.dtype).max:.2g}, the largest"
            refuse(f"{prefix}.{columns[index]}", drive, row, said)
    odd = data.transitions & ((data.steps < MIN_STEP) | (data.steps > MAX_STEP))
    for row, drive in odd.nonzero()[:1].tolist():
        step = float(data.time[row + 1, drive] - data.time[row, drive])
        said = f"time goes on by {step:.3g} s, expected {MIN_STEP:g} to {MAX_STEP:g} s from row to row"
        refuse("time", drive, row + 1, f"{said}: is it in seconds?")
    return data
