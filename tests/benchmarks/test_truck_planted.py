"""The faults that the truck's benchmark plants are what their texts say."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from examples import example

from steady_ppl import bearings_to, simulate, wrap

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
STEP = 0.1


@pytest.fixture(scope="module")
def planted():
    import truck_planted

    return truck_planted


@pytest.fixture(scope="module")
def data():
    program = example("truck", torch.float64)
    program.duration = 20 * STEP
    return simulate(program, 3, seed=0)


def bearings(data, states):
    return bearings_to(example("truck").landmarks, states, sd=0.1).mean


def test_commands_logged_late_are_those_of_before_and_the_first_is_held(planted, data):
    late = planted.FAULTS["commands logged late"].plant(data, 1.0).controls
    torch.testing.assert_close(late[2:], data.controls[:-2])
    torch.testing.assert_close(late[:2], data.controls[:1].expand(2, -1, -1))
    early = planted.FAULTS["commands act late"].plant(data, 0.5).controls
    torch.testing.assert_close(early[:-1], data.controls[1:])


def test_half_a_row_is_interpolated(planted, data):
    late = planted.commands_shifted(data, 0.5 * STEP).controls
    torch.testing.assert_close(late[1:], (data.controls[1:] + data.controls[:-1]) / 2)


def test_only_the_turn_is_scaled(planted, data):
    scaled = planted.FAULTS["turn scaled"].plant(data, 1.0).controls
    torch.testing.assert_close(scaled[..., 0], data.controls[..., 0])
    torch.testing.assert_close(scaled[..., 1], 1.08 * data.controls[..., 1])


def test_one_landmark_is_four_degrees_off(planted, data):
    off = wrap(planted.FAULTS["landmark askew"].plant(data, 1.0).measurements - data.measurements)
    torch.testing.assert_close(off[..., 1], torch.full_like(off[..., 1], math.radians(4)))
    assert float(off[..., [0, 2, 3]].abs().max()) == 0.0


@pytest.mark.parametrize("rows", [0.5, 1.0, 1.5])
def test_late_bearings_are_of_earlier_poses_with_the_noise_that_they_had(planted, data, rows):
    late = planted.bearings_late(data, rows * STEP).measurements
    noise = data.measurements - bearings(data, data.states)
    whole, share = math.ceil(rows), rows % 1.0 or 1.0
    after, before = data.states[1 : len(data.states) - whole + 1], data.states[: len(data.states) - whole]
    there = after + share * (before - after)
    there[..., 2] = after[..., 2] + share * wrap(before[..., 2] - after[..., 2])
    error = wrap(late[whole:] - bearings(data, there) - noise[whole:])
    assert float(error.abs().max()) < 1e-6


def test_what_is_known_is_no_parameter_any_more(planted):
    program = example("discovered_truck.py:DiscoveredTruck").with_effect("response_time:yaw", 0.0)
    frozen = planted.frozen(program)
    assert {name.removesuffix("_unconstrained") for name, _ in frozen.named_parameters()} == {"noise", "erratic"}
    assert str(planted.frozen(program).lever) == str(program.lever.detach())
    assert {name.removesuffix("_unconstrained") for name, _ in program.named_parameters()} >= {"lever", "turn_gain"}
