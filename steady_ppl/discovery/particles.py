"""What a particle filter says of candidates that the linearised programs' log p(y) ranks: it has the last word."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from steady_ppl.discovery.candidates import Candidate
from steady_ppl.discovery.fitting import neglected_along
from steady_ppl.discovery.refits import BY_LIKELIHOOD, Refit
from steady_ppl.errors import FilterError

NEGLIGIBLE_NATS = 1.0  # by which a filter may rank otherwise before it is asked once more, and from then on believed


def confirmed(now: Refit, candidates: Sequence[Candidate]) -> list[Candidate]:
    """Candidates for a program `now`, best first, the best by the particle filter's log p(y).

    The linearised log p(y) is off where a program is far from linear. What it neglects of a candidate and not of the
    program without is no gain.
    """
    ranked = sorted(candidates, key=lambda candidate: -candidate.total)
    if now.fitting != BY_LIKELIHOOD or not ranked:
        return ranked
    without: dict[int, Tensor] = {}

    def neglected(refit: Refit, seed: int) -> Tensor:
        judges = zip(refit.judges.programs, refit.folds, strict=True)
        return torch.cat([neglected_along(fold.judging(p), fold.held_out_path, seed=seed) for p, fold in judges])

    def more(refit: Refit, seed: int) -> Tensor:
        if seed not in without:
            without[seed] = neglected(now, seed)
        return neglected(refit, seed) - without[seed]

    while (best := ranked[0]).is_judged and not best.is_confirmed and best.total > 0:
        assert isinstance(best.refit, Refit)
        try:
            found = more(best.refit, 0)
            if not abs(float(found.sum())) <= NEGLIGIBLE_NATS:
                found = (found + more(best.refit, 1)) / 2
            believed = abs(float(found.sum())) > NEGLIGIBLE_NATS
            best = replace(best, gain=best.gain + found if believed else best.gain, is_confirmed=True)
        except FilterError as error:
            gain = torch.full_like(best.gain, -math.inf)
            best = replace(best, refit=f"no particle filter follows the drives: {error}", gain=gain, alone=gain)
        ranked = sorted([best, *ranked[1:]], key=lambda candidate: -candidate.total)
    return ranked
