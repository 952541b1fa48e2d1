"""What an effect is: a name, an equation, and a function that says how it acts on a program.

The function is written like a method of the program (`self` is the program, shapes as in `transition` and `observe`)
with the coefficient as `c`. The form says what it takes and returns:

    push       (self, state, control, time, step, c)   adds to channels' means: {channel: (...)}; may ask for `mean`
    command    (self, state, control, time, c)         the control that acts, (..., U)
    history    (self, control, time, c)                the same of whole trajectories, (rows, trajectories, U)
    between    (self, control, time, c)                that of all substeps, (rows · substeps, trajectories, U)
    measured   (self, state, measured, c)              what is measured on average, (..., K)
    viewpoint  (self, state, c)                        the state that is measured, (..., D)
    spread     (self, state, control, time, c)         factors on channels' standard deviations: {channel: (...)}
    blur       (self, state, c)                        factors on the measurements' standard deviations, (..., K)
    tails      (self, c)                               one over the degrees of freedom of the measurement noise, ()
    colour     (self, c)                               share of a channel's last deviation that stays: {channel: (...)}
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import UsageError
from steady_ppl.model.program import Program
from steady_ppl.model.roles import ROLES, controls_of

VERDICT_OF_FORM = {
    "push": "dynamics",
    **dict.fromkeys(("command", "history", "between"), "actuator"),
    **dict.fromkeys(("measured", "viewpoint"), "sensor"),
    **dict.fromkeys(("spread", "blur", "tails", "colour"), "noise"),
}
Choices = Sequence[Mapping[str, Any]]  # of a function's further arguments
Names = Sequence[str]  # of channels or controls
Need = tuple[Callable[[Any], object], str]  # what must hold for a program, and the reason why an effect lacks it
Means = Mapping[str, Tensor]  # of channels, `(...)`
Pushes = dict[str, Tensor]  # of channels, `(...)`
Value = float | Sequence[float] | Tensor  # of a coefficient, before it is a tensor
Function = TypeVar("Function", bound=Callable[..., Any])


def needs(*conditions: Need) -> Callable[[Program], str | None]:
    """Return what an effect `lacks`: the reason of the first condition that does not hold for a program."""
    return lambda program: next((reason for holds, reason in conditions if not holds(program)), None)


def has_role(*roles: str) -> Need:
    """Return the need of a control that has one of some roles."""
    texts = [ROLES[role].text + f" ({ROLES[role].unit})" * bool(ROLES[role].unit) for role in roles]
    example = f'roles = {{"NAME": "{roles[-1]}"}}'
    listed = " or ".join(filter(None, [", ".join(texts[:-1]), texts[-1]]))
    reason = f"no control is {listed}: declare one in `roles`, as {example}"
    return lambda program: controls_of(program, *roles), reason


@dataclass(frozen=True, eq=False)
class Effect:
    """A physical effect that a program may lack.

    Attributes:
        name: as users write it.
        form: how it acts, see the module.
        equation: in LaTeX.
        text: the equation in plain text.
        unit: of the coefficient.
        feels: what it feels like on the vehicle, in a line.
        occurs: on which machines it is met, in a line.
        function: how it acts.
        typical: a coefficient that is clearly felt; `(k,)` values for a vector.
        limit: magnitudes beyond this are hardly physical; the scale of the prior, but for a factor on noise.
        sign: of the coefficient where physics fixes it, else 0.
        null: the coefficient at which the effect is absent.
        components: names of a vector coefficient's components.
        between: the least and the most that can be given as a coefficient.
        probes: finite coefficients at which it is screened as well, for effects that do not grow in proportion.
        choices: the function's further arguments, a mapping a choice: channels, controls or component, called `at`, and
            knees, widths or places.
        profiled: the arguments among these that are knees, widths or places.
        by_factor: those of the profiled that are positive and uncertain by a factor; choices are spaced by ratios.
        prior: of the coefficient, a Pyro distribution; if None a Cauchy of scale `limit`, of a factor a log-normal.
        lacks: why it does not apply to a program, or None.
    """

    name: str
    form: str
    equation: str
    text: str
    unit: str
    feels: str
    function: Callable[..., Any]
    typical: float | tuple[float, ...]
    limit: float
    occurs: str = ""
    sign: int = 0
    null: float = 0.0
    components: tuple[str, ...] = ()
    between: tuple[float, float] = (-math.inf, math.inf)
    probes: tuple[float, ...] = ()
    choices: Callable[[Program, Trajectories | None], Choices] = field(default=lambda program, data: [{}])
    profiled: tuple[str, ...] = ()
    by_factor: tuple[str, ...] = ()
    prior: Any = None
    lacks: Callable[[Program], str | None] = field(default=lambda program: None)

    def __post_init__(self) -> None:
        typical = self.typical if isinstance(self.typical, tuple) else (self.typical,)
        felt = any(typical) and all(map(math.isfinite, typical))
        for holds, problem in (
            (self.form in VERDICT_OF_FORM, f"no form {self.form!r}; there are {', '.join(VERDICT_OF_FORM)}"),
            ("c" in inspect.signature(self.function).parameters, "its function takes no coefficient c"),
            (len(typical) == self.size, f"{len(typical)} typical numbers for {self.size} components"),
            (felt, f"its typical coefficient must be finite and not zero, got {self.typical}"),
            (not (self.components and self.sign), "a coefficient of several components has no sign"),
            (set(self.by_factor) <= set(self.profiled), f"of {self.by_factor} not all are profiled"),
            (self.limit > 0, f"its limit is a magnitude above zero, got {self.limit}"),
        ):
            if not holds:
                raise UsageError(f"effect {self.name}: {problem}")

    @property
    def verdict(self) -> str:
        """dynamics, actuator, sensor or noise."""
        return VERDICT_OF_FORM[self.form]

    @property
    def size(self) -> int:
        """How many components the coefficient has."""
        return max(1, len(self.components))

    def variants(self, program: Program, data: Trajectories | None = None) -> list[Variant]:
        """All ways in which it could act on a program; knees and places are chosen for `data` where given, and the
        scale is left to `Sizes`."""
        if self.lacks(program):
            return []
        found = [self.variant(**choice) for choice in self.choices(program, data)]
        for name in self.by_factor:
            if any(not variant.options[name] > 0 for variant in found):
                raise UsageError(
                    f"effect {self.name}: {name} is uncertain by a factor, so that its choices are above zero"
                )
        return [replace(variant, unit=_unit(program, variant)) for variant in found]

    def variant(self, at: str = "", **options: Any) -> Variant:
        """The effect with everything settled but its coefficient."""
        return Variant(self, at, options, unit=self.unit)


def declare(effects: list[Effect], form: str, unit: str, **more: Any) -> Callable[[Function], Function]:
    """Append to a list the effect that the function below is, with what its docstring begins with and labels.

    It has the function's name unless `more` gives another one.
    """

    def append(function: Function) -> Function:
        text, _, labelled = inspect.cleandoc(function.__doc__ or "").partition("\n\n")
        told: dict[str, Any] = {"name": function.__name__, "equation": "", "feels": ""}  # no docstrings in python -OO
        for label, phrase in re.findall(r"^(equation|feels|occurs): (.+(?:\n .+)*)", labelled, re.MULTILINE):
            told[label] = " ".join(phrase.split())
        effects.append(Effect(form=form, text=text, unit=unit, function=function, **{**told, **more}))
        return function

    return append


@dataclass(frozen=True, eq=False)
class Variant:
    """An effect with everything settled but its coefficient."""

    effect: Effect
    at: str  # where it acts, if there is a choice
    options: Mapping[str, Any]  # the further arguments of its function
    called: str = ""  # another name for the coefficient, where a program has a parameter of the effect's name
    scale: float = 1.0  # of the effect's probes, limit and typical value for the drives that were looked at
    unit: str = ""  # of the coefficient in this program

    @property
    def probes(self) -> list[float]:
        """Finite coefficients at which it is screened as well."""
        return [self.scale * probe for probe in self.effect.probes]

    @property
    def typical(self) -> Tensor:
        """A coefficient that is clearly felt, `(k,)`."""
        return self.scale * torch.as_tensor(self.effect.typical).flatten()

    @property
    def limit(self) -> float:
        """A magnitude beyond which it is hardly physical."""
        return self.scale * self.effect.limit

    @property
    def profiled(self) -> dict[str, Any]:
        """Knees, widths, places."""
        return {name: self.options[name] for name in self.effect.profiled}

    @property
    def parameter(self) -> str:
        """The name of the coefficient among a program's parameters."""
        return self.called or (f"{self.effect.name}_{self.at}" if self.at else self.effect.name)

    @property
    def name(self) -> str:
        """As users write it: the effect and, after a colon, where."""
        return f"{self.effect.name}:{self.at}" if self.at else self.effect.name

    @property
    def written(self) -> str:
        """The name and what was profiled, as users write it: `thrust_saturation:knee=0.6`."""
        return ":".join([self.name, *(f"{name}={value!r}" for name, value in self.profiled.items())])

    @property
    def label(self) -> str:
        """The name and what was profiled."""
        said = ", ".join(f"{name} {value:.3g}" for name, value in self.profiled.items())
        return f"{self.name} ({said})" if said else self.name

    def coefficient(self, value: Value | None, like: Tensor) -> Tensor:
        """A value as a tensor of its own, the typical one when None; UsageError for another number of components."""
        given = torch.as_tensor(self.effect.typical if value is None else value, dtype=like.dtype, device=like.device)
        wanted = self.effect.components
        if not wanted and given.shape == (1,):
            given = given[0]
        if given.shape != torch.Size([len(wanted)] if wanted else []):
            takes = f"{len(wanted)} numbers ({', '.join(wanted)})" if wanted else "one number"
            raise UsageError(f"effect {self.effect.name} takes {takes}, got {given.numel()}")
        return given.clone()

    def require_meaning(self, value: Value | None) -> None:
        """Raise UsageError for a coefficient outside of the effect's bounds."""
        least, most = self.effect.between
        given = torch.as_tensor(self.effect.typical if value is None else value)
        if bool(((given < least) | (given > most)).any()):
            bounds = f"at least {least:g}" if math.isinf(most) else f"between {least:g} and {most:g}"
            numbers = ", ".join(f"{number:.4g}" for number in given.flatten().tolist())
            raise UsageError(f"effect {self.effect.name} takes a number {bounds}, got {numbers}")

    def absent(self, like: Tensor) -> Tensor:
        """The coefficient without the effect."""
        return like.new_full((self.effect.size,) if self.effect.components else (), self.effect.null)

    def __call__(self, program: Program, *arguments: Any, c: Tensor, mean: Means | None = None) -> Any:
        """Call the effect's function with its options and, where it asks, the channels' means without the effect."""
        options = {**self.options, "mean": mean} if self.needs_mean else self.options
        return self.effect.function(program, *arguments, c=c, **options)

    @cached_property
    def needs_mean(self) -> bool:
        """Whether it depends on what the channels' means are without it."""
        return "mean" in inspect.signature(self.effect.function).parameters


def effects_of(kind: type[Program], *forms: str) -> tuple[Variant, ...]:
    """The effects that a class lists or that were added to it, of some forms or of any, in their order."""
    every = (vars(one)["_attached"] for one in reversed(kind.__mro__) if "_attached" in vars(one))
    return tuple(variant for variant in every if not forms or variant.effect.form in forms)


def attached(program: Program) -> tuple[Variant, ...]:
    """The effects that a program's class lists or that were added to it, in their order."""
    return effects_of(type(program))


def coefficient(program: Program, variant: Variant) -> Tensor:
    """The value of an effect's coefficient in a program that has it."""
    return getattr(program, variant.parameter)


def _unit(program: Program, variant: Variant) -> str:
    """The coefficient's unit in a program whose controls, measurements and channels have units of their own."""
    unit, options = variant.effect.unit, variant.options
    if unit == "of the control" and "controls" in options:
        return program.control_units[program.control_names.index(options["controls"][0])] or unit
    if unit == "of the measurement" and "component" in options:
        return program.measurement_units[options["component"]] or unit
    if "channels" in options and variant.effect.form == "push":
        of_channel = program.channel_units[program.channel_names.index(options["channels"][0])]
        moved = of_channel.removesuffix("/s²")
        if moved and moved != of_channel and not unit.startswith(("rad", "1/rad")):
            return re.sub(r"(?<![a-z])m(?![a-z])", moved, unit)
    return unit
