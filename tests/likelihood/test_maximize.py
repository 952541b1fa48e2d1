"""Scoring steps end where log p(y) is largest."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from operator import attrgetter

import pyro.distributions as dist
import pytest
import torch
from examples import drives, example
from pyro.distributions import constraints
from pyro.nn import PyroParam

from steady_ppl import for_program, simulate
from steady_ppl.errors import FilterError
from steady_ppl.gaussian.smoother import find_path, smooth
from steady_ppl.kernels import jit, rows
from steady_ppl.likelihood.maximize import (
    MAX_DECREASE,
    MAX_STEPS,
    STEPS_SEEN,
    Information,
    maximise,
    maximise_each,
    maximise_sum,
    refit_outliers,
    widen_noise,
)
from steady_ppl.likelihood.objective import Term, observed, posterior_score
from steady_ppl.likelihood.parameter_posterior import observed_information
from steady_ppl.likelihood.parameters import elements
from steady_ppl.model.problem import Problem
from steady_ppl.utils import cores


def likelihood_of_cart(program, data) -> float:
    path = find_path(Problem(program, data, True))
    return float(smooth(Problem(program, data, True), path).log_likelihood.sum())


@pytest.fixture(scope="module")
def cart():
    program = example("linear_gaussian")
    data = drives(program, 30, 60)
    maximum = maximise(Problem(program, data, True))
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
    again = maximise(Problem(far, data, True))
    assert again.objective == pytest.approx(maximum.objective, abs=0.05)
    for ours, theirs in zip(elements(far), elements(program), strict=True):
        torch.testing.assert_close(ours.parameter.data, theirs.parameter.data, atol=0.02, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_fits_that_are_made_one_after_another_are_the_same_on_any_cores(count, monkeypatch):
    monkeypatch.setattr(cores, "_cores", lambda: count)
    programs = [example("linear_gaussian", torch.float32) for _ in range(3)]
    problems = [Problem(one, drives(one, 20, 61, seed=seed), True) for seed, one in enumerate(programs)]
    paths = [find_path(problem) for problem in problems]
    paths[1] = replace(paths[1], states=torch.full_like(paths[1].states, torch.nan))
    fits = maximise_each(problems, paths, [None] * 3, [-math.inf] * 3)
    expected = copy.deepcopy([problems[0], problems[2]])
    for fit, problem, path in zip(fits[::2], expected, paths[::2], strict=True):
        found, alone = fit(), maximise(problem, path)
        for name in ("objective", "steps", "decrement", "gained"):
            assert getattr(found, name) == getattr(alone, name)
        for part in ("path.states", "path.noise", "log_likelihood", "information"):
            assert torch.equal(attrgetter(part)(found), attrgetter(part)(alone))
    with pytest.raises(FilterError):
        fits[1]()
    for problem, other in zip(expected, (programs[0], programs[2]), strict=True):
        for name, value in problem.program.state_dict().items():
            assert bool((value == other.state_dict()[name]).all())


@pytest.mark.slow
def test_a_fit_says_why_it_had_no_kernels_wherever_it_ran(monkeypatch):
    monkeypatch.setattr(rows, "close", lambda mine, theirs: False)
    programs = [example("linear_gaussian", torch.float32) for _ in range(2)]
    problems = [Problem(one, drives(one, 20, 61), True) for one in programs]
    paths = [find_path(problem) for problem in problems]
    found = []
    for count in (1, 2):
        monkeypatch.setattr(cores, "_cores", lambda count=count: count)
        fits = maximise_each(copy.deepcopy(problems), paths, [None] * 2, [-math.inf] * 2)
        fits[0]()
        with rows.kernel_failures() as why:
            fits[1]()
        found.append(why)
    assert found[0] == found[1] and set(found[0].values()) == {jit.RESULTS_DIFFER}


def test_what_a_fit_gives_up_is_no_matter_of_the_program(monkeypatch):
    program = example("linear_gaussian", torch.float32)
    problem = Problem(program, drives(program, 20, 61), True)
    path = find_path(problem)
    with monkeypatch.context() as patched:
        patched.setattr(rows, "close", lambda mine, theirs: False)
        with rows.kernel_failures() as why:
            maximise(problem, path)
        assert why
    with rows.kernel_failures() as why:
        smooth(problem, path)
    assert why == {}


def test_a_wrong_slope_does_not_lead_further_and_further_down(cart, monkeypatch):
    """As where a path swings about its mode, and the slope along it is not that of log p(y)."""
    program, data, maximum = cart
    own = copy.deepcopy(program)
    wrong = torch.tensor([40.0, -40.0, 30.0, 30.0], dtype=torch.float64)
    monkeypatch.setattr("steady_ppl.likelihood.objective._slope_of_prior", lambda program, parts, shares: wrong)
    ended = maximise(Problem(own, data, True))
    assert ended.objective > maximum.objective - 2.1 * MAX_DECREASE  # once more along paths at rest


def test_a_prior_pulls(cart):
    program, data, _ = cart
    pulled = copy.deepcopy(program)
    pulled.priors = {"gain": dist.Normal(2.0, 0.005)}
    maximise(Problem(pulled, data, True))
    gain, before = float(pulled.gain.detach()), float(program.gain.detach())
    assert before < gain < 2.0 and 2.0 - gain < (2.0 - before) / 4


@pytest.mark.slow
def test_noise_is_widened_before_a_program_that_explains_nothing_is_fitted():
    """A strong yaw drag that is missing: from the declared noise scoring steps end anywhere."""
    truth, program = example("hovercraft"), example("hovercraft")
    program.noise = torch.tensor([0.08, 0.08, 0.05]).double()
    truth.noise = torch.tensor([0.08, 0.08, 0.05]).double()
    data = drives(truth.with_effect("yaw_quadratic_drag", 0.25), 6, 61)
    path = widen_noise(Problem(program, data, True))
    assert float(program.noise.detach().min()) > 0.1
    assert maximise(Problem(program, data, True), path).converged
    right = example("hovercraft")
    before = right.noise.detach().clone()
    widen_noise(Problem(right, drives(right, 6, 41), True))
    assert torch.equal(right.noise.detach(), before)


@pytest.mark.slow
def test_a_fit_that_cannot_reach_what_it_must_ends_early_and_one_that_rises_goes_on(cart):
    _, data, maximum = cart
    best = float(maximum.log_likelihood.sum())

    def steps(hopeless):
        far = example("linear_gaussian")
        for part, by in zip(elements(far), (1.0, -1.0, 0.7, -0.5), strict=True):
            part.move(by)
        return maximise(Problem(far, data, True), hopeless=hopeless)

    whole = steps(-float("inf"))
    assert whole.converged and whole.steps > 8
    assert steps(best - 10).steps == whole.steps
    assert steps(best + 1e6).steps == STEPS_SEEN


def test_a_fit_that_begins_with_too_much_information_does_not_end_at_once(cart):
    _, data, maximum = cart
    far = example("linear_gaussian")
    for part, by in zip(elements(far), (0.2, -0.2, 0.1, -0.1), strict=True):
        part.move(by)
    problem = Problem(far, data, True)
    terms = [Term.alone(problem, find_path(problem))]
    (again,) = maximise_sum(terms, information=1e4 * maximum.information, steps=60)
    assert again.objective == pytest.approx(maximum.objective, abs=0.1)


def test_nor_does_one_of_so_many_numbers_that_none_is_observed(cart, monkeypatch):
    monkeypatch.setattr("steady_ppl.likelihood.maximize.MAX_OBSERVED", 0)
    test_a_fit_that_begins_with_too_much_information_does_not_end_at_once(cart)


def test_information_of_some_numbers_is_completed_wherever_they_stand():
    wide = torch.tensor([[4e6, 1e3, 2.0], [1e3, 1.0, 1e-3], [2.0, 1e-3, 9e-6]], dtype=torch.float64)
    names = ["large", "new", "small"]
    known = Information(wide[[0, 2]][:, [0, 2]], ("large", "small"))
    torch.testing.assert_close(known.completed(names, wide), wide)
    half = Information(known.matrix / 2, known.names, wide).completed(names, 7 * wide)
    assert bool((torch.linalg.eigvalsh(half / wide.diagonal().sqrt() / wide.diagonal().sqrt()[:, None]) > 0).all())
    torch.testing.assert_close(half[[0, 2]][:, [0, 2]], known.matrix / 2)
    inverse, before = torch.linalg.inv(half), torch.linalg.inv(wide)
    assert inverse[1, 1] == pytest.approx(float(before[1, 1]), rel=0.7)  # what is told of it beside the others stays
    assert torch.equal(Information(known.matrix * torch.nan, known.names).completed(names, wide), wide)


def test_a_program_that_learns_nothing_is_at_its_maximum():
    program = example("linear_gaussian").requires_grad_(False)
    maximum = maximise(Problem(program, drives(program, 3, 10), True))
    assert maximum.steps == 0 and maximum.names == () and maximum.converged


def test_information_that_is_not_positive_is_not_taken_for_observed(cart):
    program, data, maximum = cart
    term = Term.alone(Problem(program, data, True), maximum.path)
    assert observed(term, -maximum.information) is None
    assert observed(term, torch.zeros_like(maximum.information)) is None


def test_a_number_of_which_the_rest_knows_nothing_lends_no_information_to_the_others():
    """A noise that is at nothing on one half of the drives and is not on the other."""
    wide = torch.tensor([[6e-9, -1e-4], [-1e-4, 2e3]], dtype=torch.float64)
    known = Information(torch.tensor([[7.0]], dtype=torch.float64), ("vanished",), wide)
    assert float(known.completed(["vanished", "new"], wide)[1, 1]) == pytest.approx(2e3, rel=0.1)


def test_what_is_observed_is_symmetric_also_of_a_noise_and_a_number_that_moves_the_paths():
    program = example("hovercraft").with_effect("yaw_bias", 0.1)
    data = drives(program, 4, 41)
    maximum = maximise(Problem(program, data, True))
    parts = elements(program)
    noise, bias = (next(i for i, part in enumerate(parts) if part.name == name) for name in ("noise[2]", "yaw_bias"))
    seen = observed(Term.alone(Problem(program, data, True), maximum.path), maximum.information)
    size = math.sqrt(float(seen[noise, noise] * seen[bias, bias]))
    expected = observed_information(Problem(program, data, True), maximum.path, parts)
    assert abs(float(seen[noise, bias] - expected[noise, bias])) < 0.1 * size


def test_a_program_that_lacks_something_is_fitted_to_the_end_and_knows_how_sharp_it_is(cart):
    """Cross products of such a program's scores are many times its information: by these a fit would end early."""
    program, data, _ = cart
    pushed = replace(data, controls=data.controls + torch.sin(torch.arange(30.0).double())[:, None])
    problem = Problem(copy.deepcopy(program), pushed, True)
    maximum = maximise(problem, precision=1e-3)
    parts = elements(problem.program)
    expected = observed_information(problem, maximum.path, parts)
    torch.testing.assert_close(maximum.information, expected, rtol=0.15, atol=0.02 * float(expected.diagonal().max()))
    left = posterior_score(problem, maximum.path)
    assert 0.5 * float(left @ torch.linalg.solve(expected, left)) < 0.01


def test_a_number_that_begins_far_off_is_reached_in_steps_that_grow(cart):
    program, data, maximum = cart
    one = copy.deepcopy(program).with_effect("acceleration_bias", 8.0)
    problem = Problem(one, data, True)
    found = maximise(problem)
    assert found.converged and found.steps < MAX_STEPS
    assert found.objective == pytest.approx(maximum.objective, abs=4)


@pytest.mark.slow
def test_a_drive_whose_path_is_lost_is_fitted_again():
    program = example("hovercraft", torch.float32)
    program.noise, program.guesses = torch.tensor([0.08, 0.08, 0.05]), ()
    program.duration = 40 * program.step
    data = for_program(program, simulate(program, 6, seed=1)).without_truth(keep_start=True)
    right = maximise(Problem(program, data, True))
    lost, states = right.log_likelihood.clone(), right.path.states.clone()
    lost[2], states[1:, 2] = -500.0, 0.0
    problem = Problem(program, data, True)
    found = refit_outliers(problem, replace(right, log_likelihood=lost, path=replace(right.path, states=states)))
    assert torch.allclose(found.log_likelihood, right.log_likelihood, atol=0.3)
    assert refit_outliers(problem, right) is right


class Biased(type(example("linear_gaussian"))):
    """A bias of any size, in whatever unit."""

    unit = 1.0

    def __init__(self):
        super().__init__()
        self.bias = PyroParam(torch.tensor(0.0), constraints.real)

    def transition(self, state, control, time, step):
        return super().transition(state, control + self.bias * self.unit, time, step)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
def test_a_number_with_a_unit_is_found_in_any_unit(unit):
    program = Biased().double()
    program.unit, program.bias = unit, torch.tensor(0.7 / unit).double()
    data = drives(program, 10, 80)
    program.bias = torch.tensor(0.0).double()
    maximum = maximise(Problem(program, data, True))
    assert maximum.converged
    assert unit * float(program.bias.detach()) == pytest.approx(0.7, abs=0.15)
