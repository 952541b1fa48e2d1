"""`steady discover` as a person types it, rightly and wrongly."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from examples import MODELS, example
from small import HOVERCRAFT, simulated, steady, written

import steady_ppl
from steady_ppl import Fit, for_program, simulate, write_table
from steady_ppl.cli.learn import stopped_after
from steady_ppl.discovery import candidates, discover, search
from steady_ppl.errors import FilterError

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


@pytest.mark.slow
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
    assert "6 of the 12 trajectories were kept" in said
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
    assert "4 trajectories are too few: 10 are needed" in refused(capsys, "discover", HOVERCRAFT, few)
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
    assert "3 of the validation trajectories are training trajectories as well (4, 5, 6)" in said


def test_drives_of_saturated_sensors_are_not_taken_for_one_drive():
    one, other = (for_program(example("hovercraft", torch.float32), simulated(rows=20, seed=seed)) for seed in (0, 1))
    for drives in (one, other):
        drives.measurements[:] = 1.5
    assert discover.shared_drives(one, other) == [] and discover.shared_drives(one, one) == ["1", "2", "3"]


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


@pytest.mark.exhaustive
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


# --- interrupted and resumed ------------------------------------------------------------------------------------------

FEW = ("--known-start", "--simulations", 50, "--only", "dynamics")


@pytest.fixture(autouse=True)
def interrupts_arrive() -> Iterator[None]:
    """Also where the tests run in the background of a shell, which ignores them."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def interrupted_at(call: int, function: Callable[..., Any], by: signal.Signals = signal.SIGINT) -> Callable[..., Any]:
    """A function that a signal interrupts when it is called so often."""
    calls = 0

    def interrupted(*given: Any, **named: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == call:
            signal.raise_signal(by)
        return function(*given, **named)

    return interrupted


@pytest.fixture(scope="module")
def whole(table, tmp_path_factory):
    """What a search says that nobody interrupted."""
    run = tmp_path_factory.mktemp("whole") / "run"
    assert steady("discover", MODEL, table, *FEW, "--out", run) == 0
    return json.loads((run / "discovery.json").read_text())


def test_a_block_is_stopped_when_its_minutes_are_over() -> None:
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt, match="over"), stopped_after(0.005):
        time.sleep(20)
    assert time.monotonic() < began + 10
    with stopped_after(None) as never, stopped_after(60.0) as later:
        time.sleep(0.05)
    assert not never.is_set() and not later.is_set()


def test_a_search_that_is_stopped_before_its_first_tests_has_nothing_to_show(table, capsys, monkeypatch) -> None:
    monkeypatch.setattr(steady_ppl, "discover", lambda *given, **settings: time.sleep(20))
    assert steady("discover", MODEL, table, *FEW, "--minutes", 0.01) == 1
    assert "interrupted; its 0.01 min are over" in capsys.readouterr().err
    assert "--minutes" in refused(capsys, "discover", MODEL, table, "--minutes", 0)


@pytest.mark.slow
def test_an_interrupted_search_shows_what_it_found_and_ends_as_it_would_have(
    table, whole, tmp_path, capsys, monkeypatch
):
    run, figures = tmp_path / "run", tmp_path / "found.json"
    monkeypatch.setattr(search, "screen_program", interrupted_at(2, search.screen_program, signal.SIGTERM))
    assert steady("discover", MODEL, table, *FEW, "--out", run, "--json", figures) == 1
    said = capsys.readouterr()
    assert said.out.startswith("warning: interrupted while testing and fitting effects")
    assert "The dynamics lack yaw_bias = 0." in said.out and "there may be more" in said.out
    assert f"`--resume` continues {run}" in said.err
    content = json.loads(figures.read_text())
    assert content["interrupted"] and not content["complete"] and content["before"] is None
    assert content["effects"][0]["coefficient"] == pytest.approx(whole["effects"][0]["coefficient"])
    assert content["effects"][0]["sd"] == pytest.approx(whole["effects"][0]["sd"], rel=0.5)
    fit = Fit.load(run)
    assert fit.trained.interrupted and hasattr(fit.program, "yaw_bias")
    assert steady("discover", MODEL, table, *FEW, "--out", run, "--resume") == 0
    assert json.loads((run / "discovery.json").read_text()) == whole
    assert not (run / "journal").exists() and not Fit.load(run).trained


@pytest.mark.slow
def test_fits_that_ended_before_an_interrupt_are_shown(table, tmp_path, capsys, monkeypatch):
    figures, picture = tmp_path / "found.json", tmp_path / "found.png"
    monkeypatch.setattr(candidates, "finish", interrupted_at(3, candidates.finish))
    assert steady("discover", MODEL, table, *FEW, "--json", figures, "--picture", picture) == 1
    said = capsys.readouterr().out
    assert "Something is missing (p = 0" in said and "interrupted before an effect was chosen" in said
    content = json.loads(figures.read_text())
    assert content["verdict"] == "undecided" and content["effect"] is None and not content["complete"]
    assert sum(one["heldout_gain"] is not None for one in content["candidates"]) == 2
    assert picture.stat().st_size > 10_000


@pytest.mark.slow
def test_an_interrupt_before_the_first_tests_is_said_in_a_line(table, whole, tmp_path, capsys, monkeypatch):
    run = tmp_path / "run"
    monkeypatch.setattr(search, "screen_program", interrupted_at(1, search.screen_program))
    assert steady("discover", MODEL, table, *FEW, "--out", run, "-q") == 1
    said = capsys.readouterr()
    assert said.out == "" and len(said.err.splitlines()) == 1
    assert "no effect has been tested yet" in said.err and f"`--resume` continues {run}" in said.err
    assert steady("discover", MODEL, table, *FEW, "--out", run, "--resume") == 0
    assert json.loads((run / "discovery.json").read_text()) == whole
    capsys.readouterr()
    monkeypatch.setattr(search, "first_refit", interrupted_at(1, search.first_refit))
    assert steady("discover", MODEL, table, *FEW) == 1
    assert capsys.readouterr().err == "steady: interrupted\n"


@pytest.mark.exhaustive
def test_a_second_interrupt_ends_at_once_and_leaves_the_journal(table, tmp_path, capsys, monkeypatch):
    run = tmp_path / "run"
    monkeypatch.setattr(search, "screen_program", interrupted_at(2, search.screen_program))
    monkeypatch.setattr(discover, "findings", interrupted_at(1, discover.findings))
    assert steady("discover", MODEL, table, *FEW, "--out", run, "-q") == 1
    said = capsys.readouterr()
    assert said.out == "" and said.err == f"steady: interrupted; `--resume` continues {run}\n"
    assert any((run / "journal").iterdir())


@pytest.mark.exhaustive
def test_a_comparison_that_fails_takes_no_verdict_away(table, whole, tmp_path, monkeypatch):
    def fails(*_, **__):
        raise FilterError("the drives are odd")

    monkeypatch.setattr(discover, "prove", fails)
    assert steady("discover", MODEL, table, *FEW, "--json", tmp_path / "found.json") == 0
    content = json.loads((tmp_path / "found.json").read_text())
    assert content["effects"] == whole["effects"] and content["complete"] and content["after"] is None
    assert "comparing before and after failed: the drives are odd" in content["notes"]
