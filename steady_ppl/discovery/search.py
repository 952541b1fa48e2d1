"""Which effect is missing: screen, refit the leaders, choose on held-out drives, go on until nothing is left.

The steps are those of score-test model building (Klein and Morelli 2006 do them by stepwise regression); what decides
is held-out log p(y), each drive judged by a program that was fitted without it, but for its process noise.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace

from steady_ppl.criticism.step_size import StepCheck, check_step
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.discovery.candidates import (
    NATS,
    NEARLY,
    Candidate,
    Screening,
    Settings,
    fitted,
    leaders,
    screen_program,
)
from steady_ppl.discovery.look_again import RIVALS, labels, look_again
from steady_ppl.discovery.places import at_its_best_place
from steady_ppl.discovery.refits import Refit, Worth, first_refit
from steady_ppl.discovery.rounds import MARGIN, Found, Round, Search
from steady_ppl.effects import attached
from steady_ppl.errors import FilterError
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import with_substeps
from steady_ppl.utils.progress import stages

BEHIND = 25.0  # nats behind the best on the drives of a fold, with which a candidate is hardly worth another
MAX_SHIFT_OF_SIZES = 0.08  # nats by which twice the substeps may move what is reported: 0.4 standard deviations
FINEST = 128  # substeps at which a program is fitted, at most: what a coarser step leaves would be named as an effect
MOST, CURVES = 5, 3  # effects in a program, and adding curves that are fitted


def search(
    program: Program,
    train: Trajectories,
    valid: Trajectories,
    *,
    known_start: bool,
    declared: Program | None = None,
    sets: int = 200,
    later_sets: int = 60,
    seed: int = 0,
    withheld: Sequence[str] = (),
) -> Search:
    """Look for the effects that a program lacks.

    Args:
        program: the state-space model; it is not changed.
        train, valid: as returned by `for_program`; tests are made on the first, both choose.
        known_start: the first states are certain.
        declared: the program before it was fitted; `program` when None.
        sets: simulated sets of the first round.
        later_sets: of each further one.
        seed: of the simulated sets.
        withheld: names of effects that are left out of the catalogue.
    """
    settings = Settings(known_start, withheld)
    declared = copy.deepcopy(declared or program)

    def first(program: Program, nearer: Program | None = None) -> Refit:
        return first_refit(program, train, valid, known_start=known_start, seed=seed, nearer=nearer)

    with stages(("fitting the program as it stands", 1), ("comparing time steps", 1), ("", 8)) as begin:
        begin()
        base = first(program)
        gained = base.maxima[0].gained
        begin()
        step = _step_of(base, known_start)
        if step.too_coarse:  # the step is no effect: what follows is about the program at the step that suits
            program, declared = (with_substeps(one, step.suited.substeps) for one in (program, declared))
            base = first(program, step.suited.program)
        begin()
        found = _rounds(Search(known_start, base, base, step, gained), declared, settings, sets, later_sets, seed)
        with_found = _step_of(found.final, known_start, found.found) if found.found else step
        if found.found and with_found.too_coarse:  # what was found asks for a finer step: sizes are those of that step
            finer = with_found.suited.substeps
            program, declared = (with_substeps(one, finer) for one in (program, declared))
            base = first(program, with_substeps(found.base.program, finer))
            again = Search(known_start, base, base, step, gained, with_found)
            found = _rounds(again, declared, settings, sets, later_sets, seed)
    return found


def _step_of(refit: Refit, known_start: bool, found: Sequence[Found] = ()) -> StepCheck:
    """A program that was fitted to the first fold beside itself at finer steps, on these drives; sizes of what was
    found must not go with the step."""
    drives, maximum = refit.folds[0].drives, refit.maxima[0]
    if not found:
        return check_step(refit.program, drives, maximum, known_start=known_start, finest=FINEST)
    return check_step(
        refit.program,
        drives,
        maximum,
        known_start=known_start,
        watched=[variant.parameter for variant in attached(refit.program)],
        max_shift=MAX_SHIFT_OF_SIZES,
        finest=FINEST,
    )


def _rounds(found: Search, declared: Program, settings: Settings, sets: int, later_sets: int, seed: int) -> Search:
    """Test, fit and add until nothing is left."""
    with stages(("", 7), ("looking again", 1)) as begin:
        begin()
        rounds = range(MOST + 1)
        shares = [part for index in rounds for part in (("testing every effect", 1 / 2**index), ("", 1 / 2**index))]
        with stages(*shares) as begin_part:
            for index in rounds:
                begin_part()
                count = sets if index == 0 else later_sets
                try:
                    screening = screen_program(found.final, declared, settings, sets=count, seed=seed + index)
                except FilterError:
                    if index == 0:
                        raise
                    taken_back = found.found.pop()
                    found.final, found.broke = taken_back.without, [taken_back.candidate.variant.label]
                    break
                begin_part()
                if not _add_best(found, screening, settings, index):
                    break
        begin()
        if len(found.found) > 1:
            before, final = list(found.found), found.final
            look_again(found, settings)
            if set(labels(found.final)) != set(labels(final)):  # the same in another order has been tested
                last = seed + MOST + 1
                try:
                    screening = screen_program(found.final, declared, settings, sets=later_sets, seed=last)
                    found.rounds.append(Round(screening, [], None))
                except FilterError:
                    found.broke = [label for label in labels(found.final) if label not in labels(final)]
                    found.found, found.final = before, final
    return found


def _add_best(found: Search, screening: Screening, settings: Settings, index: int) -> bool:
    """Fit what the tests of a round point at and add the best, if it brings enough; whether anything was added."""
    found.rounds.append(Round(screening, [], None))
    if found.rounds[-1].quiet:
        return False
    if index == 1 and not found.curves:
        found.curves = _curves(found.base, found.rounds[0].screening, settings)
    if index == MOST:
        return False
    candidates = _refits(found.final, screening, settings, index == 0)
    able = [c for c in candidates if c.is_judged and not c.against_its_sign]
    best = next((c for c in able if c.significant(screening.tests.critical)), None)
    gains = best is not None
    if index == 0 and not gains:
        found.curves = _curves(found.base, screening, settings)
    if index == 0 and not gains and found.needs_a_name:
        best = next((c for c in able if c.total > NATS and c.tested.p_value <= NEARLY), None)
    found.rounds[-1] = Round(screening, candidates, best)
    if best is None:
        return False
    found.found.append(Found(best, candidates, found.final))
    assert isinstance(best.refit, Refit)
    found.final = best.refit
    return True


def _refits(now: Refit, screening: Screening, settings: Settings, first: bool) -> list[Candidate]:
    candidates: list[Candidate] = []
    chosen = leaders(screening.tests, first)
    with stages(*((f"fitting with {tested.variant.label}", 1) for tested in chosen)) as begin:
        for tested in chosen:
            begin()
            candidates.append(fitted(now, tested, screening, settings, _worth(candidates)))
    best = max((c for c in candidates if c.is_judged), key=lambda c: c.total, default=None)
    candidates = [c if c.is_judged else replace(c, behind=best) for c in candidates]
    close = max((candidate.total for candidate in candidates), default=0.0) - RIVALS
    found = [at_its_best_place(now, c, settings) if c.total > close else c for c in candidates]
    return sorted(found, key=lambda candidate: -candidate.total)


def _worth(candidates: Sequence[Candidate]) -> Worth:
    """What the next candidate must reach on the first fold, given those that were fitted."""
    fits = [c.refit for c in candidates if isinstance(c.refit, Refit)]
    drives = [float(fit.maxima[0].log_likelihood.sum()) for fit in fits]
    held_out = [float(fit.held_out_alone[: len(fit.folds[0].held_out)].sum()) for fit in fits]
    return Worth(max(drives, default=-math.inf) - BEHIND, max(held_out, default=-math.inf) - NATS)


def _curves(base: Refit, screening: Screening, settings: Settings) -> list[Candidate]:
    every = screening.tests.curves
    adding = [tested for tested in every if not tested.variant.options.get("times")]
    multiplying = [tested for tested in every if tested.variant.options.get("times")]
    found = []
    for tested in [*adding[:CURVES], *multiplying[:1]]:
        found.append(fitted(base, tested, screening, settings))

    def worth(candidate: Candidate) -> float:
        """The simpler one, unless the other brings clearly more."""
        return candidate.total - (MARGIN if candidate.variant.options.get("times") else 0.0)

    return sorted(found, key=worth, reverse=True)
