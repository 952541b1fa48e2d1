"""Who has the last word on candidates that the linearised programs' log p(y) ranks: a particle filter, which says what
that neglects, and a curve, which says whether what is left is of another kind."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from steady_ppl.discovery.candidates import CLEAR_GAIN, MIN_ALIAS_CORRELATION, Candidate, Screening, attempts, bar_of
from steady_ppl.discovery.fitting import neglected_along
from steady_ppl.discovery.refits import BY_LIKELIHOOD, Refit
from steady_ppl.discovery.screening import Tested
from steady_ppl.errors import FilterError
from steady_ppl.utils.text import reason_of

MIN_GAIN_OF_CURVE = 3.0  # nats by which a curve must be better than named effects
NEGLIGIBLE_NATS = 1.0  # by which a filter may rank otherwise before it is asked once more, and from then on believed

Choice = Callable[[Sequence[Candidate]], Candidate | None]  # of candidates, best first


@dataclass(frozen=True)
class ParticleJudge:
    """Log p(y) of held-out drives by a filter that looks ahead, for candidates of a program `now`.

    The linearised log p(y) is off where a program is far from linear. What it neglects of a candidate and not of the
    program without is no gain. Where no filter follows the program without, the linearised log p(y) stands.
    """

    now: Refit

    def chosen(self, candidates: Sequence[Candidate], choose: Choice) -> tuple[Candidate | None, list[Candidate]]:
        """The candidate that is chosen when it has been confirmed, and all of them, best first."""
        ranked = sorted(candidates, key=lambda candidate: -candidate.total)
        while (best := choose(ranked)) is not None and not best.is_confirmed:
            confirmed = self.confirm(best)
            ranked = [confirmed if candidate is best else candidate for candidate in ranked]
            ranked.sort(key=lambda candidate: -candidate.total)
        return best, ranked

    def confirm(self, candidate: Candidate) -> Candidate:
        """The candidate with its gain by particles, or why no filter follows the drives."""
        if self.now.fitting != BY_LIKELIHOOD or not isinstance(candidate.refit, Refit) or not candidate.is_judged:
            return replace(candidate, is_confirmed=True)
        try:
            more = self._more(candidate.refit, 0)
            if more is not None and not abs(float(more.sum())) <= NEGLIGIBLE_NATS:
                again = self._more(candidate.refit, 1)
                more = more if again is None else (more + again) / 2
        except Exception as error:  # also of the program's own code
            nothing = torch.full_like(candidate.gain, -math.inf)
            reason = f"no particle filter follows the drives: {reason_of(error)}"
            return replace(candidate, refit=reason, gain=nothing, alone=nothing, is_confirmed=True)
        if more is None or abs(float(more.sum())) <= NEGLIGIBLE_NATS:
            return replace(candidate, is_confirmed=True)
        return replace(candidate, gain=candidate.gain + more, is_confirmed=True)

    def _more(self, refit: Refit, seed: int) -> Tensor | None:
        try:
            without = _neglected(self.now, seed)
        except FilterError:
            return None
        return _neglected(refit, seed) - without


def _neglected(refit: Refit, seed: int) -> Tensor:
    """Of all held-out drives, nats; filters of one refit and seed are asked once."""
    if seed not in refit.neglected:
        judges = zip(refit.judges.programs, refit.folds, strict=True)
        try:
            found = [neglected_along(fold.judging(p), fold.held_out_path, seed=seed) for p, fold in judges]
            refit.neglected[seed] = torch.cat(found)
        except FilterError as error:
            refit.neglected[seed] = str(error)
    told = refit.neglected[seed]
    if isinstance(told, str):
        raise FilterError(told)
    return told


class CurveJudge:
    """Whether a candidate of a program `now` may be added, where the tests tell far more of a curve.

    What is left may go with a variable with which the candidate has nothing to do. Where such a curve brings more, what
    is missing most has no name: it bends whatever is fitted beside it, and a small gain is no evidence.
    """

    def __init__(self, now: Refit, screening: Screening) -> None:
        self.now, self.screening, tests = now, screening, screening.tests
        best = next((tested for tested in tests.tested if tested.is_curve), None)
        self.tested = best if best is not None and best.p_value <= tests.critical else None
        self.curve: Candidate | None = None  # the program with it, once it was asked for

    def admits(self, candidate: Candidate) -> bool:
        """Whether a candidate is like the curve or as good as it."""
        if self.tested is None:
            return True
        if not candidate.is_explanation:
            return False
        tests = self.screening.tests
        order = [tested.variant.name for tested in tests.tested]
        places = order.index(self.tested.variant.name), order.index(candidate.variant.name)
        is_alike = float(tests.correlations[places]) > MIN_ALIAS_CORRELATION
        if is_alike or self.tested.evidence < candidate.tested.statistic / 2 + CLEAR_GAIN:
            return True
        curve = self.curve = self.curve or self._fitted(self.tested, candidate)
        return not curve.is_judged or curve.total <= candidate.total + MIN_GAIN_OF_CURVE

    def _fitted(self, tested: Tested, beside: Candidate) -> Candidate:
        """The program with the curve, given up where it stays far behind the best candidate."""
        assert isinstance(beside.refit, Refit)
        threshold = replace(bar_of([beside.refit]), stops_early=True)
        (fit,) = attempts(self.now, [tested], self.screening, threshold)
        return ParticleJudge(self.now).confirm(fit(threshold))
