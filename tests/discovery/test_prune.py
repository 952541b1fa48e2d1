"""Looking again at what was found: what each effect brings beside the others, and whether a rival brings more."""

from types import SimpleNamespace

import pytest
import torch

from steady_ppl.discovery import prune as pruning
from steady_ppl.discovery.candidates import TIE_NATS
from steady_ppl.discovery.prune import prune
from steady_ppl.discovery.refits import Refit
from steady_ppl.discovery.search_state import Found, Search


def refit(*effects):
    """A fitted program with effects of these names."""
    made = object.__new__(Refit)
    made.__dict__.update(programs=[list(effects)], maxima=["known"], name=" + ".join(effects))
    return made


class Rival:
    """A candidate of so many nats beside the others."""

    is_judged, is_confirmed, is_explanation, against_its_sign = True, True, True, False

    def __init__(self, name, total, fitted):
        self.variant = SimpleNamespace(name=name, label=name, parameter=name, profiled={})
        self.tested, self.total, self.refit = name, total, fitted


@pytest.fixture
def pruned(monkeypatch):
    """Prune a search that has found a drag and then a bias; a fit beside the other effect brings what is told."""

    def run(drag, rival, others=()):
        base, first, both = refit(), refit("drag"), refit("drag", "bias")
        asked = []

        def judged(without, tested, fitted):
            asked.append((without.name, tested, fitted if isinstance(fitted, str) else fitted.name))
            return Rival(tested, {"drag": drag, "lag": rival, "bias": 9.0}[tested], fitted)

        def refit_with(without, variant, value):
            return refit(variant.name, *without.programs[0])

        monkeypatch.setattr(Refit, "effects", property(lambda self: self.programs[0]))
        monkeypatch.setattr(Refit, "coefficient", lambda self, variant: torch.tensor([0.5]))
        for replaced, stub in (
            ("judged", judged),
            ("refit_with", refit_with),
            ("refit_with_all", lambda start, later, near: refit(*start.programs[0], *(v.name for v, _ in later))),
            ("fit_near", lambda *_: "paths of other states are no start"),
            ("at_its_best_place", lambda without, one: one),
            ("moved_to_likelier_place", lambda base, fitted, variant: fitted),
            ("attached", lambda names: [SimpleNamespace(name=name) for name in names]),
            ("with_places_of", lambda final, found: found),
        ):
            monkeypatch.setattr(pruning, replaced, stub)
        first_found = Found(one := Rival("drag", 30.0, first), [one, *others], base)
        found = [first_found, Found(two := Rival("bias", 9.0, both), [two], first)]
        search = Search(base, base, both, None, 0.0, found=found)
        prune(search)
        return search, asked

    return run


def test_an_effect_without_rivals_stands_as_it_was_fitted(pruned):
    search, asked = pruned(20.0, 0.0)
    assert asked == [("bias", "drag", "drag + bias")]
    assert [one.candidate.variant.name for one in search.found] == ["drag", "bias"]
    drag = search.found[0]
    assert drag.candidate.total == 20.0 and drag.without.name == "bias" and search.final.name == "drag + bias"


def test_what_is_not_needed_beside_the_others_is_dropped(pruned):
    search, _ = pruned(TIE_NATS - 0.5, 0.0)
    assert [one.candidate.variant.name for one in search.found] == ["bias"] and search.final.name == "bias"


def test_a_rival_that_brings_more_beside_the_others_has_the_place(pruned):
    near, far = Rival("lag", 25.0, refit("lag")), Rival("wind", 3.0, refit("wind"))
    search, asked = pruned(20.0, 22.0, [near, far])
    assert asked == [
        ("bias", "drag", "drag + bias"),
        ("bias", "lag", "lag + bias"),
        ("lag", "bias", "lag + bias"),  # which was added beside another
    ]
    lag = search.found[0]
    assert lag.candidate.variant.name == "lag" and [one.total for one in lag.candidates] == [22.0, 20.0]
    assert search.final.name == "lag + bias"


def test_a_rival_that_brings_less_beside_the_others_stays_one(pruned):
    search, _ = pruned(20.0, 19.0, [Rival("lag", 31.0, refit("lag"))])
    assert [one.variant.name for one in search.found[0].candidates] == ["drag", "lag"]
    assert search.final.name == "drag + bias"
