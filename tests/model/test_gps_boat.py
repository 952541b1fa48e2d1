"""A vehicle with sensors of its pose, unknown starts, and much missing at once: `models/gps_boat.py`."""

from __future__ import annotations

import pytest
from examples import MODELS

import steady_ppl as st
from steady_ppl.effects import not_applicable
from steady_ppl.runs.recipes import find_recipe

BOAT, TRUTH = MODELS / "gps_boat.py", f"{MODELS / 'gps_boat.py'}:GpsBoatTruth"


def test_its_sensors_have_biases_of_their_own_and_nothing_of_bearings():
    boat = st.load_program(BOAT)
    assert not boat.sees_bearings and st.load_program(MODELS / "hovercraft.py").sees_bearings
    why = not_applicable(boat)
    for name in ("bearing_bias", "landmark_bias", "range_dependent_noise"):
        assert "bearing" in why[name], name
    listed = {variant.name for effect in st.effects.catalogue(boat) for variant in effect.variants(boat)}
    assert {f"sensor_bias:{name}" for name in ("gps_x", "gps_y", "compass")} <= listed


@pytest.mark.exhaustive
def test_all_that_brakes_a_boat_is_named_from_gps_and_compass_and_nothing_else_is_left():
    truth = st.load_program(f"{MODELS / 'gps_boat.py'}:GpsBoatTruth")
    train, valid = (st.simulate(truth, 8, seed=seed).without_truth() for seed in (1, 2))
    program = st.load_program(MODELS / "gps_boat.py")
    fit = find_recipe("likelihood")(program, train, valid)
    boat = st.discover(fit, train, valid, simulations=50)
    found = {finding.variant.name: finding for finding in boat.findings}
    assert found.keys() == {"yaw_linear_drag", "side_slip", "quadratic_drag"}
    for name, value in {"yaw_linear_drag": 0.6, "side_slip": 1.0, "quadratic_drag": 0.15}.items():
        (coefficient,), (sd,) = found[name].coefficient, found[name].sd
        assert abs(coefficient - value) < 4 * sd and coefficient == pytest.approx(value, rel=0.15)
    assert not boat.doubts
    assert boat.search.is_complete and "confidence" in boat.figures["sentence"]
