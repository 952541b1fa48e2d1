"""Looking again at what was found: is each effect needed beside the others, and likelier than its rivals there?"""

from __future__ import annotations

from functools import partial

from steady_ppl.discovery.candidates import (
    MAX_NATS_OF_RIVAL,
    TIE_NATS,
    Candidate,
    at_its_best_place,
    judged,
    moved_to_likelier_place,
)
from steady_ppl.discovery.judges import ParticleJudge, first_enough
from steady_ppl.discovery.refits import Fits, Refit, fit_near, judged_fits, refit_with, refit_with_all
from steady_ppl.discovery.search_state import Found, Search, with_places_of
from steady_ppl.effects import attached

SAME_MAXIMUM = 0.2  # nats within which fits from two starts have ended at the same place
MIN_NATS_OF_DIVERGENCE = 25.0  # nats above every fit that it is a part of, from which a fit is not to be believed


def prune(search: Search) -> None:
    """Drop effects that are not needed beside the others, and let the rivals of each have its place."""
    for name in [one.candidate.variant.name for one in search.found]:
        found = next(one for one in search.found if one.candidate.variant.name == name)  # its place may have moved
        without = _without(search, found)
        if isinstance(without, str) or without is found.without:  # beside which it was chosen among the same rivals
            continue
        there = {variant.name for variant in attached(without.program)}
        as_it_stands = judged(without, found.candidate.tested, search.final)
        rivals = [one for one in found.contenders[1:] if one.variant.name not in there]
        again = [as_it_stands, *(_in_its_place(search, found, without, rival, as_it_stands) for rival in rivals)]
        needed = partial(first_enough, lambda c: c.total > TIE_NATS)
        best, again = ParticleJudge(without).chosen(again, needed)
        if best is None or isinstance(best.refit, str):
            search.found, search.final = [one for one in search.found if one is not found], without
        else:
            other = Found(best, again, without)
            with_other = [other if one is found else one for one in search.found]
            search.found, search.final = with_places_of(best.refit, with_other), best.refit


def _in_its_place(search: Search, found: Found, without: Refit, rival: Candidate, stands: Candidate) -> Candidate:
    """A rival beside the other effects, at its best place where it is near what `stands` there."""
    assert isinstance(rival.refit, Refit)
    begin = rival.refit.coefficient(rival.variant)
    one = judged(without, rival.tested, refit_with(without, rival.variant, begin))
    if one.total <= stands.total - MAX_NATS_OF_RIVAL:  # no knee or place brings it near
        return one
    one = at_its_best_place(without, one)
    for other in (other for other in search.found if other is not found):
        if isinstance(one.refit, Refit):
            moved = moved_to_likelier_place(search.base, one.refit, other.candidate.variant)
            one = one if moved is one.refit else judged(without, one.tested, moved)
    return one


def _without(search: Search, found: Found) -> Refit | str:
    """The program with the other effects, fitted from where it was before the later ones were added or from the fit of
    all, whichever is likelier: a fit that has stopped early makes an effect look needed."""
    others = [other.candidate.variant for other in search.found if other is not found]
    there = set(found.without.effects) - set(search.base.effects)
    begun = there <= {other.label for other in others}
    start = found.without if begun else search.base
    later = [(other, search.final.coefficient(other)) for other in others if not begun or other.label not in there]
    afresh = refit_with_all(start, later, search.final.maxima[0]) if later else start
    near = fit_near(search.base, search.final, others)
    if isinstance(afresh, str) or isinstance(near, str):
        return afresh if isinstance(near, str) else judged_fits(near)
    most = max(_objective(search.final), _objective(afresh)) + MIN_NATS_OF_DIVERGENCE  # more: it has run away
    likelier = judged_fits(near) if _objective(afresh) + SAME_MAXIMUM < _objective(near) < most else afresh
    return afresh if isinstance(likelier, str) else likelier


def _objective(fits: Fits) -> float:
    return sum(maximum.objective for maximum in fits.maxima)
