"""The good inputs that are spoiled one at a time: tables, runs, a search, a fit that was stopped, bags, logs."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import torch
from hostile_bags import write_bags, write_logs

from steady_ppl import load_program, simulate, write_table
from steady_ppl.cli.main import main
from steady_ppl.model.program import Program

ROOT = Path(__file__).resolve().parent.parent
FEW = ("--guide", "bootstrap", "--particles", "20", "--draws", "3", "--steps", "4", "--set", "validate_every=2")
SEARCH = ("discover", "before", "t.csv", "--valid", "v.csv", "--simulations", "50", "--out")
TRAINING = ("fit", "models/linear_gaussian.py", "t.csv", "--valid", "v.csv", *FEW, "--out")
STUDY = """\
title = "A cart"
seeds = [1, 2]
known_start = true
[data]
simulate = "models/linear_gaussian.py"
train = 2
valid = 2
test = 2
[[method]]
name = "hand"
program = "models/linear_gaussian.py"
recipe = "hand"
[[method]]
name = "likelihood"
program = "models/linear_gaussian.py"
recipe = "likelihood"
settings = {validation_particles = [50, 60]}
[picture]
x = "settings.validation_particles"
y = ["log_likelihood", "seconds"]
labels = {seconds = "s"}
published = {log_likelihood = {hand = [[50, -5.0], [60, -4.0]]}}
"""
_STEADY = "import sys; from steady_ppl.cli.main import main; sys.exit(main(sys.argv[1:]))"


def lay(folder: Path) -> None:
    """Make everything in a new folder; commands run within it.

    A cart whose fits and searches take seconds makes the tables `t.csv`, `t.parquet` and `v.csv`, the runs
    `before` and `after`, the fit `begun`, which has a checkpoint to go on from, and the stopped search `searched`; on
    drives with an effect the run `found`; `study.toml` is a study of it, and `studied` that study done. A hovercraft
    that sees bearings makes `h.csv` and the runs `hover` and `hover_too`.
    """
    folder.mkdir(parents=True)
    shutil.copytree(ROOT / "models", folder / "models", ignore=shutil.ignore_patterns("__pycache__"))
    cart = load_program(f"{folder}/models/linear_gaussian.py")
    pushed = cart.with_effect("acceleration_bias", 3.0)
    for seed, name in enumerate(("pushed.csv", "pushed_too.csv")):
        write_table(_drives(pushed, 10, 30, seed), folder / name)
    write_table(_drives(cart, 10, 9, 0), folder / "t.csv")
    write_table(_drives(cart, 10, 9, 0), folder / "t.parquet")
    write_table(_drives(cart, 10, 9, 1), folder / "v.csv")
    hovercraft = load_program(f"{folder}/models/hovercraft.py:HovercraftTruth")
    write_table(_drives(hovercraft, 5, 9, 0), folder / "h.csv")
    write_bags(folder)
    write_logs(folder / "logs")
    _must("fit", "models/linear_gaussian.py", "t.csv", "--recipe", "hand", "--out", "before", at=folder)
    _must("fit", "models/hovercraft.py", "h.csv", "--recipe", "hand", "--known-start", "--out", "hover", at=folder)
    _must(*TRAINING, "after", at=folder)
    found = (*SEARCH[:2], "pushed.csv", "--valid", "pushed_too.csv", *SEARCH[5:], "found", "--json", "found.json")
    _must(*found, at=folder)
    if not json.loads((folder / "found.json").read_text())["effects"]:
        raise SystemExit("the search on drives with an effect names none")
    (folder / "study.toml").write_text(STUDY)
    _must("study", "study.toml", "--workers", "1", "--out", "studied", at=folder)
    shutil.copytree(folder / "after", folder / "begun")
    shutil.copytree(folder / "hover", folder / "hover_too")
    _killed(*SEARCH, "searched", at=folder, until=folder / "searched/journal/000003.safetensors")


def _drives(program: Program, trajectories: int, rows: int, seed: int):
    program.duration = (rows - 1) * program.step
    return simulate(program.to(torch.float32), trajectories, seed=seed)


def _must(*words: str, at: Path) -> None:
    said = io.StringIO()
    with contextlib.chdir(at), contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = main([*words, "--quiet"])
    if code:
        raise SystemExit(f"a good input is refused: steady {' '.join(words)}\n{said.getvalue()}")


def _killed(*words: str, at: Path, until: Path) -> None:
    """Run a command and kill it as soon as a file is there."""
    process = subprocess.Popen(
        [sys.executable, "-c", _STEADY, *words], cwd=at, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    while not until.exists():
        if process.poll() is not None:
            raise SystemExit(f"it ended before it could be stopped: steady {' '.join(words)}")
        time.sleep(0.002)
    process.kill()
    process.wait()
