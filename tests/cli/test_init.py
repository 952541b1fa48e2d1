"""`steady init`: a folder in which everything works, also from the wheel."""

from __future__ import annotations

import os
import shlex
import site
import subprocess
import sys
from pathlib import Path

import pytest
from examples import MODELS
from small import commands, contents, steady

from steady_ppl import read_table
from steady_ppl.cli.make import NEXT_COMMANDS

ROOT = MODELS.parent


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


@pytest.mark.slow
def test_the_wheel_is_enough(tmp_path: Path):
    """Built and installed, with the dependencies of this environment and nothing of the checkout: what `init` proposes
    runs in its folder, and so do the demonstration and every command of the README, with fewer steps and draws."""
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", tmp_path, ROOT], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "fresh"], check=True)
    python = tmp_path / "fresh" / "bin" / "python"
    (packages,) = (tmp_path / "fresh").glob("lib/python*/site-packages")
    packages.joinpath("dependencies.pth").write_text("\n".join(site.getsitepackages()) + "\n")
    subprocess.run([python, "-m", "pip", "--quiet", "install", "--no-deps", "--no-index", wheel], check=True)

    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(command: str, folder: Path) -> str:
        program, *rest = shlex.split(command)
        arguments = [python.with_name(program), *rest]
        done = subprocess.run(arguments, cwd=folder, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    home = run("python -c 'import steady_ppl; print(steady_ppl.__file__)'", tmp_path)
    assert home.startswith(str(tmp_path / "fresh")), home
    said = run("steady init lab", tmp_path)
    lab = tmp_path / "lab"
    fast = {"fit": "--steps 4", "check": "--simulations 20", "discover": "--simulations 50"}

    def fewer(words: list[str]) -> str:
        """What makes a command of the text quick; these recipes have no steps, and are."""
        return "" if {"hand", "likelihood"} & set(words) else fast.get(words[0], fast["check"])

    for line in (line.strip() for line in said.splitlines() if line.strip().startswith("steady ")):
        run(f"{line} {fewer(line.split()[1:])}", lab)
    assert (lab / "report.html").stat().st_size < 6_000_000
    assert "effects" in (lab / "runs" / "found" / "discovery.json").read_text()
    for folder in ("runs", "report.html"):
        (lab / folder).rename(lab / f"first-{folder}")
    fast |= {"evaluate": "--rollouts 20", "simulate": "", "add": "", "prove": "", "report": "--simulations 20"}
    fast |= {"states": "--draws 10", "effects": ""}
    done = set()
    for words in commands(ROOT / "README.md"):
        if words[0] == "demo":
            run(f"python -c {shlex.quote(SMALL_DEMO)}", lab)
        elif words[0] != "init":
            run(f"steady {shlex.join(words)} {fewer(words)}", lab)
        done.add(words[0])
    assert done >= {"demo", "simulate", "fit", "check", "discover", "add", "prove", "report", "evaluate"}
    run("python -c 'from inference import steady; from models.hovercraft import Hovercraft'", lab)
