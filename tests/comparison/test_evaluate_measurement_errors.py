"""Errors in measurement space against the Kalman filter's predictions."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from examples import drives, example
from oracles import assert_mean, cart_parameters, cart_system, kalman

from steady_ppl import seeded
from steady_ppl.comparison.evaluate import measurement_errors
from steady_ppl.likelihood.evidence import in_parts


def predicted(program, data, *, known_start: bool = False) -> tuple[torch.Tensor, torch.Tensor]:
    """Measured minus predicted, and the prediction's variance, of each measured cell but the first rows'."""
    exact = kalman(data, cart_parameters(program), known_start=known_start)
    seen = data.observed[1:, :, 0]
    error = data.measurements[1:, :, 0] - exact.predicted_means[1:, :, 0]
    return error[seen], (exact.predicted_covariances[1:, :, 0, 0] + program.measurement_sd**2)[seen]


def chance_below(error: torch.Tensor, variance: torch.Tensor) -> torch.Tensor:
    return torch.distributions.Normal(0.0, 1.0).cdf(error / variance.sqrt())


def test_the_one_step_error_is_that_of_kalmans_prediction(cart, data):
    error, _ = predicted(cart, data)
    runs = []
    for run in range(10):
        with seeded("one step", run):
            runs.append(measurement_errors(cart, data, particles=5000, known_start=False)["one_step"] ** 2)
    assert_mean(torch.tensor(runs), error.square().mean())


def test_the_coverage_counts_the_cells_within_kalmans_interval(cart, data):
    particles = 5000
    below = chance_below(*predicted(cart, data))
    with seeded("coverage"):
        found = measurement_errors(cart, data, particles=particles, known_start=False)["coverage_90"]
    margin = 4 * math.sqrt(0.05 * 0.95 / particles * 5)  # weights may leave a fifth of the particles' worth
    certain = ((below > 0.05 + margin) & (below < 0.95 - margin)).double().mean()
    possible = ((below > 0.05 - margin) & (below < 0.95 + margin)).double().mean()
    assert certain <= found <= possible
    assert certain > 0.5 and possible < 1


def test_ninety_percent_intervals_of_the_true_program_cover_ninety_percent(cart):
    data = drives(cart, 40, 26)
    cells = 40 * 25
    margin = 4 * math.sqrt(0.9 * 0.1 / cells)
    found = measurement_errors(cart, data, particles=500, known_start=False)["coverage_90"]
    assert found == pytest.approx(0.9, abs=margin)
    narrow = example("linear_gaussian").requires_grad_(False)
    narrow.measurement_sd = cart.measurement_sd / 2
    assert measurement_errors(narrow, data, particles=500, known_start=False)["coverage_90"] < 0.9 - margin


def second(data) -> int:
    """The rows that make up 1 s."""
    return round(1 / float(data.steps[data.transitions].median()))


def test_open_loop_errors_of_a_still_cart_are_those_of_its_recursion(still, data):
    error = data.measurements[..., 0] - kalman(data, cart_parameters(still), known_start=True).means[..., 0]
    found = measurement_errors(still, data, particles=20, known_start=True)
    seen = data.observed[..., 0]
    assert set(found) == {"one_step", "open_loop_1s", "coverage_90"}  # 3 s are longer than the 24 rows
    for name, horizon in (("one_step", 1), ("open_loop_1s", second(data))):
        expected = error[horizon:][seen[horizon:]].square().mean().sqrt()
        assert found[name] == pytest.approx(float(expected), rel=1e-5)


def test_open_loops_start_from_the_filtered_states(cart, data):
    exact, system = kalman(data, cart_parameters(cart)), cart_system(data, cart_parameters(cart))
    horizon = second(data)
    starts = 24 - horizon
    mean, covariance = exact.means[:starts], exact.covariances[:starts]
    for k in range(horizon):
        matrix = system.matrix[k : k + starts]
        mean = (matrix @ mean[..., None])[..., 0] + system.offset[k : k + starts]
        covariance = matrix @ covariance @ matrix.mT
    seen = data.observed[horizon:, :, 0]
    error = (data.measurements[horizon:, :, 0] - mean[..., 0])[seen].square().mean()
    # the mean of 64 draws is off by a 64th of the variance if they are independent, by less when systematic
    least, most = error, error + covariance[..., 0, 0][seen].mean() / 64
    runs = []
    for run in range(20):
        with seeded("open loop", run):
            runs.append(measurement_errors(cart, data, particles=1000, known_start=False)["open_loop_1s"] ** 2)
    runs = torch.tensor(runs, dtype=torch.float64)
    margin = 4 * runs.std() / math.sqrt(len(runs))
    assert least - margin < runs.mean() < most + margin
    assert margin < 0.1 * error


def test_open_loops_run_without_noise(cart):
    data = drives(cart, 3, 11)  # the only open loop of 1 s starts at the known first row
    mean, system = data.states[0], cart_system(data, cart_parameters(cart))
    for matrix, offset in zip(system.matrix, system.offset, strict=True):
        mean = (matrix @ mean[..., None])[..., 0] + offset
    expected = (data.measurements[10, :, 0] - mean[:, 0]).square().mean().sqrt()
    found = measurement_errors(cart, data, particles=20, known_start=True)["open_loop_1s"]
    assert found == pytest.approx(float(expected), rel=1e-10)


def test_three_seconds_are_judged_where_the_drives_are_long_enough(still):
    data = drives(still, 2, 36)
    assert set(measurement_errors(still, data, particles=10, known_start=True)) == {
        "one_step",
        "open_loop_1s",
        "open_loop_3s",
        "coverage_90",
    }


@pytest.mark.parametrize("step", [0.9, 2.5])
def test_open_loops_shorter_than_a_step_are_left_out_or_one_step_long(still, step):
    program = type(still)().double().requires_grad_(False)
    program.step, program.damping = step, torch.tensor(0.1, dtype=torch.float64)
    data = drives(program, 2, 8)
    assert "one_step" in measurement_errors(program, data, particles=10, known_start=True)


def errors_of(program, data) -> dict[str, float]:
    with seeded("errors"):
        return measurement_errors(program, data, particles=20, known_start=True)


def test_missing_cells_and_padding_count_nothing(still, data):
    rubbish = replace(data, measurements=torch.where(data.observed, data.measurements, 1e3))
    a, b = (errors_of(still, d) for d in (data, rubbish))
    assert a == pytest.approx(b, rel=1e-6)


def test_the_first_row_is_no_prediction(still, data):
    measurements = data.measurements.clone()
    measurements[0] += 0.5
    a, b = (errors_of(still, d) for d in (data, replace(data, measurements=measurements)))
    assert a == pytest.approx(b, rel=1e-6)


def test_nothing_measured_gives_no_error(cart, data):
    unseen = replace(data, observed=torch.zeros_like(data.observed))
    assert measurement_errors(cart, unseen, particles=10, known_start=False) == {}


def test_trajectories_in_parts_have_the_same_errors(still, data, monkeypatch):
    one = errors_of(still, data)
    monkeypatch.setattr("steady_ppl.comparison.evaluate.in_parts", partial(in_parts, at_once=20))
    parts = errors_of(still, data)
    del one["coverage_90"], parts["coverage_90"]  # other random numbers
    assert parts == pytest.approx(one, rel=1e-6)


def test_whole_turns_of_a_bearing_change_no_error():
    program = example("hovercraft").requires_grad_(False)
    data = drives(program, 2, 12, gaps=True)
    turned = data.measurements + 2 * math.pi * torch.tensor([1, -2, 0, 3], dtype=torch.float64)
    found = []
    for measurements in (data.measurements, turned):
        with seeded("turns"):
            data = replace(data, measurements=measurements)
            found.append(measurement_errors(program, data, particles=200, known_start=True))
    assert found[0] == pytest.approx(found[1], rel=1e-9)
    assert found[0]["one_step"] < math.radians(10)
