"""How large effects are on a vehicle, in any unit.

The catalogue's numbers are for vehicles whose commands change every second and gain some decimetres a second in
a second. On others, or in other units, what they do to these drives says by what to multiply them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects.declaration import Names, Variant
from steady_ppl.model.handlers import AtMean, Recording, as_vector, normal_moments, running
from steady_ppl.model.interventions import channel_means
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import acting_controls, row_controls

FELT, FELT_OF_COMMAND = 1.5, 0.15  # a typical push, in a channel's size, and change of a command, in the command's
SHARE_COMMANDED = 0.1  # of what is commanded of a channel, that counts as much as its noise
QUANTILE_OF_LARGEST = 0.99  # of what is commanded of a channel, that a limit must be below to be felt
STEPS_OF_SCALE = 4
CORRELATION = 0.5  # of commands with those before, after the time in which they change
MAX_SHARE_OF_DURATION = 0.25  # of a drive, that this time can be


@torch.no_grad()
def time_of_change(program: Program, data: Trajectories) -> float:
    """In how many seconds commands have become others, or states where no command changes.

    The lag at which the correlation with what was before falls to a half, the mean of all controls that change.
    """
    moving = torch.empty(*data.controls.shape[:2], 0) if data.states is None else data.states
    for values in (data.controls, moving):
        if len(found := _correlation(values[:-1], data.transitions)):
            most = max(1, int(MAX_SHARE_OF_DURATION * int(data.lengths.max())))
            below = (found < CORRELATION).nonzero().flatten().tolist()
            at = min(below[0], most) if below else most
            if at == most:
                return at * data.median_step
            before, after = float(found[at - 1]), float(found[at])
            return (at - 1 + (before - CORRELATION) / (before - after)) * data.median_step
    return MAX_SHARE_OF_DURATION * float(data.elapsed.max())


def _correlation(values: Tensor, inside: Tensor) -> Tensor:
    """Of rows `(T, B, U)` with those some rows later, by the lag from 0; empty where nothing changes."""
    count = inside.sum().clamp(min=1)
    there = inside.unsqueeze(-1)
    values = torch.where(there, values, 0.0).double()
    apart = torch.where(there, values - values.sum((0, 1)) / count, 0.0)
    scale = apart.square().sum((0, 1)).sqrt()
    apart = apart[..., scale > 1e-6 * values.abs().amax((0, 1)) * count.sqrt()]
    if not apart.shape[-1]:
        return torch.empty(0)
    apart = apart / apart.square().sum((0, 1)).sqrt()
    lags, pairs = _autocorrelation(apart).mean(-1), _autocorrelation(inside.double()).round()
    return (lags * count / pairs.clamp(min=1))[pairs > 0]


def _autocorrelation(values: Tensor) -> Tensor:
    """Sums of products of rows `(T, B, ...)` with those so many rows later, `(T, ...)`."""
    spectrum = torch.fft.rfft(values, n=2 * len(values), dim=0)
    return torch.fft.irfft(spectrum.abs().square().sum(1), n=2 * len(values), dim=0)[: len(values)]


def rms(values: Tensor) -> float:
    """The root mean square, in double precision."""
    return float(values.double().square().mean().sqrt())


def speed_of(program: Program, data: Trajectories | None, channels: Names) -> float:
    """The largest of some channels' root mean square velocities; zero where nothing is known of them."""
    if data is None or data.states is None:
        return 0.0
    found = program.velocities(data.states)
    return max((rms(found[channel][data.rows]) for channel in channels if channel in found), default=0.0)


@torch.no_grad()
def sizes_of_channels(program: Program, data: Trajectories, share_commanded: float = 1.0) -> dict[str, float]:
    """Root mean squares of what is commanded of each channel, or a share of it, and of its noise; along `data.states`.

    It is at most what brings a resting vehicle to its usual speed while commands change: a program that holds a
    velocity has noise that it takes back within a row.
    """
    assert data.states is not None
    states, inside = data.states[:-1], data.transitions
    controls = row_controls(program, acting_controls(program, data))[:-1]
    with running(*inside.shape), Recording() as seen, AtMean():
        program.transition(states, controls, data.elapsed[:-1], data.steps / program.substeps)
    found = list[float]()
    for site, fn in seen.distributions.items():
        mean, spread = (as_vector(part, fn.event_dim).expand(*inside.shape, -1) for part in normal_moments(fn, site))
        commanded = [rms(part[inside]) for part in mean.unbind(-1)]
        noise = [rms(part[inside]) for part in spread.unbind(-1)]
        found += [math.hypot(share_commanded * one, other) for one, other in zip(commanded, noise, strict=True)]
    sizes, time = dict(zip(program.channel_names, found, strict=True)), time_of_change(program, data)
    for channels in program.axes.values():
        if (speed := speed_of(program, data, channels)) > 0:
            sizes |= {channel: min(sizes[channel], speed / time) for channel in channels}
    return sizes


class Sizes:
    """What is much and what is long on drives of a program, along their `states` where they have any."""

    def __init__(self, program: Program, data: Trajectories) -> None:
        self.program, self.data = program, data

    def of(self, variant: Variant) -> Variant:
        """The variant with its scale."""
        found = self._scale(variant)
        return replace(variant, scale=found) if 0 < found < math.inf else variant

    @torch.no_grad()
    def _scale(self, variant: Variant) -> float:
        effect = variant.effect
        if effect.unit == "s" and (effect.form != "push" or effect.probes):
            return self.time
        if effect.unit == "of the control":
            at = [self.program.control_names.index(name) for name in variant.options["controls"]]
            return float(self.data.controls[..., at][self.data.rows].abs().amax())
        if effect.unit == "of the measurement":
            at = list(variant.options.get("columns") or [variant.options["component"]])
            seen = self.data.measurements[..., at][self.data.observed[..., at]].double()
            return float(seen.std()) if len(seen) > 1 else 1.0
        if self.data.states is None or effect.null not in (0.0, math.inf):
            return 1.0
        measure = {"push": self._push, "command": self._command, "blur": self._blur, "spread": self._spread}
        return measure[effect.form](variant) if effect.form in measure else 1.0

    @cached_property
    def time(self) -> float:
        """See `time_of_change`."""
        return time_of_change(self.program, self.data)

    @cached_property
    def _rows(self) -> tuple[Tensor, ...]:
        """States, acting controls, times and steps of all transitions, `(rows, ·)`."""
        data, inside = self.data, self.data.transitions
        assert data.states is not None
        controls = row_controls(self.program, acting_controls(self.program, data))[:-1]
        given = (data.states[:-1], controls, data.elapsed[:-1], data.steps / self.program.substeps)
        return tuple(part[inside].unsqueeze(0) for part in given)

    @cached_property
    def _means(self) -> dict[str, Tensor]:
        """Of the channels, in all transitions."""
        return channel_means(self.program, self.program.transition, *self._rows)

    @cached_property
    def _channels(self) -> dict[str, float]:
        return sizes_of_channels(self.program, self.data, share_commanded=SHARE_COMMANDED)

    def _push(self, variant: Variant) -> float:
        """By which its typical push is as large as the noise and some of what is commanded."""
        if variant.effect.null != 0:
            reach = max(variant.effect.probes)
            sizes = [self._means[name].abs().double().flatten() for name in variant.options["channels"]]
            return max(float(size.quantile(QUANTILE_OF_LARGEST)) for size in sizes) / reach
        return self._until(variant, FELT, self._size_of_push)

    def _size_of_push(self, variant: Variant) -> float:
        mean = self._means if variant.needs_mean else None
        found = variant(self.program, *self._rows, c=variant.coefficient(variant.typical, self._rows[0]), mean=mean)
        sizes = self._channels
        return max((rms(push) / sizes[channel] for channel, push in found.items() if sizes[channel] > 0), default=0.0)

    def _command(self, variant: Variant) -> float:
        state, control, time, _ = self._rows

        def size(variant: Variant) -> float:
            acting = variant(self.program, state, control, time, c=variant.coefficient(variant.typical, state))
            pairs = zip((acting - control).unbind(-1), control.unbind(-1), strict=True)
            sizes = [(rms(change), rms(command)) for change, command in pairs]
            return max((change / command for change, command in sizes if command > 0), default=0.0)

        return self._until(variant, FELT_OF_COMMAND, size)

    def _blur(self, variant: Variant) -> float:
        state = self._rows[0]

        def size(variant: Variant) -> float:
            factors = variant(self.program, state, c=variant.coefficient(variant.typical, state))
            columns = variant.options.get("columns") or range(factors.shape[-1])
            return rms(factors[..., list(columns)] - 1)

        return self._until(variant, 1.0, size)

    def _spread(self, variant: Variant) -> float:
        def size(variant: Variant) -> float:
            factors = variant(self.program, *self._rows, c=variant.coefficient(variant.typical, self._rows[0]))
            return max(rms(factor - 1) for factor in factors.values())

        return self._until(variant, 1.0, size)

    def _until(self, variant: Variant, wanted: float, size: Callable[[Variant], float]) -> float:
        """The scale at which the size is as wanted; a size that is no multiple of the coefficient takes some steps."""
        scale = 1.0
        for _ in range(STEPS_OF_SCALE):
            found = size(replace(variant, scale=scale))
            if not 0 < found < math.inf:
                return scale
            scale *= wanted / found
        return scale
