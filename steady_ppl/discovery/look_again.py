"""Effects that were found, looked at again beside each other: dropped where not needed, replaced by a better rival."""

from __future__ import annotations

from collections.abc import Sequence

from steady_ppl.discovery.candidates import NATS, Settings, judged
from steady_ppl.discovery.places import at_its_best_place
from steady_ppl.discovery.refits import Refit, refit_near, refit_with
from steady_ppl.discovery.rounds import Found, Search
from steady_ppl.effects import attached

RIVALS = 12.0  # nats behind the best in its round, with which a candidate is looked at again beside other effects
RUNAWAY = 25.0  # nats above every fit that it is a part of, from which a fit's likelihood is not to be believed


def labels(refit: Refit) -> list[str]:
    """The effects of a program."""
    return [variant.label for variant in attached(refit.program)]


def look_again(search: Search, settings: Settings) -> None:
    """Drop effects that are not needed beside the others, and let the rivals of each have its place."""
    for found in list(search.found):
        without = _without(search, found, settings)
        if isinstance(without, str):
            continue
        rivals = [found.candidate] + [
            c for c in found.candidates if c is not found.candidate and c.total > found.candidate.total - RIVALS
        ]
        there = {variant.name for variant in attached(without.program)}
        again = []
        for rival in rivals:
            if rival.variant.name not in there and isinstance(rival.refit, Refit):
                start = rival.refit.coefficient(rival.variant)
                refit = refit_with(without, rival.variant, start, known_start=settings.known_start)
                again.append(at_its_best_place(without, judged(without, rival.tested, refit), settings))
        as_it_stands = judged(without, found.candidate.tested, search.final)
        if all(c.total < as_it_stands.total for c in again if c.variant.name == found.candidate.variant.name):
            again = [as_it_stands, *(c for c in again if c.variant.name != found.candidate.variant.name)]
        again.sort(key=lambda candidate: -candidate.total)
        best = next((c for c in again if not c.against_its_sign), None)
        place = search.found.index(found)
        if best is None or best.total <= NATS or isinstance(best.refit, str):
            search.found.pop(place)
            search.final = without
        else:
            search.found[place] = Found(best, again, without)
            search.final = best.refit


def _without(search: Search, found: Found, settings: Settings) -> Refit | str:
    """The program with the other effects, fitted one after the other and from where the fit of all ended: the likelier,
    lest a fit that has stuck make an effect look needed."""
    others = [other for other in search.found if other is not found]
    variants = [other.candidate.variant for other in others]
    afresh = _with_all(search.base, others, settings)
    near = refit_near(search.base, search.final, variants, known_start=settings.known_start)
    if isinstance(afresh, str) or isinstance(near, str):
        return afresh if isinstance(near, str) else near
    most = (
        max(_objective(search.final), _objective(afresh)) + RUNAWAY
    )  # above all that it is a part of: it has run away
    return near if _objective(afresh) < _objective(near) < most else afresh


def _objective(refit: Refit) -> float:
    return sum(maximum.objective for maximum in refit.maxima)


def _with_all(base: Refit, effects: Sequence[Found], settings: Settings) -> Refit | str:
    now: Refit | str = base
    for found in effects:
        if isinstance(now, str) or isinstance(found.candidate.refit, str):
            return now
        start = found.candidate.refit.coefficient(found.candidate.variant)
        now = refit_with(now, found.candidate.variant, start, known_start=settings.known_start)
    return now
