"""`steady discover` as a person types it, rightly and wrongly."""

from __future__ import annotations

import json

import pytest
import torch
from examples import MODELS, example
from small import HOVERCRAFT, simulated, steady, written

from steady_ppl import Fit, simulate, write_table

MODEL = MODELS / "hovercraft.py"


def refused(capsys, *arguments: object) -> str:
    """The one line with which a command is refused."""
    assert steady(*arguments) == 2
    said = capsys.readouterr()
    assert said.out == "" and len(said.err.strip().splitlines()) == 1, said.err
    return said.err


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """Drives of a hovercraft with a yaw bias, 81 rows."""
    folder = tmp_path_factory.mktemp("drives")
    program = example("hovercraft", torch.float32)
    program.noise = torch.tensor([0.08, 0.08, 0.05])
    program = program.with_effect("yaw_bias", 0.1)
    program.duration = 6.0
    write_table(simulate(program, 12, seed=1), folder / "drives.csv")
    return folder / "drives.csv"


def test_a_model_is_fitted_searched_and_kept(table, tmp_path, capsys):
    run, figures, picture = tmp_path / "run", tmp_path / "found.json", tmp_path / "found.png"
    given = ("--known-start", "--simulations", 50, "--picture", picture)
    assert steady("discover", MODEL, table, *given, "--json", "-", "-q") == 0
    printed, noted = capsys.readouterr()
    assert noted == ""
    assert steady("discover", MODEL, table, *given, "--out", run, "--json", figures) == 0
    said = capsys.readouterr().out
    assert json.loads(printed)["sentence"] == json.loads(figures.read_text())["sentence"]
    assert said.startswith("The dynamics lack yaw_bias = 0.")
    assert "6 of the 12 drives were kept" in said
    content = json.loads(figures.read_text())
    assert content["verdict"] == "dynamics" and "yaw_bias" in content["class"]
    assert picture.stat().st_size > 10_000
    program = Fit.load(run).program
    assert float(program.yaw_bias.detach()) == pytest.approx(content["effects"][0]["coefficient"][0], rel=1e-4)
    assert steady("add", run, "--out", tmp_path / "biased.py") == 2  # it has to lie beside the program it derives from
    capsys.readouterr()
    assert "exists" in refused(capsys, "discover", MODEL, table, "--out", run)


def test_what_cannot_be_searched_is_said_in_a_line(tmp_path, capsys):
    few = written(tmp_path / "few.csv", simulated(trajectories=4, rows=20))
    assert "4 drives are too few: 10 are needed" in refused(capsys, "discover", HOVERCRAFT, few)
    network = f"{MODELS / 'neural_vehicle.py'}:NeuralHovercraft"
    enough = written(tmp_path / "enough.csv", simulated(trajectories=12, rows=20))
    said = refused(capsys, "discover", network, enough)
    assert "network" in said and "hybrid" in said
    assert "no file" in refused(capsys, "discover", tmp_path / "nothing.py", enough)
    assert "leave it out" in refused(capsys, "discover", HOVERCRAFT, enough, "--program", HOVERCRAFT)


def test_drives_that_both_tables_have_are_refused(tmp_path, capsys):
    drives = simulated(trajectories=8, rows=20)
    one = written(tmp_path / "one.csv", drives.subset(range(6)))
    other = written(tmp_path / "other.csv", drives.subset(range(3, 8)))
    said = refused(capsys, "discover", HOVERCRAFT, one, "--valid", other)
    assert "3 of the validation drives are training drives as well (4, 5, 6)" in said


def test_a_folder_that_does_not_exist_is_said_before_anything_is_computed(tmp_path, capsys):
    table = tmp_path / "there_is_no_such_table.csv"
    for command in (("discover", HOVERCRAFT, table), ("check", tmp_path, table), ("prove", tmp_path, tmp_path, table)):
        said = refused(capsys, *command, "--json", tmp_path / "nowhere" / "found.json")
        assert "there is no folder" in said and "nowhere" in said
        assert "it is a folder" in refused(capsys, *command, "--json", tmp_path)
        said = refused(capsys, *command, "--picture", tmp_path / "nowhere" / "found.png")
        assert "there is no folder" in said and "nowhere" in said


def test_a_run_that_cannot_be_written_is_said_before_anything_is_computed(tmp_path, capsys, monkeypatch):
    table = written(tmp_path / "drives.csv", simulated(trajectories=12, rows=20))
    monkeypatch.setattr("steady_ppl.discovery.discover.discover", lambda *a, **k: pytest.fail("it was computed"))
    assert "cannot be written" in refused(capsys, "discover", HOVERCRAFT, table, "--out", table / "run")


def test_controls_that_never_change_get_no_verdict(tmp_path, capsys):
    still = simulated(trajectories=12, rows=20)
    still.controls[:] = 0.5
    said = refused(capsys, "discover", HOVERCRAFT, written(tmp_path / "still.csv", still))
    assert "the controls never change (left, right)" in said and "no verdict" in said


def test_a_known_start_has_to_be_known(tmp_path, capsys):
    unknown = written(tmp_path / "unknown.csv", simulated(trajectories=12, rows=20).without_truth())
    assert "known start" in refused(capsys, "discover", HOVERCRAFT, unknown, "--known-start")


def test_a_run_whose_program_changed_is_refused(table, tmp_path, capsys):
    model = tmp_path / "hovercraft.py"
    model.write_text(MODEL.read_text())
    assert steady("fit", model, table, "--recipe", "hand", "--out", tmp_path / "run") == 0
    model.write_text(MODEL.read_text() + "\n# changed\n")
    capsys.readouterr()
    assert "changed" in refused(capsys, "discover", tmp_path / "run", table)


def test_one_kind_is_looked_for_and_an_effect_left_out(table, capsys):
    given = (
        "--known-start",
        "--simulations",
        50,
        "--only",
        "dynamics",
        "--withhold",
        "yaw_bias",
        "--withhold",
        "slope",
    )
    assert steady("discover", MODEL, table, *given, "--json", "-") == 0
    candidates = json.loads(capsys.readouterr().out)["candidates"]
    names = {one["effect"].partition(":")[0] for one in candidates}
    assert "linear_drag" in names and not names & {"yaw_bias", "slope", "actuator_lag", "bearing_bias", "heavy_tails"}
