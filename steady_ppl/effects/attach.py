"""A program with an effect: the same three methods, around which the effect acts."""

import copy
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary, WeakValueDictionary

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import Tensor

from steady_ppl.effects.declaration import Effect, Value, Variant, attached, coefficient, effects_of
from steady_ppl.effects.registry import chosen_variant, parsed
from steady_ppl.errors import UsageError
from steady_ppl.model import interventions
from steady_ppl.model.program import Program, names

Methods = dict[str, Any]
SD_OF_LOG_FACTOR = 1.0  # of a factor on noise: ten times too wide or too narrow costs a fit 2.7 nats
_CLASSES: WeakKeyDictionary[type[Program], WeakValueDictionary[Hashable, type[Program]]] = WeakKeyDictionary()


def with_effect(
    program: Program, effect: str | Effect | Variant, value: Value | None = None, **options: Any
) -> Program:
    """Return a copy of a program with an effect, its coefficient a learnable parameter `effect` or `effect_where`.

    Args:
        effect: a catalogue name ("linear_drag", "gain_error:turn", "landmark_bias:2"), or one of your own.
        value: the coefficient; the effect's typical one when None.
        options: knees, widths, places (`knee=0.6`); the first of its choices when not given.

    Raises:
        UsageError: no such effect, it does not apply to the program, is there already or takes other numbers.
    """
    variant = effect if isinstance(effect, Variant) else chosen_variant(program, effect, **options)
    variant.require_meaning(value)
    return attach(copy.deepcopy(program), variant, value)


def attach(program: Program, variant: Variant, value: Value | None = None, *, class_name: str | None = None) -> Program:
    """Add an effect to this very program, whose class is named after it and the effect without a `class_name`."""
    if variant.name in [known.name for known in attached(program)]:
        raise UsageError(f"model {type(program).__name__} has the effect {variant.name} already")
    if hasattr(program, variant.parameter):  # a parameter of its own that has nothing to do with it
        variant = replace(variant, called=f"{variant.parameter}_effect")
    name, effect = variant.parameter, variant.effect
    start = _start(variant, value, next(program.parameters(), torch.zeros(())))
    program.__class__ = _class_with(type(program), variant, class_name)
    with pyro.settings.context(module_local_params=True):
        setattr(program, name, PyroParam(start, _constraint(effect)))
    wide = _wide_prior(variant, variant.limit)
    program.priors = {**program.priors, name: wide if effect.prior is None else effect.prior}
    rate = float(variant.typical.abs().max()) if effect.null == 0 else 1.0  # Adam's steps are of this size in any unit
    program.rates = {name: rate, **program.rates}
    return program


def _class_with(base: type[Program], variant: Variant, name: str | None) -> type[Program]:
    """A program's class with an effect; the same one for the same effect and name, so that kernels are shared."""
    name = name or f"{base.__name__}With{''.join(part.capitalize() for part in variant.parameter.split('_'))}"
    known = _CLASSES.setdefault(base, WeakValueDictionary())
    options = variant.options.items()
    key = _frozen((name, variant.effect, variant.at, *options, variant.called, variant.scale, variant.unit))
    if (grown := known.get(key)) is None:
        about = {"__module__": base.__module__, "__doc__": base.__doc__, "_attached": variant}
        methods = _METHODS_OF_FORM[variant.effect.form](base, variant)
        known[key] = grown = type(name, (base,), {**about, **methods})
    return grown


def _frozen(value: object) -> Hashable:
    """A value that can be a key; of arrays and other objects it is the object itself."""
    if isinstance(value, tuple | list):
        return tuple(map(_frozen, value))
    return value if isinstance(value, Hashable) else id(value)


def _wide_prior(variant: Variant, width: float) -> dist.Cauchy | dist.LogNormal:
    """As wide as is physical. A factor's density is largest at one: drives that show no noise at all tell no least
    factor, and a Cauchy, flat near zero, would let it go there. Half of it is above e."""
    if variant.effect.null == 1:
        return dist.LogNormal(SD_OF_LOG_FACTOR**2, SD_OF_LOG_FACTOR)  # mode one
    return dist.Cauchy(0.0, width)


def attach_listed(program: Program) -> Program:
    """Give this very program the effects that its class lists."""
    for text in program.effects:
        name, at, options, value = parsed(text)
        attach(program, chosen_variant(program, name, at, **options), value, class_name=type(program).__name__)
        variant = attached(program)[-1]
        if value is not None and variant.effect.null != 1 and variant.effect.prior is None:
            width = max(variant.limit, *map(abs, value))  # the number that is given says in what unit
            program.priors = {**program.priors, variant.parameter: _wide_prior(variant, width)}
    return program


def set_coefficient(program: Program, variant: Variant, value: Value) -> Program:
    """Give the coefficient of an effect that a program has another value."""
    variant.require_meaning(value)
    setattr(program, variant.parameter, _start(variant, value, coefficient(program, variant)))
    return program


def _constraint(effect: Effect) -> constraints.Constraint:
    return constraints.positive if effect.null != 0 else constraints.real  # a factor or a limit is positive


def _start(variant: Variant, value: Value | None, like: Tensor) -> Tensor:
    effect, start = variant.effect, variant.coefficient(value, like.detach())
    if not bool((_constraint(effect).check(start) & (start.isfinite() | (start == effect.null))).all()):
        expected = "a positive number" if effect.null != 0 else "finite numbers"
        raise UsageError(f"effect {effect.name} takes {expected}, got {start.tolist()}")
    return start


def written_class(program: Program) -> type[Program]:
    """The class of a program as its file has it, without the effects that `attach` gave it."""
    return next(one for one in type(program).__mro__ if "_attached" not in vars(one))


def record(program: Program) -> list[str]:
    """The effects that a program's class lists or that were added to it, as `restore` reads them."""
    return [variant.written for variant in attached(program)]


def restore(program: Program, effects: Sequence[str]) -> Program:
    """Add the effects of a record that the program does not have yet to this very program."""
    have = [(variant.name, dict(variant.options)) for variant in attached(program)]
    for text in effects:
        variant = chosen_variant(program, text)
        if (variant.name, dict(variant.options)) not in have:
            attach(program, variant)
    return program


def _push(base: Any, variant: Variant) -> Methods:
    def transition(self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
        given = (state, control, time, step)
        mean = interventions.channel_means(self, partial(base.transition, self), *given) if variant.needs_mean else None
        with interventions.pushed(self, variant(self, *given, c=coefficient(self, variant), mean=mean)):
            return base.transition(self, *given)

    return {"transition": transition}


def _command(base: Any, variant: Variant) -> Methods:
    def transition(self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
        acting = variant(self, state, control, time, c=coefficient(self, variant))
        return base.transition(self, state, acting, time, step)

    return {"transition": transition}


def _history(base: Any, variant: Variant) -> Methods:
    def actuators(self: Any, control: Tensor, time: Tensor) -> Tensor:
        return variant(self, base.actuators(self, control, time), time, c=coefficient(self, variant))

    return {"actuators": actuators}


def _between(base: Any, variant: Variant) -> Methods:
    def between_rows(self: Any, control: Tensor, time: Tensor) -> Tensor:
        return variant(self, control, time, c=coefficient(self, variant))

    return {"between_rows": between_rows}


def _viewpoint(base: Any, variant: Variant) -> Methods:
    def observe(self: Any, state: Tensor) -> None:
        return base.observe(self, variant(self, state, c=coefficient(self, variant)))

    return {"observe": observe}


def _measured(base: Any, variant: Variant) -> Methods:
    """Where the state is seen as from elsewhere, this effect sees it so too."""

    def observe(self: Any, state: Tensor) -> None:
        seen = state
        for other in effects_of(base, "viewpoint"):
            seen = other(self, seen, c=coefficient(self, other))
        with interventions.misread(self, partial(variant, self, seen, c=coefficient(self, variant))):
            return base.observe(self, state)

    return {"observe": observe}


def _tails(base: Any, variant: Variant) -> Methods:
    def observe(self: Any, state: Tensor) -> None:
        share = variant(self, c=coefficient(self, variant))
        with interventions.heavy_tailed(share, variant.options.get("columns", ())):
            return base.observe(self, state)

    return {"observe": observe}


def _colour(base: Any, variant: Variant) -> Methods:
    """The deviations of the last step are states, zero at the start."""

    def split(self: Any, state: Tensor) -> tuple[Tensor, Tensor]:
        channels = len(self.channels)
        return state[..., :-channels], state[..., -channels:]

    def initial(self: Any) -> Tensor:
        start = base.initial(self)
        return torch.cat([start, start.new_zeros((*start.shape[:-1], len(self.channels)))], -1)

    def transition(self: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
        state, last = split(self, state)
        colouring = interventions.Coloured(self, variant(self, c=coefficient(self, variant)), last)
        with colouring:
            state = base.transition(self, state, control, time, step)
        return colouring.beside(state)

    def observe(self: Any, state: Tensor) -> None:
        return base.observe(self, split(self, state)[0])

    deviations = tuple(f"deviation_{name}" for name in names(base.channels))
    if set(deviations) & set(names(base.states)):  # of another coloured noise
        deviations = tuple(f"deviation_{variant.at}_{name}" for name in names(base.channels))
    methods = {"initial": initial, "transition": transition, "observe": observe}
    return methods | {"states": (*base.states, *deviations), "resting": (*base.resting, *deviations)}


def _under(handler: Callable[..., interventions.Transforming], method: str) -> Callable[[Any, Variant], Methods]:
    """A method under a handler, which is made of the program, its effect and the method's arguments."""

    def around(base: Any, variant: Variant) -> Methods:
        def run(self: Any, *given: Tensor, **named: Tensor) -> Tensor | None:
            with handler(self, partial(variant, self, c=coefficient(self, variant)), *given, **named):
                return getattr(base, method)(self, *given, **named)

        run.__name__ = method
        return {method: run}

    return around


def _widened(program: Any, act: Any, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Any:
    return interventions.widened(program, act(state, control, time, step))


_METHODS_OF_FORM: dict[str, Callable[[Any, Variant], Methods]] = {
    "push": _push,
    "command": _command,
    "history": _history,
    "between": _between,
    "measured": _measured,
    "viewpoint": _viewpoint,
    "spread": _under(_widened, "transition"),
    "blur": _under(lambda program, act, state: interventions.blurred(act(state)), "observe"),
    "tails": _tails,
    "colour": _colour,
}


def with_effects(program: Program, effects: Sequence[str]) -> tuple[Program, list[str]]:
    """A program with effects as users write them, and a line for each that says its value; UsageError: one is wrong."""
    named, lines = list[str](), list[str]()
    for text in effects:
        name, at, options, value = parsed(text)
        variant = chosen_variant(program, name, at, **options)
        if variant.name in named:
            raise UsageError(f"effect {variant.name} is given twice")
        named.append(variant.name)
        there = [known for known in attached(program) if known.name == variant.name]
        if there and (not options or dict(there[0].options) == dict(variant.options)):
            variant, origin = there[0], "as given" if value else "of the run"
            if value is not None:
                program = set_coefficient(program, variant, value)
        else:
            program, origin = with_effect(program, variant, value), "as given" if value else "typical"
            variant = attached(program)[-1]
        numbers = coefficient(program, variant).detach().flatten().tolist()
        unit = "" if variant.unit == "1" else f" {variant.unit}"
        lines.append(f"{variant.label} = {', '.join(f'{number:.4g}' for number in numbers)}{unit} ({origin})")
    return program, lines
