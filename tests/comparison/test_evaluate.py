"""The paper's errors against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from examples import cut, drives, example
from oracles import CartPosterior, assert_mean, cart_parameters, cart_system

from steady_ppl import seeded
from steady_ppl.comparison.evaluate import forward, forward_mean, squared_errors, state_estimation
from steady_ppl.likelihood.evidence import in_parts

HORIZON = 10


def roll_out_moments(program, data, horizon: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Error of the mean roll-out and its variance, `(starts, B, 2)`, by matrices, from every true state."""
    system = cart_system(data, cart_parameters(program))
    starts = data.time.shape[0] - horizon
    mean, covariance = data.states[:starts], torch.zeros(starts, len(data), 2, 2, dtype=torch.float64)
    for k in range(horizon):
        matrix = system.matrix[k : k + starts]
        mean = (matrix @ mean[..., None])[..., 0] + system.offset[k : k + starts]
        covariance = matrix @ covariance @ matrix.mT + system.noise[k : k + starts]
    return mean - data.states[horizon:], covariance.diagonal(dim1=-2, dim2=-1)


def mean_recursion(program, data) -> torch.Tensor:
    """The states without noise from the true start, `(rows, B, 2)`."""
    system = cart_system(data, cart_parameters(program))
    states = [data.states[0]]
    for matrix, offset in zip(system.matrix, system.offset, strict=True):
        states.append((matrix @ states[-1][..., None])[..., 0] + offset)
    return torch.stack(states)


# --- forward errors ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("horizon", [1, HORIZON])
def test_the_mean_roll_outs_error_is_that_of_the_matrices(cart, data, horizon):
    error, _ = roll_out_moments(cart, data, horizon)
    expected = error[data.rows[horizon:]].square().mean(0).sqrt()
    found = forward_mean(cart, data, horizon=horizon)
    assert found == pytest.approx({"position": float(expected[0]), "velocity": float(expected[1])}, rel=1e-10)


def test_the_noisy_roll_outs_error_adds_the_variance_of_the_noise(cart, data):
    error, variance = roll_out_moments(cart, data, HORIZON)
    expected = (error.square() + variance)[data.rows[HORIZON:]].mean(0)
    runs = []
    for run in range(20):
        with seeded("forward", run):
            found = forward(cart, data, rollouts=50)
        runs.append([found["position"] ** 2, found["velocity"] ** 2])
    assert_mean(torch.tensor(runs), expected)


def test_so_many_roll_outs_that_they_come_in_parts_have_the_same_error(cart):
    data = drives(cart, 100, 11)
    error, variance = roll_out_moments(cart, data, 1)
    expected = (error.square() + variance)[..., 1].mean()
    runs = []
    for run in range(8):
        with seeded("parts", run):
            runs.append(forward(cart, data, horizon=1, rollouts=700)["velocity"] ** 2)
    assert_mean(torch.tensor(runs), expected)


def test_a_horizon_of_ten_rows_is_the_default(cart, data):
    assert forward_mean(cart, data) == forward_mean(cart, data, horizon=10)


def test_padding_counts_nothing_in_forward_errors(cart, data):
    whole = forward_mean(cart, data)
    squares, count = 0.0, 0
    for trajectory, rows in enumerate(data.lengths.tolist()):
        alone = cut(data.subset([trajectory]), rows)
        squares += (rows - HORIZON) * forward_mean(cart, alone)["position"] ** 2
        count += rows - HORIZON
    assert len(set(data.lengths.tolist())) == 2
    assert whole["position"] == pytest.approx(math.sqrt(squares / count), rel=1e-10)


def test_a_start_whose_state_is_unknown_counts_nothing(cart, data):
    states = data.states.clone()
    states[0, 1] = math.nan
    error, _ = roll_out_moments(cart, data, HORIZON)
    counted = data.rows[HORIZON:].clone()
    counted[0, 1] = False
    expected = error[counted].square().mean(0).sqrt()
    found = forward_mean(cart, replace(data, states=states))
    assert found["position"] == pytest.approx(float(expected[0]), rel=1e-10)


def test_an_end_whose_state_is_unknown_counts_nothing(cart, data):
    states = data.states.clone()
    states[23, 0] = math.nan
    error, _ = roll_out_moments(cart, data, HORIZON)
    counted = data.rows[HORIZON:].clone()
    counted[-1, 0] = False
    expected = error[counted].square().mean(0).sqrt()
    found = forward_mean(cart, replace(data, states=states))
    assert found["position"] == pytest.approx(float(expected[0]), rel=1e-10)


@pytest.mark.parametrize("rows", [10, 11])
def test_drives_shorter_than_the_horizon_have_no_forward_error(cart, data, rows):
    short = cut(data, rows)
    assert bool(forward_mean(cart, short)) == bool(forward(cart, short, rollouts=2)) == (rows > HORIZON)


def test_forward_errors_need_whole_states():
    program = example("hovercraft").requires_grad_(False)
    data = drives(program, 2, 13)
    data.states[..., 3:] = math.nan  # a motion-capture system gives poses
    assert forward_mean(program, data) == {}


# --- groups and angles ------------------------------------------------------------------------------------------------


def test_angles_are_compared_on_the_circle():
    program = example("hovercraft").requires_grad_(False)
    truth = torch.tensor([[3.0, 4.0, 3.1, 0.0, 0.0, 3.1]], dtype=torch.float64)
    states = torch.tensor([[0.0, 0.0, -3.1, 0.3, 0.4, -3.1], [3, 4, 3.1 + 4 * math.pi, 0, 0, 3.1]], dtype=torch.float64)
    found = squared_errors(program, states, truth)
    assert list(found) == ["location", "angle", "velocity", "yaw_rate"]
    expected = {"location": 5.0, "angle": 2 * math.pi - 6.2, "velocity": 0.5, "yaw_rate": 6.2}
    for group, error in expected.items():
        torch.testing.assert_close(found[group], torch.tensor([error**2, 0.0], dtype=torch.float64))


def test_squared_errors_leave_their_arguments_alone():
    program = example("pendulum").requires_grad_(False)
    states, truth = torch.full((2, 2), 4.0), torch.full((2, 2), -4.0)
    assert squared_errors(program, states, truth)["angle"].tolist() == pytest.approx([(8 - 2 * math.pi) ** 2] * 2)
    assert torch.equal(states, torch.full((2, 2), 4.0)) and torch.equal(truth, torch.full((2, 2), -4.0))


def test_whole_turns_change_no_error():
    program = example("hovercraft").requires_grad_(False)
    data = drives(program, 2, 13)
    turned = data.states.clone()
    turned[::2, :, 2] += 2 * math.pi
    assert forward_mean(program, replace(data, states=turned)) == pytest.approx(forward_mean(program, data), rel=1e-9)


# --- state estimation -------------------------------------------------------------------------------------------------


def test_state_estimation_is_the_mean_over_trajectories_of_the_root_over_rows(still, data):
    error = (mean_recursion(still, data) - data.states).square()
    roots = [error[:rows, b].mean(0).sqrt() for b, rows in enumerate(data.lengths.tolist())]
    expected = torch.stack(roots).mean(0)
    found = state_estimation(still, data, particles=10, known_start=True, lineages=7)
    assert found == pytest.approx({"position": float(expected[0]), "velocity": float(expected[1])}, rel=1e-6)
    root_of_mean = error[data.rows].mean(0).sqrt()
    assert found["position"] != pytest.approx(float(root_of_mean[0]), rel=1e-3)


def test_state_estimation_is_that_of_the_exact_smoother_at_every_nth_row(cart, data):
    expected = []
    for every in (1, 5):
        exact = CartPosterior(data.observed_every(every), 0, cart_parameters(cart))
        variance = torch.stack([exact.states_covariance[t, :, t].diag() for t in range(24)])
        expected.append(((exact.states_mean - data.states[:, 0]).square() + variance).mean(0))
    alone = data.subset([0])
    for every, exact in zip((1, 5), expected, strict=True):
        runs = []
        for run in range(20):
            with seeded("state", run):
                found = state_estimation(cart, alone, particles=3000, known_start=False, every=every, lineages=500)
            runs.append([found["position"] ** 2, found["velocity"] ** 2])
        assert_mean(torch.tensor(runs), exact)


def test_groups_without_truth_are_left_out():
    program = example("hovercraft").requires_grad_(False)
    data = drives(program, 2, 6)
    data.states[..., 3:] = math.nan
    found = state_estimation(program, data, particles=20, known_start=False, lineages=5)
    assert list(found) == ["location", "angle"]


def test_trajectories_in_parts_have_the_same_error(still, data, monkeypatch):
    one = state_estimation(still, data, particles=20, known_start=True, lineages=2)
    monkeypatch.setattr("steady_ppl.comparison.evaluate.in_parts", partial(in_parts, at_once=60))
    assert state_estimation(still, data, particles=20, known_start=True, lineages=2) == pytest.approx(one, rel=1e-6)
