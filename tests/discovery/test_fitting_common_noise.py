"""Drives are judged by programs that have their process noise in common."""

from __future__ import annotations

import copy
from types import SimpleNamespace

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import drives, example
from pyro.distributions import constraints
from pyro.nn import PyroParam

from models.linear_gaussian import LinearGaussian
from steady_ppl import stack
from steady_ppl.data.trajectories import concatenated
from steady_ppl.discovery import fitting
from steady_ppl.discovery.candidates import judged
from steady_ppl.discovery.fitting import noise_numbers, with_common_noise
from steady_ppl.discovery.refits import Threshold, first_refit, refit_with
from steady_ppl.effects import chosen_variant, coefficient
from steady_ppl.errors import FilterError
from steady_ppl.gaussian.smoother import find_path, smooth
from steady_ppl.likelihood.maximize import maximise, maximise_sum
from steady_ppl.likelihood.objective import Term
from steady_ppl.likelihood.parameters import elements, values_of
from steady_ppl.model.problem import Problem

HIDDEN = 0.15  # m/s², process noise that the sensor of these drives nearly hides


class ByVariance(LinearGaussian):
    """The cart, whose noise is learned as a variance."""

    def __init__(self):
        super().__init__()
        del self.noise
        self.noise = torch.tensor(1.0)
        self.variance = PyroParam(torch.tensor(0.36), constraints.positive)

    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        mean = self.gain * control[..., 0] - self.damping * velocity
        faster = velocity + pyro.sample("acceleration", dist.Normal(mean, self.noise * self.variance.sqrt())) * step
        return stack(position + 0.5 * (velocity + faster) * step, faster)


def halves(seed: int, noise: float = HIDDEN, counts: tuple[int, int] = (4, 4)):
    """Drives of the cart, to fit and to choose by."""
    truth = example("linear_gaussian")
    truth.noise = torch.tensor(noise).double()
    return drives(truth, counts[0], 61, seed=seed), drives(truth, counts[1], 61, seed=100 + seed)


def refitted(program, seed: int = 1, **options):
    train, valid = halves(seed, **options)
    return first_refit(Problem(program, train, True), valid, seed=0)


def likelihood(programs, folds) -> float:
    found = 0.0
    for program, fold in zip(programs, folds, strict=True):
        path = find_path(Problem(program, fold.drives, True))
        found += float(smooth(Problem(program, fold.drives, True), path).log_likelihood.sum())
    return found


@pytest.fixture(scope="module")
def carts():
    return refitted(example("linear_gaussian"))


def noise_of(programs) -> list[float]:
    return [float(program.noise.detach()) for program in programs]


def test_drives_are_judged_with_noise_that_all_of_them_tell(carts):
    """Fitted to one half alone it vanishes, and the other half punishes the program for that."""
    alone, common = noise_of(carts.programs), noise_of(carts.judges.programs)
    assert min(alone) < HIDDEN / 10 and max(alone) < HIDDEN
    assert common[0] == common[1] and min(alone) < common[0] < max(alone)
    assert carts.judges.common == ("noise",) and carts.converged
    assert float(carts.mean_program().noise.detach()) == pytest.approx(common[0])
    assert float(carts.held_out.sum()) > float(carts.held_out_alone.sum()) + 10


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 4])
@pytest.mark.parametrize("counts", [(4, 4), (5, 8)])
def test_no_other_noise_in_common_is_likelier(seed, counts):
    refit = refitted(example("linear_gaussian"), seed, counts=counts)
    best = likelihood(refit.judges.programs, refit.folds)
    for by in (-0.1, 0.1):
        neighbours = copy.deepcopy(refit.judges.programs)
        for program in neighbours:
            next(part for part in elements(program) if part.name == "noise").move(by)
        assert likelihood(neighbours, refit.folds) < best
    for name in ("gain", "damping", "measurement_sd"):
        for by in (-0.05, 0.05):
            neighbours = copy.deepcopy(refit.judges.programs)
            next(part for part in elements(neighbours[1]) if part.name == name).move(by)
            assert likelihood(neighbours, refit.folds) < best


@pytest.mark.slow
@pytest.mark.parametrize("priors", [{}, {"noise": dist.Normal(0.3, 0.03)}], ids=["no prior", "a prior"])
def test_programs_that_have_everything_in_common_are_one(priors):
    """The prior of a number in common counts once."""
    train, valid = halves(3, noise=0.4, counts=(4, 6))
    pooled = example("linear_gaussian")
    pooled.priors = priors
    both = concatenated(train=train, valid=valid)
    whole = maximise(Problem(pooled, both, True), precision=1e-4)
    terms, orders = [], ([0, 1, 2, 3], [2, 0, 3, 1])
    for data, order in zip((train, valid), orders, strict=True):
        program = example("linear_gaussian")
        program.priors = priors
        parts = [elements(program)[index] for index in order]
        terms.append(Term(Problem(program, data, True), find_path(Problem(program, data, True)), parts, order))
    first, second = maximise_sum(terms, precision=1e-4)
    assert first.objective + second.objective == pytest.approx(whole.objective, abs=1e-3)
    for term in terms:
        assert values_of(elements(term.problem.program)).tolist() == pytest.approx(
            values_of(elements(pooled)).tolist(), abs=0.01
        )
    assert first.names == ("gain", "damping", "noise", "measurement_sd")
    turned = [second.names.index(name) for name in first.names]
    torch.testing.assert_close(second.information[turned][:, turned], first.information)


def test_noise_that_is_learned_as_a_variance_is_in_common_too():
    refit = refitted(ByVariance().double())
    assert refit.judges.common == ("variance",)
    assert float(refit.held_out.sum()) > float(refit.held_out_alone.sum()) + 10


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["process_noise", "coloured_noise"])
def test_effects_that_are_noise_are_in_common_too(effect):
    """Else the noise that one half wants comes back in the effect's coefficient."""
    base = refitted(example("linear_gaussian"), 2, noise=0.3, counts=(5, 5))
    variant = chosen_variant(base.program, effect)
    found = refit_with(base, variant, 1.2 if variant.effect.null == 1 else 0.1)
    assert not isinstance(found, str)
    assert set(found.judges.common) == {"noise", found.judges.common[-1]} and found.in_common(variant) == 1
    one, other = (coefficient(judge, variant).detach() for judge in found.judges.programs)
    assert torch.equal(one, other)
    assert abs(float((found.held_out - base.held_out).sum())) < 1.5


def test_what_moves_the_motion_or_only_some_rows_is_no_noise():
    program = example("hovercraft").with_effect("range_dependent_noise", 0.1).with_effect("yaw_bias", 0.1)
    data = drives(program, 3, 21)
    path = find_path(Problem(program, data, True))
    found = noise_numbers(program, data, path)
    assert [part.name for index, part in enumerate(elements(program)) if index in found] == [
        "noise[0]",
        "noise[1]",
        "noise[2]",
    ]


def test_a_program_without_learnable_noise_is_its_own_judge():
    program = example("linear_gaussian")
    value = program.noise.detach().clone()
    del program.noise
    program.noise = value
    refit = refitted(program)
    assert refit.judges.common == () and refit.judges.programs == refit.programs
    assert torch.equal(refit.held_out, refit.held_out_alone)


def test_a_candidate_that_is_given_up_is_compared_with_fits_to_the_same_half(carts):
    variant = chosen_variant(carts.program, "acceleration_bias")
    whole = refit_with(carts, variant, [0.0])
    half = refit_with(carts, variant, [0.0], threshold=Threshold(drives=1e9, held_out=1e9))
    assert not isinstance(whole, str) and not isinstance(half, str) and len(half.programs) == 1
    tested = SimpleNamespace(variant=variant)
    given_up, through = judged(carts, tested, half), judged(carts, tested, whole)
    torch.testing.assert_close(given_up.gain, through.alone[: len(given_up.gain)])


def test_it_begins_elsewhere_where_the_parabola_leads_nowhere(carts, monkeypatch):
    starts, tried = fitting._starts, []

    def far(terms, maxima):
        parabola, means = starts(terms, maxima)
        return [parabola + 400.0, means]

    def seen(terms, **options):
        tried.append(terms)
        if len(tried) == 1:
            raise FilterError("beyond all measure")
        return maximise_sum(terms, **options)

    monkeypatch.setattr(fitting, "_starts", far)
    monkeypatch.setattr(fitting, "maximise_sum", seen)
    problems = [fold.fitting(program) for program, fold in zip(carts.programs, carts.folds, strict=True)]
    found = with_common_noise(problems, carts.maxima)
    assert len(tried) == 2
    best = likelihood(carts.judges.programs, carts.folds)
    assert likelihood(found.programs, carts.folds) == pytest.approx(best, abs=0.1)
