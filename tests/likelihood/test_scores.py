"""Scores of parameters are derivatives of log p(y)."""

from __future__ import annotations

import pytest
import torch
from examples import drives, example
from paths import at_rest, settled

from steady_ppl.gaussian.smoother import find_path, smooth
from steady_ppl.kernels import rows as rows_by_kernels
from steady_ppl.likelihood.parameters import elements, moved
from steady_ppl.likelihood.scores import parameter_scores, smoothed
from steady_ppl.model.problem import Problem
from steady_ppl.model.substeps import with_substeps


@pytest.fixture(scope="module")
def hovercraft():
    program = example("hovercraft")
    data = drives(program, 12, 41)
    at, path = at_rest(program, data)
    return program, data, at, path


def test_a_linear_program_has_its_kalman_filters_scores():
    program = example("linear_gaussian")
    data = drives(program, 5, 30, gaps=True)
    at, path = at_rest(program, data)
    parts = elements(program)
    found = parameter_scores(program, data, at, parts)
    for index, part in enumerate(parts):
        with moved(part, 1e-4):
            up = smooth(Problem(program, data, True), path).log_likelihood
        with moved(part, -1e-4):
            down = smooth(Problem(program, data, True), path).log_likelihood
        torch.testing.assert_close(found[:, index], (up - down) / 2e-4, rtol=2e-3, atol=2e-3)


def test_a_linear_program_with_tails_has_the_slopes_of_its_own_log_likelihood():
    """For its measurements are touched where their mean squares are."""
    program = example("linear_gaussian").with_effect("heavy_tails", 0.4).requires_grad_(True)
    data = drives(program, 5, 30, gaps=True)
    problem, parts = Problem(program, data, True), elements(program)

    def rested(path, passes=100):
        return smooth(problem, path, passes=passes, tolerance=1e-9)

    ahead = rested(find_path(problem))
    assert float(ahead.linearization.path.variance.max()) > 0.15 * program.measurement_sd.detach() ** 2
    found = parameter_scores(program, data, smoothed(ahead, data), parts)
    for index, part in enumerate(parts):
        with moved(part, 1e-3):
            up = rested(ahead.path(data)).log_likelihood
        with moved(part, -1e-3):
            down = rested(ahead.path(data)).log_likelihood
        torch.testing.assert_close(found[:, index], (up - down) / 2e-3, rtol=5e-3, atol=5e-3)


@pytest.mark.slow
def test_scores_of_parameters_are_slopes_of_log_likelihood(hovercraft):
    program, data, at, path = hovercraft
    parts = elements(program)
    found = parameter_scores(program, data, at, parts)
    for index, part in enumerate(parts):
        with moved(part, 0.01):
            up = settled(program, data, path)[0].log_likelihood
        with moved(part, -0.01):
            down = settled(program, data, path)[0].log_likelihood
        expected = (up - down) / 0.02
        apart = (found[:, index] - expected).abs().max() / expected.abs().max()
        assert apart < 0.06, f"{part.name}: {found[:, index].tolist()} for {expected.tolist()}"


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [1, 2])
@pytest.mark.parametrize("effect", ["actuator_lag", "dead_zone", "battery_sag", "heavy_tails"])
def test_kernels_and_torch_find_the_same_scores_with_an_effect(effect, substeps, monkeypatch):
    """Kernels take the acting controls as they are: they found none of what an actuator's parameter changes."""
    program = with_substeps(example("hovercraft", torch.float32).with_effect(effect), substeps)
    data = drives(program, 3, 12)
    at, _ = at_rest(program, data)
    plain = parameter_scores(program, data, at, elements(program))
    monkeypatch.setattr(rows_by_kernels, "ROWS_WORTH_COMPILING", 1)
    with rows_by_kernels.kernel_failures() as why:
        found = parameter_scores(program, data, at, elements(program))
    assert why == {}
    torch.testing.assert_close(found, plain, rtol=1e-2, atol=1e-2 * float(plain.abs().max()))
