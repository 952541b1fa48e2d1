"""Who has the last word on candidates that the linearised programs' log p(y) ranks.

A particle filter says what that neglects. A curve says whether what is left is of another kind.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from steady_ppl.discovery.candidates import MIN_ALIAS_CORRELATION, Candidate, Screening, attempts, bar_of
from steady_ppl.discovery.fitting import neglected_along
from steady_ppl.discovery.refits import BY_LIKELIHOOD, NO_THRESHOLD, Refit
from steady_ppl.errors import FilterError
from steady_ppl.utils.text import reason_of

WITHIN_ROWS = "between"  # the form of effects that no state can tell
MIN_GAIN_OF_CURVE = 3.0  # nats by which a curve must be better than named effects
CLEAR_EVIDENCE = 10.0  # nats by which the tests must tell more of a curve than of an effect to deny it
MAX_RATIO_OF_CURVE = 2.0  # of what a curve brings and an effect of another kind that is added all the same
NEGLIGIBLE_NATS = 1.0  # by which a filter may rank otherwise before it is asked once more, and from then on believed

Choice = Callable[[Sequence[Candidate]], Candidate | None]  # of candidates, best first


def first_enough(is_enough: Callable[[Candidate], bool], ranked: Sequence[Candidate]) -> Candidate | None:
    """The best candidate that brings enough, one that explains something before one that does not."""
    able = sorted((c for c in ranked if c.is_judged and not c.against_its_sign), key=lambda c: not c.is_explanation)
    return next((c for c in able if is_enough(c)), None)


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
            reason = f"no particle filter follows the trajectories: {reason_of(error)}"
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

    What is left may go with a variable with which the candidate has nothing to do. Where such a curve brings far more,
    what is missing most has no name: it bends whatever is fitted beside it, and a small gain is no evidence.
    """

    def __init__(self, now: Refit, screening: Screening) -> None:
        self.now, self.screening, tests = now, screening, screening.tests
        best = next((tested for tested in tests.tested if tested.is_curve), None)
        self.tested = best if best is not None and best.p_value <= tests.critical else None
        self.refused: dict[str, str] = {}  # candidates that were not admitted, by their label, and why
        self._curve: Candidate | None = None  # the program with the curve, once it was fitted to the end
        self._ahead: set[str] = set()  # candidates beside which its fit was given up

    def admits(self, candidate: Candidate) -> bool:
        """Whether a candidate is like the curve or brings half as much; if it imitates whatever is missing, whether the
        curve brings nothing. How controls go within a row is a matter of the table, whatever a curve brings."""
        if self.tested is None or candidate.variant.effect.form == WITHIN_ROWS:
            return True
        if candidate.is_explanation:
            tests = self.screening.tests
            order = [tested.variant.name for tested in tests.tested]
            places = order.index(self.tested.variant.name), order.index(candidate.variant.name)
            is_alike = float(tests.correlations[places]) > MIN_ALIAS_CORRELATION
            if is_alike or self.tested.evidence < candidate.tested.statistic / 2 + CLEAR_EVIDENCE:
                return True
        label, gain = candidate.variant.label, self._gain(candidate)
        most = max(MIN_GAIN_OF_CURVE, MAX_RATIO_OF_CURVE * candidate.total * candidate.is_explanation)
        if gain > most:
            brings = f"it brings {candidate.total:.0f} nats, a curve ({self.tested.variant.at}) {gain:.0f}"
            self.refused[label] = f"{label} is not added: {brings}"
        return gain <= most

    def _gain(self, beside: Candidate) -> float:
        """Held-out log p(y) of the program with the curve above that of the program, nats; minus infinity where it
        cannot be fitted, or stays so far behind a candidate that explains something that it was given up."""
        label = beside.variant.label
        if self._curve is None and label in self._ahead:
            return -math.inf
        if self._curve is None:
            assert self.tested is not None and isinstance(beside.refit, Refit)
            threshold = NO_THRESHOLD
            if beside.is_explanation:
                threshold = replace(bar_of([beside.refit]), stops_early=True)
            (fit,) = attempts(self.now, [self.tested], self.screening, threshold)
            curve = ParticleJudge(self.now).confirm(fit(threshold))
            if not curve.is_judged:
                self._ahead.add(label)
                return -math.inf
            self._curve = curve
        return self._curve.total
