"""Neural vehicles: their parameters, their start and how their inputs are normalised."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from examples import drives, example
from model_steps import PROGRAMS, run_once, some_states, stepped, stirred
from small import TRUTH, only_start

from steady_ppl import SteadyError, dense, load_program, stack

NETWORKS = [name for name in PROGRAMS if name.startswith(("neural_vehicle", "paper.py:PaperNeural"))]


def neural(name: str = "NeuralHovercraft", **options):
    return type(example(f"neural_vehicle.py:{name}"))(**options).double()


@pytest.mark.parametrize(
    ("options", "count"),
    [
        ({}, 5 * 3 + 3 + 5 * 64 + 64 + 64 * 3 + 3 + 5 * 3 + 3),
        ({"layers": 2, "absolute_heading": True}, 4915),  # as published
        ({"layers": 2}, 4915 - 2 * (3 + 64 + 3)),
    ],
    ids=["default", "the authors'", "two layers"],
)
def test_a_network_has_so_many_parameters(options, count: int) -> None:
    for name in ("NeuralHovercraft", "NeuralTruck"):
        assert sum(parameter.numel() for parameter in neural(name, **options).parameters()) == count


def test_a_network_refuses_options_that_it_does_not_know() -> None:
    for options in ({"layers": 3}, {"normalise": "smooth"}):
        with pytest.raises(ValueError, match=str(next(iter(options.values())))):
            neural(**options)


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_starts_at_constant_velocity_with_wide_noise(name: str) -> None:
    """All heads are zero: the mean acceleration is 0 and the deviation softplus(0) = ln 2 of its scale, anywhere."""
    program = example(name)
    states, controls, acceleration, step = some_states()
    after, noise = run_once(program, states, controls, acceleration, step)
    np.testing.assert_allclose(after, stepped(program)(states, acceleration, step), rtol=1e-12)
    assert not noise.mean.any()
    scale = np.tile(program.scale.numpy(), (len(states), 1))
    np.testing.assert_allclose(noise.stddev.detach(), math.log(2) * scale, rtol=1e-12)


@pytest.mark.parametrize("absolute_heading", [False, True])
def test_a_network_knows_no_place_and_only_if_asked_the_heading(absolute_heading: bool) -> None:
    """Turning the vehicle with its velocity, or moving it, leaves its body-frame accelerations alone."""
    program = stirred(neural(absolute_heading=absolute_heading, layers=2))
    states, controls, acceleration, step = some_states()
    velocity = (states[:, 3] + 1j * states[:, 4]) * np.exp(1j)
    turned = np.stack([*(states[:, :2].T + 7), states[:, 2] + 1, velocity.real, velocity.imag, states[:, 5]], -1)
    moved = np.concatenate([states[:, :2] + 7, states[:, 2:]], -1)
    mean, of_moved, of_turned = (
        run_once(program, some, controls, acceleration, step)[1].mean.detach() for some in (states, moved, turned)
    )
    torch.testing.assert_close(of_moved, mean, rtol=1e-12, atol=1e-12)
    assert torch.allclose(of_turned, mean, rtol=1e-9, atol=1e-12) == (not absolute_heading)


def body_moments(data) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and deviation of body velocities, yaw rate and controls over all rows of the drives."""
    states = data.states[data.rows].numpy()
    body = np.exp(-1j * states[:, 2]) * (states[:, 3] + 1j * states[:, 4])
    inputs = np.concatenate([np.stack([body.real, body.imag, states[:, 5]], -1), data.controls[data.rows].numpy()], -1)
    return torch.from_numpy(inputs.mean(0)), torch.from_numpy(inputs.std(0, ddof=1))


def test_normalised_by_the_truth_a_network_sees_unit_inputs() -> None:
    data = drives(load_program(TRUTH).double(), 4, 30, gaps=True)
    program = neural(normalise="truth")
    program.prepare(data, False)
    mean, sd = body_moments(data)
    torch.testing.assert_close(program.input_mean, mean)
    torch.testing.assert_close(program.input_sd, sd)


@pytest.mark.parametrize("known_start", [True, False])
def test_normalised_by_smoothing_a_network_never_looks_at_the_truth(known_start: bool) -> None:
    data = drives(load_program(TRUTH).double(), 4, 30)
    moments = []
    for given in (data, only_start(data), only_start(data) if known_start else data.without_truth()):
        program = neural()
        torch.manual_seed(1)
        program.prepare(given, known_start)
        moments.append(torch.stack([program.input_mean, program.input_sd]))
    assert torch.equal(moments[0], moments[1]) and torch.equal(moments[0], moments[2])
    assert torch.isfinite(moments[0]).all() and (moments[0][1] > 0).all()


def test_an_input_that_never_changes_is_not_blown_up() -> None:
    data = drives(load_program(TRUTH).double(), 2, 10)
    data = replace(data, controls=torch.zeros_like(data.controls))
    program = neural(normalise="truth")
    program.prepare(data, False)
    assert (program.input_sd[3:] == 1e-3).all()


@pytest.mark.parametrize("known", ["nothing", "the start"])
def test_normalising_by_a_truth_that_is_not_there_is_an_error(known: str) -> None:
    data = drives(load_program(TRUTH).double(), 2, 10)
    data = data.without_truth(keep_start=known == "the start")
    with pytest.raises(SteadyError, match="true state"):
        neural(normalise="truth").prepare(data, False)


@pytest.mark.parametrize("left", [(), (7,), (3, 1, 4)])
def test_dense_is_the_layer_whatever_the_layout(left):
    layer = torch.nn.Linear(5, 3).double()
    by_components = stack(*torch.randn(5, *left, dtype=torch.float64))
    for inputs in (by_components, by_components.contiguous()):
        torch.testing.assert_close(dense(layer, inputs), layer(inputs))
