"""The `steady` command: usage, errors, and what a command loads."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from small import HOVERCRAFT, TRUTH, steady

from steady_ppl.cli.main import run


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


@pytest.mark.slow
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
