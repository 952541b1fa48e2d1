"""Forecasts: exact where the answer is known, from nothing but what they say they used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from examples import copies, drives, example
from oracles import assert_mean, cart_parameters, kalman
from small import simulated

import steady_ppl as st
from steady_ppl.runs.posterior import forecast

ROWS, KNOWN, COPIES = 12, 7, 400


@pytest.fixture(scope="module")
def cart():
    """Forecasts of one drive of the cart, many times over, and what a Kalman filter says."""
    program = example("linear_gaussian")
    data = drives(program, 1, ROWS, gaps=True)
    after = float(data.elapsed[KNOWN - 1, 0])
    many = replace(copies(data, COPIES), labels=tuple(map(str, range(COPIES))))
    found = forecast(program, many, after=after, draws=1, particles=50, seed=3)
    known = replace(data, observed=data.observed & (torch.arange(ROWS) < KNOWN)[:, None, None])
    return program, found, kalman(known, cart_parameters(program))


def drawn(found, name: str) -> torch.Tensor:
    """`(COPIES, rows after the moment)`."""
    return torch.from_numpy(found["predictions"][name].values[0, 0])[:, KNOWN:]


@pytest.mark.parametrize(("name", "component"), [("position", 0), ("velocity", 1)])
def test_states_are_the_kalman_filters(cart, name: str, component: int) -> None:
    _, found, exact = cart
    draws, mean = drawn(found, name), exact.predicted_means[KNOWN:, 0, component]
    assert_mean(draws, mean)
    assert_mean((draws - mean).square(), exact.predicted_covariances[KNOWN:, 0, component, component])


def test_measurements_have_their_noise(cart) -> None:
    program, found, exact = cart
    draws, mean = drawn(found, "measured_position"), exact.predicted_means[KNOWN:, 0, 0]
    variance = exact.predicted_covariances[KNOWN:, 0, 0, 0] + program.measurement_sd.double().square()
    assert_mean(draws, mean)
    assert_mean((draws - mean).square(), variance)


def test_only_later_rows_are_forecasts(cart) -> None:
    _, found, _ = cart
    for name in ("position", "measured_position"):
        assert np.isfinite(found["predictions"][name].values[0, 0, 0]).tolist() == [False] * KNOWN + [True] * (
            ROWS - KNOWN
        )
    time = found["predictions_constant_data"]["time"].values[0]
    assert np.isnan(time[:KNOWN]).all() and (np.diff(time[KNOWN:]) > 0).all()
    assert np.isfinite(found["posterior"]["position"]).all()


def test_what_comes_after_is_not_looked_at() -> None:
    program, data = example("hovercraft"), simulated()
    after = 0.55
    changed = replace(data, measurements=torch.where(data.time[..., None] > after, 1.0, data.measurements))
    before, again = (forecast(program, table, after=after, draws=3, seed=1) for table in (data, changed))
    assert np.array_equal(
        before["predictions"]["measured_bearing_0"], again["predictions"]["measured_bearing_0"], equal_nan=True
    )
    assert int(np.isfinite(before["predictions"]["x"].values[0, 0, 0]).sum()) == 7


def test_planned_controls_are_rows_without_measurements() -> None:
    fit = st.Fit(example("hovercraft"), "hand", known_start=True)
    data = replace(simulated(trajectories=2, rows=6), lengths=torch.tensor([6, 4]))
    plan = torch.tensor([[1.0, 0.5], [0.2, 0.1], [0.0, 0.0]])
    found = fit.forecast(data, plan, draws=4, seed=2)
    times = found["predictions_constant_data"]["time"].values
    assert [row[np.isfinite(row)].round(6).tolist() for row in times] == [[0.6, 0.7, 0.8], [0.4, 0.5, 0.6]]
    left = found["constant_data"]["control_left"].values
    assert left[0, 5:8].round(6).tolist() == [1.0, 0.2, 0.0] and left[1, 3:6].round(6).tolist() == [1.0, 0.2, 0.0]
    table = st.from_frame(st.to_frame(data.continued(plan)))
    assert np.array_equal(
        found["predictions"]["measured_bearing_2"],
        fit.forecast(table, draws=4, seed=2)["predictions"]["measured_bearing_2"],
        equal_nan=True,
    )


def test_each_drive_has_its_own_plan_and_step() -> None:
    data = simulated(trajectories=2, rows=4).continued(torch.tensor([[[1.0, 2.0], [3.0, 4.0]]]), step=0.25)
    assert data.controls[3].tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert data.time[-1].tolist() == pytest.approx([0.55, 0.55]) and data.lengths.tolist() == [5, 5]
    assert not data.observed[-1].any() and data.states[-1].isnan().all()


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        ({}, "has no row after 1.2 s: give planned `controls`"),
        ({"after": 5.0}, "trajectory 1 has no row after 5 s"),
        ({"after": -1.0}, "trajectory 1 begins after -1 s"),
        ({"controls": torch.zeros(3, 5)}, r"shape \(3, 5\): expected \(rows, 2\) or \(rows, 3, 2\), for left, right"),
        ({"controls": torch.zeros(0, 2)}, "planned controls of shape"),
        ({"controls": torch.zeros(3, 2), "step": 0.0}, "step must be positive, got 0.0 s"),
    ],
)
def test_what_cannot_be_forecast_is_refused(ask: dict, said: str) -> None:
    with pytest.raises(st.DataError, match=said):
        forecast(example("hovercraft"), simulated(), **ask)
