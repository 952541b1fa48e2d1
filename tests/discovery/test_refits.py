"""Programs with candidates, fitted to one half of the drives and judged on the other."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch
from examples import drives, example

from steady_ppl.discovery.candidates import gain_of_fits
from steady_ppl.discovery.fitting import ByDraws
from steady_ppl.discovery.refits import (
    Fold,
    _from,
    _refit,
    first_by_draws,
    first_refit,
    fit_near,
    judged_fits,
    refit_with,
    starts_by_draws,
)
from steady_ppl.effects import attached, chosen_variant, coefficient
from steady_ppl.errors import FilterError
from steady_ppl.gaussian.smoother import find_path, smooth
from steady_ppl.likelihood.maximize import maximise
from steady_ppl.model.problem import Problem


@pytest.mark.parametrize(("more", "is_taken"), [(5.0, True), (0.5, False), (None, False)])
def test_a_fit_begins_where_that_of_the_other_drives_ended_if_that_is_likelier(monkeypatch, more, is_taken) -> None:
    program = example("linear_gaussian")
    problem = Problem(program, drives(program, 3, 21, seed=1), True)
    maximum, start = maximise(problem), copy.deepcopy(program)
    start.gain = 2 * program.gain.detach()

    def found(problem, path):
        if more is None:
            raise FilterError("the drives cannot be followed")
        return replace(maximum, objective=maximum.objective + more)

    monkeypatch.setattr("steady_ppl.discovery.refits.maximise", found)
    taken, ended = _from(start, problem, maximum)
    assert (taken is problem) != is_taken and (ended is maximum) != is_taken
    assert torch.equal(taken.program.gain, start.gain if is_taken else program.gain)
    assert taken.program is not start


@pytest.mark.parametrize("behind", [0, 1])
def test_a_fold_that_ended_at_a_worse_maximum_begins_again_where_the_other_ended(behind: int) -> None:
    program = example("linear_gaussian")
    data = [drives(program, 3, 21, seed=seed) for seed in (1, 2)]
    programs = [copy.deepcopy(program) for _ in data]
    maxima = [maximise(Problem(one, part, True)) for one, part in zip(programs, data, strict=True)]
    best = [float(maximum.objective) for maximum in maxima]
    pairs = ((0, 1), (1, 0))
    folds = [Fold(data[a], maxima[a].path, data[b], maxima[b].path, True) for a, b in pairs]
    assert _refit(programs, folds, maxima).programs[behind] is programs[behind]  # each is at its best
    programs[behind].gain = 3 * programs[behind].gain.detach()
    worse = maxima[behind]
    maxima[behind] = replace(worse, objective=worse.objective - 90, log_likelihood=worse.log_likelihood - 30)
    refit = _refit(programs, folds, maxima)
    ended = [float(maximum.objective) for maximum in refit.maxima]
    assert ended == pytest.approx(best, abs=0.1)  # fits end within a tenth of a nat
    assert refit.programs[1 - behind] is programs[1 - behind]


@pytest.mark.slow
def test_fits_by_draws_begin_at_the_likelier_program() -> None:
    good, far = example("hovercraft", torch.float32), example("hovercraft", torch.float32)
    data = drives(good, 4, 41, seed=1)
    far.mass = torch.tensor(4.5)
    path = find_path(Problem(good, data, True))
    fold = Fold(data, path, data, path, True)
    for given, fitted in ((good, far), (far, good)):
        first, second = starts_by_draws(given, fitted, fold)
        assert first[0] is good and second[0] is far
        assert first[2] > second[2]
        assert first[1].states.shape == path.states.shape
    stiff, still = good.with_effect("linear_drag", 1e3), good.with_effect("linear_drag", 0.0)
    for given, fitted in ((still, stiff), (stiff, still)):
        assert [program is still for program, _, _ in starts_by_draws(given, fitted, fold)] == [True]
    with pytest.raises(FilterError):
        starts_by_draws(stiff, stiff, fold)


@pytest.mark.slow
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
def test_drives_are_judged_by_fits_that_have_seen_them_for_the_noise_alone():
    truth = example("hovercraft").with_effect("yaw_bias", 0.08)
    program = example("hovercraft")
    train, valid = drives(truth, 6, 41, seed=1), drives(truth, 8, 41, seed=2)
    base = first_refit(Problem(program, train, True), valid, seed=0)
    found = refit_with(base, chosen_variant(program, "yaw_bias", ""), 0.01)
    assert not isinstance(found, str)
    assert found.held_out.shape == (14,)
    variant = chosen_variant(program, "yaw_bias", "")
    first, second = (float(coefficient(judge, variant).detach()) for judge in found.judges.programs)
    assert float(found.coefficient(variant)) == pytest.approx((6 * first + 8 * second) / 14)
    judged = smooth(Problem(found.judges.programs[0], valid, True), found.folds[0].held_out_path, passes=4)
    torch.testing.assert_close(found.held_out[:8], judged.log_likelihood, atol=0.05, rtol=0)
    again = maximise(Problem(copy.deepcopy(found.programs[0]), train, True), found.folds[0].path)
    assert again.objective == pytest.approx(found.maxima[0].objective, abs=0.1)
    assert float((found.held_out - base.held_out).sum()) > 5


@pytest.mark.exhaustive
def test_fits_begin_at_the_declared_noise_as_well_where_the_program_alone_explains_nothing():
    """A sensor far worse than declared: without it, only process noise beyond all measure explains the drives."""
    truth, program = example("hovercraft"), example("hovercraft")
    for one in (truth, program):
        one.noise = torch.tensor([0.08, 0.08, 0.05]).double()
    truth = truth.with_effect("range_dependent_noise", 0.1)
    train, valid = drives(truth, 6, 41, seed=1), drives(truth, 6, 41, seed=2)
    base = first_refit(Problem(program, train, True), valid, seed=0)
    assert base.unwidened is not None and float(base.program.noise.detach().max()) > 20 * 0.05
    variant = chosen_variant(program, "range_dependent_noise", "")
    found = refit_with(base, variant, 0.05)
    assert not isinstance(found, str)
    assert float(found.coefficient(variant)) == pytest.approx(0.1, rel=0.3)
    assert all(one.noise.detach().max() < base.program.noise.detach().max() / 20 for one in found.programs)


@pytest.mark.slow
def test_a_fit_at_another_knee_is_the_one_from_nothing():
    truth, program = example("hovercraft").with_effect("thrust_saturation", 0.8, knee=0.6), example("hovercraft")
    train, valid = drives(truth, 5, 41, seed=1), drives(truth, 5, 41, seed=2)
    base = first_refit(Problem(program, train, True), valid, seed=0)
    assert base.unwidened is None
    knees = [chosen_variant(program, "thrust_saturation", knee=knee) for knee in (0.5, 0.65)]
    direct = [refit_with(base, knee, 0.5) for knee in knees]
    near = judged_fits(fit_near(base, direct[0], [knees[1]]))
    assert gain_of_fits(base, near) == pytest.approx(gain_of_fits(base, direct[1]), abs=0.2)
    # fits rest within .02 nats of their maxima, .2 standard deviations: of two fits on two folds .4 nats, three of them
    assert float((near.held_out - direct[1].held_out).sum()) == pytest.approx(0.0, abs=1.2)


class Stumbling(type(example("hovercraft"))):
    """A program whose code fails as soon as it is given an effect."""

    def integrate(self, state, acceleration, step):
        if len(attached(self)) > 0:
            raise ZeroDivisionError("of the program's own")
        return super().integrate(state, acceleration, step)


def test_a_failure_of_a_programs_own_fails_the_candidate_with_its_reason():
    program = Stumbling().double()
    train, valid = drives(program, 6, 21, seed=1), drives(program, 6, 21, seed=2)
    base = first_refit(Problem(program, train, True), valid, seed=0)
    found = refit_with(base, chosen_variant(program, "yaw_bias", ""), 0.01)
    assert found == "ZeroDivisionError: of the program's own"
