"""Knees, leads and drags that an effect has beside its coefficient: steps between them, priors and intervals."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from examples import example

import steady_ppl as st
from steady_ppl.discovery.candidates import _axis, _log_prior, _neighbours
from steady_ppl.discovery.finding import _interval
from steady_ppl.effects import chosen_variant


def test_a_scale_goes_by_factors_and_a_place_by_steps():
    """The drag of a wind is on a grid of .02, .06 and .2; a knee has no such grid."""
    program = example("hovercraft", torch.float32)
    grid = chosen_variant(program, "wind").effect.variants(program)
    assert [round(one.profiled["drag"] / 0.06, 4) for one in _neighbours(grid[0], grid, "drag", 1.0)] == [3, 0.3333]
    knee = chosen_variant(program, "thrust_saturation", knee=0.6)
    assert [one.profiled["knee"] for one in _neighbours(knee, [knee], "knee", 0.25)] == pytest.approx([0.72, 0.48])


def test_what_a_factor_leaves_open_is_in_an_interval_by_a_factor():
    effect = chosen_variant(example("hovercraft", torch.float32), "wind").effect
    low, high = _interval(effect, -0.5, 0.0, 0.25, 0.5)
    assert low * high == pytest.approx(0.25) and low < -0.5 < high < 0
    assert sum(_interval(effect, 0.5, 0.1, 0.25, 0.0)) == pytest.approx(1.0)
    low, high = _interval(effect, 1e-5, 0.02, 0.01, 0.5)  # a component near zero
    assert high == pytest.approx(-low, rel=0.01) and high < 0.04


def test_choices_of_a_factor_are_above_zero():
    program = example("hovercraft", torch.float32)
    wind = chosen_variant(program, "wind").effect
    with pytest.raises(st.UsageError, match="drag is uncertain by a factor"):
        replace(wind, choices=lambda program, data: [{"drag": 0.0}]).variants(program)
    (alone,) = replace(wind, choices=lambda program, data: [{"drag": 0.1}]).variants(program)
    assert [one.profiled["drag"] for one in _neighbours(alone, [alone], "drag", 1.0)] == pytest.approx(
        [0.18, 0.1 / 1.8]
    )
    assert _log_prior(alone, [alone]) == 0.0


def test_the_prior_of_a_place_and_its_variance_are_one():
    """Leads of 0, .2 and .5 s: a step of a quarter of .2 s is .2 of half the grid's width."""
    slip = chosen_variant(example("hovercraft"), "side_slip").effect.variants(example("hovercraft"))
    middle = replace(slip[0], options={**slip[0].options, "lead": 0.25})
    axis, falls = (
        _axis(middle, slip, "lead"),
        [_log_prior(one, slip) for one in _neighbours(middle, slip, "lead", 0.25)],
    )
    assert -2 * sum(falls) / 2 == pytest.approx((0.25 * axis.spacing / axis.half_width) ** 2) == pytest.approx(0.04)


def test_a_grid_of_one_point_goes_by_shares_of_where_it_is():
    """A radius stays above zero, and may be anywhere."""
    knee = chosen_variant(example("hovercraft"), "thrust_saturation", knee=1.0)
    here, places = knee, list[float]()
    for _ in range(3):
        here = _neighbours(here, [knee], "knee", 0.5)[1]
        places.append(here.profiled["knee"])
        assert _log_prior(here, [knee]) == 0.0
    assert places == pytest.approx([0.6, 0.36, 0.216])
    assert _axis(replace(knee, options={**knee.options, "knee": 0.0}), [knee], "knee").half_width > 0


def test_the_prior_of_a_place_is_as_wide_as_its_grid():
    slip = chosen_variant(example("hovercraft"), "side_slip").effect.variants(example("hovercraft"))  # leads 0 to .5
    assert _log_prior(replace(slip[0], options={**slip[0].options, "lead": 1.0}), slip) == pytest.approx(-4.5)
    grid = chosen_variant(example("hovercraft"), "wind").effect.variants(example("hovercraft"))
    (least,) = (one for one in grid if one.profiled["drag"] == 0.02)
    assert _log_prior(least, grid) == pytest.approx(-0.5)
