"""Errors of a map: printed, marked where it was only declared, and refused for another vehicle."""

from __future__ import annotations

import json

import pytest
import torch
from examples import MODELS, example
from small import HOVERCRAFT, QUICK, simulated, steady, written

from steady_ppl import Fit, UsageError, load_program
from steady_ppl.comparison.evaluate import evaluate, map_errors

UNKNOWN = f"{MODELS / 'hovercraft_unknown_map.py'}:HovercraftUnknownMap"


def test_the_maps_error_is_printed(tmp_path, capsys) -> None:
    table = written(tmp_path / "t.csv", simulated(rows=9))
    assert steady("fit", UNKNOWN, table, "--recipe", "hand", "--known-start", "--out", tmp_path / "run") == 0
    capsys.readouterr()
    command = ("evaluate", tmp_path / "run", table, *QUICK, "--json", tmp_path / "e.json")
    assert steady(*command, "--map", HOVERCRAFT) == 0
    assert "run: landmarks off by 0 m rms, 0 m at most" in capsys.readouterr().out
    (row,) = json.loads((tmp_path / "e.json").read_text())["runs"]
    assert row["map"] == {"rms": 0.0, "most": 0.0, "learned": False}
    assert steady(*command, "--map", MODELS / "pendulum.py") == 2
    assert "Pendulum has no landmarks" in capsys.readouterr().err


def test_a_map_that_was_not_learned_is_said_to_be_declared(tmp_path, capsys) -> None:
    table, runs = written(tmp_path / "t.csv", simulated(rows=9)), (tmp_path / "declared", tmp_path / "learned")
    Fit(load_program(HOVERCRAFT), "hand").save(runs[0])
    program = load_program(UNKNOWN)
    with torch.no_grad():
        program.map[:, 0] += 1.0
    Fit(program, "steady").save(runs[1])
    assert steady("evaluate", *runs, table, *QUICK, "--map", HOVERCRAFT, "--json", tmp_path / "e.json") == 0
    assert capsys.readouterr().out.splitlines()[-2:] == [
        "declared: landmarks off by 0 m rms, 0 m at most (declared, not learned)",
        "learned: landmarks off by 1 m rms, 1 m at most",
    ]
    rows = json.loads((tmp_path / "e.json").read_text())["runs"]
    assert [row["map"]["learned"] for row in rows] == [False, True]


@pytest.mark.parametrize(
    ("what", "components"),
    [
        ("states", ("x", "y", "heading", "vx", "vy", "yaw_rate", "tilt")),
        ("controls", ("speed", "turn")),
        ("measurements", ("bearing_0", "bearing_1", "bearing_2", "range_3")),
    ],
)
def test_the_map_of_another_vehicle_is_refused(what: str, components: tuple[str, ...]) -> None:
    other = type("Other", (type(load_program(HOVERCRAFT)),), {what: components})()
    fit = Fit(load_program(UNKNOWN), "steady")
    with pytest.raises(UsageError, match=f"another vehicle's: Other has the {what} {', '.join(components)}, Hover"):
        evaluate(fit, simulated(rows=9), surveyed=other)


def test_an_added_effect_with_states_of_its_own_leaves_the_vehicle_the_same() -> None:
    program = load_program(UNKNOWN).with_effect("coloured_noise")
    assert len(program.states) > 6
    result = evaluate(
        Fit(program, "steady"), simulated(rows=4), particles=20, rollouts=2, surveyed=example("hovercraft")
    )
    assert result["map"]["rms"] == 0.0


def test_maps_of_different_sizes_are_not_compared() -> None:
    few = load_program(HOVERCRAFT)
    few.landmarks = few.landmarks[:3]
    with pytest.raises(UsageError, match="4 landmarks cannot be compared with 3"):
        map_errors(load_program(UNKNOWN), few)


def test_a_vehicle_without_landmarks_has_no_map() -> None:
    fixed = type("Fixed", (type(load_program(HOVERCRAFT)),), {"landmarks": (), "measurements": ("bearing_0",)})
    with pytest.raises(UsageError, match="model Fixed has no landmarks"):
        evaluate(Fit(fixed(), "hand"), simulated(rows=9), surveyed=fixed())
