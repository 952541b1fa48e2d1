"""With several substeps the score is the slope of log p(y), where responses are fast beside a row too."""

from __future__ import annotations

import pytest
import torch
from examples import example
from oracles import joint_density

from steady_ppl import fit_by_likelihood, for_program, seeded, simulate, with_substeps
from steady_ppl.gaussian.smoother import find_path, smooth, smoother_paths
from steady_ppl.likelihood.parameters import elements, moved
from steady_ppl.likelihood.scores import parameter_scores, smoothed
from steady_ppl.model.problem import Problem

Cart = type(example("linear_gaussian"))


def fast(damping, substeps, noise=3.0):
    """A cart that follows its push within a row or less."""
    cart = Cart().double()
    for name, value in (("damping", damping), ("gain", damping), ("noise", noise)):
        setattr(cart, name, torch.tensor(value).double())
    return with_substeps(cart, substeps)


def at_rest(program, data, path):
    return smooth(Problem(program, data), path, passes=20, tolerance=1e-7, kernels=False)


def log_likelihood(program, data, path):
    return float(at_rest(program, data, path).log_likelihood.sum())


def beside_the_maximum(damping, substeps):
    """A cart whose numbers are a fifth and a third off, drives of the right one, and the one smoothed along them."""
    data = for_program(Cart().double(), simulate(fast(damping, substeps), 6, seed=1, substeps=substeps)).without_truth()
    program = fast(1.2 * damping, substeps, noise=2.0)
    with seeded(0, "path"):
        path = find_path(Problem(program, data))
    return program, data, at_rest(program, data, path)


@pytest.mark.slow
@pytest.mark.parametrize(("damping", "substeps"), [(0.8, 1), (0.8, 4), (10.0, 16), (30.0, 32)])
def test_scores_are_slopes(damping, substeps) -> None:
    program, data, ahead = beside_the_maximum(damping, substeps)
    parts, path = elements(program), ahead.path(data)
    scores = parameter_scores(program, data, smoothed(ahead, data), parts).sum(0)
    assert [part.name for part in parts] == ["gain", "damping", "noise", "measurement_sd"]
    for part, score in zip(parts, scores.tolist(), strict=True):
        ends = []
        for sign in (1, -1):
            with moved(part, 0.1 * sign * part.step):
                ends.append(log_likelihood(program, data, path))
        assert score == pytest.approx((ends[0] - ends[1]) / (0.2 * part.step), rel=2e-3, abs=0.1)


@pytest.mark.slow
def test_a_fit_that_calls_itself_converged_is_at_the_maximum() -> None:
    """Noise held 30 % too small: what the mean alone says of the damping leads elsewhere."""
    data = for_program(Cart().double(), simulate(fast(30.0, 32), 12, seed=1, substeps=32)).without_truth()
    program = fast(25.0, 32, noise=2.1)
    program.noise_unconstrained.requires_grad_(False)
    with seeded(0, "path"):
        maximum = fit_by_likelihood(program, data)
    assert maximum.converged
    best = log_likelihood(program, data, maximum.path)
    for part in elements(program):
        for sign in (1, -1):
            with moved(part, 4 * sign * part.step):
                assert log_likelihood(program, data, maximum.path) < best + 0.1


@pytest.mark.exhaustive
@pytest.mark.parametrize(("damping", "substeps"), [(0.8, 4), (3.0, 8), (10.0, 16)])
def test_the_density_of_given_draws_has_the_same_slopes(damping, substeps) -> None:
    """What an M step climbs, by 4,000 draws in ten lots."""
    program, data, ahead = beside_the_maximum(damping, substeps)
    scores = parameter_scores(program, data, smoothed(ahead, data), elements(program)).sum(0)
    lots = []
    for seed in range(10):
        with seeded(seed, "draws"):
            paths = smoother_paths(Problem(program, data), ahead, 400)
        program.zero_grad()
        _, slopes = joint_density(program, paths, data)
        lots.append(torch.stack([-slope / 400 for slope in slopes.values()]))
    mean, sd = torch.stack(lots).mean(0), torch.stack(lots).std(0)
    assert ((mean - scores).abs() < 4 * sd / 10**0.5 + 0.01 * scores.abs()).all(), (mean, scores, sd)
