"""What may go wrong around a run: two writers, processes that are killed, disks that are full."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from examples import example
from small import HOVERCRAFT, steady, without_progress, written

import steady_ppl as st
from steady_ppl.runs.folder import LOCK, run_folder
from steady_ppl.utils.tensor_files import read_tensors

HOLDER = """
import sys
from steady_ppl.runs.folder import run_folder
with run_folder(sys.argv[1], force=True) as folder:
    (folder / "parameters.safetensors").write_bytes(b"half")
    print("open", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A finished run."""
    table = written(tmp_path / "table.csv")
    assert steady("fit", HOVERCRAFT, table, "--recipe", "hand", "--out", tmp_path / "run") == 0
    return tmp_path / "run"


@pytest.fixture
def writer(run: Path):
    """Another process that writes to the run."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(run)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "open\n"
    yield process
    if process.poll() is None:
        os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stdin.close()
    process.stdout.close()


@pytest.mark.slow
def test_of_two_writers_the_second_is_refused(run: Path, writer, tmp_path: Path, refused) -> None:
    command = ("fit", HOVERCRAFT, tmp_path / "table.csv", "--recipe", "hand", "--force", "--out", run)
    refused(2, "another process writes to it", *command)
    writer.stdin.close()
    writer.wait()
    assert steady(*command) == 0
    assert not (run / LOCK).exists()


@pytest.mark.slow
def test_the_lock_of_a_killed_writer_is_none_and_the_old_run_comes_back(run: Path, writer) -> None:
    before = st.Fit.load(run.parent / "run", HOVERCRAFT) if (run / "run.json").exists() else None
    assert before is None  # the writer has put the old run aside
    os.kill(writer.pid, signal.SIGKILL)
    writer.wait()
    with pytest.raises(RuntimeError, match="breaks"), run_folder(run, force=True):
        raise RuntimeError("breaks")
    assert st.Fit.load(run).recipe == "hand" and not (run / LOCK).exists()


def test_nothing_is_left_of_a_new_folder_whose_block_fails(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), run_folder(tmp_path / "a" / "b"):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


# --- killed, and gone on with -----------------------------------------------------------------------------------------

COMMANDS = {
    "discover": ("discover", HOVERCRAFT, "train.csv", "--valid", "valid.csv", "--known-start", "--simulations", "50"),
    "fit": ("fit", HOVERCRAFT, "train.csv", "--known-start", "--steps", "20", "--set", "validate_every=5"),
}
KEPT = {"discover": ("discovery.json", "parameters.safetensors"), "fit": ("parameters.safetensors", "run.json")}


@pytest.fixture(scope="module")
def desk(tmp_path_factory) -> Path:
    """Two tables of drives with a yaw bias."""
    desk = tmp_path_factory.mktemp("desk")
    truth = example("hovercraft", torch.float32).with_effect("yaw_bias", 0.15)
    truth.duration = 3.0
    for seed, name in enumerate(("train", "valid")):
        st.write_table(st.simulate(truth, 6, seed=seed), desk / f"{name}.csv")
    return desk


def undisturbed(desk: Path, name: str) -> tuple[float, float]:
    """Run the command where nothing happens to it, once; seconds until it has begun, and until it has ended."""
    timed = desk / f"{name}.seconds"
    if not timed.exists():
        start = time.monotonic()
        process = started(desk, *COMMANDS[name], "--out", name)
        while not begun(desk / name):
            assert process.poll() is None
            time.sleep(0.01)
        first = time.monotonic() - start
        assert process.wait() == 0
        timed.write_text(f"{first} {time.monotonic() - start}")
    first, whole = map(float, timed.read_text().split())
    return first, whole


def started(desk: Path, *words: object, room: int = -1) -> subprocess.Popen:
    """A command in a process of its own, none of whose files grows beyond `room` bytes."""
    program = f"""import resource, sys; from steady_ppl.cli.main import main
resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, {room}))
sys.exit(main(sys.argv[1:]))"""
    with (desk / "errors").open("w") as errors:
        return subprocess.Popen(
            [sys.executable, "-c", program, *map(str, words)],
            cwd=desk,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )


def killed_and_resumed(desk: Path, name: str, out: str, moment: float, *, of_begun: bool) -> str:
    """Kill a command after so many seconds, or so many after it has begun, and let it end; whether it had `ended`
    first, was caught `early`, before there was anything to go on with, or `resumed`."""
    process = started(desk, *COMMANDS[name], "--out", out)
    while of_begun and not begun(desk / out) and process.poll() is None:
        time.sleep(0.01)
    try:
        assert process.wait(moment) == 0
        return "ended"
    except subprocess.TimeoutExpired:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    how = "resumed" if begun(desk / out) else "early"
    if (desk / out).exists() and not resumable(desk / out):
        shutil.rmtree(desk / out)
    resume = ["--resume"] if (desk / out).exists() else []
    assert started(desk, *COMMANDS[name], "--out", out, *resume).wait() == 0
    return how


def resumable(run: Path) -> bool:
    return (run / "run.json").exists() and any(
        (run / place).exists() for place in ("journal", "checkpoint.safetensors")
    )


def begun(run: Path) -> bool:
    """Whether it has done something that need not be done again."""
    return resumable(run) and ((run / "checkpoint.safetensors").exists() or any(run.glob("journal/*.safetensors")))


def same_results(desk: Path, name: str, out: str) -> None:
    """What the command has made is what it makes undisturbed, and nothing else is left."""
    undisturbed(desk, name)
    for kept in KEPT[name]:  # the record says where the run was written
        ours, theirs = ((desk / run / kept).read_bytes().replace(f"--out {run}".encode(), b"") for run in (out, name))
        assert ours == theirs, kept
    assert not any((desk / out / left).exists() for left in ("journal", LOCK, "previous"))


@pytest.mark.parametrize(
    ("name", "begun"),
    [
        pytest.param("discover", "journal/000004.safetensors", marks=pytest.mark.slow),
        pytest.param("fit", "checkpoint.safetensors", marks=pytest.mark.exhaustive),
    ],
)
def test_a_command_that_is_killed_goes_on_to_the_same_result(desk: Path, name: str, begun: str) -> None:
    out = f"{name}_killed"
    process = started(desk, *COMMANDS[name], "--out", out)
    while not (desk / out / begun).exists():
        assert process.poll() is None
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert started(desk, *COMMANDS[name], "--out", out, "--resume").wait() == 0
    same_results(desk, name, out)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("room", "some"),
    [  # bytes: less than the largest of the pieces, and less than the first
        pytest.param(20_000, True, id="some"),
        pytest.param(4_000, False, id="none"),
    ],
)
def test_a_search_on_a_disk_that_fills_up_goes_on_when_there_is_room(desk: Path, room: int, some: bool) -> None:
    undisturbed(desk, "discover")  # numba's machine code is on the disk then, which has no room for it either
    out = f"full_{room}"
    command = (*COMMANDS["discover"], "--out", out)
    assert started(desk, *command, room=room).wait() == 2
    (said,) = without_progress((desk / "errors").read_text())
    assert said.startswith("steady: ") and said.endswith("cannot be written: File too large")
    if not some:
        assert not (desk / out).exists()
        return
    pieces = sorted((desk / out / "journal").iterdir())
    assert [file.name for file in pieces] == [f"{piece:06d}.safetensors" for piece in range(1, len(pieces) + 1)]
    assert pieces and all(read_tensors(piece) for piece in pieces)  # whole, by their hash
    assert started(desk, *command, "--resume").wait() == 0
    same_results(desk, "discover", out)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", COMMANDS)
def test_twenty_random_kills_change_nothing(desk: Path, name: str) -> None:
    (first, whole), random, caught = undisturbed(desk, name), np.random.default_rng(20), []
    for trial in range(20):
        of_begun = trial % 4 > 0  # the others while it loads, or when it is about to begin
        moment = float(random.uniform(0, whole - first) if of_begun else random.uniform(0, 1.2 * first))
        caught.append(killed_and_resumed(desk, name, f"{name}_{trial}", moment, of_begun=of_begun))
        if caught[-1] == "ended":  # the machine is less busy than when it was timed
            whole = first + 0.8 * (whole - first)
        same_results(desk, name, f"{name}_{trial}")
    assert caught.count("resumed") >= 10, caught


@pytest.mark.slow
def test_a_search_goes_on_with_what_it_was_begun_with_only(desk: Path, refused, monkeypatch) -> None:
    monkeypatch.chdir(desk)
    process = started(desk, *COMMANDS["discover"], "--out", "begun")
    while not any((desk / "begun" / "journal").glob("*.safetensors")):
        assert process.poll() is None
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    command = (*COMMANDS["discover"], "--out", "begun")
    refused(2, "--resume to go on", *command)
    refused(2, "the same options", *command[:-3], "60", "--out", "begun", "--resume")
    other = [word if word != "train.csv" else "valid.csv" for word in command]
    refused(2, "the same training table", *other, "--resume")
    refused(2, "discover has not finished", "check", "begun", "valid.csv")
    refused(2, "name it (--out)", *COMMANDS["discover"], "--resume")
    first = next((desk / "begun" / "journal").glob("*.safetensors"))
    first.write_bytes(first.read_bytes()[:100])
    refused(2, "is damaged", *command, "--resume")
    assert steady(*command, "--force") == 0
    same_results(desk, "discover", "begun")
