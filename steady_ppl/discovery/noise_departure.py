"""How far the fitted noise is from what the program declared, of channels and of measurements."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.discovery.refits import Fold, Refit, as_declared
from steady_ppl.effects import Variant, attached, catalogue
from steady_ppl.likelihood.parameters import Element, on_both_sides
from steady_ppl.likelihood.scores import measured, substep_spreads
from steady_ppl.model.program import Program


@dataclass(frozen=True)
class Departure:
    """Of the fitted standard deviations of some channels, or of the measurements, from the declared."""

    variant: Variant  # `process_noise` of these channels, or `measurement_noise`
    away: float  # log ratio of fitted to declared, their mean, on the drives that are tested
    on_all: float  # the same of the judges, on the drives of all folds
    share: float  # of the drives that are tested among all
    slope: Tensor  # derivative of `away` in the fitted parameters, (P,)

    @property
    def factor(self) -> float:
        """By what the noise differs."""
        return math.exp(self.on_all)


@torch.no_grad()
def departures(declared: Program, now: Refit, parts: Sequence[Element]) -> list[Departure]:
    """Of every group of channels and of the measurements, where their noise is learned and no guess (`guesses`).

    What effects that were added to the program do to its noise is no departure.

    Args:
        declared: the program as it was before it was fitted.
        now: the fitted program; the first fold's drives are tested.
        parts: the learnable numbers of the first fold's program.
    """
    if not parts:
        return []
    program, fold = now.program, now.folds[0]
    effects = {known.parameter for known in attached(program)}
    own = torch.tensor([part.name.split("[")[0] not in effects for part in parts])
    found = []
    for name, spread in SPREADS.items():
        slope = _slope(spread, program, fold, parts) * own.unsqueeze(-1)
        away = _away(spread, declared, program, fold)
        mean = now.mean([_away(spread, declared, *one) for one in zip(now.judges.programs, now.folds, strict=True)])
        variants = [v for effect in catalogue(program) if effect.name == name for v in effect.variants(program)]
        for variant in variants:
            index = _columns(program, variant)
            index = [i for i in index if bool(slope[:, i].any()) and not _guessed(program, parts, slope[:, i])]
            if index:
                of_all = float(mean[index].mean())
                found.append(
                    Departure(variant, float(away[index].mean()), of_all, now.first_share, slope[:, index].mean(1))
                )
    return found


def _slope(spread: Spread, program: Program, fold: Fold, parts: Sequence[Element]) -> Tensor:
    """The derivative of log standard deviations in the parameters, `(P, C)` or `(P, K)`."""
    slopes = []
    for part in parts:
        up, down = on_both_sides(part, lambda: spread(program, fold.drives, fold.path.states))
        slopes.append((up - down) / (2 * part.step))
    return torch.stack(slopes)


def _away(spread: Spread, declared: Program, program: Program, fold: Fold) -> Tensor:
    """Log ratios of standard deviations to the declared, `(C,)` or `(K,)`."""
    here, there = (spread(one, fold.drives, fold.path.states) for one in (program, as_declared(declared, program)))
    return here - there


def _of_channels(program: Program, data: Trajectories, states: Tensor) -> Tensor:
    spread = substep_spreads(program, data, states[:-1].unsqueeze(0))
    return spread[0][data.transitions].log().mean(0).double()


def _of_measurements(program: Program, data: Trajectories, states: Tensor) -> Tensor:
    return measured(program, states.unsqueeze(0)).spread[0][data.rows].log().mean(0).double()


Spread = Callable[[Program, Trajectories, Tensor], Tensor]
SPREADS: dict[str, Spread] = {"process_noise": _of_channels, "measurement_noise": _of_measurements}


def _columns(program: Program, variant: Variant) -> list[int]:
    """Of the standard deviations that an effect multiplies."""
    if "channels" not in variant.options:
        return list(range(len(program.measurement_names)))
    return [program.channel_names.index(channel) for channel in variant.options["channels"]]


def _guessed(program: Program, parts: Sequence[Element], slope: Tensor) -> bool:
    moving = [part.name for part, value in zip(parts, slope.tolist(), strict=True) if value]
    return any(name.startswith(guess) for name in moving for guess in program.guesses)
