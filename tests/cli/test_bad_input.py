"""One clear line for everything that can be wrong with a table, a program or a setting, and nothing written."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from examples import MODELS
from small import FEW, HOVERCRAFT, impossible, only_start, rewritten, simulated, steady, written


def lone_row(path: Path) -> None:
    last = path.read_text().splitlines()[-1]
    path.write_text(path.read_text() + "4" + last[last.index(",") :] + "\n")


def backwards(path: Path) -> None:
    lines = path.read_text().splitlines()
    lines[4], lines[5] = lines[5], lines[4]
    path.write_text("\n".join(lines) + "\n")


BAD_TABLES = [
    pytest.param(lambda path: rewritten(path, "y.bearing_2", "y.baring_2"), "no column y.bearing_2", id="misnamed y"),
    pytest.param(lambda path: rewritten(path, "u.left", "u.port"), "no column u.left", id="misnamed u"),
    pytest.param(lambda path: rewritten(path, "u.left", "left"), "column left: unknown column", id="no such group"),
    pytest.param(lambda path: rewritten(path, "time", "t"), "column t: unknown column", id="misnamed time"),
    pytest.param(lambda path: rewritten(path, "\n2,0.1,", "\n2,abc,"), "trajectory 2, row 15: got 'abc'", id="text"),
    pytest.param(
        lambda path: rewritten(path, "\n3,0.1,", "\n3,,"), "trajectory 3, row 28: got an empty cell", id="empty"
    ),
    pytest.param(backwards, "trajectory 1, row 5: time must strictly increase", id="backwards"),
    pytest.param(lone_row, "trajectory 4, row 40: a trajectory needs at least two rows", id="one row"),
    pytest.param(lambda path: path.write_text(""), "the table is empty", id="nothing"),
    pytest.param(lambda path: path.unlink(), "there is no such file", id="missing"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("spoil", "says"), BAD_TABLES)
def test_a_bad_table_is_refused_before_anything_is_written(tmp_path: Path, refused, spoil, says: str) -> None:
    good, bad, run = written(tmp_path / "good.csv"), written(tmp_path / "bad.csv"), tmp_path / "run"
    spoil(bad)
    refused(2, says, "fit", HOVERCRAFT, bad, "--out", run)
    refused(2, says, "fit", HOVERCRAFT, good, "--valid", bad, "--out", run)
    if "y.bearing" not in says:
        refused(2, says, "simulate", HOVERCRAFT, "--controls", bad, "--out", tmp_path / "out.csv")


@pytest.mark.slow
def test_a_bad_table_in_an_evaluation_is_refused(tmp_path: Path, work: Path, refused) -> None:
    bad = rewritten(written(tmp_path / "bad.csv"), "y.bearing_2", "y.baring_2")
    refused(2, "no column y.bearing_2", "evaluate", work / "hand", bad, "--json", tmp_path / "e.json")


BAD_PROGRAMS = [
    pytest.param("import nowhere\n", "line 1 of boat.py: ModuleNotFoundError", id="import"),
    pytest.param("\n\nclass Boat(:\n", "line 3 of boat.py: SyntaxError", id="syntax"),
    pytest.param("x = 1\n", "boat.py has no model Boat", id="no class"),
    pytest.param(
        "from steady_ppl import Program\nclass Boat(Program):\n    states = measurements = ('x',)\n",
        "model Boat lacks the method initial(self)",
        id="no method",
    ),
    pytest.param(
        HOVERCRAFT.read_text().replace("Hovercraft", "Boat").replace("self.noise).to_event(1)", "self.noise)"),
        "Boat: transition",
        id="shape",
    ),
    pytest.param(
        "raise ValueError('one\\ntwo\\nthree')\n",
        "line 1 of boat.py: ValueError: one",
        id="three lines",
    ),
    pytest.param("import sys\nsys.exit(3)\n", "line 2", id="exit"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("text", "says"), BAD_PROGRAMS)
def test_a_bad_program_is_refused_before_anything_is_written(tmp_path: Path, refused, text: str, says: str) -> None:
    table, program = written(tmp_path / "t.csv"), tmp_path / "boat.py"
    program.write_text(text)
    refused(2, says, "fit", program, table, "--out", tmp_path / "run")
    refused(2, says, "simulate", program, "--out", tmp_path / "out.csv")


def test_a_class_that_is_no_complete_program_is_refused(tmp_path: Path, refused) -> None:
    neural = HOVERCRAFT.with_name("neural_vehicle.py")
    says = "NeuralVehicle declares no measurements (for a planar vehicle: landmarks); name another class"
    refused(2, says, "fit", neural, written(tmp_path / "t.csv"), "--out", tmp_path / "run")
    refused(
        2,
        "no model Boat; its models: Hovercraft, HovercraftTruth",
        "simulate",
        f"{HOVERCRAFT}:Boat",
        "--out",
        "t.csv",
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "says"),
    [
        (
            ("--recipe", "magic"),
            "no recipe 'magic'; there are fit-hand, fit-truth, fit-tv, hand, likelihood, steady, steady-minus, svi",
        ),
        (("--recipe", "mine.py"), "no recipe file mine.py"),
        (("--recipe", "hand", "--particles", "9"), "recipe hand has no setting particles; it has none"),
        (
            ("--recipe", "fit-truth", "--draws", "9"),
            "recipe fit-truth has no setting draws; it has steps, ",
        ),
        (("--device", "cuda"), "this machine has no CUDA device"),
        (("--valid", "nothing.csv"), "nothing.csv: there is no such file"),
        (("--resume",), "is not a run"),
    ],
)
def test_an_option_that_does_not_apply_is_refused(tmp_path: Path, monkeypatch, refused, options, says: str) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    table = written(tmp_path / "t.csv")
    refused(2, says, "fit", HOVERCRAFT, table, "--out", tmp_path / "run", *options)


def test_a_recipe_that_does_not_import_or_has_no_fit_is_refused(tmp_path: Path, refused) -> None:
    table, recipe = written(tmp_path / "t.csv"), tmp_path / "mine.py"
    for text, says in (
        ("1 / 0\n", "line 1 of mine.py: ZeroDivisionError"),
        ("x = 1\n", "mine.py has no function fit("),
    ):
        recipe.write_text(text)
        refused(2, says, "fit", HOVERCRAFT, table, "--recipe", recipe, "--out", tmp_path / "run")


def test_a_known_start_needs_every_first_state(tmp_path: Path, refused) -> None:
    data = simulated()
    blind = written(tmp_path / "blind.csv", data.without_truth())
    states = data.states.clone()
    states[0, 1, 2] = math.nan
    partly = written(tmp_path / "partly.csv", replace(data, states=states))
    says = "x.heading of trajectory 2 is empty"
    refused(2, "the table has no x. columns", "fit", HOVERCRAFT, blind, "--known-start", "--out", tmp_path / "run")
    refused(2, says, "fit", HOVERCRAFT, partly, "--known-start", "--out", tmp_path / "run")
    good = written(tmp_path / "good.csv", only_start(data))
    assert steady("fit", HOVERCRAFT, good, "--known-start", *FEW, "--out", tmp_path / "run") == 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["run", "file", "empty folder"])
def test_what_exists_is_not_overwritten(tmp_path: Path, work: Path, refused, kind: str) -> None:
    table, there = written(tmp_path / "t.csv"), work / "hand" if kind == "run" else tmp_path / "there"
    if kind == "file":
        there.write_text("mine")
    elif kind == "empty folder":
        there.mkdir()
    refused(2, "exists", "fit", HOVERCRAFT, table, "--out", there, folder=there if kind == "run" else tmp_path)


def test_bad_input_spares_the_old_run_whatever_the_force(tmp_path: Path, work: Path, refused) -> None:
    bad = rewritten(written(tmp_path / "bad.csv"), "y.bearing_2", "y.baring_2")
    refused(2, "no column", "fit", HOVERCRAFT, bad, "--force", "--out", work / "hand", folder=work)
    good = (HOVERCRAFT, work / "train.csv", "--out", work / "hand", "--force")
    refused(2, "no recipe", "fit", *good, "--recipe", "magic", folder=work)


def test_fit_truth_needs_the_truth_and_says_so_before_it_makes_a_folder(tmp_path: Path, refused) -> None:
    table = written(tmp_path / "t.csv", only_start(simulated()))
    says = "needs the true state of every row"
    refused(2, says, "fit", HOVERCRAFT, table, "--recipe", "fit-truth", "--out", tmp_path / "run")


def test_an_impossible_measurement_names_trajectory_and_time_and_leaves_no_run(tmp_path: Path, refused) -> None:
    table = written(tmp_path / "t.csv", impossible(simulated(), trajectory=1, row=3))
    says = "trajectory 2 at 0.3 s: every particle's weight is zero"
    refused(1, says, "fit", HOVERCRAFT, table, *FEW, "--out", tmp_path / "run")


def test_no_landmarks_is_no_program(tmp_path: Path, refused) -> None:
    blind = tmp_path / "blind.py"
    blind.write_text("from steady_ppl import PlanarVehicle\n\n\nclass Blind(PlanarVehicle):\n    landmarks = ()\n")
    says = "declares no measurements (for a planar vehicle: landmarks)"
    refused(2, says, "fit", blind, written(tmp_path / "t.csv"), "--out", tmp_path / "run")


def test_example_controls_of_another_shape_are_the_programs_fault(tmp_path: Path, refused) -> None:
    text = (MODELS / "linear_gaussian.py").read_text().replace("LinearGaussian", "Cart")
    assert "time.sin().unsqueeze(-1)" in text
    for controls, says in (
        ("time.sine()", "example_controls failed: AttributeError"),
        ("time.sin()", "example_controls gave shape"),
        ("None", "example_controls gave NoneType"),
        ("time.sin().unsqueeze(-1) / 0", "not finite"),
    ):
        (tmp_path / "cart.py").write_text(text.replace("time.sin().unsqueeze(-1)", controls))
        refused(2, says, "simulate", tmp_path / "cart.py", "--out", tmp_path / "t.csv")
