"""Cases of other people's data: what they are asked for, from what commands said."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import others
import pytest
from small import MODELS, simulated, written
from small_studies import CART

import steady_ppl as st

KINDS = {"cubic_stiffness": "dynamics", "measurement_noise": "noise", "lever_arm": "dynamics"}
KINDS |= {"actuator_lag:speed": "actuator", "actuator_lag:steering": "actuator"}


def found(*names: str, correction: str = "", verdict: str = "dynamics") -> dict:
    """As `discover` says it."""
    effects = [{"effect": name, "coefficient": [3.6], "interval_90": [[3.4, 3.9]]} for name in names]
    effects += [{**one, "effect": correction, "correction": True} for one in effects[:1] if correction]
    candidates = [{"effect": name, "kind": kind} for name, kind in KINDS.items()]
    return {"verdict": verdict, "effects": effects, "candidates": candidates, "outliers": []}


def proof(particles: float | None, error: float) -> dict:
    """As `prove` says it, of a program that is two nats a drive better before what is neglected."""
    against = {"log_likelihood": {"difference": 2.0}, "measurement": {"m": {"3 s": {"interval": [-0.2, error]}}}}
    rows = [
        {"neglected": neglected, "measurement": {"m": {"3 s": 4.0}}, "against_reference": against}
        for neglected in (0.0, particles)
    ]
    return {"rows": rows}


@pytest.mark.parametrize(
    ("said", "met"),
    [
        (found("cubic_stiffness"), [True, True]),
        (found("cubic_stiffness", correction="measurement_noise"), [True, True]),
        (found("cubic_stiffness", "measurement_noise"), [True, False]),
        (found(verdict="other"), [False, False]),
    ],
)
def test_a_spring_is_asked_for_and_no_noise_but_as_a_correction(said: dict, met: list[bool]) -> None:
    for error, is_small in (("0.0054", True), ("0.0056 a note", False)):
        asked = list(others.CASES["silverbox"].asked({"discover": said, "free": error}))
        assert [one.is_met for one in asked] == [*met, is_small]
    assert not met[0] or "cubic_stiffness 3.6 [3.4, 3.9]" in asked[0].value


@pytest.mark.parametrize(
    ("said", "proved", "met"),
    [
        (found("lever_arm", correction="heavy_tails"), proof(-1.0, -0.1), [True, True, True, True]),
        (found("lever_arm", "actuator_lag:steering"), proof(-1.0, -0.1), [False, True, True, True]),
        (found("lever_arm", "actuator_lag:speed"), proof(-3.0, 0.1), [False, False, False, False]),
        (found(verdict="other"), proof(None, -0.1), [False, True, False, True]),
    ],
)
def test_particles_must_not_deny_what_a_car_lacks(said: dict, proved: dict, met: list[bool]) -> None:
    asked = list(others.CASES["victoria_park"].asked({"discover": said, "prove": proved}))
    assert [one.is_met for one in asked] == met


@pytest.mark.parametrize(("mass", "met"), [("95.4 0.4", True), ("96.0 0.4", False), ("80.0 30.0", False)])
def test_a_mass_is_right_within_an_error_that_says_something(mass: str, met: bool) -> None:
    said = {"discover": found("coulomb_friction", "linear_drag", "acceleration_bias"), "mass": mass}
    assert [one.is_met for one in others.CASES["emps"].asked(said)] == [True, met]


def test_a_vehicle_that_lacks_nothing_has_no_curve_either() -> None:
    asked = others.CASES["exact_unicycle"].asked
    verdicts = [next(asked({"discover": found(verdict=verdict)})).is_met for verdict in ("none", "other", "noise")]
    assert verdicts == [True, False, False]


def test_progress_is_no_answer() -> None:
    said = "steady: scoring steps … 2 min gone by, about 4 min left steady: finding paths … 14 s gone by, about to end"
    said += " steady: drawing states … 20 s gone by steady: done"
    assert others.PROGRESS.sub("", said) == "steady: done"
    assert others.PROGRESS.sub("", f"steady: 24 cells are -9999 {said}") == "steady: 24 cells are -9999 steady: done"


@pytest.mark.exhaustive
def test_commands_run_in_the_folder_of_a_case_and_one_that_fails_is_no_answer(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "cart").mkdir()
    (tmp_path / "cart" / "cart.py").write_text((MODELS / "linear_gaussian.py").read_text())
    written(tmp_path / "cart" / "train.csv", simulated("linear_gaussian", trajectories=2, rows=9))

    def asked(said):
        yield others.Asked("a damping", said["fit"], "damping=" in said["fit"])
        yield others.Asked("which file is missing", said["missing"], "none.csv" in said["missing"])
        yield others.Asked("what never ran", said["never"], True)

    commands = {"fit": "fit cart.py {train} --recipe hand --out {out}/fit", "missing": "check {out}/fit none.csv"}
    monkeypatch.setitem(others.CASES, "cart", others.Case(commands | {"never": "effects cart.py"}, asked))
    record = others.work("cart", str(tmp_path), None) | {"set": "cart"}
    assert [one["is_met"] for one in record["asked"]] == [True, True, False]
    assert "'never'" in record["asked"][-1]["value"]
    assert set(record["cost"]) == {"fit"} and record["cost"]["fit"]["peak"] > 50
    assert "| cart | an answer |" in others.page([record], "Cases", others.CASES)
    assert "| **no** |" in others.page([record], "Cases", others.CASES)


def test_a_free_run_begins_where_the_first_rows_say_and_has_no_noise(tmp_path: Path) -> None:
    """A cart that moves as its program says, but for its noise, which a free run does not know."""
    program = st.load_program(CART)
    table = st.simulate(program, 3, seed=1)
    st.write_table(table, tmp_path / "drives.csv")
    st.Fit(program, "hand", {}).save(tmp_path / "run")
    words = [sys.executable, "-c", others.FREE, tmp_path / "run", tmp_path / "drives.csv"]
    error = float(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
    away = (table.measurements - table.measurements.nanmean(0))[51:]
    assert 0 < error < float(away.square().nanmean().sqrt())
