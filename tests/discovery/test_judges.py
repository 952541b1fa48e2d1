"""A particle filter has the last word about the best candidate."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch
from examples import drives, example

from steady_ppl.discovery import judges
from steady_ppl.discovery.judges import ParticleJudge
from steady_ppl.discovery.refits import BY_DRAWS, BY_LIKELIHOOD, Refit, Threshold
from steady_ppl.errors import FilterError
from steady_ppl.gaussian.smoother import find_path, require_found, smooth
from steady_ppl.model.problem import Problem


@dataclass(frozen=True)
class Fake:
    """A candidate that was fitted, as far as a ranking looks at it."""

    name: str
    gain: torch.Tensor
    refit: object
    alone: torch.Tensor | None = None
    is_confirmed: bool = False

    @property
    def is_judged(self) -> bool:
        return not isinstance(self.refit, str)

    @property
    def total(self) -> float:
        return float(self.gain.sum())


def refit(name: str, fitting=BY_LIKELIHOOD) -> SimpleNamespace:
    fold = SimpleNamespace(judging=lambda program: program, held_out_path=None)
    return SimpleNamespace(judges=SimpleNamespace(programs=[name]), folds=[fold], fitting=fitting, neglected={})


def first(ranked):
    """The best."""
    return ranked[0]


def ranking(monkeypatch, neglected: dict[str, float], now=BY_LIKELIHOOD, choose=first) -> list[Fake]:
    """Of a first that gains 9 nats, a second that gains 6 and a third that loses 3, when so much is neglected."""
    asked: list[tuple[str, int]] = []

    def along(program: str, path: object, seed: int) -> torch.Tensor:
        asked.append((program, seed))
        if math.isnan(neglected.get(program, 0.0)):
            raise FilterError("every weight is zero")
        return torch.full((2,), neglected.get(program, 0.0) / 2)

    monkeypatch.setattr(judges, "neglected_along", along)
    monkeypatch.setattr(judges, "Refit", SimpleNamespace)
    each = [Fake(name, torch.full((2,), gain / 2), refit(name)) for name, gain in (("b", 6.0), ("a", 9.0), ("c", -3.0))]
    best, found = ParticleJudge(refit("now", now)).chosen(each, choose)
    assert len(asked) == len(set(asked))
    assert best is choose(found) and best.is_confirmed
    return found


def test_what_agrees_keeps_its_rank_and_its_gain(monkeypatch):
    first, second, third = ranking(monkeypatch, {"a": 0.4, "now": 0.1})
    assert (first.name, first.total, first.is_confirmed) == ("a", 9.0, True)
    assert not second.is_confirmed and third.name == "c"


def test_what_particles_deny_falls_back(monkeypatch):
    first, second, third = ranking(monkeypatch, {"a": -9000.0})
    assert (first.name, first.is_confirmed) == ("b", True)
    assert second.name == "c" and third.total == pytest.approx(9 - 9000)


def test_what_the_program_without_neglects_too_is_no_matter(monkeypatch):
    first, *_ = ranking(monkeypatch, {"a": -50.0, "b": -50.0, "now": -50.0})
    assert (first.name, first.total) == ("a", 9.0)


def test_a_candidate_that_no_filter_follows_is_none(monkeypatch):
    first, *_, last = ranking(monkeypatch, {"a": math.nan})
    assert first.name == "b" and last.name == "a"
    assert isinstance(last.refit, str) and "every weight is zero" in last.refit and last.total == -math.inf


def test_whatever_is_chosen_has_been_confirmed(monkeypatch):
    """Also one that is not the first of all."""
    found = ranking(monkeypatch, {"b": -9000.0}, choose=lambda ranked: next(c for c in ranked if c.name != "a"))
    assert [one.name for one in found] == ["a", "c", "b"] and not found[0].is_confirmed


def test_where_no_filter_follows_the_program_without_the_linearised_ranking_stands(monkeypatch):
    first, second, _ = ranking(monkeypatch, {"now": math.nan, "a": -9000.0})
    assert (first.name, first.total, second.is_confirmed) == ("a", 9.0, False)


def test_fits_by_draws_are_judged_by_particles_already(monkeypatch):
    first, *_ = ranking(monkeypatch, {"a": -9000.0}, now=BY_DRAWS)
    assert (first.name, first.total) == ("a", 9.0)


def test_a_likelihood_that_no_gaussian_could_reach_is_refused():
    program = example("linear_gaussian", torch.float32)
    problem = Problem(program, drives(program, 3, 40), True)
    ahead = smooth(problem, find_path(problem))
    assert not bool(ahead.is_broken.any())
    most = ahead.linearization.log_scale.sum(0)
    beyond = replace(ahead, log_likelihood=torch.where(torch.arange(3) == 1, most + 1, ahead.log_likelihood))
    assert beyond.is_broken.tolist() == [False, True, False]
    with pytest.raises(FilterError, match="trajectory 2: .* is larger than its sensors allow"):
        require_found(beyond, problem)


def test_filters_of_one_refit_are_asked_once_by_all_judges(monkeypatch):
    asked = []

    def along(program, path, seed):
        asked.append((program, seed))
        if program == "broken":
            raise FilterError("every weight is zero")
        return torch.full((2,), 0.1)

    monkeypatch.setattr(judges, "neglected_along", along)
    monkeypatch.setattr(judges, "Refit", SimpleNamespace)
    now, broken = refit("now"), refit("broken")
    for _ in range(2):
        good = ParticleJudge(now).confirm(Fake("a", torch.full((2,), 3.0), refit("a"), is_confirmed=False))
        bad = ParticleJudge(now).confirm(Fake("b", torch.full((2,), 3.0), broken, is_confirmed=False))
        assert good.total == 6.0 and bad.refit == "no particle filter follows the drives: every weight is zero"
    assert sorted(asked) == [("a", 0), ("a", 0), ("broken", 0), ("now", 0)]


@pytest.mark.parametrize(
    ("change", "admitted"),
    [
        ({}, False),
        ({"p_value": 0.5}, True),  # no curve is found
        ({"evidence": 15.0}, True),  # of which the tests tell little more
        ({"correlation": 0.95}, True),  # the curve is the same effect, with what it leaves
        ({"gain": 16.9}, True),  # and brings as much
        ({"gain": 17.1}, False),
        ({"gain": 17.1, "is_judged": False}, True),  # given up on its way
        ({"explains": False}, False),
        ({"explains": False, "p_value": 0.5}, True),
    ],
)
def test_what_brings_less_than_a_curve_of_another_kind_is_not_admitted(monkeypatch, change, admitted):
    """A saturation, where the rest of a friction goes with the velocity."""
    told = {"p_value": 1e-20, "evidence": 40.0, "correlation": 0.4, "gain": 100.0, "explains": True}
    told |= {"is_judged": True} | change

    def tested(name, is_curve, statistic, p_value, evidence=0.0):
        variant = SimpleNamespace(name=name)
        given = {"is_curve": is_curve, "statistic": statistic, "p_value": p_value, "evidence": evidence}
        return SimpleNamespace(variant=variant, **given)

    curve = tested("curve", True, 90.0, told["p_value"], told["evidence"])
    saturation = tested("saturation", False, 19.0, 1e-5)
    correlations = torch.tensor([[1.0, told["correlation"]], [told["correlation"], 1.0]])
    tests = SimpleNamespace(tested=[curve, saturation], critical=0.01, correlations=correlations)
    fits = []

    def attempts(now, chosen, screening, threshold):
        assert chosen == [curve] and threshold.stops_early
        fitted = SimpleNamespace(total=told["gain"], is_judged=told["is_judged"])
        return [lambda threshold: fits.append(now) or fitted]

    monkeypatch.setattr(judges, "attempts", attempts)
    monkeypatch.setattr(judges.ParticleJudge, "confirm", lambda self, candidate: candidate)
    monkeypatch.setattr(judges, "bar_of", lambda fits: Threshold(1.0))
    judge = judges.CurveJudge("now", SimpleNamespace(tests=tests))
    given = {"tested": saturation, "variant": saturation.variant, "refit": object.__new__(Refit)}
    given |= {"total": 14.0, "is_explanation": told["explains"]}
    for _ in range(2):
        assert judge.admits(SimpleNamespace(**given)) == admitted
    assert fits == ["now"] * (not change or "gain" in change)
