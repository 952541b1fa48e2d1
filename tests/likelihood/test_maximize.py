"""Scoring steps end where log p(y) is largest."""

from __future__ import annotations

import copy

import pyro.distributions as dist
import pytest
import torch
from examples import drives, example

from steady_ppl.discovery.candidates import gain_of_fits
from steady_ppl.discovery.refits import first_refit, fit_near, judged_fits, refit_with
from steady_ppl.effects import chosen_variant
from steady_ppl.gaussian.smoother import smooth
from steady_ppl.likelihood.maximize import maximise, widen_noise
from steady_ppl.likelihood.parameters import elements
from steady_ppl.likelihood.problem import Problem


def set_values(program, values) -> None:
    for part, value in zip(elements(program), values, strict=True):
        part.parameter.data.view(-1)[part.index] = value


def likelihood_of_cart(program, data) -> float:
    from steady_ppl.gaussian.smoother import find_path

    path = find_path(program, data, known_start=True)
    return float(smooth(program, data, path, known_start=True).log_likelihood.sum())


@pytest.fixture(scope="module")
def cart():
    program = example("linear_gaussian")
    data = drives(program, 30, 60)
    maximum = maximise(program, data, known_start=True)
    return program, data, maximum


def test_no_neighbour_is_likelier(cart):
    program, data, maximum = cart
    assert maximum.converged and maximum.names == ("gain", "damping", "noise", "measurement_sd")
    best = float(maximum.log_likelihood.sum())
    assert best == pytest.approx(likelihood_of_cart(program, data), abs=1e-3)
    for part in elements(program):
        for by in (-0.1, 0.1):
            neighbour = copy.deepcopy(program)
            own = next(one for one in elements(neighbour) if one.name == part.name)
            own.move(by)
            assert likelihood_of_cart(neighbour, data) < best


def test_the_start_does_not_matter(cart):
    program, data, maximum = cart
    far = example("linear_gaussian")
    for part, by in zip(elements(far), (1.0, -1.0, 0.7, -0.5), strict=True):
        part.move(by)
    again = maximise(far, data, known_start=True)
    assert again.objective == pytest.approx(maximum.objective, abs=0.05)
    for ours, theirs in zip(elements(far), elements(program), strict=True):
        torch.testing.assert_close(ours.parameter.data, theirs.parameter.data, atol=0.02, rtol=0.02)


def test_a_prior_pulls(cart):
    program, data, _ = cart
    pulled = copy.deepcopy(program)
    pulled.priors = {"gain": dist.Normal(2.0, 0.005)}
    maximise(pulled, data, known_start=True)
    gain, before = float(pulled.gain.detach()), float(program.gain.detach())
    assert before < gain < 2.0 and 2.0 - gain < (2.0 - before) / 4


def test_noise_is_widened_before_a_program_that_explains_nothing_is_fitted():
    """A strong yaw drag that is missing: from the declared noise scoring steps end anywhere."""
    truth, program = example("hovercraft"), example("hovercraft")
    program.noise = torch.tensor([0.08, 0.08, 0.05]).double()
    truth.noise = torch.tensor([0.08, 0.08, 0.05]).double()
    data = drives(truth.with_effect("yaw_quadratic_drag", 0.25), 6, 61)
    path = widen_noise(Problem(program, data, True))
    assert float(program.noise.detach().min()) > 0.1
    assert maximise(program, data, path, known_start=True).converged
    right = example("hovercraft")
    before = right.noise.detach().clone()
    widen_noise(Problem(right, drives(right, 6, 41), True))
    assert torch.equal(right.noise.detach(), before)


def test_drives_are_judged_by_fits_that_have_seen_them_for_the_noise_alone():
    truth = example("hovercraft").with_effect("yaw_bias", 0.08)
    program = example("hovercraft")
    train, valid = drives(truth, 6, 41, seed=1), drives(truth, 8, 41, seed=2)
    base = first_refit(Problem(program, train, True), valid, seed=0)
    found = refit_with(base, chosen_variant(program, "yaw_bias", ""), 0.01)
    assert not isinstance(found, str)
    assert found.held_out.shape == (14,)
    variant = chosen_variant(program, "yaw_bias", "")
    first, second = (float(value) for value in found.coefficients(variant))
    assert float(found.coefficient(variant)) == pytest.approx((6 * first + 8 * second) / 14)
    judged = smooth(found.judges.programs[0], valid, found.folds[0].held_out_path, known_start=True, passes=4)
    torch.testing.assert_close(found.held_out[:8], judged.log_likelihood, atol=0.05, rtol=0)
    again = maximise(copy.deepcopy(found.programs[0]), train, found.folds[0].path, known_start=True)
    assert again.objective == pytest.approx(found.maxima[0].objective, abs=0.1)
    assert float((found.held_out - base.held_out).sum()) > 5


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


def test_a_fit_that_cannot_reach_what_it_must_ends_after_six_steps_and_one_that_rises_goes_on(cart):
    _, data, maximum = cart
    best = float(maximum.log_likelihood.sum())

    def steps(hopeless):
        far = example("linear_gaussian")
        for part, by in zip(elements(far), (1.0, -1.0, 0.7, -0.5), strict=True):
            part.move(by)
        return maximise(far, data, known_start=True, hopeless=hopeless)

    whole = steps(-float("inf"))
    assert whole.converged and whole.steps > 8
    assert steps(best - 10).steps == whole.steps
    assert steps(best + 1e6).steps == 6


def test_a_fit_that_begins_with_too_much_information_does_not_end_at_once(cart):
    _, data, maximum = cart
    far = example("linear_gaussian")
    for part, by in zip(elements(far), (0.2, -0.2, 0.1, -0.1), strict=True):
        part.move(by)
    again = maximise(far, data, known_start=True, information=1e4 * maximum.information, steps=60)
    assert again.objective == pytest.approx(maximum.objective, abs=0.1)
