"""Angles that differ by whole turns: side by side, and in every posterior and forecast."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from examples import example
from small import simulated

from steady_ppl import Fit
from steady_ppl.runs.posterior import states_frame
from steady_ppl.utils.angles import TURN, draws_on_one_turn, nearest_turn, paths_on_one_turn

GENERATOR = np.random.default_rng(0)


def test_paths_are_moved_as_a_whole_and_the_first_begins_between_minus_pi_and_pi():
    paths = 2.5 + 0.1 * GENERATOR.normal(size=(20, 3, 50)).cumsum(-1)
    turns = GENERATOR.integers(-2, 3, size=(20, 3, 1))
    inside = np.arange(50) < np.array([50, 2, 20])[:, None]
    found = paths_on_one_turn(np.where(inside, paths + TURN * turns, np.nan), inside)
    np.testing.assert_allclose(found[:, inside], paths[:, inside], atol=1e-9)


def test_draws_on_both_sides_of_the_cut_are_one_heap():
    draws = np.pi + 0.1 * GENERATOR.normal(size=(500, 4))
    wrapped = nearest_turn(draws, 0.0)
    assert np.ptp(wrapped) > 6
    found = draws_on_one_turn(wrapped)
    assert np.ptp(found, axis=0).max() < 1
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * draws), atol=1e-9)
    assert (abs(np.median(found, axis=0)) < np.pi + 0.1).all()


def test_the_nearest_turn_is_nearest():
    assert nearest_turn(np.array([0.1, 3.0, -3.0]), np.array([6.2, -3.1, 3.1])).tolist() == [
        0.1 + TURN,
        3.0 - TURN,
        -3.0 + TURN,
    ]


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
