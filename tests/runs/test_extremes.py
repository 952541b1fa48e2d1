"""Numbers that nothing can hold, and names that no file system or encoding does: one line each, nothing written."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from small import FEW, HOVERCRAFT, QUICK, steady, tree, written

from steady_ppl import read_table

THIRTY = "9" * 30
LONG = "n" * 300


# --- numbers ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("number", ["99999999999", THIRTY])
@pytest.mark.parametrize(
    "command",
    [
        ("simulate", HOVERCRAFT, "--out", "new.csv", "--trajectories"),
        ("fit", HOVERCRAFT, "train.csv", "--out", "new", "--particles"),
        ("fit", HOVERCRAFT, "train.csv", "--out", "new", "--draws"),
        ("fit", HOVERCRAFT, "train.csv", "--out", "new", "--steps"),
        ("evaluate", "hand", "train.csv", "--particles"),
        ("evaluate", "hand", "train.csv", "--rollouts"),
        ("states", "hand", "train.csv", "--out", "new.csv", "--draws"),
        ("states", "hand", "train.csv", "--out", "new.csv", "--particles"),
        ("check", "hand", "train.csv", "--simulations"),
        ("discover", "hand", "train.csv", "--simulations"),
        ("report", "hand", "train.csv", "--out", "new.html", "--simulations"),
    ],
    ids=lambda words: f"{words[0]} {words[-1]}",
)
def test_no_number_is_without_end(work: Path, monkeypatch, refused, command: tuple, number: str) -> None:
    monkeypatch.chdir(work)
    refused(2, f"Invalid value for '{command[-1]}'", *command, number)


def test_a_setting_is_not_without_end_either(work: Path, monkeypatch, refused) -> None:
    monkeypatch.chdir(work)
    command = ("fit", HOVERCRAFT, "train.csv", "--out", "new", "--set", f"validate_every={THIRTY}")
    refused(2, "expected a whole number up to", *command)


def test_a_seed_is_one_that_a_record_can_hold(work: Path, tmp_path: Path, monkeypatch, refused) -> None:
    monkeypatch.chdir(work)
    command = ("fit", HOVERCRAFT, "train.csv", "--recipe", "hand", "--out")
    refused(2, "--seed", *command, tmp_path / "run", "--seed", 2**63)
    assert steady(*command, tmp_path / "run", "--seed", 2**63 - 1) == 0
    assert steady("states", tmp_path / "run", "train.csv", "--draws", 3, "--out", tmp_path / "states.csv") == 0


@pytest.mark.parametrize(
    "greedy",
    [lambda: torch.empty(2**55), lambda: torch.empty(2**40, 2**40), lambda: np.empty(2**55), lambda: b"0" * 2**55],
    ids=["torch", "overflow", "numpy", "python"],
)
def test_more_memory_than_there_is_is_one_line(tmp_path: Path, monkeypatch, refused, greedy) -> None:
    monkeypatch.setattr("steady_ppl.simulate", lambda *_, **__: greedy())
    refused(1, "more memory than there is", "simulate", HOVERCRAFT, "--out", tmp_path / "new.csv")


# --- names that are too long ------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "command",
    [
        ("fit", f"{LONG}.py", "train.csv", "--out", "new"),
        ("fit", HOVERCRAFT, f"{LONG}.csv", "--out", "new"),
        ("fit", HOVERCRAFT, "train.csv", "--recipe", f"{LONG}.py", "--out", "new"),
        ("fit", HOVERCRAFT, "train.csv", "--recipe", "fit-hand", "--hand", f"{LONG}.py", "--out", "new"),
        ("fit", HOVERCRAFT, "train.csv", "--recipe", "hand", "--out", LONG),
        ("fit", HOVERCRAFT, "train.csv", "--recipe", "hand", "--out", "deep/" * 1000),
        ("simulate", HOVERCRAFT, "--out", f"{LONG}.csv"),
        ("check", LONG, "train.csv"),
        ("check", "hand", "train.csv", "--program", f"{LONG}.py"),
        ("check", "hand", "train.csv", "--json", LONG),
        ("report", "hand", "train.csv", "--discovery", LONG, "--out", "new.html"),
        ("add", HOVERCRAFT, "wind", "--out", HOVERCRAFT.with_name(f"{LONG}.py")),
        ("init", LONG),
        ("demo", "--out", LONG),
        ("import-bag", LONG),
        ("import-log", LONG),
        ("data", "alpha-truck", LONG, "--out", "new.csv"),
        ("data", "cut", f"{LONG}.csv", "--seconds", 1, "--out", "new.csv"),
    ],
    ids=lambda words: " ".join(str(word)[:12] for word in words if word != HOVERCRAFT),
)
def test_a_name_that_is_too_long_is_one_line(work: Path, monkeypatch, refused, command: tuple) -> None:
    monkeypatch.chdir(work)
    refused(2, "name too long", *command, folder=work)


@pytest.mark.slow
@pytest.mark.parametrize("length", [240, 255])
def test_a_name_may_be_as_long_as_the_file_system_has_them(tmp_path: Path, length: int) -> None:
    table = tmp_path / f"{'n' * (length - 4)}.csv"
    assert steady("simulate", HOVERCRAFT, "--trajectories", 2, "--out", table) == 0
    assert len(read_table(table)) == 2 and tree(tmp_path) == [table]


# --- a file system that is read only ----------------------------------------------------------------------------------


READ_ONLY = """mount -t tmpfs -o size=1m none "$1" && mkdir "$1/run" && mount -o remount,ro "$1" || exit 77
shift; exec "$@" """


@pytest.mark.slow
def test_a_file_system_that_is_read_only_is_one_line(tmp_path: Path) -> None:
    place = tmp_path / "ro"
    place.mkdir()
    program = "import sys; from steady_ppl.cli.main import main; sys.exit(main(sys.argv[1:]))"
    words = ["simulate", HOVERCRAFT, "--trajectories", "2", "--out", place / "a.csv"]
    command = ["unshare", "-m", "sh", "-c", READ_ONLY, "sh", place, sys.executable, "-c", program, *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    except FileNotFoundError:
        pytest.skip("no unshare here")
    if done.returncode == 77 or "unshare" in done.stderr:
        pytest.skip("file systems cannot be mounted here")
    assert done.returncode == 2 and done.stderr.splitlines()[-1].endswith("cannot be written: Read-only file system")


# --- names that are no UTF-8 ------------------------------------------------------------------------------------------
@pytest.fixture
def odd(tmp_path: Path) -> Path:
    """A folder whose name is not UTF-8."""
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/odd\xff"))
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system has no such names")
    return folder


@pytest.mark.exhaustive
def test_a_run_whose_name_is_no_utf8_is_read_like_any_other(work: Path, odd: Path) -> None:
    table = written(odd / "train\udcfe.csv")
    run = odd / "run\udcfe"
    assert steady("fit", HOVERCRAFT, table, "--out", run, *FEW) == 0
    assert steady("fit", HOVERCRAFT, table, "--out", run, *FEW, "--resume") == 0
    quick = ("--simulations", 20)
    assert steady("check", run, table, *quick, "--json", odd / "check.json", "--picture", odd / "check.png") == 0
    assert steady("states", run, table, "--draws", 3, "--out", odd / "states.nc") == 0
    assert steady("evaluate", run, table, *QUICK, "--json", odd / "errors.json") == 0
    proved = ("prove", work / "hand", run, work / "test.csv")
    assert steady(*proved, "--json", odd / "proof.json", "--picture", odd / "proof.png") == 0
    assert steady("report", run, table, *quick, "--out", odd / "page.html") == 0
    assert "train\\udcfe.csv" in (odd / "page.html").read_text(encoding="utf-8")


def test_parquet_whose_text_is_no_utf8_is_one_line(tmp_path: Path, refused) -> None:
    table = written(tmp_path / "drives.csv")
    frame = pd.read_csv(table, dtype={"trajectory": str})
    frame["trajectory"] = "drive-" + frame["trajectory"]
    frame.to_parquet(tmp_path / "drives.parquet", compression="none", index=False)
    content = (tmp_path / "drives.parquet").read_bytes()
    assert b"drive-1" in content
    bad = tmp_path / "bad.parquet"
    bad.write_bytes(content.replace(b"drive-1", b"drive\xff1"))
    command = ("simulate", HOVERCRAFT, "--controls", bad, "--out", tmp_path / "new.csv")
    refused(2, "bad.parquet: cannot be read as parquet: ", *command)
