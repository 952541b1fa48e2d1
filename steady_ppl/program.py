"""The form of a program: `initial`, `transition` and `observe` on a PyroModule, written for any shape on the left.

The latent variables are the start and the channel noise; the states follow from them, so no density over poses, which
would be singular, is ever needed. The engine runs the same three methods forward in time, for many particles, and for
all times at once.
"""

from __future__ import annotations

import importlib.util
import inspect
import itertools
import sys
from collections.abc import Mapping, Sequence
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

import pyro
import torch
from pyro.nn import PyroModule, PyroParam, PyroSample
from pyro.nn.module import _PyroModuleMeta
from torch import Tensor

from steady_ppl.errors import ProgramError, SteadyError

if TYPE_CHECKING:
    from steady_ppl.data import Trajectories

_LOADS = itertools.count()


class _WithEffects(_PyroModuleMeta):
    """Adds the effects that a class lists when one of it is made."""

    effects: Sequence[str]

    def __call__(cls, *arguments: Any, **options: Any) -> Any:
        program = super().__call__(*arguments, **options)
        if cls.effects:
            from steady_ppl.effects import attach, chosen_variant, parsed

            for text in cls.effects:
                name, at, where, value = parsed(text)
                attach(program, chosen_variant(program, name, at, **where), value)
        return program


class Program(PyroModule, metaclass=_WithEffects):
    """A state-space model as a Pyro program.

    A subclass declares its components as "name [unit]" and writes three methods. `...` is any shape, the same for all
    arguments: times and steps are `(...)`, states `(..., D)`, controls `(..., U)`.

    Attributes:
        states: names and units of the state's components.
        controls: names and units of the controls.
        measurements: names and units of the measurement's components, in the order of the observed sites.
        channels: names and units of the noise channels.
        angles: the state components that live on a circle.
        error_groups: what an error is reported for: name → components whose Euclidean norm it is.
        motion: channel → the state components that are its position and its velocity; the generic effects go by it.
        effects: names of effects that the program has besides what it writes out, see `steady_ppl.effects`.
        attached: coefficient's name → the effect that a program written by `steady add` has, as users write it.
        guesses: beginnings of the names of parameters whose declared value is a guess, from which a fit may depart.
        priors: parameter's name → its prior, a Pyro distribution over the parameter's value.
        rates: learning rates relative to the recipe's, by the beginning of a parameter's name.
        decays: weight decay relative to the recipe's, by the beginning of a parameter's name; only the matrices of
            `torch.nn.Linear` decay.
        resting: state components that start at zero in every drive; a table need not have them.
        duration, step: of a simulated trajectory, s.
    """

    states: Sequence[str] = ()
    controls: Sequence[str] = ()
    measurements: Sequence[str] = ()
    channels: Sequence[str] = ()
    angles: ClassVar[Sequence[str]] = ()
    error_groups: ClassVar[Mapping[str, Sequence[str]]] = {}
    motion: ClassVar[Mapping[str, tuple[str, str]]] = {}
    effects: ClassVar[Sequence[str]] = ()
    attached: ClassVar[Mapping[str, Any]] = {}
    guesses: ClassVar[Sequence[str]] = ()
    priors: ClassVar[Mapping[str, Any]] = {}
    rates: ClassVar[Mapping[str, float]] = {}
    decays: ClassVar[Mapping[str, float]] = {}
    resting: Sequence[str] = ()
    duration: float = 10.0
    step: float = 0.1

    def __init__(self) -> None:
        # parameters belong to this object, not to Pyro's global store, where a second program would find them
        with pyro.settings.context(module_local_params=True):
            super().__init__()

    def __setattr__(self, name: str, value: Any) -> None:
        hidden = isinstance(value, PyroParam | PyroSample | torch.nn.Parameter) and hasattr(type(self), name)
        if hidden and not callable(getattr(type(self), name)):
            raise ProgramError(
                f"program {type(self).__name__}: {name} is a constant of its class, behind which a parameter of that "
                "name would never be seen: take another name",
                site="__init__",
            )
        super().__setattr__(name, value)

    def initial(self) -> Tensor:
        """Sample the start; returns the first state, `(..., D)`."""
        raise ProgramError(f"program {type(self).__name__} lacks the method initial(self)", site="initial")

    def transition(self, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
        """Sample the channel noise and move on by `step`; returns the next state, `(..., D)`."""
        raise ProgramError(
            f"program {type(self).__name__} lacks the method transition(self, state, control, time, step)",
            site="transition",
        )

    def observe(self, state: Tensor) -> None:
        """Sample the measurement of `state`, without `obs=`: the engine conditions and masks."""
        raise ProgramError(f"program {type(self).__name__} lacks the method observe(self, state)", site="observe")

    def actuators(self, control: Tensor, time: Tensor) -> Tensor:
        """The controls as they act, `(rows, trajectories, U)`: what lag, delay and wear make of the commands.

        Called with whole trajectories before `transition` sees a row of the result.

        Args:
            control: the commands, `(rows, trajectories, U)`.
            time: s since each trajectory's first row, `(rows, trajectories)`.
        """
        return control

    @property
    def axes(self) -> Mapping[str, tuple[str, ...]]:
        """Channels that one coefficient of a generic effect can belong to, by the name of the group; each channel of
        `motion` alone unless a program knows better."""
        return {channel: (channel,) for channel in self.motion}

    def velocities(self, state: Tensor) -> dict[str, Tensor]:
        """The velocity that each channel accelerates, `(...)`."""
        order = names(self.states)
        return {channel: state[..., order.index(velocity)] for channel, (_, velocity) in self.motion.items()}

    def positions(self, state: Tensor) -> dict[str, Tensor]:
        """The position that each channel moves, `(...)`, where it has one."""
        order = names(self.states)
        return {channel: state[..., order.index(position)] for channel, (position, _) in self.motion.items()}

    def earlier(self, state: Tensor, ago: Tensor) -> Tensor:
        """The state `ago` seconds before, at its velocity, `(..., D)`."""
        order = names(self.states)
        moved = list(state.unbind(-1))
        for position, velocity in self.motion.values():
            if position and velocity:
                moved[order.index(position)] = moved[order.index(position)] - ago * state[..., order.index(velocity)]
        return torch.stack(torch.broadcast_tensors(*moved), -1)

    def control_index(self, name: str) -> int:
        """Which column of `control` a control has."""
        return names(self.controls).index(name)

    def chosen_controls(self, chosen: Sequence[str], like: Tensor) -> Tensor:
        """One for the controls that are named and zero for the others, `(U,)`."""
        return like.new_tensor([float(name in chosen) for name in names(self.controls)])

    def with_effect(self, effect: Any, value: Any = None, **where: Any) -> Program:
        """A copy with a physical effect added, its coefficient a learnable parameter; see `effects.attach`."""
        from steady_ppl.effects import with_effect

        return with_effect(self, effect, value, **where)

    def example_controls(self, time: Tensor) -> Tensor:
        """Controls of simulated drives, `(rows, trajectories, U)` at `time` of `(rows, trajectories)`; zero unless
        a program knows better."""
        return time.new_zeros((*time.shape, len(self.controls)))

    def prepare(self, data: Trajectories, known_start: bool) -> None:
        """Called once before learning, with the training table; a network sets its normalisation here."""

    def extra_repr(self) -> str:
        """The values of the program's own parameters."""
        own = {
            name.removesuffix("_unconstrained"): getattr(self, name.removesuffix("_unconstrained"))
            for name, _ in self.named_parameters(recurse=False)
        }
        return ", ".join(f"{name}={_rounded(value)}" for name, value in own.items())


def _rounded(value: Tensor) -> Any:
    values = [float(f"{v:.4g}") for v in value.detach().flatten().tolist()]
    return values[0] if value.dim() == 0 else values


def names(declared: Sequence[str]) -> tuple[str, ...]:
    """The names in a declaration such as `("left [N]", "right [N]")`."""
    return tuple(component.split("[")[0].strip() for component in declared)


def units(declared: Sequence[str]) -> tuple[str, ...]:
    """The units in a declaration, empty where none is given."""
    return tuple(component.partition("[")[2].rstrip("] ") for component in declared)


def error_groups(program: Program) -> dict[str, tuple[int, ...]]:
    """What errors are reported for: name → indices of the state components; each component alone by default."""
    order = names(program.states)
    groups = program.error_groups or {name: (name,) for name in order}
    return {group: tuple(order.index(name) for name in members) for group, members in groups.items()}


def acting_controls(program: Program, data: Trajectories) -> Tensor:
    """The controls of drives as they act on the program, `(T + 1, B, U)`."""
    return program.actuators(data.controls, data.elapsed)


def for_program(program: Program, data: Trajectories) -> Trajectories:
    """The columns that the program reads, in its order, its precision and on its device."""
    chosen = data.select(names(program.controls), names(program.measurements), names(program.states))
    if chosen.states is not None and program.resting:
        resting = [names(program.states).index(name) for name in names(program.resting)]
        chosen.states[0][..., resting] = 0.0
    parameter = next(program.parameters(), None)
    if parameter is None:
        return chosen.to(torch.get_default_dtype())
    return chosen.to(parameter.dtype, parameter.device)


def load_program(source: str | Path) -> Program:
    """Load a program by path: `models/hovercraft.py` (the class named after the file) or `mine.py:Boat`.

    The file is run afresh under a private module name; `from .sibling import …` finds files of its own folder.

    Raises:
        ProgramError: the file does not exist or does not import, or has no such class.
    """
    path, _, class_name = str(source).rpartition(":")
    if not class_name.isidentifier() or not path:
        path, class_name = str(source), ""
    file = Path(path)
    class_name = class_name or "".join(word.capitalize() for word in file.stem.split("_"))
    module = run_file(file)
    program_class = getattr(module, class_name, None)
    if not (inspect.isclass(program_class) and issubclass(program_class, Program)):
        own = [c for c in vars(module).values() if inspect.isclass(c) and c.__module__ == module.__name__]
        have = ", ".join(c.__name__ for c in own if issubclass(c, Program)) or "none"
        if inspect.isclass(program_class):
            have += f"; its class {class_name} derives from no steady_ppl.Program"
        raise ProgramError(f"{file.name} has no program {class_name}; its programs: {have} (choose with {path}:NAME)")
    try:
        return program_class()
    except SteadyError:
        raise
    except (Exception, SystemExit) as error:
        raise ProgramError(f"{class_name}() of {file.name} failed: {one_line(error)}") from error


class _AsWritten(SourceFileLoader):
    """Compiles what the file says now: a cache goes by size and whole seconds, which misses a digit edited quickly."""

    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)


def run_file(file: Path) -> ModuleType:
    """Run a Python file as a module of a private package that stands for its folder.

    Raises:
        ProgramError: the file does not exist or raises while it is imported.
    """
    if not file.is_file():
        raise ProgramError(f"no file {file}")
    folder = file.resolve().parent
    package = f"_steady_folder_{next(_LOADS)}"
    parent = ModuleType(package)
    parent.__path__ = [str(folder)]
    sys.modules[package] = parent
    if file.suffix != ".py":
        raise ProgramError(f"{file} is not a Python file")
    name = f"{package}.{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file, loader=_AsWritten(name, str(file)))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        message = one_line(error).replace(f"{package}.", ".")
        raise ProgramError(f"{file} does not import: {_place(folder, file, error)}: {message}") from error
    return module


def one_line(error: BaseException) -> str:
    """An error's type and the first line of its message."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def _place(folder: Path, file: Path, error: BaseException) -> str:
    """The last line in one of the folder's files on the way to an error."""
    if isinstance(error, SyntaxError) and error.lineno is not None:
        return f"line {error.lineno} of {Path(error.filename or file).name}"
    place, trace = file.name, error.__traceback__
    while trace is not None:
        passed = Path(trace.tb_frame.f_code.co_filename)
        if passed.resolve().parent == folder:
            place = f"line {trace.tb_lineno} of {passed.name}"
        trace = trace.tb_next
    return place
