"""The recipe that suits a program where none is named."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from examples import example
from small import FEW, HOVERCRAFT, steady, written

from steady_ppl import read_table
from steady_ppl.runs.recipes import suited_recipe


@pytest.mark.parametrize(
    ("program", "options", "device", "recipe", "says"),
    [
        ("hovercraft", {}, "cpu", "likelihood", "5 learnable numbers and noise that can be linearised"),
        ("hovercraft", {"validation_particles": 50}, "cpu", "likelihood", "5 learnable numbers"),
        ("hovercraft", {"particles": 50}, "cpu", "steady", "particles is a setting of it"),
        ("hovercraft", {}, "cuda", "steady", "it computes on cuda"),
        (
            "neural_vehicle.py:NeuralHovercraft",
            {},
            "cpu",
            "steady",
            "where likelihood takes 1 to 60",
        ),
    ],
)
def test_it_goes_by_program_and_settings(tmp_path: Path, program: str, options, device: str, recipe: str, says: str):
    table = read_table(written(tmp_path / "t.csv"))
    name, why = suited_recipe(example(program), table, options, device=device)
    assert name == recipe and says in why


def test_noise_that_cannot_be_linearised_is_steadys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    table = read_table(written(tmp_path / "t.csv"))
    monkeypatch.setattr("steady_ppl.runs.recipes.why_not_linear", lambda *_, **__: "its noise is Laplace")
    assert suited_recipe(example("hovercraft"), table, {}) == (
        "steady",
        "likelihood needs a program that can be linearised: its noise is Laplace",
    )


def test_a_fit_says_which_and_keeps_it_and_goes_on_with_it(tmp_path: Path, capsys):
    table = written(tmp_path / "t.csv")
    assert steady("fit", HOVERCRAFT, table, "--out", tmp_path / "one") == 0
    assert "recipe likelihood: 5 learnable numbers" in capsys.readouterr().err
    assert json.loads((tmp_path / "one" / "run.json").read_text())["recipe"] == "likelihood"
    assert steady("fit", HOVERCRAFT, table, *FEW, "--out", tmp_path / "two") == 0
    assert "recipe steady: " in capsys.readouterr().err
    assert steady("fit", HOVERCRAFT, table, *FEW, "--out", tmp_path / "two", "--resume") == 0
    assert "recipe steady: " in capsys.readouterr().err
    svi = ("fit", HOVERCRAFT, table, "--set", "steps=2", "--out", tmp_path / "four")
    assert steady(*svi, "--recipe", "svi") == 0
    capsys.readouterr()
    assert steady(*svi, "--resume") == 0
    assert json.loads((tmp_path / "four" / "run.json").read_text())["recipe"] == "svi"
    assert "recipe " not in capsys.readouterr().err
    assert steady("fit", HOVERCRAFT, table, "--recipe", "hand", "--out", tmp_path / "three") == 0
    assert "recipe hand: " not in capsys.readouterr().err
