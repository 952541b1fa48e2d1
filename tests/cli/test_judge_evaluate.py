"""`steady evaluate` end to end."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from examples import MODELS, example
from small import HOVERCRAFT, QUICK, contents, impossible, only_start, simulated, steady, written

from steady_ppl import Fit, load_program, read_table
from steady_ppl.comparison.evaluate import evaluate

ERRORS = {"location", "angle", "velocity", "yaw_rate"}


def test_evaluate_writes_the_figures_of_every_run_as_json(tmp_path: Path, work: Path, capsys) -> None:
    runs, file = (work / "hand", work / "steady"), tmp_path / "figures.json"
    assert steady("evaluate", *runs, work / "valid.parquet", "--json", file, *QUICK) == 0
    content = json.loads(file.read_text())
    assert list(content) == ["runs"]
    assert [(row["run"], row["recipe"]) for row in content["runs"]] == [
        (str(runs[0]), "hand"),
        (str(runs[1]), "steady"),
    ]
    for row in content["runs"]:
        groups = {"forward", "forward_mean", "state_estimation"}
        about = {"run", "recipe", "known_start", "measured", "filter", "scarce"}
        assert row.keys() == about | {"log_likelihood", "measurement"} | groups
        assert row["known_start"] is False and row["measured"] == [f"bearing_{i}" for i in range(4)]
        assert all(row[group].keys() == ERRORS for group in groups)
        assert row["measurement"].keys() == {"one_step", "open_loop_1s", "open_loop_3s", "coverage_90"}
        figures = [
            row["log_likelihood"],
            *(value for group in (*groups, "measurement") for value in row[group].values()),
        ]
        assert all(math.isfinite(figure) for figure in figures)
    out, error = capsys.readouterr()
    lines = out.splitlines()
    assert "comparable" not in error and "start" not in lines[0]
    assert len(lines) == 3 and "log p(y)" in lines[0] and "open_loop_3s" in lines[0]
    assert [line.split("  ")[0] for line in lines[1:]] == ["hand (hand)", "steady (steady)"]
    assert f"{content['runs'][0]['forward']['location']:.4f}" in lines[1]


KEEN = """

class Keen(Hovercraft):
    bearing_sd = 0.001

    def transition(self, state, control, time, step):
        noise = dist.StudentT(4.0, torch.zeros(3), self.noise).to_event(1)
        return self.integrate(state, pyro.sample("acceleration", noise).expand(*state.shape[:-1], 3), step)
"""


def test_particles_that_collapse_are_said(tmp_path: Path, capsys) -> None:
    """Heavy tails keep the filter from looking ahead, and nearly exact bearings leave hardly a particle."""
    (tmp_path / "keen.py").write_text(HOVERCRAFT.read_text() + KEEN)
    table, run = written(tmp_path / "t.csv", simulated(trajectories=2)), tmp_path / "run"
    assert steady("fit", f"{tmp_path / 'keen.py'}:Keen", table, "--recipe", "hand", "--out", run) == 0
    capsys.readouterr()
    assert steady("evaluate", run, table, "--particles", 50, "--rollouts", 2, "--json", tmp_path / "found.json") == 0
    said = capsys.readouterr().err
    found = json.loads((tmp_path / "found.json").read_text())["runs"][0]["scarce"]
    assert found["particles"] == 50 and 0.5 < found["share"] <= 1
    after = f"after {found['share']:.0%} of trajectory {found['trajectory']}'s measured rows"
    assert f"{after} fewer than 10 of the filter's 50 particles" in said
    assert steady("states", run, table, "--particles", 50, "--out", tmp_path / "states.csv") == 0
    assert "starts 1 survive a trajectory: raise particles" in capsys.readouterr().err


def test_particles_that_suffice_are_passed_over(work: Path, capsys) -> None:
    assert steady("evaluate", work / "hand", work / "valid.parquet", *QUICK) == 0
    assert steady("states", work / "hand", work / "valid.parquet", "--out", work / "states.csv") == 0
    assert "particles" not in capsys.readouterr().err


@pytest.mark.slow
def test_runs_of_one_name_are_told_apart_and_a_table_that_was_used_is_said(tmp_path: Path, work: Path, capsys) -> None:
    twin = tmp_path / "steady"
    twin.symlink_to(work / "steady")
    assert steady("evaluate", work / "steady", twin, work / "train.csv", *QUICK) == 0
    out, error = capsys.readouterr()
    assert [line.split("  ")[0] for line in out.splitlines()[1:]] == [
        f"{run} (steady)" for run in (work / "steady", twin)
    ]
    assert f"{twin} was fitted to this very table" in error
    assert steady("evaluate", work / "steady", work / "valid.parquet", *QUICK) == 0
    assert "very table" not in capsys.readouterr().err
    assert steady("evaluate", twin, twin, work / "train.csv", *QUICK) == 2
    assert "cannot be told apart" in capsys.readouterr().err


def test_evaluate_gives_what_the_library_gives(tmp_path: Path, work: Path) -> None:
    options = ("--particles", 40, "--rollouts", 3, "--seed", 7)
    assert steady("evaluate", work / "hand", work / "train.csv", "--json", tmp_path / "e.json", *options) == 0
    (row,) = json.loads((tmp_path / "e.json").read_text())["runs"]
    drives = read_table(work / "train.csv")
    assert row == {
        "run": str(work / "hand"),
        **evaluate(Fit.load(work / "hand"), drives, particles=40, rollouts=3, seed=7),
    }


def test_runs_of_different_starts_are_marked_as_incomparable(tmp_path: Path, work: Path, capsys) -> None:
    runs, file = (work / "hand", tmp_path / "known"), tmp_path / "e.json"
    Fit(load_program(HOVERCRAFT), "hand", known_start=True).save(runs[1])
    assert steady("evaluate", *runs, work / "train.csv", "--json", file, *QUICK) == 0
    assert [row["known_start"] for row in json.loads(file.read_text())["runs"]] == [False, True]
    out, error = capsys.readouterr()
    header, *lines = [line.split() for line in out.splitlines()]
    assert header[0] == "start" and [line[2] for line in lines] == ["prior", "known"]
    said = f"log p(y) is not comparable: the start is known to {runs[1]} and from the prior in {runs[0]}"
    assert said in error and len(error.splitlines()) == 1


def test_runs_that_read_different_columns_are_marked_as_incomparable(tmp_path: Path, work: Path, capsys) -> None:
    runs, file = (work / "hand", tmp_path / "few"), tmp_path / "e.json"
    few = tmp_path / "hovercraft.py"
    few.write_text(HOVERCRAFT.read_text().replace(", (-4.0, 10.0), (6.0, 7.0))", ")"))
    Fit(load_program(few), "hand").save(runs[1])
    assert steady("evaluate", *runs, work / "train.csv", "--json", file, *QUICK) == 0
    assert [len(row["measured"]) for row in json.loads(file.read_text())["runs"]] == [4, 2]
    out, error = capsys.readouterr()
    said = "log p(y) is not comparable, nor are errors in measurement space: "
    assert f"{said}{runs[1]} does not read y.bearing_2, y.bearing_3; " in error
    assert error.count("comparable") == 1 and "start" not in out


@pytest.fixture
def nothing_computed(monkeypatch) -> None:
    def too_late(*_, **__):
        raise AssertionError("computed before everything was checked")

    monkeypatch.setattr("steady_ppl.comparison.evaluate.choose_filter", too_late)


@pytest.mark.usefixtures("nothing_computed")
def test_every_run_is_checked_before_anything_is_computed(tmp_path: Path, work: Path, refused) -> None:
    table, blind = work / "train.csv", written(tmp_path / "blind.csv", simulated().without_truth())
    truck, known = tmp_path / "truck", tmp_path / "known"
    Fit(example("truck"), "hand").save(truck)
    Fit(example("hovercraft"), "hand", known_start=True).save(known)
    refused(2, f"{truck}: the table has no column u.speed", "evaluate", work / "hand", truck, table)
    refused(2, f"{known}: a known start needs the true states", "evaluate", work / "hand", known, blind)


@pytest.mark.usefixtures("nothing_computed")
def test_a_map_that_does_not_suit_a_run_is_refused_before_anything_is_computed(
    tmp_path: Path, work: Path, refused
) -> None:
    run, cart, few = work / "hand", tmp_path / "cart", tmp_path / "hovercraft.py"
    drives = written(tmp_path / "cart.csv", simulated("linear_gaussian"))
    Fit(example("linear_gaussian"), "hand").save(cart)
    few.write_text(HOVERCRAFT.read_text().replace(", (6.0, 7.0))", ")"))
    says = f"{cart}: model LinearGaussian has no landmarks"
    refused(2, says, "evaluate", cart, drives, "--map", HOVERCRAFT)
    says = f"{run}: the map is another vehicle's: Truck has the controls speed, turn, Hovercraft has left, right"
    refused(2, says, "evaluate", run, work / "train.csv", "--map", MODELS / "truck.py")
    says = f"{run}: 4 landmarks cannot be compared with 3"
    refused(2, says, "evaluate", run, work / "train.csv", "--map", few)


def test_evaluate_without_true_states_judges_the_measurements_only(tmp_path: Path, work: Path, capsys) -> None:
    table = written(tmp_path / "blind.csv", only_start(simulated(rows=33)))
    assert steady("evaluate", work / "hand", table, "--json", tmp_path / "e.json", *QUICK) == 0
    (row,) = json.loads((tmp_path / "e.json").read_text())["runs"]
    assert row["forward"] == row["forward_mean"] == row["state_estimation"] == {}
    assert len(row["measurement"]) == 4 and "forward" not in capsys.readouterr().out


def test_evaluate_of_drives_shorter_than_the_horizon_leaves_those_figures_out(tmp_path: Path, work: Path) -> None:
    table = written(tmp_path / "short.csv", simulated(rows=8))
    assert steady("evaluate", work / "hand", table, "--json", tmp_path / "e.json", *QUICK) == 0
    (row,) = json.loads((tmp_path / "e.json").read_text())["runs"]
    assert row["forward"] == row["forward_mean"] == {} and row["state_estimation"].keys() == ERRORS
    assert row["measurement"].keys() == {"one_step", "coverage_90"}


def test_evaluate_with_some_state_columns_only_does_without_the_others(tmp_path: Path, work: Path) -> None:
    data = simulated()
    positions = replace(data, states=data.states[..., :2], state_names=("x", "y"))
    table = written(tmp_path / "positions.csv", positions)
    assert steady("evaluate", work / "hand", table, "--json", tmp_path / "e.json", *QUICK) == 0
    (row,) = json.loads((tmp_path / "e.json").read_text())["runs"]
    assert row["forward"] == {} and row["state_estimation"].keys() == {"location"}


def test_figures_are_written_whole_or_not_at_all(tmp_path: Path, work: Path, capsys) -> None:
    file = tmp_path / "e.json"
    file.write_text("the old one")
    table = written(tmp_path / "bad.csv", impossible(simulated(), trajectory=1, row=10))
    before = contents(tmp_path)
    assert steady("evaluate", work / "hand", table, "--json", file, *QUICK) == 1
    said = f"steady: {work / 'hand'}: trajectory 2 at 1 s: every particle's weight is zero"
    assert capsys.readouterr().err.startswith(said)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("target", ["nowhere/e.json", "."])
def test_figures_that_cannot_be_written_leave_nothing_behind(tmp_path: Path, work: Path, capsys, target: str) -> None:
    (tmp_path / "in").mkdir()
    assert steady("evaluate", work / "hand", work / "train.csv", "--json", tmp_path / "in" / target, *QUICK) == 2
    assert "cannot be written" in capsys.readouterr().err
    assert contents(tmp_path) == {}


def test_a_program_that_moved_is_named(tmp_path: Path, work: Path, refused) -> None:
    program, run = tmp_path / "hovercraft.py", tmp_path / "run"
    program.write_text(HOVERCRAFT.read_text())
    assert steady("fit", program, work / "train.csv", "--recipe", "hand", "--out", run) == 0
    program = program.rename(tmp_path / "boat.py")
    refused(2, "hovercraft.py is gone: name it with --program", "evaluate", run, work / "train.csv", *QUICK)
    named = ("--program", f"{program}:Hovercraft")
    assert steady("evaluate", run, work / "train.csv", *named, *QUICK) == 0


def test_several_runs_name_a_program_each(tmp_path: Path, work: Path, refused) -> None:
    runs, table, copy = (work / "hand", work / "steady"), work / "train.csv", tmp_path / "copy.py"
    copy.write_text(HOVERCRAFT.read_text())
    named = ("--program", f"{copy}:Hovercraft")
    refused(2, "--program is given 1 times for 2 runs", "evaluate", *runs, table, *named, *QUICK)
    assert steady("evaluate", *runs, table, *named, *named, *QUICK) == 0


def test_evaluate_refuses_what_is_no_run_and_no_table(tmp_path: Path, work: Path, refused) -> None:
    (tmp_path / "empty").mkdir()
    written(tmp_path / "truck.csv", simulated("truck"))
    refused(2, "it has no run.json", "evaluate", tmp_path / "empty", work / "train.csv")
    refused(2, "there is no such file", "evaluate", work / "hand", tmp_path / "nothing.csv")
    refused(2, "at least one RUN and then a TABLE", "evaluate", work / "hand")
    refused(2, "the table has no column u.left", "evaluate", work / "hand", tmp_path / "truck.csv")


def test_figures_that_cannot_be_written_are_refused_first(tmp_path: Path, work: Path, capsys) -> None:
    file = tmp_path / "nowhere" / "e.json"
    assert steady("evaluate", work / "hand", work / "train.csv", "--json", file) == 2
    said = capsys.readouterr()
    assert "cannot be written: there is no folder" in said.err and not said.out


@pytest.mark.slow
def test_degrees_are_suspected_by_whatever_judges(tmp_path: Path, capsys) -> None:
    data = simulated(trajectories=6)
    turned = replace(data, measurements=data.measurements * 180 / math.pi)
    run, other, table = tmp_path / "run", tmp_path / "other", written(tmp_path / "t.csv", turned)
    for folder in (run, other):
        assert steady("fit", HOVERCRAFT, written(tmp_path / "r.csv", data), "--recipe", "hand", "--out", folder) == 0
    for command in (
        ("evaluate", run, table, *QUICK),
        ("states", run, table, "--out", tmp_path / "states.csv"),
        ("prove", run, other, table),
    ):
        capsys.readouterr()
        assert steady(*command) in (0, 1)
        said = "".join(capsys.readouterr())
        assert said.count("y.bearing_0 is between") == 1 and "are these degrees?" in said, command
