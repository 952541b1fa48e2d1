"""The demonstration: the whole loop by the commands that it prints."""

import json
from pathlib import Path

import pytest
import typer
from small import steady

from steady_ppl import Fit, RunError, load_program, read_table
from steady_ppl.cli import demo
from steady_ppl.cli.demo import DEMO_RECORD, Size, demonstrate
from steady_ppl.cli.main import app
from steady_ppl.effects import attached
from steady_ppl.errors import ComputationError
from steady_ppl.runs.folder import write_record

STEADY = typer.main.get_command(app)
QUICK = Size(train=6, valid=6, test=8, simulations=50)
FILES = [f"{name}.{kind}" for name in ("check", "discovery", "proof") for kind in ("json", "png", "txt")]


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """The folder of a small demonstration and what it said."""
    out, lines = tmp_path_factory.mktemp("demo") / "out", list[str]()
    demonstrate(out, STEADY, size=QUICK, say=lines.append)
    return out, lines


@pytest.mark.slow
def test_it_goes_through_the_loop_and_keeps_everything(told: tuple[Path, list[str]]) -> None:
    out, lines = told
    commands = [line.split()[2] for line in lines if line.startswith("   $ steady")]
    learned = ["fit", "check", "discover", "add", "fit", "fit"]
    assert commands == ["simulate"] * 3 + learned + ["prove", "check", "report"]
    for file in (*FILES, "after.json", "after.txt", "report.html", "train.csv", "valid.csv", "test.csv"):
        assert (out / file).stat().st_size > 0
    record = json.loads((out / DEMO_RECORD).read_text())
    assert record["status"] == "finished"
    assert all(step["result"] and step["commands"] for step in record["steps"])


@pytest.mark.slow
def test_poses_of_the_drives_that_are_fitted_are_not_kept(told: tuple[Path, list[str]]) -> None:
    out, _ = told
    for name in ("train", "valid"):
        states = read_table(out / f"{name}.csv").states
        assert states is not None and bool(states[0].isfinite().all()) and bool(states[1:].isnan().all())


@pytest.mark.slow
def test_what_it_adds_is_a_program_that_was_fitted(told: tuple[Path, list[str]]) -> None:
    out, _ = told
    (file,) = (out / "models").glob("hovercraft_with_*.py")
    program, after = load_program(file), Fit.load(out / "runs" / "after")
    found = json.loads((out / "discovery.json").read_text())["effects"]
    assert found
    for name in (finding["effect"].split(":")[0] for finding in found):
        assert name in [variant.effect.name for variant in attached(program)] and name in file.stem
        assert not getattr(after.program, name).equal(getattr(program, name))


@pytest.mark.slow
def test_predictions_of_the_locked_drives_get_better(told: tuple[Path, list[str]]) -> None:
    out, lines = told
    rows = {row["row"]: row for row in json.loads((out / "proof.json").read_text())["rows"]}
    assert list(rows) == ["before", "after", "oracle", "truth", "constant velocity", "last measurement", "noise floor"]
    for ahead in ("3 s", "10 s"):
        assert rows["after"]["measurement"]["rad"][ahead] < 0.8 * rows["before"]["measurement"]["rad"][ahead]
    assert any(line.split()[:1] == ["after"] for line in lines)


def test_a_search_that_finds_nothing_to_add_is_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "runs" / "found").mkdir(parents=True)
    (tmp_path / "discovery.json").write_text('{"sentence": "No effect is missing."}')
    write_record(tmp_path / "runs" / "found", {"program": None, "recipe": "discover", "status": "", "effects": []})
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(demo.Demo, "steady", lambda self, command, *, keep: "")
    with pytest.raises(ComputationError, match="nothing to add.*No effect is missing"):
        demo.discover(demo.Demo(STEADY, [].append), QUICK)


def test_it_goes_over_its_own_folder_only(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(RunError, match="is no demo's"):
        demonstrate(tmp_path, STEADY, size=QUICK)
    assert steady("demo", "--out", tmp_path) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_folder_that_cannot_be_made_is_said_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert steady("demo", "--out", tmp_path / "file" / "demo") == 2
    assert "cannot be written" in capsys.readouterr().err
