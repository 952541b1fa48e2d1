"""What is much and what is long on a vehicle follows its units."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from examples import drives, example

from steady_ppl.effects import Sizes, catalogue
from steady_ppl.effects.sizes import time_of_change


@pytest.mark.parametrize(
    "name", ["hovercraft", "gps_boat", "truck", "car", "two_wheels", "pendulum", "linear_gaussian"]
)
def test_every_effect_has_a_size_on_every_vehicle(name):
    program = example(name, torch.float32)
    data = drives(program, 6, 61)
    sizes = Sizes(program, data)
    for variant in (v for effect in catalogue(program) for v in effect.variants(program, data)):
        assert 1e-4 < sizes.of(variant).scale < 1e4, variant.label


def held(period: int, rows: int = 400, trajectories: int = 4) -> torch.Tensor:
    """Controls that are something else every so many rows, `(rows, trajectories, 1)`."""
    levels = torch.randn(rows // period + 1, trajectories, 1, generator=torch.Generator().manual_seed(0))
    return levels.repeat_interleave(period, 0)[:rows]


@pytest.mark.parametrize("period", [4, 20])
def test_commands_change_in_half_the_time_for_which_they_are_held(period):
    """The correlation of levels that are drawn anew falls in a line, to a half at half the period."""
    program = example("linear_gaussian", torch.float32)
    data = drives(program, 4, 400)
    data = replace(data, controls=held(period))
    assert time_of_change(program, data) == pytest.approx(period / 2 * data.median_step, rel=0.3)
    slower = replace(data, time=1000 * data.time)
    assert time_of_change(program, slower) == pytest.approx(1000 * time_of_change(program, data), rel=1e-4)


def test_commands_that_never_change_leave_it_to_the_states():
    program = example("linear_gaussian", torch.float32)
    data = drives(program, 4, 100)
    still = replace(data, controls=torch.full_like(data.controls, 1000.3))
    assert time_of_change(program, replace(still, states=None)) == pytest.approx(float(data.elapsed.max()) / 4)
    assert 0 < time_of_change(program, still) < float(data.elapsed.max()) / 4


def test_sizes_go_with_the_size_of_the_commands():
    """Pulse widths of a thousand and more, not newtons."""
    program = example("hovercraft", torch.float32)
    data = drives(program, 2, 6)
    large = replace(data, controls=1000 * data.controls)
    dead_zone = next(effect for effect in catalogue(program) if effect.name == "dead_zone")
    (small,), (great,) = (
        [Sizes(program, table).of(v) for v in dead_zone.variants(program, table)] for table in (data, large)
    )
    assert great.scale == pytest.approx(1000 * small.scale)
    assert great.scale == pytest.approx(float(large.controls.abs().max()))
    assert small.probes == [small.scale * probe for probe in (0.05, 0.15, 0.3)]
