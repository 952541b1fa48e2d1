"""What a fit says that should be doubted."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from examples import example
from pyro.distributions import constraints
from pyro.nn import PyroParam
from small import HOVERCRAFT, simulated, steady, written

import steady_ppl as st
from steady_ppl.runs.diagnostics import diagnose_fit, diagnose_units
from steady_ppl.training.loop import Trained


def trained(*values: float, kept: int | None = None, interrupted: bool = False) -> Trained:
    history = [{"step": 25.0 * (k + 1), "log_likelihood": value} for k, value in enumerate(values)]
    return Trained(history, 25 * len(values) if kept is None else kept, interrupted)


@pytest.mark.parametrize(
    ("found", "rising"),
    [
        (trained(-20.0, -6.0, -5.0, -2.0), 3.0),
        (trained(-20.0, -6.0, -5.0, -4.9), None),
        (trained(-20.0, -6.0, -5.0, -2.0, kept=75), None),
        (trained(-20.0, -6.0, -5.0, -2.0, interrupted=True), None),
        (trained(-20.0, -2.0), None),
        (Trained([{"step": 25.0, "loss": 1.0}], 25), None),
    ],
)
def test_a_training_that_still_rises_says_so(found: Trained, rising: float | None):
    assert found.still_rising == (None if rising is None else pytest.approx(rising))
    program = st.load_program(HOVERCRAFT)
    notes = diagnose_fit(st.Fit(program, "steady", {"steps": 100}, trained=found), program.state_dict())
    assert [note.startswith("not converged") and "--steps 400" in note for note in notes] == [True] * bool(rising)


def test_a_proof_says_what_may_be_training(lighter):
    program = st.load_program(HOVERCRAFT)
    rows = {
        "before": st.Fit(program, "steady", known_start=True, trained=trained(-20.0, -6.0, -5.0, -2.0)),
        "after": st.Fit(program, "steady", known_start=True, trained=trained(-20.0, -6.0, -5.0, -4.9)),
    }
    notes = st.prove(rows, lighter[1], with_constant_velocity=False).notes
    assert [note.split()[0] for note in notes if "had not converged" in note] == ["before"]


def test_a_number_that_a_fit_takes_away_is_named():
    class Named(type(st.load_program(HOVERCRAFT))):
        def __init__(self):
            super().__init__()
            self.gains = PyroParam(torch.tensor([1.0, 2.0]), constraints.positive)

    program = Named()
    declared = {name: value.clone() for name, value in program.state_dict().items()}
    assert diagnose_fit(st.Fit(program, "hand"), declared) == []
    program.gains, program.noise = torch.tensor([1.0, 0.05]), torch.tensor([1e-3, 1e-3, 1e-3])  # noise is a guess
    (said,) = diagnose_fit(st.Fit(program, "hand"), declared)
    assert said.startswith("gains[1] fell from 2 to 0.05")
    program.guesses = ()
    assert len(diagnose_fit(st.Fit(program, "hand"), declared)) == 4


def test_degrees_are_asked_for(tmp_path: Path, lighter, capsys):
    program = st.load_program(HOVERCRAFT)
    data = st.for_program(program, lighter[0])
    assert diagnose_units(program, data) == []
    degrees = replace(lighter[0], measurements=torch.rad2deg(lighter[0].measurements))
    found = diagnose_units(program, st.for_program(program, degrees))
    assert len(found) == 4 and all("are these degrees?" in said for said in found)
    many_turns = replace(data, measurements=data.measurements + 4 * math.pi)
    assert diagnose_units(program, many_turns) == []  # an angle that counts its turns
    table = written(tmp_path / "degrees.csv", degrees)
    assert steady("fit", HOVERCRAFT, table, "--recipe", "hand", "--out", tmp_path / "run") == 0
    assert "y.bearing_0 is between" in capsys.readouterr().err


def test_degrees_are_suspected_in_controls_and_known_headings(tmp_path: Path, capsys) -> None:
    program, data = example("truck", torch.float32), simulated("truck", 3, 13)
    controls, states = data.controls.clone(), data.states.clone()
    controls[..., 1] = 45.0
    states[..., 2] = 170.0
    found = diagnose_units(program, st.for_program(program, replace(data, controls=controls, states=states)))
    assert any(said.startswith("u.turn") and "radians a second" in said for said in found)
    assert any(said.startswith("x.heading is between 170 and 170") for said in found)
    assert diagnose_units(program, st.for_program(program, data)) == []
