"""The picture of a proof: how the error grows with the time ahead."""

from __future__ import annotations

import pytest
import torch
from examples import example

import steady_ppl as st
from steady_ppl.comparison.scores import Key
from steady_ppl.plotting.comparison import open_loop_picture


@pytest.fixture(scope="module")
def proof() -> st.Proof:
    """The owner's program without drag, and the one that made the drives."""
    before, truth = (example(name, torch.float32) for name in ("hovercraft", "hovercraft:HovercraftTruth"))
    truth.duration = 4.0
    rows = {"before": before.requires_grad_(False), "after": truth.requires_grad_(False)}
    return st.prove(rows, st.simulate(truth, 5, seed=2), known_start=True, truth="after")


@pytest.mark.slow
def test_the_picture_has_a_line_for_each_row_and_a_grey_floor(proof):
    axes = open_loop_picture(proof)
    rows = ["before", "after", "constant velocity", "last measurement"]
    assert [found.get_label() for found in axes.get_lines()] == rows
    assert [found.get_label() for found in axes.collections] == ["noise floor"]
    assert axes.get_xlabel() == "predicted ahead [s]" and axes.get_ylabel().endswith("[rad]")
    seconds, errors = axes.get_lines()[0].get_data()
    key = Key("measurement", "rad", proof.horizons["1 s"])
    assert errors[list(seconds).index(pytest.approx(1.0))] == proof.rows["before"].sums[key].value
    assert open_loop_picture(proof, of="location").get_ylabel() == "location, root mean square error [m]"
    with pytest.raises(st.UsageError, match="no open-loop error of 'speed'; there are angle, location, rad"):
        open_loop_picture(proof, of="speed")
