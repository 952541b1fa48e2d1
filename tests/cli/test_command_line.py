"""The `steady` command: usage, errors, and the commands that write tables."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small import HOVERCRAFT, TRUTH, simulated, steady, written
from truck_logs import command_log, pose_log, write as write_logs

from steady_ppl import read_table
from steady_ppl.cli.main import run
from steady_ppl.data.table import to_frame

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


# --- bad usage --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [(), ("simulate",), ("fit",), ("evaluate",), ("data",), ("data", "alpha-truck")])
@pytest.mark.parametrize("flag", ["--help", "-h"])
def test_every_command_explains_itself(capsys, command: tuple[str, ...], flag: str) -> None:
    assert steady(*command, flag) == 0
    out, error = capsys.readouterr()
    assert out.startswith(f"Usage: {' '.join(('steady', *command))}") and error == ""


def test_help_does_not_wait_for_torch() -> None:
    code = (
        "import sys; from steady_ppl.cli.main import main\n"
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

    monkeypatch.setattr("steady_ppl.simulate", broken)
    refused(1, "RuntimeError: first line", "simulate", TRUTH, "--out", tmp_path / "t.csv")


def test_a_command_loads_nothing_that_it_does_not_use(tmp_path: Path) -> None:
    """No compiler of torch, no algebra, nothing that draws; the table is large enough for kernels."""
    table, run = tmp_path / "t.csv", tmp_path / "run"
    commands = [
        ["simulate", str(HOVERCRAFT), "--trajectories", "12", "--out", str(table)],
        ["fit", str(HOVERCRAFT), str(table), "--recipe", "likelihood", "--out", str(run)],
        ["states", str(run), str(table), "--draws", "3", "--particles", "20", "--out", str(tmp_path / "states.nc")],
    ]
    code = (
        "import sys; from steady_ppl.cli.main import main\n"
        f"assert [main(words) for words in {commands}] == [0, 0, 0]\n"
        "heavy = {'torch._dynamo', 'torch._inductor', 'sympy', 'matplotlib', 'arviz', 'scipy.stats', 'plotly'}\n"
        "print(sorted(heavy & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
