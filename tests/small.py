"""Small tables and programs on disk, and the `steady` command in this process."""

from __future__ import annotations

import math
import re
import shlex
import warnings
from dataclasses import replace
from pathlib import Path

import torch
from examples import MODELS, example

from steady_ppl import Trajectories, simulate, write_table
from steady_ppl.cli.main import main

with warnings.catch_warnings():
    warnings.simplefilter("ignore", FutureWarning)  # arviz announces its next version whenever it is imported
    import arviz  # noqa: F401

HOVERCRAFT, TRUTH = MODELS / "hovercraft.py", f"{MODELS / 'hovercraft.py'}:HovercraftTruth"

HIDDEN = "\x1b[2J\x1b]0;owned\x07\r\x9b31m\u202e"  # clears the screen, renames the window, goes back, turns the line
FEW = ("--guide", "bootstrap", "--particles", 20, "--draws", 3, "--steps", 3)
QUICK = ("--particles", 50, "--rollouts", 5)


def steady(*arguments: object) -> int:
    """The exit code of `steady ARGUMENTS`."""
    return main([str(argument) for argument in arguments])


def without_progress(said: str) -> list[str]:
    """The lines of a command's standard error but those that tell how long it has taken: there are some where it is
    slow."""
    return [line for line in said.splitlines() if " gone by" not in line]


def simulated(name: str = "hovercraft.py:HovercraftTruth", trajectories: int = 3, rows: int = 13, seed: int = 0):
    """Drives of an example program, as a table holds them."""
    program = example(name, torch.float32)
    program.duration = (rows - 1) * program.step
    return simulate(program, trajectories, seed=seed)


def written(path: Path, data: Trajectories | None = None) -> Path:
    """A table on disk."""
    write_table(simulated() if data is None else data, path)
    return path


def only_start(data: Trajectories) -> Trajectories:
    """The same drives, of whose true states only the first is known."""
    return data.without_truth(keep_start=True)


def impossible(data: Trajectories, trajectory: int, row: int) -> Trajectories:
    """The same drives with a measurement that no program explains."""
    measurements = data.measurements.clone()
    measurements[row, trajectory] = 1e30
    return replace(data, measurements=measurements)


def finite(content) -> bool:
    """Whether no figure of a report is infinite or missing."""
    if isinstance(content, dict):
        return all(finite(value) for value in content.values())
    if isinstance(content, list | tuple):
        return all(finite(value) for value in content)
    return not isinstance(content, float) or math.isfinite(content)


def tree(folder: Path) -> list[Path]:
    """Every file and folder below a folder but Python's caches."""
    return [path for path in sorted(folder.rglob("*")) if "__pycache__" not in path.parts]


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder; to see that nothing was written, changed or left over."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in tree(folder) if path.is_file()}


def rewritten(path: Path, old: str, new: str, count: int = 1) -> Path:
    """A table with some text replaced."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))
    return path


def commands(page: Path) -> list[list[str]]:
    """The words of every `steady` command in the shell blocks of a page."""
    text = "\n".join(text for language in ("sh", "bash") for _, text in blocks(page, language))
    lines = [line.split("  #")[0].split(" > ")[0].split(" | ")[0] for line in text.replace("\\\n", " ").splitlines()]
    return [shlex.split(line)[1:] for line in lines if line.startswith("steady ")]


def blocks(page: Path, language: str) -> list[tuple[str, str]]:
    """What stands behind the language of each block, and the block."""
    return [(about, text) for found, about, text in BLOCK.findall(page.read_text()) if found == language]


BLOCK = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
