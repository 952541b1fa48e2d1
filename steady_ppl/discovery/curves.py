"""What no catalogue has: a curve of some variable that a channel or a measurement lacks.

A curve adds to a channel, or multiplies what is commanded of it (over time: wear). It is piecewise linear between
knots, with a Gaussian-process prior (a normal over the heights at the knots, whose correlation falls with their
distance), so that it bends only where the drives ask for it.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyro.distributions as dist
import torch
from numba import njit
from pyro.distributions.transforms import LowerCholeskyAffine
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects import Effect, Variant
from steady_ppl.gaussian.lanes import Array
from steady_ppl.gaussian.predict import on_a_circle
from steady_ppl.model.interventions import channel_means
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import acting_controls, row_controls

KNOTS = 7  # of a curve
LENGTH_SCALE = 0.4  # of the heights' prior, in the range of the variable
MIN_HEIGHT = 1e-15  # height of a curve whose square is still a number in single precision
HEIGHT_SD = 1.5  # prior standard deviation of the heights, in the noise's
CURVE = "curve"  # the name of these effects
ADDITIVE, COMMANDED = "", "what is commanded"  # what a curve is multiplied with


@torch.no_grad()
def curves(program: Program, data: Trajectories, spread: Tensor, sharpness: Tensor) -> list[Variant]:
    """All curves: every channel over every variable, its command over time, every measurement over its own reading.

    `data` has the states along which they are looked at. `spread`, `(C,)`, are standard deviations of the channels,
    `sharpness`, `(K,)`, of the measurements.
    """
    assert data.states is not None
    (along, mean), found = variables_along(program, data, data.states), list[Variant]()
    for variable, values in along.items():
        seen = values.expand(data.transitions.shape)[data.transitions]
        if (knots := knots_of(seen, variable in program.angles)) is None:
            continue
        for index, channel in enumerate(program.channel_names):
            for times in (ADDITIVE, COMMANDED) if variable == "time" else (ADDITIVE,):
                size, unit = 1.0, program.channel_units[index]
                if times:
                    size = float(mean[channel].expand(data.steps.shape)[data.transitions].square().mean().sqrt())
                    unit = "1"
                if size > 0 and (height_sd := float(spread[index]) / size) > MIN_HEIGHT:
                    effect = _effect("push", variable, knots, height_sd, unit, variable in program.angles)
                    at = f"{channel}~{variable}{f' × {times}' if times else ''}"
                    found.append(effect.variant(at=at, channel=channel, variable=variable, knots=knots, times=times))
    return found + _of_readings(program, data, sharpness)


def multiplier(mean: Mapping[str, Tensor], channel: str, times: str) -> Tensor | float:
    """What a curve of a channel is multiplied with, `(...)`."""
    return mean[channel] if times == COMMANDED else 1.0


def variables(
    program: Program, state: Tensor, control: Tensor, time: Tensor, mean: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Everything that a curve may depend on, by name, each `(...)`: state components, velocities in the channels' own
    frame and their products, controls, what the program makes of them, and time."""
    found = {name: state[..., i] for i, name in enumerate(program.state_names) if name not in program.resting_names}
    moving = {f"{channel} velocity": value for channel, value in program.velocities(state).items()}
    named = {f"{channel} velocity": velocity for channel, (_, velocity) in program.motion.items()}
    found |= {name: value for name, value in moving.items() if name not in named and name != "yaw velocity"}
    for one, other in itertools.combinations(moving, 2):
        found[f"{one} × {other}"] = moving[one] * moving[other]
    found |= {name: control[..., i] for i, name in enumerate(program.control_names)}
    found |= {f"commanded {channel}": value for channel, value in mean.items()}
    return found | {"time": time}


@torch.no_grad()
def variables_along(
    program: Program, data: Trajectories, states: Tensor
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """`variables` along states `(T + 1, B, D)`, and what is commanded of each channel; all expand to `(T, B)`."""
    given = (states[:-1], row_controls(program, acting_controls(program, data))[:-1], data.elapsed[:-1])
    mean = channel_means(program, program.transition, *given, data.steps / program.substeps)
    return variables(program, *given, mean), mean


def knots_of(values: Tensor, circular: bool) -> tuple[float, ...] | None:
    """Where a curve bends, between the outermost hundredths of values, or over a whole turn; None where none vary."""
    if circular:
        return tuple(-math.pi + 2 * math.pi * k / KNOTS for k in range(KNOTS))
    if not len(values):
        return None
    every = values[:: max(1, len(values) // 100_000)]
    low, high = (float(q) for q in torch.quantile(every, torch.tensor([0.01, 0.99]).to(every)))
    if not math.isfinite(high - low) or high - low <= 1e-6 * max(abs(low), abs(high)):
        return None
    return tuple(low + (high - low) * k / (KNOTS - 1) for k in range(KNOTS))


def height(values: Tensor, knots: Sequence[float], circular: bool, c: Tensor) -> Tensor:
    """The curve of heights `c` `(K,)` at some values, `(...)`: each knot has a hat that ends at the next ones."""
    count = len(knots)
    place = ((values - knots[0]) / (knots[1] - knots[0])).unsqueeze(-1)
    if circular:
        apart = torch.remainder(place - torch.arange(count).to(place) + count / 2, count) - count / 2
    else:
        apart = place.clamp(0, count - 1) - torch.arange(count).to(place)
    return ((1 - apart.abs()).clamp(min=0) * c).sum(-1)


def by_height(values: Tensor, weights: Tensor, knots: Sequence[float], circular: bool) -> Tensor:
    """The derivative in the heights of the sum of a curve's values times `weights`, `(..., B)`; `(B, K)`."""
    drives, count = values.shape[-1], len(knots)
    found = np.zeros((2, drives, count))
    at, by = (part.detach().reshape(-1, drives).numpy() for part in (values, weights.expand_as(values)))
    grid = np.array([knots[0], knots[1] - knots[0]], at.dtype)
    _add_by_height(at, by, grid, np.arange(count + 1).astype(at.dtype), circular, found)
    return torch.from_numpy(found[0] + found[1])


@njit(cache=True, error_model="numpy")
def _add_by_height(values: Array, weights: Array, grid: Array, places: Array, circular: bool, found: Array) -> None:
    """Add the weights of `values` `(M, B)` to the knots before and behind them, `(2, B, K)`; beyond the outermost knots
    a curve is constant. In the values' precision: `grid`, the first knot and the distance of two, and `places`, 0 … K.
    """
    before, behind = found[0], found[1]
    count = before.shape[1]
    last = count - 1 if circular else count - 2
    for m in range(len(values)):
        for b in range(values.shape[1]):
            place = (values[m, b] - grid[0]) / grid[1]
            if circular:
                place %= places[count]
            else:
                place = min(max(place, places[0]), places[count - 1])
            knot = min(int(place), last) if place == place else 0
            share = place - places[knot]
            before[b, knot] += weights[m, b] * (places[1] - share)
            behind[b, (knot + 1) % count] += weights[m, b] * share


def over_state(
    self: Any, *at: Tensor, c: Tensor, mean: Mapping[str, Tensor], channel: Any, variable: Any, knots: Any, times: Any
) -> Any:
    """A curve that adds to a channel."""
    state, control, time, _ = at
    value = variables(self, state, control, time, mean)[variable]
    return {channel: height(value, knots, variable in self.angles, c) * multiplier(mean, channel, times)}


def over_reading(self: Any, state: Tensor, measured: Tensor, c: Tensor, chosen: Any, circular: Any, knots: Any) -> Any:
    """A curve that adds to measurements, of what they read; of one of many, the others cost a kernel nothing."""
    order = self.measurement_names
    read = measured if len(chosen) > 1 else measured[..., order.index(chosen[0]), None]
    return measured + height(read, knots, circular, c) * torch.tensor([float(n in chosen) for n in order]).to(measured)


def _effect(form: str, variable: str, knots: Sequence[float], spread: float, unit: str, circular: bool) -> Effect:
    at, reach = torch.tensor(knots, dtype=torch.float64), LENGTH_SCALE * (knots[-1] - knots[0])
    apart = (at.unsqueeze(1) - at).abs()
    if circular:
        apart, reach = 2 * (apart / 2).sin().abs(), 1.0
    correlation = torch.exp(-0.5 * (apart / reach) ** 2) + 1e-3 * torch.eye(len(knots)).double()
    root = torch.linalg.cholesky((HEIGHT_SD**2 * spread**2 * correlation).float())
    zeros = torch.zeros(len(knots))
    normal = dist.Normal(zeros, 1.0).to_event(1)  # turned by `root`: `MultivariateNormal` loads sympy, half a second
    return Effect(
        name=CURVE,
        form=form,
        equation=rf"f(\text{{{variable}}})",
        text=f"a curve over {variable}, straight between knots",
        unit=unit,
        feels="something that is in no catalogue",
        function=over_state if form == "push" else over_reading,
        typical=tuple(spread for _ in knots),
        limit=HEIGHT_SD * spread,
        components=tuple(f"{knot:.3g}" for knot in knots),
        prior=dist.TransformedDistribution(normal, [LowerCholeskyAffine(zeros, root)]),
    )


def prior_covariance(effect: Effect) -> Tensor:
    """Of a curve's heights, `(K, K)`, in double precision."""
    (along,) = effect.prior.transforms
    root: Tensor = along.scale_tril.double()
    return root @ root.T


def _of_readings(program: Program, data: Trajectories, sharpness: Tensor) -> list[Variant]:
    """Curves over what is read, of each measurement alone and, if all are angles, of all together."""
    assert data.states is not None
    found, order = [], program.measurement_names
    turning = on_a_circle(program, data, data.states)
    groups = [(name,) for name in order] + ([order] if len(order) > 1 and bool(turning.all()) else [])
    for group in groups:
        index = order.index(group[0])
        circular = bool(turning[index])
        if (knots := knots_of(data.measurements[..., index][data.observed[..., index]], circular)) is None:
            continue
        at = group[0] if len(group) == 1 else "all"
        unit = program.measurement_units[index]
        effect = _effect("measured", f"reading of {at}", knots, float(sharpness[index]), unit, circular)
        found.append(effect.variant(at=f"{at}~reading", chosen=group, circular=circular, knots=knots))
    return found
