"""The `steady` command: every command end to end, and one clear line for everything that can be wrong."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small import HOVERCRAFT, TRUTH, contents, impossible, only_start, simulated, steady, written
from test_alpha_truck import command_log, pose_log
from test_alpha_truck import write as write_logs

from steady_ppl import Fit, SMCGuide, read_table
from steady_ppl.command_line import run
from steady_ppl.evaluation import evaluate
from steady_ppl.table import to_frame

FEW = ("--particles", 20, "--draws", 3, "--steps", 3)
QUICK = ("--particles", 50, "--rollouts", 5)
ERRORS = {"location", "angle", "velocity", "yaw_rate"}


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tables, and a run of each of two recipes."""
    folder = tmp_path_factory.mktemp("work")
    written(folder / "train.csv")
    written(folder / "valid.parquet", simulated(trajectories=2, rows=33, seed=1))
    assert steady("fit", HOVERCRAFT, folder / "train.csv", "--recipe", "hand", "--out", folder / "hand") == 0
    assert steady("fit", HOVERCRAFT, folder / "train.csv", "--out", folder / "steady", *FEW) == 0
    return folder


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., None]:
    """Asserts that a command ends with a code and one line that says something, and that no file is touched."""

    def check(code: int, says: str, *arguments: object, folder: Path = tmp_path) -> None:
        capsys.readouterr()
        before = contents(folder), sorted(folder.rglob("*"))
        assert steady(*arguments) == code
        out, error = capsys.readouterr()
        assert error.startswith("steady: ") and 1 <= len(error.splitlines()) <= 2, error
        assert says in error
        assert out == ""
        assert (contents(folder), sorted(folder.rglob("*"))) == before

    return check


# --- simulate ---------------------------------------------------------------------------------------------------------


def test_simulate_writes_the_same_drives_as_csv_and_as_parquet(tmp_path: Path) -> None:
    for name in ("drives.csv", "drives.parquet"):
        assert steady("simulate", TRUTH, "--trajectories", 2, "--seed", 5, "--out", tmp_path / name) == 0
    csv, parquet = (read_table(tmp_path / name) for name in ("drives.csv", "drives.parquet"))
    assert len(csv) == 2 and csv.lengths.tolist() == [101, 101]
    assert to_frame(csv).equals(to_frame(parquet))
    columns = list(to_frame(csv).columns)
    assert columns[:4] == ["trajectory", "time", "u.left", "u.right"]
    assert columns[4:8] == [f"y.bearing_{i}" for i in range(4)]
    assert columns[8:] == ["x.x", "x.y", "x.heading", "x.vx", "x.vy", "x.yaw_rate"]


def test_simulate_draws_other_drives_from_another_seed(tmp_path: Path) -> None:
    for name, seed in (("a.csv", 1), ("b.csv", 1), ("c.csv", 2)):
        assert steady("simulate", HOVERCRAFT, "--trajectories", 1, "--seed", seed, "--out", tmp_path / name) == 0
    a, b, c = (path.read_bytes() for path in sorted(tmp_path.iterdir()))
    assert a == b != c


def test_simulate_takes_time_controls_and_gaps_from_a_table(tmp_path: Path) -> None:
    given = simulated(trajectories=2, rows=6, seed=3)
    observed = given.observed.clone()
    observed[2, 0, 1] = observed[4, 1] = False
    given = replace(given, observed=observed, time=given.time * 2 + 100, labels=("b", "a"), states=None)
    table = written(tmp_path / "controls.csv", given)
    assert steady("simulate", TRUTH, "--controls", table, "--out", tmp_path / "out.csv") == 0
    out, given = read_table(tmp_path / "out.csv"), read_table(table)
    assert out.labels == ("b", "a")
    assert torch.equal(out.time, given.time) and torch.equal(out.observed, observed)
    assert torch.allclose(out.controls, given.controls)  # the program reads them in single precision
    assert not torch.allclose(out.measurements, given.measurements)


def test_simulate_refuses_a_table_without_the_programs_control(tmp_path: Path, refused) -> None:
    table = written(tmp_path / "t.csv", replace(simulated(), control_names=("left", "port")))
    says = "the table has no column u.right; it has u.left, u.port"
    refused(2, says, "simulate", TRUTH, "--controls", table, "--out", tmp_path / "out.csv")


# --- data alpha-truck -------------------------------------------------------------------------------------------------


def test_alpha_truck_turns_logs_into_a_table_that_the_truck_program_reads(tmp_path: Path) -> None:
    write_logs(tmp_path, pose_log(), command_log())
    for name, degrees in (("five.csv", 5), ("one.csv", 1)):
        assert steady("data", "alpha-truck", tmp_path, "--sigma-deg", degrees, "--out", tmp_path / name) == 0
    five, one = read_table(tmp_path / "five.csv"), read_table(tmp_path / "one.csv")
    assert five.lengths.tolist() == [100, 100] and five.control_names == ("speed", "turn")
    assert torch.equal(five.states, one.states) and not torch.equal(five.measurements, one.measurements)
    program = HOVERCRAFT.with_name("truck.py")
    assert steady("fit", program, tmp_path / "five.csv", "--recipe", "hand", "--out", tmp_path / "run") == 0


def test_alpha_truck_refuses_a_folder_without_logs(tmp_path: Path, refused) -> None:
    refused(2, "vrpn-pose.csv", "data", "alpha-truck", tmp_path, "--out", tmp_path / "t.csv")
    refused(2, "no such folder", "data", "alpha-truck", tmp_path / "nowhere", "--out", tmp_path / "t.csv")


# --- fit --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("recipe", "options"),
    [("steady", FEW), ("hand", ()), ("fit-truth", ("--steps", 3))],
    ids=["steady", "hand", "truth"],
)
def test_fit_leaves_a_run_that_names_its_recipe(tmp_path: Path, work: Path, capsys, recipe: str, options) -> None:
    run = tmp_path / "runs" / "first"
    tables = (work / "train.csv", "--valid", work / "valid.parquet")
    assert steady("fit", HOVERCRAFT, *tables, "--recipe", recipe, *options, "--seed", 4, "--out", run) == 0
    assert capsys.readouterr().out.startswith(f"{run}: Hovercraft(mass=1.")
    record = json.loads((run / "run.json").read_text())
    assert (record["recipe"], record["status"], record["seed"]) == (recipe, "finished", 4)
    expected = {"parameters.safetensors", "posterior.nc", "run.json"}
    assert set(contents(run)) == expected | ({"checkpoint.safetensors"} if options else set())


def test_fit_tells_the_held_out_likelihood(tmp_path: Path, work: Path, capsys) -> None:
    tables = (work / "train.csv", "--valid", work / "valid.parquet")
    assert steady("fit", HOVERCRAFT, *tables, *FEW, "--out", tmp_path / "run") == 0
    (entry,) = json.loads((tmp_path / "run/run.json").read_text())["history"]
    assert f"held-out log p(y) {entry['log_likelihood']:.2f} → " in capsys.readouterr().out


def test_fit_says_that_nothing_is_held_out(tmp_path: Path, work: Path, capsys) -> None:
    assert steady("fit", HOVERCRAFT, work / "train.csv", *FEW, "--out", tmp_path / "run") == 0
    assert capsys.readouterr().err.startswith("steady: no --valid table")


def test_fit_accepts_the_guide_by_name(tmp_path: Path, work: Path) -> None:
    assert steady("fit", HOVERCRAFT, work / "train.csv", "--guide", "bootstrap", *FEW, "--out", tmp_path / "run") == 0


def test_the_seed_decides_a_networks_first_weights_and_the_whole_fit(tmp_path: Path) -> None:
    program = f"{HOVERCRAFT.with_name('neural_vehicle.py')}:NeuralHovercraft"
    table = written(tmp_path / "t.csv", simulated(trajectories=2, rows=4))
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert steady("fit", program, table, *FEW, "--seed", seed, "--out", tmp_path / name) == 0
    a, b, c = ((tmp_path / name / "parameters.safetensors").read_bytes() for name in "abc")
    assert a == b != c


def test_force_overwrites_a_run_and_leaves_nothing_of_the_old_one(tmp_path: Path, work: Path) -> None:
    run = tmp_path / "run"
    assert steady("fit", HOVERCRAFT, work / "train.csv", *FEW, "--out", run) == 0
    assert steady("fit", HOVERCRAFT, work / "train.csv", "--recipe", "hand", "--force", "--out", run) == 0
    assert set(contents(run)) == {"parameters.safetensors", "posterior.nc", "run.json"}
    assert json.loads((run / "run.json").read_text())["recipe"] == "hand"


def test_a_fit_in_a_shell_says_its_result_and_nothing_else(tmp_path: Path, work: Path) -> None:
    command = ("fit", HOVERCRAFT, work / "train.csv", "--recipe", "hand", "--out", tmp_path / "run")
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}  # where arviz notes that it has announced itself
    program = (sys.executable, "-m", "steady_ppl.command_line")
    done = subprocess.run([*program, *command], capture_output=True, text=True, check=False, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == f"{tmp_path / 'run'}: Hovercraft(mass=1.5, inertia=1.5, noise=[0.2, 0.2, 0.1])\n"


# --- evaluate ---------------------------------------------------------------------------------------------------------


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
        assert row.keys() == {"run", "recipe", "log_likelihood", "measurement"} | groups
        assert all(row[group].keys() == ERRORS for group in groups)
        assert row["measurement"].keys() == {"one_step", "open_loop_1s", "open_loop_3s", "coverage_90"}
        figures = [
            row["log_likelihood"],
            *(value for group in (*groups, "measurement") for value in row[group].values()),
        ]
        assert all(math.isfinite(figure) for figure in figures)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3 and "log p(y)" in lines[0] and "open_loop_3s" in lines[0]
    assert [line.split("  ")[0] for line in lines[1:]] == ["hand (hand)", "steady (steady)"]
    assert f"{content['runs'][0]['forward']['location']:.4f}" in lines[1]


def test_evaluate_gives_what_the_library_gives(tmp_path: Path, work: Path) -> None:
    options = ("--particles", 40, "--rollouts", 3, "--seed", 7)
    assert steady("evaluate", work / "hand", work / "train.csv", "--json", tmp_path / "e.json", *options) == 0
    (row,) = json.loads((tmp_path / "e.json").read_text())["runs"]
    drives = read_table(work / "train.csv")
    assert row == {
        "run": str(work / "hand"),
        **evaluate(Fit.load(work / "hand"), drives, particles=40, rollouts=3, seed=7),
    }


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
    assert capsys.readouterr().err.startswith("steady: trajectory 2 at 1 s: every particle's weight is zero")
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


def test_evaluate_refuses_what_is_no_run_and_no_table(tmp_path: Path, work: Path, refused) -> None:
    (tmp_path / "empty").mkdir()
    written(tmp_path / "truck.csv", simulated("truck"))
    refused(2, "it has no run.json", "evaluate", tmp_path / "empty", work / "train.csv")
    refused(2, "there is no such file", "evaluate", work / "hand", tmp_path / "nothing.csv")
    refused(2, "at least one RUN and then a TABLE", "evaluate", work / "hand")
    refused(2, "the table has no column u.left", "evaluate", work / "hand", tmp_path / "truck.csv")


# --- bad usage --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [(), ("simulate",), ("fit",), ("evaluate",), ("data",), ("data", "alpha-truck")])
@pytest.mark.parametrize("flag", ["--help", "-h"])
def test_every_command_explains_itself(capsys, command: tuple[str, ...], flag: str) -> None:
    assert steady(*command, flag) == 0
    out, error = capsys.readouterr()
    assert out.startswith(f"Usage: {' '.join(('steady', *command))}") and error == ""


def test_help_does_not_wait_for_torch() -> None:
    code = (
        "import sys; from steady_ppl.command_line import main\n"
        "assert main(['fit', '--help']) == 0\n"
        "assert main(['nothing']) == 2\n"
        "print(sorted({'torch', 'pyro', 'pandas', 'arviz'} & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("learn",), "No such command 'learn'"),
        (("fit",), "Missing argument"),
        (("fit", "m.py", "t.csv"), "Missing option '--out'"),
        (("fit", "m.py", "t.csv", "--out", "r", "--speed", "3"), "No such option: --speed"),
        (("fit", "m.py", "t.csv", "--out", "r", "--steps", "0"), "--steps"),
        (("fit", "m.py", "t.csv", "--out", "r", "--particles", "many"), "--particles"),
        (("fit", "m.py", "t.csv", "--out", "r", "--device", "tpu"), "--device"),
        (("fit", "m.py", "t.csv", "--out", "r", "--guide", "magic"), "--guide"),
        (("simulate", "m.py", "--out", "t.csv", "--trajectories", "0"), "--trajectories"),
        (("simulate", "m.py", "--out", "t.csv", "--seed", "-1"), "--seed"),
        (("evaluate",), "Missing argument"),
    ],
)
def test_bad_usage_is_one_line(tmp_path: Path, monkeypatch, refused, arguments: tuple[str, ...], says: str) -> None:
    monkeypatch.chdir(tmp_path)
    refused(2, says, *arguments)


def test_no_command_at_all_shows_the_usage(capsys) -> None:
    assert steady() == 2
    assert "Commands:" in "".join(capsys.readouterr())


def test_the_exit_code_and_the_arguments_are_those_of_the_shell(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["steady", "learn"])
    with pytest.raises(SystemExit) as caught:
        run()
    assert caught.value.code == 2 and "No such command 'learn'" in capsys.readouterr().err


@pytest.mark.parametrize("place", [0, -1])
def test_debug_shows_the_traceback_and_then_the_line(tmp_path: Path, capsys, place: int) -> None:
    arguments: list[object] = ["simulate", "no.py", "--out", tmp_path / "t.csv"]
    assert steady(*arguments) == 2
    assert capsys.readouterr().err == "steady: no file no.py\n"
    arguments.insert(place % (len(arguments) + 1), "--debug")
    assert steady(*arguments) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Traceback") and any("load_program" in line for line in lines)
    assert lines[-1] == "steady: no file no.py"


def test_a_defect_of_the_library_is_one_line_and_code_1(tmp_path: Path, monkeypatch, refused) -> None:
    def broken(*_, **__):
        raise RuntimeError("first line\n\nsecond line")

    monkeypatch.setattr("steady_ppl.simulation.simulate", broken)
    refused(1, "RuntimeError: first line", "simulate", TRUTH, "--out", tmp_path / "t.csv")


# --- bad input: one line, nothing written -----------------------------------------------------------------------------


def rewritten(path: Path, old: str, new: str, count: int = 1) -> Path:
    """A table with some text replaced."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))
    return path


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


@pytest.mark.parametrize(("spoil", "says"), BAD_TABLES)
def test_a_bad_table_is_refused_before_anything_is_written(tmp_path: Path, refused, spoil, says: str) -> None:
    good, bad, run = written(tmp_path / "good.csv"), written(tmp_path / "bad.csv"), tmp_path / "run"
    spoil(bad)
    refused(2, says, "fit", HOVERCRAFT, bad, "--out", run)
    refused(2, says, "fit", HOVERCRAFT, good, "--valid", bad, "--out", run)
    if "y.bearing" not in says:
        refused(2, says, "simulate", HOVERCRAFT, "--controls", bad, "--out", tmp_path / "out.csv")


def test_a_bad_table_in_an_evaluation_is_refused(tmp_path: Path, work: Path, refused) -> None:
    bad = rewritten(written(tmp_path / "bad.csv"), "y.bearing_2", "y.baring_2")
    refused(2, "no column y.bearing_2", "evaluate", work / "hand", bad, "--json", tmp_path / "e.json")


BAD_PROGRAMS = [
    pytest.param("import nowhere\n", "line 1 of boat.py: ModuleNotFoundError", id="import"),
    pytest.param("\n\nclass Boat(:\n", "line 3 of boat.py: SyntaxError", id="syntax"),
    pytest.param("x = 1\n", "boat.py has no program Boat", id="no class"),
    pytest.param(
        "from steady_ppl import Program\nclass Boat(Program):\n    states = measurements = ('x',)\n",
        "program Boat lacks the method initial(self)",
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
        "no program Boat; its programs: Hovercraft, HovercraftTruth",
        "simulate",
        f"{HOVERCRAFT}:Boat",
        "--out",
        "t.csv",
    )


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--recipe", "magic"), "no recipe 'magic'; there are fit-truth, hand, steady"),
        (("--recipe", "mine.py"), "no recipe file mine.py"),
        (("--recipe", "hand", "--particles", "9"), "recipe hand takes no --particles"),
        (("--recipe", "fit-truth", "--draws", "9"), "recipe fit-truth takes no --draws"),
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


# --- interrupted and resumed ------------------------------------------------------------------------------------------

LONGER = ("--particles", 20, "--draws", 3, "--steps", 26)


@pytest.fixture
def ctrl_c(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Makes the E step that is given by its number end in Ctrl-C, from now on."""
    refresh = SMCGuide.refresh

    def arm(at: int) -> None:
        count = iter(range(1_000_000))

        def interrupted(self, data, progress: float) -> dict[str, float]:
            if next(count) == at:
                raise KeyboardInterrupt
            return refresh(self, data, progress)

        monkeypatch.setattr(SMCGuide, "refresh", interrupted)

    return arm


def figures(run: Path) -> dict[str, object]:
    """What two equal runs have in common: their parameters bit for bit and the record, places apart."""
    record = json.loads((run / "run.json").read_text())
    record["program"].pop("file")
    return {"parameters": (run / "parameters.safetensors").read_bytes(), "record": record}


def test_an_interrupted_run_is_usable_and_resumes_to_the_uninterrupted_one(tmp_path: Path, capsys, ctrl_c) -> None:
    table, valid = written(tmp_path / "t.csv"), written(tmp_path / "v.csv", simulated(seed=1))
    run, whole = tmp_path / "run", tmp_path / "whole"
    neural = f"{HOVERCRAFT.with_name('neural_vehicle.py')}:NeuralHovercraft"
    command = ("fit", neural, table, "--valid", valid, *LONGER)
    assert steady(*command, "--out", whole) == 0
    ctrl_c(25)
    assert steady(*command, "--out", run) == 1
    assert "interrupted" in capsys.readouterr().err
    assert json.loads((run / "run.json").read_text())["status"] == "interrupted"
    assert steady("evaluate", run, valid, *QUICK) == 0
    ctrl_c(1_000_000)
    assert steady(*command, "--resume", "--out", run) == 0
    assert figures(run) == figures(whole)


def test_a_run_interrupted_twice_stays_usable(tmp_path: Path, capsys, ctrl_c) -> None:
    command = ("fit", HOVERCRAFT, written(tmp_path / "t.csv"), *FEW, "--out", tmp_path / "run")
    ctrl_c(1)
    assert steady(*command) == 1
    ctrl_c(0)
    assert steady(*command, "--resume") == 1
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "interrupted"
    Fit.load(tmp_path / "run")


def test_a_run_interrupted_before_its_first_checkpoint_can_be_resumed(tmp_path: Path, capsys, ctrl_c) -> None:
    command = ("fit", HOVERCRAFT, written(tmp_path / "t.csv"), *FEW[:-1], 5)
    assert steady(*command, "--out", tmp_path / "whole") == 0
    ctrl_c(3)
    assert steady(*command, "--out", tmp_path / "run") == 1
    assert "--resume" in capsys.readouterr().err
    ctrl_c(1_000_000)
    assert steady(*command, "--resume", "--out", tmp_path / "run") == 0
    assert figures(tmp_path / "run") == figures(tmp_path / "whole")


def test_ctrl_c_before_the_training_leaves_no_run(tmp_path: Path, monkeypatch, refused) -> None:
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("steady_ppl.Program.prepare", interrupted)
    table = written(tmp_path / "t.csv")
    refused(1, "interrupted", "fit", HOVERCRAFT, table, *FEW, "--out", tmp_path / "run")


def test_a_run_killed_outright_is_refused_in_one_line_and_resumes(tmp_path: Path, refused, ctrl_c) -> None:
    run, table = tmp_path / "run", written(tmp_path / "t.csv")
    ctrl_c(1)
    assert steady("fit", HOVERCRAFT, table, *FEW, "--out", run) == 1
    record = json.loads((run / "run.json").read_text())
    begun = {key: value for key, value in record.items() if key not in ("settings", "history", "notes", "kept_step")}
    (run / "run.json").write_text(json.dumps({**begun, "status": "training"}))  # as after a power cut while resuming
    refused(2, "run", "evaluate", run, table)
    (run / "parameters.safetensors").unlink()  # as after a power cut in the first training
    refused(2, "run", "evaluate", run, table)
    ctrl_c(1_000_000)
    assert steady("fit", HOVERCRAFT, table, *FEW, "--resume", "--out", run) == 0
    assert json.loads((run / "run.json").read_text())["status"] == "finished"


def test_resume_needs_the_same_everything(tmp_path: Path, refused) -> None:
    table, other = written(tmp_path / "t.csv"), written(tmp_path / "o.csv", simulated(seed=9))
    program, run = tmp_path / "hovercraft.py", tmp_path / "run"
    program.write_text(HOVERCRAFT.read_text())
    assert steady("fit", program, table, "--valid", table, *FEW, "--out", run) == 0

    def resume(says: str, model=program, train=table, valid=("--valid", table), options=FEW) -> None:
        refused(2, f"the same {says}", "fit", model, train, *valid, *options, "--resume", "--out", run)

    resume("options", options=(*FEW[:-1], 9))
    resume("options", options=FEW[:-2])
    resume("training table", train=other)
    resume("--valid table", valid=("--valid", other))
    resume("--valid table", valid=())
    resume("seed", options=(*FEW, "--seed", 1))
    resume("known_start", options=(*FEW, "--known-start"))
    resume("recipe", options=("--recipe", "fit-truth", "--steps", 3))
    resume("program", model=f"{program}:HovercraftTruth")
    program.write_text(program.read_text().replace("tensor(1.5)", "tensor(1.6)"))
    resume("program")


def test_a_recipe_that_keeps_no_checkpoint_cannot_be_resumed(work: Path, refused) -> None:
    command = ("fit", HOVERCRAFT, work / "train.csv", "--recipe", "hand", "--resume", "--out", work / "hand")
    refused(2, "no file checkpoint.safetensors", *command, folder=work)
