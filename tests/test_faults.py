"""What may go wrong around a run: two writers, processes that are killed, disks that are full."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from small import HOVERCRAFT, steady, written

import steady_ppl as st
from steady_ppl.run_folder import LOCK, run_folder

HOLDER = """
import sys
from steady_ppl.run_folder import run_folder
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


def test_of_two_writers_the_second_is_refused(run: Path, writer, tmp_path: Path, refused) -> None:
    command = ("fit", HOVERCRAFT, tmp_path / "table.csv", "--recipe", "hand", "--force", "--out", run)
    refused(2, "another process writes to it", *command)
    writer.stdin.close()
    writer.wait()
    assert steady(*command) == 0
    assert not (run / LOCK).exists()


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
