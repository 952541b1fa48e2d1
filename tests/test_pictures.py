"""Pictures draw what they say, on the axes they are given."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest
import torch
from examples import example
from small import simulated

from steady_ppl.posterior import posterior

matplotlib.use("Agg")

import matplotlib.pyplot as plt

from steady_ppl.pictures import posterior_trajectories, posterior_velocities


@pytest.fixture(scope="module")
def drawn():
    with torch.random.fork_rng():
        return posterior(example("hovercraft", torch.float32), simulated(rows=6), draws=4, particles=30)


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")


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
    with pytest.raises(KeyError):
        posterior_trajectories(drawn, "nine")


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
