"""Angles that differ by whole turns, side by side."""

from __future__ import annotations

import numpy as np

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
