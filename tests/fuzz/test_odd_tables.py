"""Odd tables by hand: a line that names column, trajectory and row, or a table that is read."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from examples import MODELS
from mutants import BYTES, lay
from small import FEW, HOVERCRAFT, QUICK, rewritten, simulated, steady, tree, written
from table_mutants import TABLE

import steady_ppl as st
from steady_ppl.utils.text import shown

CART = MODELS / "linear_gaussian.py"


def mutant(how: str) -> Callable[[Path], None]:
    """What the fuzzer does to a table, in which nothing is drawn."""
    return lambda path: lay(path, (BYTES | TABLE)[how](None, path.read_bytes()))


def columns(path: Path, **values: object) -> Path:
    """A cart's table with columns replaced; a dot is spelt as two underscores."""
    frame = pd.DataFrame(st.to_frame(simulated("linear_gaussian", 5, 9)))
    for name, value in values.items():
        frame[name.replace("__", ".")] = value
    frame.to_csv(path, index=False)
    return path


NAMED = {
    "infinity": (lambda path: columns(path, y__position=math.inf), "column y.position, trajectory 1, row 1: got 'inf'"),
    "minus infinity": (lambda path: columns(path, u__push=-math.inf), "column u.push, trajectory 1, row 1: got '-inf'"),
    "NaN in a control": (lambda path: columns(path, u__push=math.nan), "expected a finite number"),
    "duplicate times": (lambda path: columns(path, time=0.0), "time must strictly increase, got 0.0 after 0.0"),
    "times that go back": (lambda path: columns(path, time=-np.arange(45.0)), "time must strictly increase"),
    "one row": (lambda path: cut(path, 2), "a trajectory needs at least two rows, got one"),
    "only the header": (lambda path: cut(path, 1), "the table has no rows"),
    "empty": (mutant("empty"), "the table is empty"),
    "junk": (lambda path: path.write_bytes(bytes(range(256)) * 20), "cannot be read as csv"),
    "NUL bytes": (mutant("NUL bytes"), r"column \x00\x00"),
    "semicolons and decimal commas": (mutant("semicolons and decimal commas"), "column u,push: unknown column"),
    "an escape": (lambda path: rewritten(path, "y.position", "y.\x1b[2J"), r"it has y.\x1b[2J"),
    "text turned around": (lambda path: rewritten(path, "y.position", "y.\u202e"), r"it has y.\u202e"),
    "an endless name": (lambda path: rewritten(path, "y.position", f"y.{'n' * 100_000}"), "it has y.nnn"),
    "HTML": (lambda path: rewritten(path, "y.position", "y.<script>"), "the table has no column y.position"),
    "a path": (lambda path: rewritten(path, "y.position", "y.../../etc/passwd"), "no column y.position"),
    "a folder": (mutant("a folder"), "is a folder: expected a file"),
    "a pipe": (mutant("a pipe"), "is a pipe: expected a file"),
    "endless zeros": (mutant("a link to endless zeros"), "is a device: expected a file"),
}


def cut(path: Path, lines: int) -> None:
    path.write_text("\n".join(path.read_text().splitlines()[:lines]) + "\n")


@pytest.mark.slow
@pytest.mark.parametrize("name", list(NAMED))
def test_a_hostile_table_is_refused(tmp_path: Path, table: Path, cart_run: Path, capsys, name: str) -> None:
    spoil, says = NAMED[name]
    spoil(table)
    for words in (
        ("fit", CART, table, "--recipe", "hand", "--out", tmp_path / "run"),
        ("check", cart_run, table, "--json", tmp_path / "c.json"),
        ("evaluate", cart_run, table, "--json", tmp_path / "e.json"),
    ):
        assert steady(*words) == 2
        out, error = capsys.readouterr()
        assert says in error and error.count("\n") == 1 and len(error) < 1100 and out == "", error
        assert shown(error[:-1]) == error[:-1]
    assert [path.name for path in tree(tmp_path)] == ["t.csv"]


FINE = {
    "NaN in a measurement": lambda path: columns(path, y__position=math.nan),
    "a byte order mark": mutant("a byte order mark"),
    "CRLF": mutant("CRLF"),
    "constant measurements": lambda path: columns(path, y__position=0.5),
    "a label with a bell": lambda path: rewritten(path, "\n1,", "\n1\a,", -1),
    "labels of other tongues": lambda path: rewritten(path, "\n1,", "\nповорот 🚗,", -1),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(FINE))
def test_an_odd_table_is_read(tmp_path: Path, table: Path, cart_run: Path, capsys, name: str) -> None:
    FINE[name](table)
    assert steady("fit", CART, table, "--recipe", "hand", "--out", tmp_path / "run") == 0
    assert steady("evaluate", cart_run, table, *QUICK) == 0
    assert steady("check", cart_run, table, "--simulations", 20) in (0, 2)
    assert "\a" not in "".join(capsys.readouterr())


@pytest.mark.parametrize("column", ["y__position", "u__push", "x__position"])
def test_numbers_without_measure_end_in_a_line(tmp_path: Path, cart_run: Path, capsys, column: str) -> None:
    huge = columns(tmp_path / "huge.csv", **{column: 1e300})
    for words in (
        ("fit", CART, huge, *FEW, "--out", tmp_path / "run"),
        ("fit", CART, huge, "--recipe", "likelihood", "--out", tmp_path / "likely"),
        ("check", cart_run, huge, "--simulations", 20, "--json", tmp_path / "c.json"),
        ("evaluate", cart_run, huge, *QUICK, "--json", tmp_path / "e.json"),
        ("states", cart_run, huge, "--draws", 3, "--out", tmp_path / "s.csv"),
    ):
        code = steady(*words)
        error = capsys.readouterr().err
        assert code in (0, 1, 2) and "--debug shows where" not in error
        assert code == 0 or not Path(words[-1]).exists()


def test_drives_of_two_rows_hold_nothing_to_check(tmp_path: Path, refused) -> None:
    table = written(tmp_path / "t.csv", simulated(trajectories=5, rows=2))
    assert steady("fit", HOVERCRAFT, table, "--recipe", "hand", "--known-start", "--out", tmp_path / "run") == 0
    refused(2, "take more trajectories, or longer ones", "check", tmp_path / "run", table, "--simulations", 20)


def test_lists_in_a_parquet_table_are_no_numbers(tmp_path: Path, cart_run: Path, refused) -> None:
    frame = st.to_frame(simulated("linear_gaussian", 5, 9))
    for cell in ([1.0, 2.0], []):
        frame["y.position"] = [cell] * len(frame)
        frame.to_parquet(tmp_path / "t.parquet")
        refused(2, "column y.position, trajectory 1, row 1: got", "evaluate", cart_run, tmp_path / "t.parquet")


@pytest.mark.slow
def test_a_hundred_thousand_rows_are_handled_in_bounded_memory(tmp_path: Path, cart_run: Path) -> None:
    rows = 100_000
    frame = pd.DataFrame({"trajectory": 1, "time": np.arange(rows) / 100, "u.push": np.sin(np.arange(rows) / 100)})
    frame["y.position"] = np.cos(np.arange(rows) / 300)
    frame.to_csv(tmp_path / "long.csv", index=False)
    code = (
        "import resource, sys\n"
        "from steady_ppl.cli.main import main\n"
        "done = main(sys.argv[1:])\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, file=sys.stderr)\n"
        "sys.exit(done)"
    )
    words = ("fit", CART, tmp_path / "long.csv", "--recipe", "hand", "--out", tmp_path / "run", "--quiet")
    began = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code, *map(str, words)], capture_output=True, text=True)
    lines = done.stderr.splitlines()
    assert done.returncode in (0, 1, 2) and "--debug" not in done.stderr, done.stderr
    assert float(lines[-1]) < 4000 and time.monotonic() - began < 240
