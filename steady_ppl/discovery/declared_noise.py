"""How far the fitted noise of the channels is from what the program declared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from steady_ppl.data import Trajectories
from steady_ppl.effects import Variant, catalogue
from steady_ppl.program import Program, names
from steady_ppl.scores import Element, channel_moments, moved


@dataclass(frozen=True)
class Departure:
    """Of the fitted standard deviations of some channels from the declared.

    Attributes:
        variant: `process_noise` of these channels.
        away: log ratio of fitted to declared, the channels' mean.
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
    """Of every group of channels whose noise is learned and not marked a guess (`guesses`).

    Args:
        declared: the program as it was before it was fitted.
        fitted: the program.
        data: as returned by `for_program`.
        states: along which the noise is looked at, `(T + 1, B, D)`.
        parts: the learnable numbers of `fitted`.
    """
    order = names(fitted.channels)
    slopes = []
    for part in parts:
        with moved(part, part.step):
            up = _log_spread(fitted, data, states)
        with moved(part, -part.step):
            slopes.append((up - _log_spread(fitted, data, states)) / (2 * part.step))
    if not slopes:
        return []
    slope = torch.stack(slopes)
    away = _log_spread(fitted, data, states) - _log_spread(declared, data, states[..., : len(declared.states)])
    found = []
    for effect in catalogue(fitted):
        for variant in effect.variants(fitted) if effect.name == "process_noise" else []:
            index = [order.index(channel) for channel in variant.options["channels"]]
            index = [i for i in index if bool(slope[:, i].any()) and not _guessed(fitted, parts, slope[:, i])]
            if index:
                found.append(Departure(variant, float(away[index].mean()), slope[:, index].mean(1)))
    return found


def _log_spread(program: Program, data: Trajectories, states: Tensor) -> Tensor:
    _, spread = channel_moments(program, data, states[:-1].unsqueeze(0))
    return spread[0][data.transitions].log().mean(0).double()


def _guessed(program: Program, parts: Sequence[Element], slope: Tensor) -> bool:
    moving = [part.name for part, value in zip(parts, slope.tolist(), strict=True) if value]
    return any(name.startswith(guess) for name in moving for guess in program.guesses)
