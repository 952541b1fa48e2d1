"""Scores of drives that the fitted program makes itself: their spread is the information, their mean the bias."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.discovery.columns import PART, Column, Scoring
from steady_ppl.errors import FilterError
from steady_ppl.gaussian.information_filter import Lookahead
from steady_ppl.gaussian.linearize import Path
from steady_ppl.gaussian.predict import simulate_again
from steady_ppl.gaussian.smoother import smooth
from steady_ppl.likelihood.parameters import Element
from steady_ppl.likelihood.scores import parameter_scores, smoothed
from steady_ppl.model.program import Program
from steady_ppl.utils.random import seeded

LEAST_LEFT = 0.8  # share of the simulated sets that must not blow up


@dataclass(frozen=True)
class Simulated:
    """Scores of simulated sets of drives.

    Attributes:
        scores: `(S, B, N)`, of the parameters first and then of the columns.
        log_likelihood: `(S, B)`.
    """

    scores: Tensor
    log_likelihood: Tensor

    @cached_property
    def information(self) -> Tensor:
        """Covariance of a set's summed scores, `(N, N)`, from the spread of each drive's among the sets."""
        apart = self.scores - self.scores.mean(0)
        return torch.einsum("sbi,sbj->ij", apart, apart) / (len(apart) - 1)


def scores_along(
    program: Program, data: Trajectories, ahead: Lookahead, parts: Sequence[Element], columns: Sequence[Column]
) -> Tensor:
    """Scores of parameters and columns, `(B, N)`."""
    at = smoothed(ahead, data)
    scoring = Scoring(program, data, at)
    return torch.cat([parameter_scores(program, data, at, list(parts)), *(scoring(column) for column in columns)], -1)


@torch.no_grad()
def simulate_scores(
    program: Program,
    data: Trajectories,
    starts: Tensor,
    parts: Sequence[Element],
    columns: Sequence[Column],
    *,
    known_start: bool,
    seed: int,
    passes: int = 2,
) -> Simulated:
    """Simulate drives with the same controls and gaps, and score them at the same parameters.

    Args:
        program: fitted.
        data: as returned by `for_program`.
        starts: where each drive begins, `(S, B, D)`.
        parts, columns: what is scored.
        known_start: the first state is certain.
        seed: the same seed gives the same scores.
        passes: linearisations; they begin at the true path.
    """
    channels, sets = len(program.channels), len(starts)
    with seeded(seed, "bootstrap"):
        drives, path = simulate_again(program, data, starts, channels)
    scores, likely = [], []
    for first in range(0, len(drives), PART):
        index = torch.arange(first, min(first + PART, len(drives)))
        part = drives.subset(index)
        ahead = smooth(
            program, part, Path(path.states[:, index], path.noise[:, index]), known_start=known_start, passes=passes
        )
        scores.append(scores_along(program, part, ahead, parts, columns))
        likely.append(ahead.log_likelihood)
    found = Simulated(torch.cat(scores).unflatten(0, (sets, len(data))), torch.cat(likely).view(sets, len(data)))
    whole = torch.isfinite(found.scores).all(-1).all(-1) & torch.isfinite(found.log_likelihood).all(-1)
    if int(whole.sum()) < LEAST_LEFT * sets:
        raise FilterError(
            f"{int((~whole).sum())} of {sets} simulated sets blew up: the fitted program does not even explain "
            "drives of its own"
        )
    return Simulated(found.scores[whole], found.log_likelihood[whole])
