"""What comes out again to the last bit: every command twice, and with what may differ between two machines.

    python benchmarks/determinism.py [--quick]

Each command runs in a process and a folder of its own with the same seed: again; with an empty cache of compiled
kernels; with two threads. Parameters, tables, drawn states, figures and pages are compared as bytes (not `run.json`,
which says when and where, and not `posterior.nc`, whose draws `states` writes as a table); where they differ, by how
much at most, if they are numbers. The table is printed and kept as results/determinism.md. Exits with 1 where a run
with the same threads differs.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file

ROOT = Path(__file__).resolve().parents[1]
HOVERCRAFT, TRUTH = f"{ROOT / 'models' / 'hovercraft.py'}", f"{ROOT / 'models' / 'hovercraft.py'}:HovercraftTruth"
NETWORK = f"{ROOT / 'models' / 'neural_vehicle.py'}:NeuralHovercraft"
DRIVES = ("{desk}/train.csv", "--valid", "{desk}/valid.csv")
SHORT = ("--known-start", "--steps", "8", "--set", "validate_every=4")
FITS = {
    "fit, gaussian guide": (NETWORK, *SHORT),
    "fit, lookahead guide": (NETWORK, *SHORT, "--set", "guide=lookahead"),
    "fit, bootstrap guide": (NETWORK, *SHORT, "--set", "guide=bootstrap"),
    "fit, likelihood": (HOVERCRAFT, "--recipe", "likelihood", "--known-start"),
    "fit, svi": (NETWORK, *SHORT, "--recipe", "svi"),
    "fit, steady-minus": (NETWORK, *SHORT, "--recipe", "steady-minus"),
    "fit, fit-truth": (NETWORK, *SHORT, "--recipe", "fit-truth"),
    "fit, fit-hand": (NETWORK, *SHORT, "--recipe", "fit-hand", "--hand", HOVERCRAFT),
    "fit, fit-tv": (NETWORK, *SHORT, "--recipe", "fit-tv"),
}
COMMANDS: dict[str, tuple[str, ...]] = {
    "simulate": ("simulate", TRUTH, "--trajectories", "3", "--seed", "5", "--out", "out.csv"),
    **{name: ("fit", program, *DRIVES, *settings, "--out", "run") for name, (program, *settings) in FITS.items()},
    "check": ("check", "{desk}/hand", "{desk}/valid.csv", "--simulations", "20", "--json", "out.json"),
    "discover": ("discover", HOVERCRAFT, *DRIVES, "--known-start", "--simulations", "50", "--json", "out.json"),
    "prove": ("prove", "{desk}/hand", "{desk}/true", "{desk}/valid.csv", "--json", "out.json"),
    "evaluate": ("evaluate", "{desk}/hand", "{desk}/valid.csv", "--rollouts", "20", "--json", "out.json"),
    "states": ("states", "{desk}/hand", "{desk}/valid.csv", "--draws", "20", "--out", "out.csv"),
    "report": ("report", "{desk}/hand", "{desk}/valid.csv", "--simulations", "20", "--out", "out.html"),
}
RESULTS = Path(__file__).parent / "results" / "determinism.md"
QUICK = ("simulate", "fit, gaussian guide", "fit, lookahead guide", "fit, likelihood", "check", "states")


@dataclass(frozen=True)
class Condition:
    """What is other than at first.

    Attributes:
        name: of the column.
        environment: what is set, a path relative to the folder of the run.
        same: whether every bit must be the same.
    """

    name: str
    environment: dict[str, str]
    same: bool


CONDITIONS = (
    Condition("again", {}, True),
    Condition("kernels compiled anew", {"NUMBA_CACHE_DIR": "cache", "STEADY_KERNEL_CACHE": "off"}, True),
    Condition("two threads", {"OMP_NUM_THREADS": "2"}, False),
)


def steady(folder: Path, words: tuple[str, ...], environment: dict[str, str]) -> None:
    """A command in a process and a folder of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    own = {name: str(folder / value) if name.endswith("DIR") else value for name, value in environment.items()}
    done = subprocess.run(
        [str(Path(sys.executable).with_name("steady")), *words],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONHASHSEED": "random", **own},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(f"{words}: {done.stderr[-400:]}")


def results(folder: Path) -> dict[str, bytes]:
    """What a command has written, file by file, but for where and by what command line it was; of tensors their
    numbers, since safetensors writes its metadata in any order."""
    files = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    files = [file for file in files if "cache" not in file.relative_to(folder).parts]
    found = {
        str(file.relative_to(folder)): _tensors(file) if file.suffix == ".safetensors" else file.read_bytes()
        for file in files
        if file.name not in ("run.json", "posterior.nc")
    }
    if not found:
        raise RuntimeError(f"{folder} has no results")
    return found


def _tensors(file: Path) -> bytes:
    tensors = sorted(load_file(file).items())
    return b"".join(f"{name} {value.dtype} {value.shape}".encode() + value.tobytes() for name, value in tensors)


def furthest(one: Path, other: Path) -> float:
    """How far the numbers of two results are apart at most, relative to the largest of their array or 1; NaN where
    that is not told."""
    found = [0.0]
    if any(Path(file).suffix not in (".csv", ".json", ".safetensors") for file in results(one)):
        return float("nan")
    for file in results(one):
        a, b = (_numbers(folder / file) for folder in (one, other))
        if a.keys() != b.keys() or any(a[key].shape != b[key].shape for key in a):
            return float("nan")
        for key, values in a.items():
            found.append(float(np.nanmax(np.abs(values - b[key]), initial=0.0) / max(1.0, np.nanmax(np.abs(values)))))
    return max(found)


def _numbers(file: Path) -> dict[str, np.ndarray]:
    if file.suffix == ".safetensors":
        return {name: value.astype(float) for name, value in load_file(file).items() if value.size}
    if file.suffix == ".csv":
        rows = [line.split(",")[1:] for line in file.read_text().splitlines()[1:]]
        return {"all": np.array([[float(cell or "nan") for cell in row] for row in rows])}
    return (
        {name: np.array([value]) for name, value in _leaves(json.loads(file.read_text()))}
        if file.suffix == ".json"
        else {}
    )


def _leaves(content: Any, name: str = "") -> list[tuple[str, float]]:
    if isinstance(content, dict | list):
        parts = content.items() if isinstance(content, dict) else enumerate(content)
        return [leaf for key, value in parts for leaf in _leaves(value, f"{name}.{key}")]
    return [(name, float(content))] if isinstance(content, int | float) else []


def compared(desk: Path, name: str) -> dict[str, str]:
    """What is said of a command in each condition."""
    words = tuple(word.format(desk=desk) for word in COMMANDS[name])
    first, said = desk / name / "first", {}
    steady(first, words, {})
    for condition in CONDITIONS:
        folder = desk / name / condition.name
        steady(folder, words, condition.environment)
        same, most = results(folder) == results(first), furthest(first, folder)
        said[condition.name] = "same" if same else "differs" if math.isnan(most) else f"differs by {most:.1g}"
    return said


def prepared(desk: Path) -> None:
    """Tables and two runs that need no fit."""
    for seed, table in enumerate(("train", "valid"), 1):
        words = ("--trajectories", "6", "--seed", str(seed), "--out", f"{table}.csv")
        steady(desk, ("simulate", TRUTH, *words), {})
    for run, program in (("hand", HOVERCRAFT), ("true", TRUTH)):
        words = ("fit", program, "train.csv", "--recipe", "hand", "--known-start", "--out", run)
        steady(desk, words, {})


def main(arguments: list[str] | None = None, say: Callable[[str], None] = print) -> int:
    """Run all, print the table; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"only {', '.join(QUICK)}")
    chosen = parser.parse_args(arguments)
    missed, lines = 0, [f"| command | {' | '.join(condition.name for condition in CONDITIONS)} |"]
    lines.append("|---" * (len(CONDITIONS) + 1) + "|")
    say("\n".join(lines))
    with tempfile.TemporaryDirectory() as folder:
        prepared(Path(folder))
        for name in QUICK if chosen.quick else COMMANDS:
            said = compared(Path(folder), name)
            missed += sum(condition.same and said[condition.name] != "same" for condition in CONDITIONS)
            lines.append(f"| {name} | {' | '.join(said.values())} |")
            say(lines[-1])
    if not chosen.quick:
        RESULTS.write_text("\n".join(lines) + "\n")
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main())
