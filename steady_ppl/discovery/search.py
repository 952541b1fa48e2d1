"""Which effect is missing: screen, refit the leaders, choose on held-out drives, look again, until nothing is left.

The steps are those of score-test model building (Klein and Morelli 2006 do them by stepwise regression); what decides
is held-out log p(y), each drive judged by a program that was fitted without it, but for its process noise.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch

from steady_ppl.criticism.step_size import MIN_GAIN, StepCheck, check_step
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.discovery.candidates import (
    MAX_NATS_OF_RIVAL,
    NEAR_FAMILY_LEVEL,
    TIE_NATS,
    UNEXPLAINED,
    Candidate,
    Screening,
    at_its_best_place,
    attempts,
    bar_of,
    judged,
    leaders,
    moved_to_likelier_place,
    screen_program,
)
from steady_ppl.discovery.judges import MIN_GAIN_OF_CURVE, Choice, CurveJudge, ParticleJudge, first_enough
from steady_ppl.discovery.noise_first import needless, with_same_noise, with_suitable_noise, without, without_outliers
from steady_ppl.discovery.prune import prune
from steady_ppl.discovery.refits import (
    NO_THRESHOLD,
    Refit,
    Threshold,
    first_refit,
    refit_with,
)
from steady_ppl.discovery.screening import Tested
from steady_ppl.discovery.search_state import FINER, LOOKING, MAX_EFFECTS, Found, Round, Search, with_places_of
from steady_ppl.effects import Effect, Variant, attached
from steady_ppl.errors import FilterError
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import with_substeps
from steady_ppl.utils.journal import close_journal
from steady_ppl.utils.progress import stages
from steady_ppl.utils.text import reason_of

MAX_SHIFT_OF_SIZES = 0.08  # nats by which twice the substeps may move what is reported: 0.4 standard deviations
MAX_SUBSTEPS_OF_FIT = 128  # of a fitted program, at most: what a coarser step leaves would be named as an effect
MAX_CURVES = 3  # adding curves that are fitted
MAX_ROUNDS = MAX_EFFECTS + 3  # with factors on noise, which take no place, and a last test
NOT_FINER = "what was found was not looked at in finer time steps: {}"
COARSE = "what was found asks for {} substeps a row: all sizes are those of a step that is too coarse"
NOTHING_TESTED = "the model as it stands was fitted, and no effect has been tested yet"


@dataclass(frozen=True)
class Settings:
    """What a search was told."""

    declared: Program  # the program before it was fitted
    sets: int = 200  # simulated sets of the first round
    later_sets: int = 60  # of each further one
    seed: int = 0  # of the simulated sets
    withheld: Sequence[str] = ()  # names of effects that are left out of the catalogue
    only: Sequence[str] = ()  # the kinds of effects that are looked for; all of them where none is named

    def wants(self, effect: Effect) -> bool:
        """Whether an effect is looked for."""
        return effect.name not in self.withheld and (not self.only or effect.verdict in self.only)

    def corrects(self, variant: Variant) -> bool:
        """Whether a declared noise may be corrected, whichever effects are looked for."""
        return variant.effect.name not in self.withheld

    def screen(self, now: Refit, index: int) -> Screening:
        """Test every candidate that a fitted program does not have, in a round counted from 0."""
        sets = self.later_sets if index else self.sets
        return screen_program(now, self.declared, sets=sets, seed=self.seed + index, wanted=self.wants)


def search(problem: Problem, valid: Trajectories, settings: Settings) -> Search:
    """Look for the effects that a program lacks; its drives test it, both they and `valid` choose."""

    def fit(program: Program, train: Trajectories, valid: Trajectories, nearer: Program | None = None) -> Refit:
        return first_refit(Problem(program, train, problem.known_start), valid, seed=settings.seed, nearer=nearer)

    program = problem.program
    with stages(("fitting the model as it stands", 1), ("comparing time steps", 1), ("", 8)) as begin:
        begin()
        own, suited, outliers, whole = without_outliers(partial(fit, program), problem.data, valid, settings.corrects)
        left, valid = (one.left for one in outliers)
        (base, corrections), tails = suited, suited.tails
        gained = whole.maxima[0].gained
        _require_resolved(base)
        begin()
        step = _step_of(base)
        if step.too_coarse:  # the step is no effect: what follows is about the program at the step that suits
            finer = step.suited.substeps
            nearer = with_substeps(own.program, finer) if corrections else step.suited.program
            settings = replace(settings, declared=with_substeps(settings.declared, finer))
            program = with_substeps(program, finer)
            own = fit(program, left, valid, nearer)
            base, corrections = with_suitable_noise(own, settings.corrects, tails)
        begin()
        found = _rounds(Search(own, base, base, step, gained, outliers, corrections), settings)

        if found.asks is None or found.interrupted:
            return found
        finer = found.asks.suited.substeps  # sizes are those of that step
        try:
            own = fit(with_substeps(program, finer), left, valid, with_substeps(own.program, finer))
            same = with_same_noise(own, base, corrections) if corrections else None
            base, corrections = same or with_suitable_noise(own, settings.corrects, tails)
            there = replace(settings, declared=with_substeps(settings.declared, finer))
            fresh = Search(own, base, base, step, gained, outliers, corrections, found.asks)
            again = _rounds(fresh, there, carried=found.found, looks_at_step=False)
            if again.interrupted != LOOKING:
                return again
            found.interrupt(FINER)
        except KeyboardInterrupt:
            found.interrupt(FINER)
        except Exception as error:  # also of the program's own code, in steps that nobody tried before
            found.notes.append(NOT_FINER.format(reason_of(error)))
            close_journal()
            _end(found, settings)
            return found
    found.notes.append(COARSE.format(finer))
    return found


def _require_resolved(base: Refit) -> None:
    """Raise FilterError where rounding moves a trajectory's log p(y) by more than what counts between programs."""
    for fold, maximum in zip(base.folds, base.maxima, strict=True):
        likely, index = maximum.log_likelihood.min(0)
        if -likely * torch.finfo(fold.drives.measurements.dtype).eps > MIN_GAIN:
            label = fold.drives.labels[int(index)]
            raise FilterError(
                f"trajectory {label}: its log p(y) is {float(likely):.2g} nats, too far down to compare models: "
                "`steady doctor` looks for wrong readings and units",
                trajectory=label,
            )


def _step_of(refit: Refit, **watched: Any) -> StepCheck:
    """A program that was fitted to the first fold beside itself at finer steps, on these drives."""
    given = (refit.program, refit.folds[0].drives, refit.maxima[0])
    return check_step(*given, known_start=refit.folds[0].known_start, finest=MAX_SUBSTEPS_OF_FIT, **watched)


def _look_at_step(found: Search) -> None:
    """Compare time steps beside what was found."""
    if not found.found:
        return
    try:
        parameters = [variant.parameter for variant in attached(found.final.program)]
        check = _step_of(found.final, watched=parameters, max_shift=MAX_SHIFT_OF_SIZES)
        found.asks = check if check.too_coarse else None
    except Exception as error:  # also of the program's own code, in steps that nobody tried before
        found.notes.append(NOT_FINER.format(reason_of(error)))


def _rounds(found: Search, settings: Settings, carried: Sequence[Found] = (), *, looks_at_step: bool = True) -> Search:
    """Test, fit and add until nothing is left, or until an interrupt (Ctrl-C) after the first tests.

    What was found at a coarser step and is `carried` is added after the first round, as far as it is needed. Where it
    `looks_at_step`, it ends before curves if what was found `asks` for a finer one.
    """
    doing = LOOKING
    try:
        with stages(("", 6), ("looking again", 1)) as begin:
            begin()
            _add_all(found, settings, carried)
            doing = "looking again at what was found"
            begin()
            if len(found.found) > 1:
                _look_again(found, settings)
            doing = FINER
            if looks_at_step:
                _look_at_step(found)
    except KeyboardInterrupt as stop:
        if not found.rounds:
            raise KeyboardInterrupt(NOTHING_TESTED) from stop
        found.interrupt(doing)
    if found.asks is None and not found.interrupted:
        _end(found, settings)
    return found


def _end(found: Search, settings: Settings) -> None:
    """Fit curves beside what was found, and take corrections back that it makes needless, until an interrupt."""
    try:
        if found.found and not found.curves and (len(found.found) > 1 or not found.rounds[1].nothing_found):
            with stages(("fitting curves", 1)) as begin:
                begin()
                found.curves = _curves(found)
        if found.found:
            _drop_corrections(found, settings)
    except KeyboardInterrupt:
        found.interrupt("fitting curves")
    except Exception as error:  # also of the program's own code
        found.notes.append(f"curves and corrections were not looked at to the end: {reason_of(error)}")


def _drop_corrections(found: Search, settings: Settings) -> None:
    """Take corrections of the noise back that are not needed beside what was found."""
    dropped = needless(found.corrections, found.final, found.rounds[-1].screening)
    final = without(dropped, found.as_it_stands, found.final) if dropped else None
    if final is None:
        return
    try:
        last = Round(settings.screen(final, MAX_ROUNDS + 1), [], None)
    except Exception as error:  # also of the program's own code
        found.notes.append(f"the declared noise was not taken back, for with it the tests fail: {reason_of(error)}")
        return
    kept = [one for one in found.corrections if one not in dropped]
    found.rounds, found.final, found.corrections = [*found.rounds, last], final, kept


def _add_all(found: Search, settings: Settings, carried: Sequence[Found]) -> None:
    """Test, fit and add one effect after another; at first what is `carried`."""
    near = {rival.variant.name for one in carried for rival in one.contenders}
    shares = [(said, 0.5**index) for index in range(MAX_ROUNDS) for said in ("testing every effect", "")]
    with stages(*shares) as begin_part:
        earlier = list(found.found)
        for index in range(MAX_ROUNDS):
            begin_part()
            try:
                screening = settings.screen(found.final, index)
            except Exception as error:
                if index == 0 or (index == 1 and carried):  # no tests of a program that is left
                    raise
                taken_back = found.found[-1]
                found.found, found.final = earlier, taken_back.without
                found.taken_back = {taken_back.candidate.variant.label: reason_of(error)}
                break
            begin_part()
            earlier = list(found.found)
            if not _add_best(found, screening, index, near if index == 0 and carried else None):
                break
            if index == 0:
                _carry(found, carried)


def _carry(found: Search, carried: Sequence[Found]) -> None:
    """Add effects of another search that explain something and are needed beside the first one here, each or a rival
    that it had there."""
    for one in (one for one in carried if one.candidate.is_explanation):
        there, rivals = {variant.name for variant in attached(found.final.program)}, one.contenders
        if found.is_full or one.candidate.variant.name in there:
            continue
        again = [_fitted_again(found.final, c) for c in rivals if c.variant.name not in there]
        best, again = ParticleJudge(found.final).chosen(again, partial(first_enough, lambda c: c.total > TIE_NATS))
        if best is not None:
            _add(found, best, again)


def _fitted_again(now: Refit, candidate: Candidate) -> Candidate:
    """On every fold, beside what `now` has, from where it was."""
    assert isinstance(candidate.refit, Refit)
    begin = candidate.refit.coefficient(candidate.variant)
    again = judged(now, candidate.tested, refit_with(now, candidate.variant, begin))
    return at_its_best_place(now, again)


def _look_again(found: Search, settings: Settings) -> None:
    """Prune, and test a program that has other effects then."""
    before, final = list(found.found), found.final
    prune(found)
    if set(found.final.effects) == set(final.effects):  # the same in another order has been tested
        return
    try:
        found.rounds.append(Round(settings.screen(found.final, MAX_ROUNDS), [], None))
    except Exception as error:
        new = [label for label in found.final.effects if label not in final.effects]
        found.taken_back = dict.fromkeys(new, reason_of(error))
        found.found, found.final = before, final


def _add_best(found: Search, screening: Screening, index: int, near: Collection[str] | None = None) -> bool:
    """Fit what the tests of a round point at and add the best, if it brings enough; whether anything was added.

    `near` names the effects that are fitted before others, beside what the tests put first; None: all are.
    """
    found.rounds.append(Round(screening, [], None))
    if found.rounds[-1].nothing_found or found.is_full or index == MAX_ROUNDS - 1:
        return False
    judge, curve = ParticleJudge(found.final), CurveJudge(found.final, screening)
    candidates, best = list[Candidate](), None

    def is_enough(candidate: Candidate) -> bool:
        if not candidate.significant(screening.tests.critical):
            return False
        return index == 0 or not candidate.is_confirmed or curve.admits(candidate)  # fitting a curve costs more

    groups = _groups(leaders(screening.tests, index == 0), near)
    for group in groups:
        if index == 0 and group is groups[-1]:
            found.curves = _curves(found)
            if found.curve is not None:
                break
        candidates += _refits(found.final, group, screening, found.rounds[-1].candidates)
        best, candidates = _chosen(judge, candidates, partial(first_enough, is_enough))
        if best is not None:
            break
    if index == 0 and best is None and found.curve is None and not found.departed:  # neither is what the tests found
        nearly = partial(first_enough, lambda c: c.total > TIE_NATS and c.tested.p_value <= NEAR_FAMILY_LEVEL)
        best, candidates = judge.chosen(candidates, nearly)
    found.notes += curve.refused.values()
    found.rounds[-1] = Round(screening, candidates, best)
    if best is None:
        return False
    _add(found, best, candidates)
    return True


def _groups(chosen: Sequence[Tested], near: Collection[str] | None) -> list[list[Tested]]:
    """What is fitted first, and what only where nothing before it is enough: effects that are neither `near` nor what
    the tests put first, and then what imitates whatever is missing."""
    first, later, imitating = groups = [list[Tested](), list[Tested](), list[Tested]()]
    for tested in chosen:
        if tested.variant.effect.form == UNEXPLAINED:
            imitating.append(tested)
        elif near is None or tested.variant.name in near or not first:
            first.append(tested)
        else:
            later.append(tested)
    return groups


def _add(found: Search, best: Candidate, candidates: list[Candidate]) -> None:
    """Add an effect, and move the knees and places of the earlier ones to where they are likeliest beside it."""
    assert isinstance(best.refit, Refit)
    # in one assignment, here and below: no interrupt comes between effects and the program that has them
    found.found, found.final = [*found.found, Found(best, candidates, found.final)], best.refit
    for one in found.found[:-1]:
        _place_again(found, one)


def _place_again(search: Search, found: Found) -> None:
    """Move the knee or place of an effect to where it is likeliest beside those that were added after it."""
    final = moved_to_likelier_place(search.base, search.final, found.candidate.variant)
    search.found, search.final = with_places_of(final, search.found), final


def _refits(now: Refit, chosen: Sequence[Tested], screening: Screening, candidates: list[Candidate]) -> list[Candidate]:
    """Fits of what the tests point at; each is added to `candidates` as it ends, whatever happens to the next."""
    chosen, begun = sorted(chosen, key=lambda tested: tested.variant.effect.verdict == "noise"), len(candidates)
    with stages(*((f"fitting with {tested.variant.label}", 1) for tested in chosen)) as begin:
        for fit in attempts(now, chosen, screening):
            begin()
            candidates.append(fit(_threshold(candidates)))
    best = max((c for c in candidates if c.is_judged), key=lambda c: c.total, default=None)
    added = [c if c.is_judged else replace(c, behind=best) for c in candidates[begun:]]
    least = max((c.total for c in [*candidates[:begun], *added]), default=0.0) - MAX_NATS_OF_RIVAL
    return [at_its_best_place(now, c) if c.total > least else c for c in added]


def _chosen(
    judge: ParticleJudge, candidates: Sequence[Candidate], choose: Choice
) -> tuple[Candidate | None, list[Candidate]]:
    """See `ParticleJudge.chosen`. Candidates that were given up and seem to be ahead of all others are judged then:
    a filter may have denied the one beside which they stayed behind."""
    while True:
        best, ranked = judge.chosen(candidates, choose)
        most = max((c.total for c in ranked if c.is_judged), default=-math.inf)
        candidates = [c if c.is_judged or c.total <= most else _fitted_again(judge.now, c) for c in ranked]
        if all(one is other for one, other in zip(candidates, ranked, strict=True)):
            return best, ranked


def _threshold(candidates: Sequence[Candidate]) -> Threshold:
    """What the next candidate must reach on the first fold, given those that were fitted. What loses on the drives
    kept from it, or imitates whatever is missing, says nothing of what can be reached."""
    return bar_of([c.refit for c in candidates if isinstance(c.refit, Refit) and c.is_explanation and c.total > 0])


def _curves(search: Search) -> list[Candidate]:
    """Fits of the curves that the first tests point at; they are given up where they stay far behind all effects."""
    base, screening = search.base, search.rounds[0].screening
    named, threshold = None, NO_THRESHOLD
    if search.found:
        named = judged(base, search.found[0].candidate.tested, search.final)
        threshold = replace(bar_of([search.final]), stops_early=True)

    def multiplies(one: Tested | Candidate) -> bool:
        return bool(one.variant.options.get("times"))

    adding = [tested for tested in screening.tests.curves if not multiplies(tested)]
    multiplying = [tested for tested in screening.tests.curves if multiplies(tested)]
    chosen = [*adding[:MAX_CURVES], *multiplying[:1]]
    judge = ParticleJudge(base)
    fitted = (replace(fit(threshold), behind=named) for fit in attempts(base, chosen, screening, threshold))
    found = [judge.confirm(candidate) for candidate in fitted]
    # the simpler one, unless the other brings clearly more
    return sorted(found, key=lambda c: c.total - MIN_GAIN_OF_CURVE * multiplies(c), reverse=True)
