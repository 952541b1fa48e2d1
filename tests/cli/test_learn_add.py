"""`steady add` and `steady effects`."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from examples import MODELS
from small import FEW, QUICK, steady, written

from steady_ppl import Fit, load_program
from steady_ppl.effects import attached


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program, drives and a run of it."""
    folder = tmp_path_factory.mktemp("add")
    shutil.copy(MODELS / "hovercraft.py", folder)
    written(folder / "t.csv")
    assert steady("fit", folder / "hovercraft.py", folder / "t.csv", "--out", folder / "run", *FEW) == 0
    return folder


@pytest.fixture
def work(ready: Path, tmp_path: Path) -> Path:
    shutil.copytree(ready, tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


# --- add --------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_add_writes_a_program_that_is_fitted_and_judged_like_any_other(work: Path, capsys) -> None:
    new = work / "hovercraft_with_drag.py"
    capsys.readouterr()
    assert steady("add", work / "run", "linear_drag=0.2", "landmark_bias:2", "--out", new) == 0
    out, error = capsys.readouterr()
    assert error.splitlines() == [
        "steady: linear_drag = 0.2 1/s (as given)",
        "steady: landmark_bias:bearing_2 = 0.06 rad (typical)",
    ]
    assert out.splitlines()[0].startswith(f"{new}: HovercraftWith")
    assert out.splitlines()[1:] == [
        "linear_drag: a = -c v",
        r"linear_drag: $a = -c\,v$",
        "landmark_bias:bearing_2: y_i → y_i + c, one landmark",
        r"landmark_bias:bearing_2: $y_i \to y_i + c$",
    ]
    fitted, program = Fit.load(work / "run").program, load_program(new)
    torch.testing.assert_close(program.mass, fitted.mass)
    torch.testing.assert_close(program.noise, fitted.noise)
    assert steady("fit", new, work / "t.csv", "--out", work / "again", *FEW) == 0
    assert steady("evaluate", work / "again", work / "t.csv", *QUICK) == 0
    again = Fit.load(work / "again").program
    assert [v.name for v in attached(again)] == ["linear_drag", "landmark_bias:bearing_2"]
    assert again.linear_drag.item() != program.linear_drag.item()  # it was learned


def test_add_takes_effects_and_their_values_from_the_run(work: Path, capsys) -> None:
    program = load_program(work / "hovercraft.py").with_effect("linear_drag", 0.3).with_effect("yaw_bias", 0.1)
    Fit(program, "hand").save(work / "found")
    assert steady("add", work / "found", "--out", work / "one.py") == 0
    assert steady("add", work / "found", "linear_drag", "yaw_bias=0.2", "slope", "--out", work / "two.py") == 0
    assert "steady: linear_drag = 0.3 1/s (of the run)" in capsys.readouterr().err
    one, two = load_program(work / "one.py"), load_program(work / "two.py")
    assert [one.linear_drag.item(), one.yaw_bias.item()] == pytest.approx([0.3, 0.1])
    assert [two.linear_drag.item(), two.yaw_bias.item()] == pytest.approx([0.3, 0.2])
    assert [v.name for v in attached(two)] == ["linear_drag", "yaw_bias", "slope"]


def test_add_takes_a_program_as_well_and_overwrites_when_forced(work: Path) -> None:
    new = work / "new.py"
    assert steady("add", work / "hovercraft.py", "slope", "--out", new) == 0
    assert steady("add", f"{work / 'hovercraft.py'}:HovercraftTruth", "slope", "--out", new, "--force") == 0
    assert "from .hovercraft import HovercraftTruth" in new.read_text()


def test_add_refuses_in_one_line(work: Path, refused) -> None:
    run, new, model = work / "run", work / "new.py", work / "hovercraft.py"
    refused(2, "did you mean linear_drag?", "add", run, "liner_drag", "--out", new)
    refused(2, "has no effect that its file does not have", "add", run, "--out", new)
    refused(2, "--program names the model of a RUN", "add", model, "slope", "--out", new, "--program", model)
    refused(2, "no file", "add", work / "nothing.py", "slope", "--out", new)
    refused(2, "takes 2 numbers", "add", model, "slope=1", "--out", new)
    assert steady("add", model, "slope", "--out", work / "t.csv") == 2
    assert steady("add", model, "slope", "--out", work / "hovercraft.py", "--force") == 2


# --- effects ----------------------------------------------------------------------------------------------------------


def test_effects_lists_the_catalogue_and_what_a_program_cannot_lack(capsys) -> None:
    assert steady("effects") == 0
    assert capsys.readouterr().out == (MODELS.parent / "docs" / "effects.md").read_text()
    assert steady("effects", MODELS / "truck.py") == 0
    out = capsys.readouterr().out
    assert "| `curvature_steering` |" in out and "| `wind` |" not in out
    assert "- `wind`: the model holds the lateral velocity at zero" in out
