"""A disk that is full, or a folder that cannot be written: one line, nothing half-written, what was there stays.

The disk is full for this process alone: no file of it may grow beyond a limit.
"""

from __future__ import annotations

import os
import resource
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from small import FEW, HOVERCRAFT, QUICK, contents, steady, tree

WRITING = {
    "simulate a table": ("simulate", HOVERCRAFT, "--trajectories", 2, "--out", "{out}/new.csv"),
    "simulate Parquet": ("simulate", HOVERCRAFT, "--trajectories", 2, "--out", "{out}/new.parquet"),
    "fit": ("fit", HOVERCRAFT, "{work}/train.csv", "--out", "{out}/run", *FEW),
    "fit hand": ("fit", HOVERCRAFT, "{work}/train.csv", "--recipe", "hand", "--out", "{out}/run"),
    "check": ("check", "{work}/hand", "{work}/train.csv", "--simulations", 20, "--json", "{out}/check.json"),
    "check's picture": (
        "check",
        "{work}/hand",
        "{work}/train.csv",
        "--simulations",
        20,
        "--picture",
        "{out}/check.png",
    ),
    "states": ("states", "{work}/hand", "{work}/train.csv", "--draws", 5, "--out", "{out}/states.csv"),
    "states as netCDF": ("states", "{work}/hand", "{work}/train.csv", "--draws", 5, "--out", "{out}/states.nc"),
    "init": ("init", "{out}/lab"),
    "data cut": ("data", "cut", "{work}/valid.parquet", "--seconds", 1, "--out", "{out}/pieces.csv"),
    "evaluate": ("evaluate", "{work}/hand", "{work}/train.csv", *QUICK, "--json", "{out}/errors.json"),
    "prove": ("prove", "{work}/hand", "{work}/steady", "{work}/test.csv", "--json", "{out}/proof.json"),
    "prove's picture": ("prove", "{work}/hand", "{work}/steady", "{work}/test.csv", "--picture", "{out}/proof.png"),
    "check's mask": ("check", "{work}/hand", "{work}/train.csv", "--simulations", 20, "--mask", "{out}/masked.csv"),
    "demo": ("demo", "--out", "{out}/demo"),
    "add": ("add", "{out}/hovercraft.py", "wind=1,1", "--out", "{out}/windy.py"),
    "study": ("study", "{work}/study.toml", "--workers", 1, "--out", "{out}/study"),
    "study's picture": ("plot-study", "{work}/study", "--out", "{out}/study.png"),
    "report": ("report", "{work}/hand", "{work}/valid.parquet", "--simulations", 20, "--out", "{out}/report.html"),
}

ONE_JOB = f"""
title = "One job"
seeds = [1]
known_start = true
[data]
simulate = "{HOVERCRAFT}"
train = 2
valid = 2
test = 2
[[method]]
name = "as declared"
program = "{HOVERCRAFT}"
recipe = "hand"
[picture]
x = "data.train"
y = ["log_likelihood"]
"""


@pytest.fixture(scope="module")
def studied(work: Path) -> None:
    """A study of one job beside the tables and runs."""
    (work / "study.toml").write_text(ONE_JOB)
    assert steady("study", work / "study.toml", "--workers", 1, "--out", work / "study") == 0


@contextmanager
def full_beyond(size: int) -> Iterator[None]:
    """No file grows beyond `size` bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def words(command: tuple, work: Path, out: Path) -> list[object]:
    return [word.format(work=work, out=out) if isinstance(word, str) else word for word in command]


@pytest.mark.slow
@pytest.mark.usefixtures("studied")
@pytest.mark.parametrize(
    "size",
    [pytest.param(0, id="nothing fits", marks=pytest.mark.exhaustive), pytest.param(2000, id="two kilobytes fit")],
)
@pytest.mark.parametrize("name", WRITING)
def test_a_full_disk_is_one_line_and_leaves_nothing(name: str, size: int, work: Path, tmp_path: Path, capsys) -> None:
    shutil.copy(HOVERCRAFT, tmp_path)
    before = contents(tmp_path), tree(tmp_path)
    capsys.readouterr()
    with full_beyond(size):
        code = steady(*words(WRITING[name], work, tmp_path))
    if code == 0:
        assert name in ("add", "evaluate") and size > 0  # a short file
        return
    *notes, said = capsys.readouterr().err.splitlines()
    assert code in (1, 2) and said.startswith("steady: ") and "cannot be written: " in said, said
    assert said.endswith("File too large") and not any("Error" in note or "Traceback" in note for note in notes)
    if name == "study":  # its folder is gone on with
        assert steady(*words(WRITING[name], work, tmp_path)) == 0
    elif (tmp_path / "run").exists():
        resumed(name, work, tmp_path)
    else:
        assert (contents(tmp_path), tree(tmp_path)) == before


def resumed(name: str, work: Path, out: Path) -> None:
    """What is left of a run has a checkpoint: once there is room it goes on from there."""
    assert name == "fit" and (out / "run" / "checkpoint.safetensors").is_file()
    assert steady("check", out / "run", work / "train.csv") == 2  # it is no finished run
    assert steady(*words(WRITING[name], work, out), "--resume") == 0


@pytest.mark.parametrize("size", [0, 300, 2000])
def test_an_overwritten_run_comes_back_when_the_disk_is_full(size: int, work: Path, tmp_path: Path, capsys) -> None:
    shutil.copytree(work / "steady", tmp_path / "run")
    before = contents(tmp_path / "run")
    with full_beyond(size):
        code = steady("fit", HOVERCRAFT, work / "train.csv", "--out", tmp_path / "run", *FEW, "--force")
    assert code in (1, 2) and "cannot be written" in capsys.readouterr().err
    assert contents(tmp_path / "run") == before


def test_the_last_good_checkpoint_stays_when_the_disk_is_full(work: Path, tmp_path: Path, capsys) -> None:
    from steady_ppl.errors import RunError
    from steady_ppl.utils.tensor_files import read_tensors, write_tensors

    tensors, said = read_tensors(work / "steady" / "checkpoint.safetensors")
    file = tmp_path / "checkpoint.safetensors"
    write_tensors(file, tensors, said)
    good = file.read_bytes()
    with full_beyond(len(good) // 2), pytest.raises(RunError, match="cannot be written"):
        write_tensors(file, tensors, {**said, "step": "99"})
    assert file.read_bytes() == good and [path.name for path in tmp_path.iterdir()] == [file.name]


@pytest.fixture
def locked(tmp_path: Path) -> Path:
    """A folder that nobody can write to; root can in any but the kernel's own."""
    folder = Path("/sys/kernel") if os.geteuid() == 0 else tmp_path / "locked"
    if not folder.exists():
        folder.mkdir(mode=0o500)
    return folder


@pytest.mark.slow
@pytest.mark.usefixtures("studied")
@pytest.mark.parametrize("name", [name for name in WRITING if name != "add"])
def test_a_folder_that_cannot_be_written_is_one_line(name: str, work: Path, locked: Path, capsys) -> None:
    capsys.readouterr()
    assert steady(*words(WRITING[name], work, locked)) in (1, 2)
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith("steady: ") and "cannot be written: " in said
