"""How far the fitted noise is from what the program declared, of channels and of measurements."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from steady_ppl.data import Trajectories
from steady_ppl.effects import Variant, catalogue
from steady_ppl.elements import Element, moved
from steady_ppl.program import Program, names
from steady_ppl.scores import channel_moments, measured


@dataclass(frozen=True)
class Departure:
    """Of the fitted standard deviations of some channels, or of the measurements, from the declared.

    Attributes:
        variant: `process_noise` of these channels, or `measurement_noise`.
        away: log ratio of fitted to declared, their mean.
        slope: its derivative in the fitted parameters, `(P,)`.
    """

    variant: Variant
    away: float
    slope: Tensor

    @property
    def factor(self) -> float:
        """By what the noise differs."""
        return math.exp(self.away)


@torch.no_grad()
def departures(
    declared: Program, fitted: Program, data: Trajectories, states: Tensor, parts: Sequence[Element]
) -> list[Departure]:
    """Of every group of channels and of the measurements, where their noise is learned and no guess (`guesses`).

    Args:
        declared: the program as it was before it was fitted.
        fitted: the program.
        data: as returned by `for_program`.
        states: along which the noise is looked at, `(T + 1, B, D)`.
        parts: the learnable numbers of `fitted`.
    """
    found = []
    for name, spread in SPREADS.items():
        slope = _slope(spread, fitted, data, states, parts)
        away = spread(fitted, data, states) - spread(declared, data, states[..., : len(declared.states)])
        variants = [v for effect in catalogue(fitted) if effect.name == name for v in effect.variants(fitted)]
        for variant in variants if parts else []:
            index = _columns(fitted, variant)
            index = [i for i in index if bool(slope[:, i].any()) and not _guessed(fitted, parts, slope[:, i])]
            if index:
                found.append(Departure(variant, float(away[index].mean()), slope[:, index].mean(1)))
    return found


def _slope(spread: Spread, program: Program, data: Trajectories, states: Tensor, parts: Sequence[Element]) -> Tensor:
    """The derivative of log standard deviations in the parameters, `(P, C)` or `(P, K)`."""
    slopes = []
    for part in parts:
        with moved(part, part.step):
            up = spread(program, data, states)
        with moved(part, -part.step):
            slopes.append((up - spread(program, data, states)) / (2 * part.step))
    return torch.stack(slopes) if slopes else torch.zeros(0)


def _of_channels(program: Program, data: Trajectories, states: Tensor) -> Tensor:
    _, spread = channel_moments(program, data, states[:-1].unsqueeze(0))
    return spread[0][data.transitions].log().mean(0).double()


def _of_measurements(program: Program, data: Trajectories, states: Tensor) -> Tensor:
    return measured(program, states.unsqueeze(0)).spread[0][data.rows].log().mean(0).double()


Spread = Callable[[Program, Trajectories, Tensor], Tensor]
SPREADS: dict[str, Spread] = {"process_noise": _of_channels, "measurement_noise": _of_measurements}


def _columns(program: Program, variant: Variant) -> list[int]:
    """Of the standard deviations that an effect multiplies."""
    if "channels" not in variant.options:
        return list(range(len(names(program.measurements))))
    return [names(program.channels).index(channel) for channel in variant.options["channels"]]


def _guessed(program: Program, parts: Sequence[Element], slope: Tensor) -> bool:
    moving = [part.name for part, value in zip(parts, slope.tolist(), strict=True) if value]
    return any(name.startswith(guess) for name in moving for guess in program.guesses)
