"""The score test of many candidates at once, on scores whose distribution is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from examples import example
from scipy import stats

from steady_ppl.discovery.effect_scores import Column
from steady_ppl.discovery.screening import FAMILY_LEVEL, UNEXCITED, _critical, _limit, _test, screen
from steady_ppl.effects import chosen_variant

DRIVES, PARAMETERS = 16, 3
NAMES = ("linear_drag", "quadratic_drag", "yaw_bias", "slope", "bearing_bias", "sensor_scale")


def columns() -> list[Column]:
    program = example("hovercraft")
    return [Column(chosen_variant(program, name, "")) for name in NAMES]


def scores_of(sets: int, seed: int, missing: float = 0.0) -> torch.Tensor:
    """Scores `(S, B, N)` that are correlated and not normal; `missing` of the second candidate."""
    random = torch.Generator().manual_seed(seed)
    count = PARAMETERS + sum(column.size for column in columns())
    mixing = torch.randn(count, count, generator=torch.Generator().manual_seed(1)).double() + 2 * torch.eye(count)
    raw = torch.rand(sets, DRIVES, count, generator=random).double() - 0.5
    scores = raw @ mixing.T
    information = mixing @ mixing.T / 12
    return scores + missing * information[:, PARAMETERS + 1]


@pytest.mark.slow
def test_p_values_are_uniform_where_nothing_is_missing():
    found, drives = columns(), scores_of(400, 2)
    p_values = []
    for index in range(400):
        simulated = scores_of(199, 1000 + index)
        p_values.append(screen(drives[index], simulated, PARAMETERS, found).p_value)
    jitter = np.random.default_rng(0).uniform(0, 1 / 200, 400)  # p-values are multiples of 1/200
    assert stats.kstest(np.array(p_values) - jitter, "uniform").pvalue > 0.01


def test_what_is_missing_is_first_with_its_coefficient():
    screened = screen(scores_of(1, 3, missing=1.2)[0], scores_of(400, 4), 3, columns())
    first = screened.tested[0]
    assert first.variant.name == "quadratic_drag" and screened.p_value < 0.01
    assert abs(float(first.coefficient[0]) - 1.2) < 4 * float(first.sd[0])
    quantiles = stats.norm.isf(screened.critical / 2) + stats.norm.isf(0.05)
    assert first.detection_limit == pytest.approx(quantiles * first.sd, rel=1e-3)
    assert 4 < quantiles < 5.5


def test_the_fitted_parameters_own_score_is_taken_as_it_is():
    """Where log p(y) is biased so are the sets' scores, which is no fault of the fit."""
    drives, simulated = scores_of(1, 6)[0], scores_of(400, 5)
    drives[:, :PARAMETERS] -= drives[:, :PARAMETERS].mean(0)  # at the maximum
    simulated[..., :PARAMETERS] += 3.0
    statistic, count = screen(drives, simulated, PARAMETERS, columns()).fitted
    assert statistic == pytest.approx(0.0, abs=1e-6) and count == PARAMETERS


def test_what_fitted_parameters_explain_is_projected_out():
    """A candidate whose scores are the parameters' mixed is untestable; moving a parameter changes nothing."""
    simulated, drives = scores_of(400, 5), scores_of(1, 6)[0]
    mix = torch.tensor([0.3, -1.0, 2.0]).double()
    for scores in (simulated, drives):
        scores[..., PARAMETERS + 2] = scores[..., :PARAMETERS] @ mix
    found = screen(drives, simulated, PARAMETERS, columns())
    bias = next(tested for tested in found.tested if tested.variant.name == "yaw_bias")
    assert bias.untestable and not np.isfinite(bias.detection_limit).any()
    others = {tested.variant.name: tested.statistic for tested in found.tested}
    information = torch.einsum("sbi,sbj->ij", simulated, simulated)[:, :PARAMETERS] / len(simulated) / DRIVES
    again = screen(drives + information @ mix * 0.1, simulated, PARAMETERS, columns())
    for tested in again.tested:
        assert tested.statistic == pytest.approx(others[tested.variant.name], abs=0.25)


@pytest.mark.parametrize("sets", [50, 60, 200, 999])
def test_a_single_tests_level_and_the_familys_say_the_same(sets):
    """The family's p-value is at most 5 % exactly where some test is at or below the critical one."""
    family = np.random.default_rng(sets).uniform(size=sets)
    critical = _critical(family)
    for observed in (*np.sort(family), critical, *np.nextafter(np.sort(family)[:12], 0.0)):
        whole = (1 + int((family <= observed).sum())) / (1 + sets)
        assert (whole <= FAMILY_LEVEL) == (observed <= critical)


def test_a_statistic_that_rounding_made_negative_says_nothing():
    column = next(column for column in columns() if column.size == 2)
    scores, information = torch.tensor([[1.0, -1.0], [0.1, 0.2]]).double(), torch.ones(2, 2).double()
    information[0, 1] = information[1, 0] = 1 + 1e-6  # two columns that are nearly one
    found = _test(column, slice(0, 2), scores, information, information.diagonal())
    assert found.statistic < 0 and found.p_values[0] == 1.0


def test_a_candidate_without_a_test_leaves_the_others_theirs():
    """A matrix that is singular, a test that is not finite, and columns without scores are said to be untestable."""
    simulated, drives, found = scores_of(200, 7), scores_of(1, 8)[0], columns()
    plain = screen(drives, simulated, PARAMETERS, found)
    (slope,) = (index for index, column in enumerate(found) if column.variant.name == "slope")
    first = PARAMETERS + sum(column.size for column in found[:slope])
    for scores in (simulated, drives):
        scores[..., first + 1] = scores[..., first]
    drives[0, -1] = float("inf")  # of the last candidate
    screened = screen(drives, simulated, PARAMETERS, found)
    why = {tested.variant.name: tested.untestable for tested in screened.tested}
    assert "singular" in why["slope"] and why[NAMES[-1]] == "its test is not finite"
    without = screen(drives[:, :-1], simulated[..., :-1], PARAMETERS, found[:-1], failed=[(found[-1], "it failed")])
    assert {tested.variant.name: tested.untestable for tested in without.tested}[NAMES[-1]] == "it failed"
    for one in (screened, without):
        assert len(one.tested) == len(plain.tested) and one.correlations.shape == (len(NAMES), len(NAMES))
        by_name = {tested.variant.name: tested.p_value for tested in one.tested}
        expected = {tested.variant.name: tested.p_value for tested in plain.tested}
        assert by_name["linear_drag"] == pytest.approx(expected["linear_drag"])
        assert by_name[NAMES[-1]] == 1


@pytest.mark.parametrize("critical", [0.0, 1e-300, 1 - 1e-16])
def test_a_limit_exists_at_every_level(critical):
    tested = screen(scores_of(1, 9)[0], scores_of(200, 10), PARAMETERS, columns()).tested[0]
    limit = _limit(tested, critical)
    assert (limit > 0).all() and bool(np.isfinite(limit).all()) == (critical > 0)


def test_a_candidate_that_is_never_excited_is_said_to_be():
    simulated, drives = scores_of(200, 11), scores_of(1, 12)[0]
    for scores in (simulated, drives):
        scores[..., PARAMETERS] = 0
    screened = screen(drives, simulated, PARAMETERS, columns())
    assert {tested.variant.name: tested.untestable for tested in screened.tested}[NAMES[0]] == UNEXCITED
