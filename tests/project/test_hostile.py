"""Broken and hostile files: a line that says what is wrong, no traceback, nothing half-written."""

from __future__ import annotations

import json
import math
import os
import struct
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from examples import MODELS, example
from small import FEW, HOVERCRAFT, QUICK, contents, rewritten, simulated, steady, tree, written

import steady_ppl as st
from steady_ppl.datasets.alpha_truck import read_alpha_truck
from steady_ppl.errors import DataError, RunError
from steady_ppl.utils.files import read_json, require_file
from steady_ppl.utils.schema import NUMBER, TEXT, WHOLE, Absent, Among, Maybe, misfit
from steady_ppl.utils.text import shown

CART = MODELS / "linear_gaussian.py"
BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def test_mutants_of_every_kind_neither_crash_nor_hang() -> None:
    done = subprocess.run(
        [sys.executable, BENCHMARKS / "hostile.py", "--quick"], capture_output=True, text=True, env=os.environ
    )
    assert done.returncode == 0, done.stdout + done.stderr
    total = [cell.strip() for cell in done.stdout.splitlines()[-2].split("|")]
    tried, refused = int(total[3]), int(total[5])
    assert tried >= 60 and refused >= 20


# --- tables -----------------------------------------------------------------------------------------------------------


def columns(path: Path, **values: object) -> Path:
    """A cart's table with columns replaced; a dot is spelt as two underscores."""
    frame = pd.DataFrame(st.table.to_frame(carts()))
    for name, value in values.items():
        frame[name.replace("__", ".")] = value
    frame.to_csv(path, index=False)
    return path


def carts(trajectories: int = 5, rows: int = 9) -> st.Trajectories:
    program = example("linear_gaussian", torch.float32)
    program.duration = (rows - 1) * program.step
    return st.simulate(program, trajectories, seed=0)


@pytest.fixture(scope="module")
def cart_run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cart")
    table = written(folder / "t.csv", carts())
    assert steady("fit", CART, table, "--recipe", "hand", "--out", folder / "run") == 0
    return folder / "run"


NAMED = {
    "infinity": (lambda path: columns(path, y__position=math.inf), "column y.position, trajectory 1, row 1: got 'inf'"),
    "minus infinity": (lambda path: columns(path, u__push=-math.inf), "column u.push, trajectory 1, row 1: got '-inf'"),
    "NaN in a control": (lambda path: columns(path, u__push=math.nan), "expected a finite number"),
    "duplicate times": (lambda path: columns(path, time=0.0), "time must strictly increase, got 0.0 after 0.0"),
    "times that go back": (lambda path: columns(path, time=-np.arange(45.0)), "time must strictly increase"),
    "one row": (lambda path: cut(path, 2), "a trajectory needs at least two rows, got one"),
    "only the header": (lambda path: cut(path, 1), "the table has no rows"),
    "empty": (lambda path: path.write_bytes(b""), "the table is empty"),
    "junk": (lambda path: path.write_bytes(bytes(range(256)) * 20), "cannot be read as csv"),
    "NUL bytes": (lambda path: path.write_bytes(bytes(5000)), r"column \x00\x00"),
    "UTF-16": (lambda path: path.write_bytes(path.read_text().encode("utf-16")), "cannot be read as csv"),
    "semicolons and decimal commas": (
        lambda path: path.write_text(path.read_text().replace(",", ";").replace(".", ",")),
        "separated by semicolons",
    ),
    "an escape": (lambda path: rewritten(path, "y.position", "y.\x1b[2J"), r"it has y.\x1b[2J"),
    "text turned around": (lambda path: rewritten(path, "y.position", "y.\u202e"), r"it has y.\u202e"),
    "an endless name": (lambda path: rewritten(path, "y.position", f"y.{'n' * 100_000}"), "it has y.nnn"),
    "HTML": (lambda path: rewritten(path, "y.position", "y.<script>"), "the table has no column y.position"),
    "a path": (lambda path: rewritten(path, "y.position", "y.../../etc/passwd"), "no column y.position"),
    "a folder": (lambda path: (path.unlink(), path.mkdir()), "is a folder: expected a file"),
    "a pipe": (lambda path: (path.unlink(), os.mkfifo(path)), "is a pipe: expected a file"),
    "endless zeros": (lambda path: (path.unlink(), path.symlink_to("/dev/zero")), "is a device: expected a file"),
}


def cut(path: Path, lines: int) -> None:
    path.write_text("\n".join(path.read_text().splitlines()[:lines]) + "\n")


@pytest.mark.parametrize("name", list(NAMED))
def test_a_hostile_table_is_refused(tmp_path: Path, cart_run: Path, capsys, name: str) -> None:
    spoil, says = NAMED[name]
    bad = written(tmp_path / "bad.csv", carts())
    spoil(bad)
    for words in (
        ("fit", CART, bad, "--recipe", "hand", "--out", tmp_path / "run"),
        ("check", cart_run, bad, "--json", tmp_path / "c.json"),
        ("evaluate", cart_run, bad, "--json", tmp_path / "e.json"),
    ):
        assert steady(*words) == 2
        out, error = capsys.readouterr()
        assert says in error and error.count("\n") == 1 and len(error) < 1100 and out == "", error
        assert shown(error[:-1]) == error[:-1]
    assert [path.name for path in tree(tmp_path)] == ["bad.csv"]


FINE = {
    "NaN in a measurement": lambda path: columns(path, y__position=math.nan),
    "a byte order mark": lambda path: path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes()),
    "CRLF": lambda path: path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n")),
    "constant measurements": lambda path: columns(path, y__position=0.5),
    "a label with a bell": lambda path: rewritten(path, "\n1,", "\n1\a,", -1),
    "labels of other tongues": lambda path: rewritten(path, "\n1,", "\nповорот 🚗,", -1),
}


@pytest.mark.parametrize("name", list(FINE))
def test_an_odd_table_is_read(tmp_path: Path, cart_run: Path, capsys, name: str) -> None:
    odd = written(tmp_path / "odd.csv", carts())
    FINE[name](odd)
    assert steady("fit", CART, odd, "--recipe", "hand", "--out", tmp_path / "run") == 0
    assert steady("evaluate", cart_run, odd, *QUICK) == 0
    assert steady("check", cart_run, odd, "--simulations", 20) in (0, 2)
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
    refused(2, "take more drives, or longer ones", "check", tmp_path / "run", table, "--simulations", 20)


def test_lists_in_a_parquet_table_are_no_numbers(tmp_path: Path, cart_run: Path, refused) -> None:
    frame = st.table.to_frame(carts())
    for cell in ([1.0, 2.0], []):
        frame["y.position"] = [cell] * len(frame)
        frame.to_parquet(tmp_path / "t.parquet")
        refused(2, "column y.position, trajectory 1, row 1: got", "evaluate", cart_run, tmp_path / "t.parquet")


def test_no_landmarks_is_no_program(tmp_path: Path, refused) -> None:
    blind = tmp_path / "blind.py"
    blind.write_text("from steady_ppl import PlanarVehicle\n\n\nclass Blind(PlanarVehicle):\n    landmarks = ()\n")
    says = "declares no measurements (for a planar vehicle: landmarks)"
    refused(2, says, "fit", blind, written(tmp_path / "t.csv"), "--out", tmp_path / "run")


def test_degrees_are_suspected_in_controls_and_known_headings(tmp_path: Path, capsys) -> None:
    program, data = example("truck", torch.float32), simulated("truck", 3, 13)
    controls, states = data.controls.clone(), data.states.clone()
    controls[..., 1] = 45.0
    states[..., 2] = 170.0
    found = st.doubts.diagnose_units(program, st.for_program(program, replace(data, controls=controls, states=states)))
    assert any(said.startswith("u.turn") and "radians a second" in said for said in found)
    assert any(said.startswith("x.heading is between 170 and 170") for said in found)
    assert st.doubts.diagnose_units(program, st.for_program(program, data)) == []


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


# --- runs -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda record: record.update(program=3), "program is 3, expected names and values"),
        (lambda record: record["program"].pop("class"), "program has no class"),
        (lambda record: record.update(seed=-1), "seed is -1, expected a whole number"),
        (lambda record: record.update(notes=[None]), "notes[0] is None, expected text"),
        (lambda record: record.update(effects="wind"), "effects is 'wind', expected a list"),
        (lambda record: record.pop("history"), "it has no history"),
        (lambda record: record.update(recipe=["\x1b[2J"]), "recipe is "),
    ],
)
def test_a_record_of_another_form_is_refused(tmp_path: Path, cart_run: Path, refused, change, says: str) -> None:
    copy = copied(cart_run, tmp_path / "run")
    record = json.loads((copy / "run.json").read_text())
    change(record)
    (copy / "run.json").write_text(json.dumps(record))
    refused(2, says, "evaluate", copy, written(tmp_path / "t.csv", carts()))


@pytest.mark.parametrize("text", ["[" * 100_000, "", "3", "\ud83d", '{"a": ' + "9" * 10_000 + "}"])
def test_a_record_that_is_no_json_is_refused(tmp_path: Path, cart_run: Path, refused, text: str) -> None:
    copy = copied(cart_run, tmp_path / "run")
    (copy / "run.json").write_bytes(text.encode(errors="surrogatepass"))
    refused(2, "run.json is damaged", "evaluate", copy, written(tmp_path / "t.csv", carts()))


def copied(run: Path, place: Path) -> Path:
    place.mkdir()
    for name, content in contents(run).items():
        (place / name).write_bytes(content)
    record = json.loads((place / "run.json").read_text())
    record["program"]["file"] = os.path.relpath(CART, place)
    (place / "run.json").write_text(json.dumps(record))
    return place


def test_parameters_of_which_a_bit_has_turned_are_refused(tmp_path: Path, cart_run: Path, refused) -> None:
    copy, table = copied(cart_run, tmp_path / "run"), written(tmp_path / "t.csv", carts())
    file = copy / "parameters.safetensors"
    good = file.read_bytes()
    file.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
    refused(2, "its numbers are not those that were written", "evaluate", copy, table)
    file.write_bytes(struct.pack("<Q", 2**63) + good[8:])
    refused(2, "is damaged", "evaluate", copy, table)


def test_parameters_that_are_not_finite_are_refused(tmp_path: Path, cart_run: Path) -> None:
    fit = st.Fit.load(cart_run)
    with torch.no_grad():
        next(fit.program.parameters()).fill_(torch.nan)
    fit.save(tmp_path / "run")
    with pytest.raises(RunError, match="are not finite: fit again"):
        st.Fit.load(tmp_path / "run")


def test_a_run_in_which_a_folder_takes_a_files_place_is_not_overwritten(
    tmp_path: Path, cart_run: Path, refused
) -> None:
    copy, table = copied(cart_run, tmp_path / "run"), written(tmp_path / "t.csv", carts())
    (copy / "run.json").unlink()
    (copy / "run.json").mkdir()
    refused(2, "run.json is a folder", "fit", CART, table, "--recipe", "hand", "--force", "--out", copy)


def test_a_checkpoint_of_another_form_is_refused(tmp_path: Path, refused) -> None:
    table, run = written(tmp_path / "t.csv", carts()), tmp_path / "run"
    assert steady("fit", CART, table, *FEW, "--out", run) == 0
    tensors, text = st.checkpoint.read_tensors(run / "checkpoint.safetensors")
    resumed = ("fit", CART, table, *FEW, "--out", run, "--resume")
    slot = next(name for name in tensors if name.startswith("optimizer/") and tensors[name].dim() == 0)
    for other, said, says in (
        ({"odd/name": torch.zeros(1)}, {}, "no checkpoint has odd/name"),
        ({slot.replace("/0/", "/77/"): torch.zeros(1)}, {}, "the optimiser has no"),
        ({"averaged/gain": torch.zeros(7)}, {}, "the averaged parameters are others"),
        ({}, {"step": '"one"'}, "step is 'one', expected a whole number"),
        ({}, {"history": "{"}, "is no JSON"),
    ):
        st.checkpoint.write_tensors(run / "checkpoint.safetensors", tensors | other, text | said)
        refused(2, says, *resumed)


def test_a_discovery_of_another_form_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "found.json"
    said = {
        "sentence": "s",
        "candidates": [],
        "effects": [],
        "shape": None,
        "doubts": [],
        "notes": [],
        "next_run": None,
    }
    for change, says in (
        ({}, None),
        ({"candidates": [3]}, "candidates[0] is 3, expected names and values"),
        ({"doubts": None}, "doubts is None, expected a list"),
        ({"shape": {"channel": "yaw"}}, "shape has no variable"),
    ):
        file.write_text(json.dumps(said | change))
        if says is None:
            assert st.run_folder.read_discovery(file) == said
            continue
        with pytest.raises(RunError) as caught:
            st.run_folder.read_discovery(file)
        assert says in str(caught.value)


# --- other files ------------------------------------------------------------------------------------------------------


def test_a_form_is_told_from_another(tmp_path: Path) -> None:
    form = {"a": NUMBER, "b": Maybe([WHOLE]), "c": Absent(TEXT), "d": Among((NUMBER, TEXT))}
    assert misfit({"a": 1, "b": None, "d": "x"}, form) is None
    assert misfit({"a": 1, "b": [1, -1], "d": 2}, form) == "b[1] is -1, expected a whole number from 0 to 2^63"
    assert misfit({"a": math.inf, "b": [], "d": 2}, form) == "a is inf, expected a finite number"
    assert misfit({"a": True, "b": [], "d": 2}, form) == "a is True, expected a finite number"
    assert misfit({"b": [], "d": 2}, form) == "it has no a"
    assert misfit([], form) == "it is [], expected names and values"
    assert misfit({"x": 10**400}, {str: NUMBER}).startswith("x is 1000")
    assert misfit({"a": 1, "b": [], "c": 3, "d": 2}, form) == "c is 3, expected text"


def test_what_may_never_end_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(DataError, match="is a pipe"):
        read_json(tmp_path / "pipe.json", DataError)
    require_file(tmp_path / "nothing", DataError)  # is for the reader to find
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "nothing", DataError)


def test_what_a_file_says_is_shown_on_one_line() -> None:
    assert shown("a\x1b[2J\nb\0\u202e") == r"a\x1b[2J\nb\x00\u202e"
    assert shown("x" * 200, 10) == "x" * 9 + "…"


def test_example_controls_of_another_shape_are_the_programs_fault(tmp_path: Path, refused) -> None:
    text = CART.read_text().replace("LinearGaussian", "Cart")
    assert "time.sin().unsqueeze(-1)" in text
    for controls, says in (
        ("time.sine()", "example_controls failed: AttributeError"),
        ("time.sin()", "example_controls gave shape"),
        ("None", "example_controls gave NoneType"),
        ("time.sin().unsqueeze(-1) / 0", "not finite"),
    ):
        (tmp_path / "cart.py").write_text(text.replace("time.sin().unsqueeze(-1)", controls))
        refused(2, says, "simulate", tmp_path / "cart.py", "--out", tmp_path / "t.csv")


def test_a_hostile_log_is_refused(tmp_path: Path) -> None:
    head = "header.stamp.secs,header.stamp.nsecs,"
    pose = "pose.position.x,pose.position.y,pose.orientation.z,pose.orientation.w\n"
    for text, says in (
        ("," * 2_000_000 + "\n", "the first line has more than"),
        (head + pose + f"{'9' * 400},0,0,0,0,1\n", "expected a finite number"),
        (head + pose + "1e300,0,0,0,0,1\n", "expected a part of a time stamp"),
        (head + pose + "1,-5,0,0,0,1\n", "expected a part of a time stamp"),
    ):
        (tmp_path / "vrpn-pose.csv").write_text(text)
        with pytest.raises(DataError, match=says):
            read_alpha_truck(tmp_path)
