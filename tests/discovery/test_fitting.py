"""Fits by likelihood and by draws: where which is right, and that they never end below where they began."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from examples import drives, example

from steady_ppl.discovery.candidates import TIE_NATS
from steady_ppl.discovery.fitting import ByDraws, ByLikelihood, is_doubtful
from steady_ppl.discovery.refits import first_refit, refit_with
from steady_ppl.effects import chosen_variant
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import find_path
from steady_ppl.likelihood.maximize import maximise
from steady_ppl.model.problem import Problem


@pytest.mark.slow
def test_both_ways_agree_where_the_program_is_nearly_linear() -> None:
    program = example("hovercraft", torch.float32)
    data = drives(example("hovercraft.py:HovercraftTruth", torch.float32), 6, 61, seed=3)
    path = find_path(Problem(program, data, True))
    fits = []
    for fitting in (ByLikelihood(), ByDraws(steps=200)):
        own = copy.deepcopy(program)
        (fit,) = fitting.fit_each([Problem(own, data, True)], [path], [None], [-math.inf])
        fits.append((own, fit()))
    (likely, first), (drawn, second) = fits
    assert not is_doubtful(Problem(likely, data, True), first.path)
    assert abs(float((first.log_likelihood - second.log_likelihood).sum())) < 1.0
    assert float(likely.mass.detach()) == pytest.approx(float(drawn.mass.detach()), rel=0.02)
    assert second.gained > 10 and second.converged


def test_a_fit_never_ends_below_where_it_began() -> None:
    program = example("hovercraft", torch.float32)
    data = drives(program, 4, 41, seed=1)
    problem = Problem(program, data, True)
    maximise(problem)
    before = {name: value.clone() for name, value in program.named_parameters()}
    fit = ByDraws(steps=3, learning_rate=2.0).fit(problem, find_path(problem))
    assert fit.gained == 0.0
    assert all(torch.equal(value, before[name]) for name, value in program.named_parameters())


@pytest.mark.exhaustive
def test_a_program_whose_linearised_likelihood_is_off_is_fitted_by_draws(monkeypatch) -> None:
    truth = example("paper.py:PaperTruck", torch.float32).with_effect("lever_arm", 0.4)
    truth.noise = torch.tensor([2.0, 1.0, 1.0])
    train, valid = drives(truth, 6, 61, seed=1), drives(truth, 6, 61, seed=2)
    program = example("paper.py:PaperTruck", torch.float32)
    assert is_doubtful(Problem(program, train, True), find_path(Problem(program, train, True)))
    monkeypatch.setattr("steady_ppl.discovery.fitting.MAX_LINEARISATION_ERROR", 0.0)
    base = first_refit(Problem(program, train, True), valid, seed=0)
    assert isinstance(base.fitting, ByDraws)
    found = refit_with(base, chosen_variant(program, "lever_arm"), 0.1)
    assert not isinstance(found, str) and found.fitting == base.fitting
    assert float((found.held_out - base.held_out).sum()) > TIE_NATS
    likely, path = copy.deepcopy(found.program), found.folds[0].path
    maximise(Problem(likely, train, True), path)
    there, _ = found.fitting.judge(Problem(likely, train, True), path)
    assert float((found.maxima[0].log_likelihood - there).sum()) > -TIE_NATS


@pytest.mark.slow
def test_a_nearly_linear_program_is_fitted_by_likelihood() -> None:
    program = example("hovercraft")
    base = first_refit(Problem(program, drives(program, 4, 41, seed=1), True), drives(program, 4, 41, seed=2), seed=0)
    assert isinstance(base.fitting, ByLikelihood)


@pytest.mark.parametrize(
    ("one", "other", "doubtful"),
    [
        ([-20.4, 0.4, -70.5, 0.2, -4.4, 0.1], [-9.2, 0.3, -111.2, 0.2, -5.5, 0.0], False),  # jumps of the GPS
        ([0.2, -0.9, -0.3, -1.6, -0.5, -0.5], [0.1, -1.0, -0.2, -1.2, -0.5, -0.4], True),  # limits that bind
        ([-20.4, 0.4, -70.5, 7.0, -4.4, 0.1], [-9.2, 0.3, -111.2, 1.2, -5.5, 0.0], True),  # lost nearly everywhere
    ],
    ids=["wrong readings", "off", "lost"],
)
def test_drives_on_which_two_filters_disagree_say_nothing(monkeypatch, one, other, doubtful) -> None:
    found = {0: torch.tensor(one), 1: torch.tensor(other)}
    monkeypatch.setattr("steady_ppl.discovery.fitting._smooth", lambda problem, path: None)
    monkeypatch.setattr("steady_ppl.discovery.fitting._neglected", lambda problem, ahead, *, seed: found[seed])
    program = example("hovercraft", torch.float32)
    problem = Problem(program, drives(program, 6, 11, seed=1), True)
    assert is_doubtful(problem, ReferencePath(torch.zeros(1), torch.zeros(1))) is doubtful
