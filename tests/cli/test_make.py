"""`steady init`, `simulate`, `data` and `import-bag`: folders and tables to work with, also from the wheel."""

from __future__ import annotations

import os
import shlex
import site
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from examples import MODELS
from small import HOVERCRAFT, TRUTH, commands, contents, simulated, steady, written
from truck_logs import command_log, pose_log, write as write_logs

from steady_ppl import read_table
from steady_ppl.cli.make import NEXT_COMMANDS
from steady_ppl.data.table import to_frame

ROOT = MODELS.parent

# --- init -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_it_copies_the_rooms_and_simulates_drives(tmp_path: Path, capsys, refused):
    lab = tmp_path / "lab"
    assert steady("init", lab) == 0
    said = capsys.readouterr().out
    assert "train.csv" in said and all(line in said for line in NEXT_COMMANDS)
    for room in ("models", "inference", "notebooks", "studies"):
        ours = {name: text for name, text in contents(lab / room).items() if "__pycache__" not in name}
        kinds = (".py", ".ipynb", ".toml")
        theirs = {path.name: path.read_bytes() for path in (ROOT / room).iterdir() if path.suffix in kinds}
        assert ours == theirs
    train, test = read_table(lab / "train.csv"), read_table(lab / "test.csv")
    assert len(train) == 16 and bool(train.states[1:].isnan().all()) and not bool(train.states[0].isnan().any())
    assert len(test) == 32 and not bool(test.states.isnan().any())
    refused(2, "is not empty", "init", lab)
    refused(2, "is not empty", "init", lab / "train.csv")


SMALL_DEMO = """
from pathlib import Path
import typer
from steady_ppl.cli.demo import Size, demonstrate
from steady_ppl.cli.main import app
demonstrate(Path("demo"), typer.main.get_command(app), size=Size(train=6, valid=6, test=8, simulations=50))
"""


@dataclass(frozen=True)
class Installed:
    """The package as its wheel brings it, in an environment of its own."""

    python: Path

    def run(self, command: str, folder: Path) -> str:
        """What a command prints."""
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        program, *rest = shlex.split(command)
        arguments = [self.python.with_name(program), *rest]
        done = subprocess.run(arguments, cwd=folder, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def run_quickly(self, command: str, folder: Path) -> None:
        """A command of `steady` with fewer steps and draws; some recipes have no steps, and are quick."""
        name, *rest = shlex.split(command)
        more = "" if {"hand", "likelihood"} & set(rest) else FEWER.get(name, FEWER["check"])
        self.run(f"steady {command} {more}", folder)


FEWER = {"fit": "--steps 4", "check": "--simulations 20", "discover": "--simulations 50"}
FEWER |= {"evaluate": "--rollouts 20", "states": "--draws 10", "report": "--simulations 20"}
FEWER |= dict.fromkeys(("simulate", "doctor", "add", "prove", "effects"), "")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """With the dependencies of this environment and nothing of the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", folder, ROOT], check=True)
    (wheel,) = folder.glob("*.whl")
    subprocess.run([sys.executable, "-m", "venv", folder / "fresh"], check=True)
    python = folder / "fresh" / "bin" / "python"
    (packages,) = (folder / "fresh").glob("lib/python*/site-packages")
    packages.joinpath("dependencies.pth").write_text("\n".join(site.getsitepackages()) + "\n")
    subprocess.run([python, "-m", "pip", "--quiet", "install", "--no-deps", "--no-index", wheel], check=True)
    found = Installed(python)
    home = found.run("python -c 'import steady_ppl; print(steady_ppl.__file__)'", folder)
    assert home.startswith(str(folder / "fresh")), home
    return found


@pytest.mark.slow
def test_the_wheel_is_enough(installed: Installed, tmp_path: Path) -> None:
    """What `init` proposes runs in its folder."""
    said, lab = installed.run("steady init lab", tmp_path), tmp_path / "lab"
    for line in (line.strip() for line in said.splitlines()):
        if line.startswith("steady "):
            command = line.removeprefix("steady ")
            installed.run_quickly(f"{command} --only dynamics" if command.startswith("discover ") else command, lab)
    assert (lab / "report.html").stat().st_size < 6_000_000
    assert "effects" in (lab / "runs" / "found" / "discovery.json").read_text()
    installed.run("python -c 'from inference import steady; from models.hovercraft import Hovercraft'", lab)


@pytest.mark.exhaustive
def test_every_command_of_the_readme_and_of_its_page_runs_from_the_wheel(installed: Installed, tmp_path: Path) -> None:
    installed.run("steady init lab", tmp_path)
    lab, done = tmp_path / "lab", set()
    for words in [*commands(ROOT / "README.md"), *commands(ROOT / "docs" / "cli.md")]:
        if words[0] == "demo":
            installed.run(f"python -c {shlex.quote(SMALL_DEMO)}", lab)
        elif words[0] != "init":
            installed.run_quickly(shlex.join(words), lab)
        done.add(words[0])
    assert done >= {"demo", "simulate", "fit", "check", "discover", "add", "prove", "report", "evaluate"}


# --- simulate ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_simulate_with_effects_says_their_values(tmp_path: Path, capsys) -> None:
    few = ("--trajectories", 2, "--seed", 3)
    given = ("--effect", "linear_drag", "--effect", "slope=0.05,-0.03", "--effect", "thrust_saturation:knee=0.6=0.3")
    assert steady("simulate", HOVERCRAFT, *few, "--out", tmp_path / "plain.csv") == 0
    capsys.readouterr()
    assert steady("simulate", HOVERCRAFT, *few, *given, "--out", tmp_path / "with.csv") == 0
    out, error = capsys.readouterr()
    assert out == "" and error.splitlines() == [
        "steady: linear_drag = 0.12 1/s (typical)",
        "steady: slope = 0.05, -0.03 m/s² (as given)",
        "steady: thrust_saturation (knee 0.6) = 0.3 (as given)",
        "steady: simulated in steps of 5 ms, 20 a row",
    ]
    plain, other = read_table(tmp_path / "plain.csv"), read_table(tmp_path / "with.csv")
    assert torch.equal(plain.controls, other.controls) and not torch.allclose(plain.states, other.states)


@pytest.mark.parametrize(
    ("effects", "says"),
    [
        (("liner_drag",), "no effect 'liner_drag': did you mean linear_drag?"),
        (("slope=1",), "takes 2 numbers (x, y), got 1"),
        (("gain_error:left",), "does not apply to Hovercraft"),
        (("linear_drag", "linear_drag=0.2"), "effect linear_drag is given twice"),
    ],
)
def test_simulate_refuses_an_effect_that_is_none(tmp_path: Path, capsys, effects: tuple[str, ...], says: str) -> None:
    options = [part for effect in effects for part in ("--effect", effect)]
    assert steady("simulate", HOVERCRAFT, *options, "--out", tmp_path / "out.csv") == 2
    assert says in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "out.csv").exists()


# --- data alpha-truck and data cut ------------------------------------------------------------------------------------


@pytest.mark.slow
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


def test_the_command_cuts_and_says_what_it_left_out(tmp_path, capsys):
    table = written(tmp_path / "log.csv", simulated(trajectories=2, rows=31))
    assert steady("data", "cut", table, "--seconds", 1, "--out", tmp_path / "cut.csv") == 0
    out, error = capsys.readouterr()
    assert out == f"{tmp_path / 'cut.csv'}: 6 trajectories\n" and "2 rows left out" in error
    assert len(read_table(tmp_path / "cut.csv")) == 6
    assert steady("data", "cut", table, "--seconds", 0, "--out", tmp_path / "no.csv") == 2
    assert not (tmp_path / "no.csv").exists()


# --- import-bag, import-log -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["import-bag", "import-log"])
def test_help_waits_for_neither_torch_nor_rosbags(command: str) -> None:
    code = (
        "import sys; from steady_ppl.cli.main import main\n"
        f"assert main(['{command}', '--help']) == 0\n"
        "print(sorted({'torch', 'rosbags', 'pandas', 'numpy'} & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
