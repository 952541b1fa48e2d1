"""Posterior trajectories as InferenceData: named, in units, and with the noise that leads from state to state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from examples import drives, example
from oracles import CartPosterior, assert_mean, cart_parameters
from small import simulated

from steady_ppl import Fit, Trajectories
from steady_ppl.model.handlers import Replaying
from steady_ppl.model.substeps import sample_row
from steady_ppl.runs.posterior import posterior, states_frame

ROWS = 9


def uneven(name: str) -> Trajectories:
    """Three drives: the second two rows shorter, a fifth of the cells missing, steps of any length."""
    return replace(drives(example(name), 3, ROWS, gaps=True), labels=("a", "b", "c"))


@pytest.fixture(scope="module")
def hovercraft():
    with torch.random.fork_rng():
        data = uneven("hovercraft")
        return data, posterior(example("hovercraft"), data, draws=7, particles=60, seed=1)


def test_every_variable_has_named_coordinates(hovercraft) -> None:
    _, result = hovercraft
    states = result["posterior"]
    assert list(states.data_vars) == ["x", "y", "heading", "vx", "vy", "yaw_rate", "acceleration"]
    assert states["x"].dims == ("chain", "draw", "trajectory", "row")
    assert states["acceleration"].dims == ("chain", "draw", "trajectory", "row", "acceleration_channel")
    assert dict(states.sizes) == {"chain": 1, "draw": 7, "trajectory": 3, "row": ROWS, "acceleration_channel": 3}
    assert states["trajectory"].values.tolist() == ["a", "b", "c"] and states["row"].values.tolist() == list(
        range(ROWS)
    )
    assert states["acceleration_channel"].values.tolist() == ["forward", "lateral", "yaw"]
    for group in ("observed_data", "constant_data"):
        assert result[group]["trajectory"].values.tolist() == ["a", "b", "c"]
    assert set(result["observed_data"]) == {f"measured_bearing_{i}" for i in range(4)}
    assert {"time", "log_likelihood", "control_left", "control_right", "true_x"} <= set(result["constant_data"])


def test_every_variable_has_its_unit(hovercraft) -> None:
    _, result = hovercraft
    units = {name: variable.attrs["units"] for name, variable in result["posterior"].data_vars.items()}
    assert list(units.pop("acceleration")) == ["m/s²", "m/s²", "rad/s²"]
    assert units == {"x": "m", "y": "m", "heading": "rad", "vx": "m/s", "vy": "m/s", "yaw_rate": "rad/s"}
    constants = {name: variable.attrs["units"] for name, variable in result["constant_data"].data_vars.items()}
    assert constants["time"] == "s" and constants["control_left"] == "N" and constants["true_heading"] == "rad"
    assert {variable.attrs["units"] for variable in result["observed_data"].data_vars.values()} == {"rad"}


def test_a_trajectory_ends_in_nan_and_its_noise_one_row_earlier(hovercraft) -> None:
    data, result = hovercraft
    assert data.lengths.tolist() == [ROWS, ROWS - 2, ROWS]
    inside = data.rows.T.numpy()
    states, noise = result["posterior"]["x"].values, result["posterior"]["acceleration"].values
    assert np.array_equal(np.isfinite(states), np.broadcast_to(inside, states.shape))
    leading = np.append(inside[:, 1:], np.zeros((3, 1), bool), 1)
    assert np.array_equal(np.isfinite(noise), np.broadcast_to(leading[..., None], noise.shape))


def test_what_was_not_measured_is_nan(hovercraft) -> None:
    data, result = hovercraft
    for index in range(4):
        shown = result["observed_data"][f"measured_bearing_{index}"].values
        observed = data.observed[..., index].T.numpy()
        assert np.array_equal(np.isfinite(shown), observed)
        assert np.array_equal(shown[observed], data.measurements[..., index].T.numpy()[observed])


def test_times_controls_and_truth_are_those_of_the_drives(hovercraft) -> None:
    data, result = hovercraft
    constants, inside = result["constant_data"], data.rows.T.numpy()
    shown = [constants[name].values[inside] for name in ("time", "control_right", "true_vy")]
    expected = (data.elapsed, data.controls[..., 1], data.states[..., 4])
    for values, tensor in zip(shown, expected, strict=True):
        assert np.array_equal(values, tensor.T.numpy()[inside])
    assert np.isfinite(constants["log_likelihood"].values).all()


@pytest.mark.parametrize("name", ["hovercraft", "pendulum", "truck"])
def test_the_noise_of_a_row_leads_from_its_state_to_the_next(name: str) -> None:
    program, data = example(name), uneven(name)
    result = posterior(program, data, draws=4, particles=50)["posterior"]
    states = torch.from_numpy(np.stack([result[n].values[0] for n in program.state_names], -1)).transpose(1, 2)
    noise = torch.from_numpy(result["acceleration"].values[0]).transpose(1, 2)[:, :-1]
    noise = noise if len(program.channels) > 1 else noise[..., 0]
    with Replaying({"acceleration": noise.nan_to_num()}):
        after = sample_row(program, states[:, :-1].nan_to_num(), data.controls[:-1], data.elapsed[:-1], data.steps)
    inside = data.transitions.expand(4, -1, -1)
    torch.testing.assert_close(after[inside], states[:, 1:][inside], rtol=1e-12, atol=1e-12)


def test_a_measurement_and_a_state_of_one_name_are_kept_apart() -> None:
    """The cart's position is a state, and what is measured bears the same name."""
    result = posterior(example("linear_gaussian"), uneven("linear_gaussian"), draws=3, particles=30)
    assert set(result["posterior"]) == {"position", "velocity", "acceleration"}
    assert result["posterior"]["acceleration_channel"].values.tolist() == ["push"]
    assert set(result["observed_data"]) == {"measured_position"}


def test_the_same_seed_gives_the_same_draws_and_leaves_the_random_numbers_alone() -> None:
    program, data = example("linear_gaussian"), uneven("linear_gaussian")
    torch.manual_seed(5)
    expected = torch.rand(1)
    torch.manual_seed(5)
    a, b, c = (posterior(program, data, draws=5, particles=40, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(torch.rand(1), expected)
    assert a["posterior"].equals(b["posterior"]) and not a["posterior"].equals(c["posterior"])


def test_a_known_start_is_the_first_state_of_every_draw() -> None:
    program, data = example("hovercraft"), uneven("hovercraft")
    result = posterior(program, data, draws=3, particles=30, known_start=True)["posterior"]
    for index, name in enumerate(program.state_names):
        first = result[name].isel(chain=0, row=0).values
        assert np.array_equal(first, np.broadcast_to(data.states[0, :, index].numpy(), first.shape))


def test_a_fit_draws_with_its_own_start_and_the_rows_that_are_asked_for() -> None:
    program = example("hovercraft", torch.float32)
    fit, data = Fit(program, "hand", known_start=True), simulated(rows=ROWS)
    result = fit.posterior(data, draws=3, particles=30, every=4, seed=2)
    starts = result["posterior"]["x"].isel(row=0)
    assert (starts == starts.isel(draw=0)).all()
    measured = np.isfinite(result["observed_data"]["measured_bearing_0"].values)
    assert np.array_equal(measured, np.broadcast_to(np.arange(ROWS) % 4 == 0, measured.shape))
    assert result["posterior"].attrs == {"program": "Hovercraft", "particles": 30, "filter": "lookahead"}


def test_without_truth_no_true_state_is_shown() -> None:
    program = example("linear_gaussian")
    data = uneven("linear_gaussian").without_truth()
    constants = posterior(program, data, draws=2, particles=20)["constant_data"]
    assert not [name for name in constants if str(name).startswith("true_")]


def test_drives_without_labels_are_numbered() -> None:
    program = example("linear_gaussian")
    data = replace(uneven("linear_gaussian"), labels=())
    result = posterior(program, data, draws=2, particles=20)
    assert result["posterior"]["trajectory"].values.tolist() == ["1", "2", "3"]


@pytest.mark.slow
def test_the_draws_of_the_cart_have_the_exact_posterior_mean() -> None:
    program = example("linear_gaussian")
    data = replace(drives(program, 2, 5, gaps=True), labels=("a", "b"))
    runs = [posterior(program, data, draws=100, particles=2000, seed=seed)["posterior"] for seed in range(40)]
    for trajectory, label in enumerate(data.labels):
        exact = CartPosterior(data, trajectory, cart_parameters(program))
        rows = len(exact.states_mean)
        means = [
            np.stack(
                [run[name].sel(trajectory=label).mean(("chain", "draw")).values[:rows] for name in program.state_names],
                -1,
            )
            for run in runs
        ]
        assert_mean(torch.from_numpy(np.stack(means)), exact.states_mean)


def test_headings_whose_start_nobody_knows_are_on_one_turn():
    program, data = example("hovercraft", torch.float32), simulated(rows=21, trajectories=4).without_truth()
    posterior = Fit(program, "hand").posterior(data, draws=60, seed=1)
    heading = posterior["posterior"]["heading"].values[0]
    around = abs(np.exp(1j * heading).mean(0))
    assert around.min() > 0.9  # they are known
    assert heading.std(0).max() < 0.5 and abs(heading[0, :, 0]).max() <= np.pi
    table = states_frame(posterior)
    assert (table["heading_high"] - table["heading_low"]).max() < 2


def test_a_bearing_across_the_cut_has_a_narrow_forecast():
    program = example("hovercraft", torch.float32)
    program.landmarks = tuple((-1000.0, 0.1 * i) for i in range(4))
    data = simulated(rows=8)
    states = torch.zeros_like(data.states)
    there = replace(data, states=states, measurements=torch.full_like(data.measurements, 3.1))
    found = Fit(program, "hand", known_start=True).forecast(there, after=0.35, draws=200, particles=50)
    draws = found["predictions"]["measured_bearing_0"].values[0, :, 0, 4:]
    assert (draws > np.pi).any() and (draws < np.pi).any()
    assert np.ptp(draws, axis=0).max() < 2
    assert found["predictions"]["measured_bearing_0"].attrs["circular"] == 1
    later = found["predictions_constant_data"]["measured_bearing_0"].values[0]
    np.testing.assert_allclose(later[4:], 3.1, rtol=1e-6)
    assert np.isnan(later[:4]).all()
