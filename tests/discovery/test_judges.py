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
        assert good.total == 6.0 and bad.refit == "no particle filter follows the trajectories: every weight is zero"
    assert sorted(asked) == [("a", 0), ("a", 0), ("broken", 0), ("now", 0)]


class Curved:
    """A judge whose tests see a curve, beside candidates that it may admit."""

    def __init__(self, monkeypatch, gain=100.0, p_value=1e-20, evidence=40.0, correlation=0.4, behind=()):
        curve = self._tested("curve", True, 90.0, p_value, evidence)
        self.saturation = self._tested("saturation", False, 19.0, 1e-5)
        correlations = torch.tensor([[1.0, correlation], [correlation, 1.0]])
        tests = SimpleNamespace(tested=[curve, self.saturation], critical=0.01, correlations=correlations)
        self.fits = []

        def attempts(now, chosen, screening, threshold):
            assert now == "now" and chosen == [curve]
            given_up = threshold.stops_early and len(self.fits) in behind
            fitted = SimpleNamespace(total=gain, is_judged=not given_up)
            return [lambda threshold: self.fits.append(threshold.stops_early) or fitted]

        monkeypatch.setattr(judges, "attempts", attempts)
        monkeypatch.setattr(judges.ParticleJudge, "confirm", lambda self, candidate: candidate)
        monkeypatch.setattr(judges, "bar_of", lambda fits: Threshold(1.0))
        self.judge = judges.CurveJudge("now", SimpleNamespace(tests=tests))

    @staticmethod
    def _tested(name, is_curve, statistic, p_value, evidence=0.0):
        given = {"is_curve": is_curve, "statistic": statistic, "p_value": p_value, "evidence": evidence}
        return SimpleNamespace(variant=SimpleNamespace(name=name, label=name, at="forward~velocity"), **given)

    def candidate(self, total=14.0, explains=True, label="saturation", form="history"):
        variant = SimpleNamespace(name="saturation", label=label, effect=SimpleNamespace(form=form))
        given = {"tested": self.saturation, "variant": variant, "refit": object.__new__(Refit)}
        return SimpleNamespace(**given, total=total, is_explanation=explains)


@pytest.mark.parametrize(
    ("change", "admitted"),
    [
        ({}, False),
        ({"p_value": 0.5}, True),  # no curve is found
        ({"evidence": 15.0}, True),  # of which the tests tell little more
        ({"correlation": 0.95}, True),  # the curve is the same effect, with what it leaves
        ({"gain": 27.9}, True),  # and brings as much
        ({"gain": 28.1}, False),
        ({"gain": 28.1, "behind": [0, 1]}, True),  # given up on its way
    ],
)
def test_what_brings_far_less_than_a_curve_of_another_kind_is_not_admitted(monkeypatch, change, admitted):
    """A saturation, where the rest of a friction goes with the velocity."""
    curved = Curved(monkeypatch, **change)
    candidate = curved.candidate()
    for _ in range(2):
        assert curved.judge.admits(candidate) == admitted
    assert curved.fits == [True] * (not change or "gain" in change)
    gain = change.get("gain", 100.0)
    why = f"saturation is not added: it brings 14 nats, a curve (forward~velocity) {gain:.0f}"
    assert curved.judge.refused == ({} if admitted else {"saturation": why})


@pytest.mark.parametrize(("gain", "p_value", "admitted"), [(3.5, 1e-5, False), (2.5, 1e-5, True), (99.0, 0.5, True)])
def test_what_imitates_anything_enters_where_no_curve_brings_something(monkeypatch, gain, p_value, admitted):
    curved = Curved(monkeypatch, gain=gain, p_value=p_value, behind=[0, 1])
    assert curved.judge.admits(curved.candidate(total=500.0, explains=False)) == admitted
    assert curved.fits == [False] * (p_value < 0.01)


def test_a_curve_is_no_rival_of_how_controls_go_within_a_row(monkeypatch):
    curved = Curved(monkeypatch, gain=1000.0)
    assert curved.judge.admits(curved.candidate(form="between"))
    assert not curved.fits and not curved.judge.admits(curved.candidate())


def test_a_curve_that_was_given_up_beside_one_candidate_is_fitted_again_beside_another(monkeypatch):
    """A broken fit of a huge log p(y) has every curve given up."""
    curved = Curved(monkeypatch, behind=[0])
    assert curved.judge.admits(curved.candidate(total=1e6, label="broken"))
    assert not curved.judge.admits(curved.candidate())
    assert len(curved.fits) == 2
