"""Fits by draws: where the linearised log p(y) cannot be trusted, and that they never end below where they began."""

from __future__ import annotations

import copy

import pytest
import torch
from examples import drives, example

import steady_ppl as st
from steady_ppl.discovery.candidates import TIE_NATS
from steady_ppl.discovery.fitting import ByDraws, ByLikelihood, is_doubtful
from steady_ppl.discovery.refits import Fold, first_by_draws, first_refit, refit_with, starts_by_draws
from steady_ppl.effects import chosen_variant
from steady_ppl.errors import FilterError
from steady_ppl.gaussian.smoother import find_path
from steady_ppl.model.problem import Problem


@pytest.mark.slow
def test_both_ways_agree_where_the_program_is_nearly_linear() -> None:
    program = example("hovercraft", torch.float32)
    data = drives(example("hovercraft.py:HovercraftTruth", torch.float32), 6, 61, seed=3)
    path = find_path(Problem(program, data, True))
    fits = []
    for fitting in (ByLikelihood(), ByDraws(steps=200)):
        own = copy.deepcopy(program)
        fits.append((own, fitting.fit(Problem(own, data, True), path)))
    (likely, first), (drawn, second) = fits
    assert not is_doubtful(Problem(likely, data, True), first.path)
    assert abs(float((first.log_likelihood - second.log_likelihood).sum())) < 1.0
    assert float(likely.mass.detach()) == pytest.approx(float(drawn.mass.detach()), rel=0.02)
    assert second.gained > 10 and second.converged


def test_a_fit_never_ends_below_where_it_began() -> None:
    program = example("hovercraft", torch.float32)
    data = drives(program, 4, 41, seed=1)
    ByLikelihood().fit(Problem(program, data, True))
    before = {name: value.clone() for name, value in program.named_parameters()}
    fit = ByDraws(steps=3, learning_rate=5.0).fit(Problem(program, data, True))
    assert fit.gained == 0.0
    assert all(torch.equal(value, before[name]) for name, value in program.named_parameters())


def test_fits_by_draws_begin_at_the_likelier_program() -> None:
    good, far = example("hovercraft", torch.float32), example("hovercraft", torch.float32)
    data = drives(good, 4, 41, seed=1)
    far.mass = torch.tensor(4.5)
    path = find_path(Problem(good, data, True))
    fold = Fold(data, path, data, path, True)
    for given, fitted in ((good, far), (far, good)):
        first, second = starts_by_draws(given, fitted, fold)
        assert first.program is good and second.program is far
        assert first.log_likelihood > second.log_likelihood
        assert first.path.states.shape == path.states.shape
    stiff, still = good.with_effect("linear_drag", 1e3), good.with_effect("linear_drag", 0.0)
    for given, fitted in ((still, stiff), (stiff, still)):
        assert [start.program is still for start in starts_by_draws(given, fitted, fold)] == [True]
    with pytest.raises(FilterError):
        starts_by_draws(stiff, stiff, fold)


def test_where_a_climb_by_draws_diverges_another_begins_at_the_program_as_given(monkeypatch) -> None:
    given, fitted = example("hovercraft", torch.float32), example("hovercraft", torch.float32)
    data = drives(fitted, 4, 41, seed=1)
    given.mass = torch.tensor(1.8)
    path = find_path(Problem(fitted, data, True))
    folds = [Fold(data, path, data, path, True)] * 2
    began = []

    def train(program, guide, *arguments, **settings):
        began.append(float(program.mass.detach()))
        if began[-1] < 1.7:
            raise FilterError("the model diverges")

    monkeypatch.setattr("steady_ppl.discovery.fitting.train", train)
    base = first_by_draws(given, [fitted, fitted], folds, seed=0)
    assert began == pytest.approx([1.5, 1.8, 1.8])
    assert [float(program.mass.detach()) for program in base.programs] == pytest.approx([1.8, 1.8])
    assert isinstance(base.fitting, ByDraws)
    began.clear()
    with pytest.raises(FilterError, match="diverges"):
        first_by_draws(fitted, [given, given], folds, seed=0)
    assert began == pytest.approx([1.5])


@pytest.mark.slow
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
    ByLikelihood().fit(Problem(likely, train, True), path)
    there = found.fitting.judge(Problem(likely, train, True), path)
    assert float((found.maxima[0].log_likelihood - there.log_likelihood).sum()) > -TIE_NATS


def test_a_nearly_linear_program_is_fitted_by_likelihood() -> None:
    program = example("hovercraft")
    base = first_refit(Problem(program, drives(program, 4, 41, seed=1), True), drives(program, 4, 41, seed=2), seed=0)
    assert isinstance(base.fitting, ByLikelihood)


def test_mixed_tables_are_one_and_every_second_drive_chooses() -> None:
    program = example("hovercraft", torch.float32)
    train, valid = drives(program, 6, 21, seed=1), drives(program, 5, 21, seed=2)
    found = st.discover(program, train, valid, known_start=True, mix=True, simulations=50)
    first, second = found.search.base.folds
    assert first.drives.labels == ("train 1", "train 3", "train 5", "valid 1", "valid 3", "valid 5")
    assert second.drives.labels == ("train 2", "train 4", "train 6", "valid 2", "valid 4")
    assert "the tables were mixed: 5 of the 11 drives were kept to choose by" in found.notes
    with pytest.raises(st.UsageError, match="mix puts two tables together"):
        st.discover(program, train, known_start=True, mix=True)
