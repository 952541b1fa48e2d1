"""A program with an effect: the same three methods, around which the effect acts."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import Tensor

from steady_ppl.altering import Coloured, blurred, heavy_tailed, misread, pushed, widened
from steady_ppl.effects.declaration import Effect, Variant
from steady_ppl.effects.registry import chosen_variant
from steady_ppl.errors import UsageError
from steady_ppl.program import Program, names

Methods = dict[str, Any]


def with_effect(
    program: Program, effect: str | Effect | Variant, value: float | Sequence[float] | None = None, **options: Any
) -> Program:
    """A copy of a program with an effect, its coefficient a learnable parameter called `effect` or `effect_where`.

    Args:
        program: any program.
        effect: a catalogue name ("linear_drag", "gain_error:turn", "landmark_bias:2"), or one of your own.
        value: the coefficient; the effect's typical one when None.
        options: knees, widths, places (`knee=0.6`); the first of its choices when not given.

    Raises:
        UsageError: no such effect, it does not apply to the program, is there already or takes other numbers.
    """
    variant = effect if isinstance(effect, Variant) else chosen_variant(program, effect, **options)
    return attach(copy.deepcopy(program), variant, value)


def attach(program: Program, variant: Variant, value: float | Sequence[float] | Tensor | None = None) -> Program:
    """Add an effect to this very program."""
    if variant.name in [known.name for known in attached(program)]:
        raise UsageError(f"program {type(program).__name__} has the effect {variant.name} already")
    if hasattr(program, variant.parameter):  # a parameter of its own that has nothing to do with it
        variant = replace(variant, called=f"{variant.parameter}_effect")
    name, effect = variant.parameter, variant.effect
    like = next(program.parameters(), torch.zeros(()))
    scaled = effect.null != 0  # a factor or a limit is positive
    constraint = constraints.positive if scaled else constraints.real
    base = type(program)
    title = "".join(part.capitalize() for part in name.split("_"))
    about = {"__module__": base.__module__, "__doc__": base.__doc__, "attached": (*attached(program), variant)}
    program.__class__ = type(f"{base.__name__}With{title}", (base,), {**about, **_AROUND[effect.form](base, variant)})
    with pyro.settings.context(module_local_params=True):
        setattr(program, name, PyroParam(variant.coefficient(value, like), constraint))
    prior = dist.Normal(1.0 if effect.null == 1 else 0.0, effect.limit)
    program.priors = {**program.priors, name: prior}  # type: ignore[misc]
    return program


def attached(program: Program) -> tuple[Variant, ...]:
    """The effects that were added to a program, in their order."""
    return getattr(program, "attached", ())


def coefficient(program: Program, variant: Variant) -> Tensor:
    """The value of an effect's coefficient in a program that has it."""
    return getattr(program, variant.parameter)


def _push(base: Any, variant: Variant) -> Methods:
    def transition(self, state, control, time, step):
        def below():
            return base.transition(self, state, control, time, step)

        with pushed(self, variant.push(self, state, control, time, step, coefficient(self, variant), below)):
            return below()

    return {"transition": transition}


def _command(base: Any, variant: Variant) -> Methods:
    def transition(self, state, control, time, step):
        return base.transition(
            self, state, variant(self, state, control, time, c=coefficient(self, variant)), time, step
        )

    return {"transition": transition}


def _history(base: Any, variant: Variant) -> Methods:
    def actuators(self, control, time):
        return variant(self, base.actuators(self, control, time), time, c=coefficient(self, variant))

    return {"actuators": actuators}


def _measured(base: Any, variant: Variant) -> Methods:
    def observe(self, state):
        with misread(self, lambda measured: variant(self, state, measured, c=coefficient(self, variant))):
            return base.observe(self, state)

    return {"observe": observe}


def _viewpoint(base: Any, variant: Variant) -> Methods:
    def observe(self, state):
        return base.observe(self, variant(self, state, c=coefficient(self, variant)))

    return {"observe": observe}


def _spread(base: Any, variant: Variant) -> Methods:
    def transition(self, state, control, time, step):
        factors = variant(self, state, control, time, step, c=coefficient(self, variant))
        with widened(self, factors):
            return base.transition(self, state, control, time, step)

    return {"transition": transition}


def _blur(base: Any, variant: Variant) -> Methods:
    def observe(self, state):
        with blurred(variant(self, state, c=coefficient(self, variant))):
            return base.observe(self, state)

    return {"observe": observe}


def _tails(base: Any, variant: Variant) -> Methods:
    def observe(self, state):
        with heavy_tailed(variant(self, c=coefficient(self, variant))):
            return base.observe(self, state)

    return {"observe": observe}


def _colour(base: Any, variant: Variant) -> Methods:
    """The deviations of the last step are states, zero at the start."""

    def split(self, state):
        channels = len(self.channels)
        return state[..., :-channels], state[..., -channels:]

    def initial(self):
        start = base.initial(self)
        return torch.cat([start, start.new_zeros((*start.shape[:-1], len(self.channels)))], -1)

    def transition(self, state, control, time, step):
        state, last = split(self, state)
        colouring = Coloured(self, variant(self, c=coefficient(self, variant)), last)
        with colouring:
            state = base.transition(self, state, control, time, step)
        deviations = torch.cat(colouring.deviations, -1)
        left = torch.broadcast_shapes(state.shape[:-1], deviations.shape[:-1])
        return torch.cat([state.expand(*left, -1), deviations.expand(*left, -1)], -1)

    def observe(self, state):
        return base.observe(self, split(self, state)[0])

    deviations = tuple(f"deviation_{name}" for name in names(base.channels))
    methods = {"initial": initial, "transition": transition, "observe": observe}
    return methods | {"states": (*base.states, *deviations), "resting": (*base.resting, *deviations)}


_AROUND: dict[str, Callable[[Any, Variant], Methods]] = {
    "push": _push,
    "command": _command,
    "history": _history,
    "measured": _measured,
    "viewpoint": _viewpoint,
    "spread": _spread,
    "blur": _blur,
    "tails": _tails,
    "colour": _colour,
}
