"""Pictures draw what they say, on the axes they are given."""

from __future__ import annotations

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from examples import example
from small import simulated

from steady_ppl import Fit, UsageError, check
from steady_ppl.plotting import (
    effective_sizes,
    held_out_curve,
    observation_noise,
    particle_curve,
    posterior_states,
    posterior_trajectories,
    posterior_velocities,
)
from steady_ppl.plotting.check import check_picture, innovations
from steady_ppl.plotting.fit import forecast_band
from steady_ppl.runs.posterior import posterior
from steady_ppl.training.loop import Trained


@pytest.fixture(scope="module")
def drawn():
    with torch.random.fork_rng():
        return posterior(example("hovercraft", torch.float32), simulated(rows=6), draws=4, particles=30)


def labels(axes) -> list[str]:
    return [line.get_label() for line in axes.get_lines() if not line.get_label().startswith("_")]


def test_draws_truth_and_landmarks_are_labelled_lines(drawn) -> None:
    landmarks = ((1.0, 2.0), (3.0, 4.0))
    axes = posterior_trajectories(drawn, "2", landmarks=landmarks)
    assert labels(axes) == ["posterior draws", "truth", "landmark"]
    assert len(axes.get_lines()) == 4 + 2  # one line a draw
    states, constants = drawn["posterior"].sel(trajectory="2", chain=0), drawn["constant_data"].sel(trajectory="2")
    for draw, line in enumerate(axes.get_lines()[:4]):
        assert np.array_equal(line.get_xydata(), np.stack([states[name].values[draw] for name in "xy"], -1))
    truth, marks = axes.get_lines()[4:]
    assert np.array_equal(truth.get_xydata(), np.stack([constants["true_x"], constants["true_y"]], -1))
    assert np.array_equal(marks.get_xydata(), landmarks) and marks.get_linestyle() == "None"


def test_axes_carry_units_and_the_trajectorys_name(drawn) -> None:
    axes = posterior_trajectories(drawn, "3")
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_title()) == ("x [m]", "y [m]", "trajectory 3")
    axes.figure.canvas.draw()
    assert axes.get_aspect() == 1.0


def test_two_pictures_share_the_axes_that_are_given(drawn) -> None:
    axes = plt.subplots()[1]
    assert posterior_trajectories(drawn, "1", axes=axes, label="before", color="red") is axes
    assert posterior_trajectories(drawn, "1", axes=axes, label="after") is axes
    assert labels(axes) == ["before", "truth", "after", "truth"]
    assert axes.get_lines()[0].get_color() == "red" and len(plt.get_fignums()) == 1


def test_no_more_draws_than_asked_for_are_shown(drawn) -> None:
    axes = posterior_trajectories(drawn, "1", shown=2)
    assert len(axes.get_lines()) == 2 + 1


def test_without_truth_or_with_the_start_alone_no_truth_is_drawn() -> None:
    program = example("hovercraft", torch.float32)
    for keep_start in (False, True):
        data = simulated(rows=4).without_truth(keep_start=keep_start)
        axes = posterior_trajectories(posterior(program, data, draws=2, particles=20), "1")
        assert labels(axes) == ["posterior draws"]


def test_a_trajectory_that_is_not_there_is_an_error(drawn) -> None:
    for picture in (posterior_trajectories, posterior_velocities, effective_sizes):
        with pytest.raises(UsageError, match="no trajectory 'nine'; there are 1, 2"):
            picture(drawn, "nine")
    with pytest.raises(UsageError, match="no state speed in this posterior; there are x, y, heading"):
        posterior_states(drawn, "1", ["x", "speed"])


@pytest.mark.slow
def test_names_from_a_table_are_not_read_as_formulas() -> None:
    program = example("hovercraft", torch.float32)
    data = replace(simulated(rows=81), labels=(r"$\frac{$", "$x^2$", "3"))
    drives = posterior(program, data, draws=4, particles=30)
    found = check(Fit(program.requires_grad_(False), "hand"), data, simulations=20)
    figures = [posterior_trajectories(drives, name).figure for name in data.labels]
    figures += [innovations(found, name).figure for name in data.labels]
    figures += [check_picture(found)]
    for figure in figures:
        figure.canvas.draw()
    written = [text.get_text() for text in figures[-1].findobj(plt.Text) if not text.get_parse_math()]
    assert set(data.labels) < set(written)
    assert any(text.startswith("measured and predicted, trajectory") for text in written)


def test_any_components_are_drawn_by_their_names_and_units(drawn) -> None:
    axes = posterior_states(drawn, "2", ["heading", "yaw_rate"])
    assert [one.get_ylabel() for one in axes] == ["heading [rad]", "yaw_rate [rad/s]"]
    assert [labels(one) for one in axes] == [["posterior", "truth"]] * 2
    median = drawn["posterior"]["heading"].sel(trajectory="2", chain=0).median("draw")
    np.testing.assert_allclose(axes[0].get_lines()[0].get_ydata(), median, rtol=1e-6)
    plane = posterior_trajectories(drawn, "2", plane=("heading", "yaw_rate"))
    assert plane.get_xlabel() == "heading [rad]" and plane.get_aspect() == "auto"


def test_velocities_are_those_of_the_body(drawn) -> None:
    axes = posterior_velocities(drawn, "2", label="one")
    posterior_velocities(drawn, "2", axes=axes, label="other", color="red")
    assert [labels(one) for one in axes] == [["one", "truth", "other"]] * 2
    assert [one.get_ylabel() for one in axes] == ["longitudinal [m/s]", "lateral [m/s]"]
    truth = drawn["constant_data"].sel(trajectory="2")
    turned = np.exp(-1j * truth["true_heading"].values) * (truth["true_vx"].values + 1j * truth["true_vy"].values)
    for one, expected in zip(axes, (turned.real, turned.imag), strict=True):
        (line,) = (line for line in one.get_lines() if line.get_label() == "truth")
        np.testing.assert_allclose(line.get_ydata(), expected, atol=1e-6)


def test_the_particle_curve_of_a_drive(drawn) -> None:
    axes = effective_sizes(drawn, "2")
    sizes = drawn["sample_stats"]["effective_size"].sel(trajectory="2", chain=0)
    line = axes.get_lines()[0]
    assert line.get_ydata().tolist() == sizes.values.tolist() and line.get_label() == "lookahead"
    assert ((sizes > 1) & (sizes <= 30)).all() and axes.get_lines()[1].get_ydata()[0] == 30


def test_a_forecast_is_a_band_after_what_was_used() -> None:
    fit = Fit(example("hovercraft", torch.float32), "hand", known_start=True)
    found = fit.forecast(simulated(rows=8), after=0.35, draws=20, particles=20)
    axes = forecast_band(found, "1", "bearing_1")
    assert axes.get_ylabel() == "bearing_1 [rad]" and labels(axes) == [
        "forecast, median",
        "used",
        "measured later",
    ]
    median, used, later = axes.get_lines()
    assert later.get_xdata().tolist() == median.get_xdata().tolist()
    assert (abs(later.get_ydata() - median.get_ydata()) < np.pi).all() and np.isfinite(later.get_ydata()).all()
    assert median.get_xdata().tolist() == pytest.approx([0.4, 0.5, 0.6, 0.7])
    assert np.isfinite(used.get_ydata()).tolist() == [True] * 4 + [False] * 4
    assert labels(forecast_band(found, "1", "yaw_rate")) == ["forecast, median", "truth"]
    with pytest.raises(UsageError, match="no forecast of 'speed'; there are x, y, heading"):
        forecast_band(found, "1", "speed")


HISTORY = [
    {"step": 5.0, "observation_weight": 0.25, "ess": 20.0, "roots": 3.0, "log_likelihood": 1.0},
    {"step": 10.0, "observation_weight": 1.0, "ess": 40.0, "roots": 2.0, "log_likelihood": 2.0},
]


def fitted(history=HISTORY, **settings) -> Fit:
    return Fit(example("hovercraft"), "steady", settings, trained=Trained(history, kept=10))


def test_curves_of_a_fit_are_its_history() -> None:
    fit = fitted(guide="bootstrap", particles=50)
    held_out = held_out_curve(fit)
    assert held_out.get_lines()[0].get_ydata().tolist() == [1.0, 2.0]
    assert held_out.get_lines()[1].get_xydata().tolist() == [[10.0, 2.0]]
    assert observation_noise(fit).get_lines()[0].get_ydata().tolist() == [2.0, 1.0]
    particles = particle_curve(fit)
    assert labels(particles) == ["effective sample size", "starts with descendants", "N"]
    assert [line.get_ydata()[0] for line in particles.get_lines()] == [20.0, 3.0, 50]
    by_svi = fitted([{"step": 1.0, "kl_weight": 4.0}])
    assert observation_noise(by_svi).get_lines()[0].get_ydata().tolist() == [2.0]


@pytest.mark.parametrize(
    ("draw", "fit", "said"),
    [
        (particle_curve, fitted([{"step": 1.0}], guide="gaussian"), "guide gaussian has no particles"),
        (observation_noise, fitted([{"step": 1.0}]), "not tempered"),
        (held_out_curve, fitted([{"step": 1.0}]), "without held-out trajectories"),
        (held_out_curve, Fit(example("hovercraft"), "hand"), "recipe hand does not train"),
    ],
)
def test_a_curve_that_is_not_there_is_an_error(draw, fit: Fit, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        draw(fit)
