"""What each effect would do to a vehicle's accelerations, for those who regress these.

The catalogue's own functions and the program's own transition say it; nothing of them is written a second time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from steady_ppl import Program, Trajectories
from steady_ppl.discovery.effect_scores import Column, columns_of
from steady_ppl.effects import Sizes, Variant, attached, catalogue
from steady_ppl.gaussian.linearize import ReferencePath, linearize
from steady_ppl.likelihood.parameters import elements, moved
from steady_ppl.likelihood.scores import channel_moments
from steady_ppl.model.interventions import by_channel
from steady_ppl.model.problem import Problem
from steady_ppl.model.substeps import acting_controls

REGRESSED = ("push", "command", "history")  # forms of effects that change an acceleration


@dataclass(frozen=True)
class Evidence:
    """A regression problem, in standard deviations of the program's noise.

    Attributes:
        names: of the `N` columns' effects.
        labels: with place, knee and probe: columns of one label are the components of one coefficient.
        columns: what the channels' means gain by a unit of each coefficient, `(T, B, C, N)`.
        own: by a unit of the program's own parameters, `(T, B, C, P)`.
        states: `(T + 1, B, D)`, at which they are taken.
        entry: what a standard deviation of each channel adds to the next state, `(T, B, D, C)`.
        drift: the next state without noise, `(T, B, D)`.
    """

    names: tuple[str, ...]
    labels: tuple[str, ...]
    columns: Tensor
    own: Tensor
    states: Tensor
    entry: Tensor
    drift: Tensor


def candidates(program: Program, data: Trajectories, withheld: Sequence[str] = ()) -> list[Variant]:
    """The variants that a program does not have."""
    have = {variant.name for variant in attached(program)}
    left, sizes = [effect for effect in catalogue(program) if effect.name not in withheld], Sizes(program, data)
    return [sizes.of(one) for effect in left for one in effect.variants(program, data) if one.name not in have]


def evidence(program: Program, data: Trajectories, states: Tensor, variants: Sequence[Variant]) -> Evidence:
    """Columns of the variants that change an acceleration.

    Args:
        program: as it stands.
        data: as returned by `for_program`.
        states: believed, `(T + 1, B, D)`.
        variants: of the catalogue.
    """
    path = ReferencePath(states, states.new_zeros((*data.steps.shape, len(program.channels))))
    linear = linearize(Problem(program, data), path, kernels=False)
    mean, spread = _moments(program, data, states)
    found, called, labels = [], [], []
    for column in columns_of([variant for variant in variants if variant.effect.form in REGRESSED]):
        for gained in _gains(program, data, states, mean, column):
            found.append(gained / spread)
            called.append(column.variant.name)
            labels.append(f"{column.variant.label} {column.probe}")
    own = [_by_parameter(program, data, states, part) / spread for part in elements(program)]
    return Evidence(
        names=tuple(called),
        labels=tuple(labels),
        columns=torch.stack(found, -1).double(),
        own=torch.stack([part for part in own if part.any()], -1).double(),
        states=states.double(),
        entry=linear.noise,
        drift=linear.offset + states[1:].double(),
    )


def _moments(
    program: Program, data: Trajectories, states: Tensor, controls: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Means and standard deviations of the channels, `(T, B, C)`."""
    mean, spread = channel_moments(program, data, states[None, :-1], controls)
    return mean[0], spread[0]


def _by_parameter(program: Program, data: Trajectories, states: Tensor, part: object) -> Tensor:
    with moved(part, part.step):  # type: ignore
        up = _moments(program, data, states)[0]
    with moved(part, -part.step):  # type: ignore
        return (up - _moments(program, data, states)[0]) / (2 * part.step)  # type: ignore


@torch.no_grad()
def _gains(program: Program, data: Trajectories, states: Tensor, mean: Tensor, column: Column) -> list[Tensor]:
    """What the channels' means gain by each component of a coefficient, per unit of it, `(T, B, C)`."""
    variant = column.variant
    absent = variant.absent(mean)
    before = _changed(program, data, states, mean, variant, absent)
    if column.probe is not None:
        after = _changed(program, data, states, mean, variant, torch.full_like(absent, column.probe))
        return [(after - before) / (column.probe if absent.isfinite().all() else 1.0)]
    typical = torch.as_tensor(variant.effect.typical).to(mean).flatten()
    sizes = 0.05 * torch.where(typical == 0, typical.abs().max(), typical)
    gains = []
    for index, size in enumerate(sizes):
        by = torch.zeros_like(sizes)
        by[index] = size
        after = _changed(program, data, states, mean, variant, absent + by.reshape(absent.shape))
        gains.append((after - before) / size)
    return gains


def _changed(program: Program, data: Trajectories, states: Tensor, mean: Tensor, variant: Variant, c: Tensor) -> Tensor:
    """The channels' means with an effect, `(T, B, C)`."""
    controls, times = acting_controls(program, data), data.elapsed
    if variant.effect.form == "push":
        means = dict(zip(program.channel_names, mean.unbind(-1), strict=True))
        pushes = variant(program, states[:-1], controls[:-1], times[:-1], data.steps, c=c, mean=means)
        return mean + by_channel(program, pushes, 0.0, mean)
    if variant.effect.form == "command":
        acting = variant(program, states, controls, times, c=c)
    else:
        acting = variant(program, controls, times, c=c)
    return _moments(program, data, states, acting)[0]
