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
from steady_ppl.likelihood.parameters import Element, moved
from steady_ppl.likelihood.scores import measured, substep_spreads
from steady_ppl.model.program import Program


@dataclass(frozen=True)
class Departure:
    """Of the fitted standard deviations of some channels, or of the measurements, from the declared.

    Attributes:
        variant: `process_noise` of these channels, or `measurement_noise`.
        away: log ratio of fitted to declared, their mean, on the drives that are tested.
        on_all: the same of the judges, on the drives of all folds.
        share: of the drives that are tested among all.
        slope: derivative of `away` in the fitted parameters, `(P,)`.
    """

    variant: Variant
    away: float
    on_all: float
    share: float
    slope: Tensor

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
    own = [part.name.split("[")[0] not in {known.parameter for known in attached(now.program)} for part in parts]
    counts = [len(fold.drives) for fold in now.folds]
    found = []
    for name, spread in SPREADS.items():
        slope = _slope(spread, now.program, now.folds[0], parts) * torch.tensor(own).unsqueeze(-1)
        away = _away(spread, declared, now.program, now.folds[0])
        of_folds = torch.stack(
            [_away(spread, declared, *one) for one in zip(now.judges.programs, now.folds, strict=True)]
        )
        mean = (torch.tensor(counts).unsqueeze(-1) * of_folds).sum(0) / sum(counts)
        variants = [v for effect in catalogue(now.program) if effect.name == name for v in effect.variants(now.program)]
        for variant in variants if parts else []:
            index = _columns(now.program, variant)
            index = [i for i in index if bool(slope[:, i].any()) and not _guessed(now.program, parts, slope[:, i])]
            if index:
                away_of, mean_of = float(away[index].mean()), float(mean[index].mean())
                found.append(Departure(variant, away_of, mean_of, counts[0] / sum(counts), slope[:, index].mean(1)))
    return found


def _slope(spread: Spread, program: Program, fold: Fold, parts: Sequence[Element]) -> Tensor:
    """The derivative of log standard deviations in the parameters, `(P, C)` or `(P, K)`."""
    slopes = []
    for part in parts:
        with moved(part, part.step):
            up = _spread(spread, program, fold)
        with moved(part, -part.step):
            slopes.append((up - _spread(spread, program, fold)) / (2 * part.step))
    return torch.stack(slopes) if slopes else torch.zeros(0)


def _away(spread: Spread, declared: Program, program: Program, fold: Fold) -> Tensor:
    """Log ratios of standard deviations to the declared, `(C,)` or `(K,)`."""
    return _spread(spread, program, fold) - _spread(spread, as_declared(declared, program), fold)


def _spread(spread: Spread, program: Program, fold: Fold) -> Tensor:
    return spread(program, fold.drives, fold.path.states)


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
