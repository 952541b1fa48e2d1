"""The tutorial, typed from its first line to its last: on a log of one's own with other names, and on its own log."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from examples import MODELS, example

import steady_ppl as st

TUTORIAL = MODELS.parent / "docs" / "tutorial.md"
COLUMNS = {"trajectory": "drive", "time": "t", "u.left": "left", "u.right": "right"}
COLUMNS |= {"y.gps_x": "gps_x", "y.gps_y": "gps_y", "y.compass": "compass"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A log with names of its own and a column that nobody asked for, beside the models."""
    log = st.to_frame(st.simulate(example("gps_boat.py:GpsBoatTruth"), 18, seed=1))
    log[list(COLUMNS)].rename(columns=COLUMNS).assign(note="windy").to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "models").symlink_to(MODELS)
    return tmp_path


def blocks() -> list[tuple[str, str]]:
    """Languages and texts, in their order."""
    return re.findall(r"^```(sh|python)\n(.*?)^```", TUTORIAL.read_text(), re.MULTILINE | re.DOTALL)


def typed(folder: Path, command: list[str]) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_log_becomes_three_tables(folder: Path) -> None:
    (script,) = [text for language, text in blocks() if language == "python"]
    typed(folder, [sys.executable, "-c", script])
    tables = {name: st.read_table(folder / f"{name}.csv") for name in ("train", "valid", "test")}
    assert [len(table) for table in tables.values()] == [6, 5, 7]
    assert all(table.measurement_names == ("gps_x", "gps_y", "compass") for table in tables.values())


@pytest.mark.exhaustive
def test_it_ends_with_a_program_that_predicts_better_and_a_page(folder: Path) -> None:
    steady = shutil.which("steady", path=str(Path(sys.executable).parent))
    assert steady is not None
    said = {}
    for language, text in blocks():
        if language == "python":
            typed(folder, [sys.executable, "-c", text])
            continue
        for line in text.splitlines():
            name, *words = shlex.split(line)
            if name == "sed":
                (folder / "mine.py").write_text(typed(folder, [name, *words[:2]]))
            else:
                said[" ".join(words[:2])] = typed(folder, [steady, *words])
    assert "does not fit these trajectories" in said["check runs/before"]
    assert "lack yaw_linear_drag" in said["discover runs/before"]
    assert "class " in (folder / "mine_after.py").read_text()
    first = re.findall(r"^(before|after) +([−\d.]+)", said["prove runs/before"], re.MULTILINE)[:2]  # rows: log p(y)
    levels = dict(first)
    before, after = (float(levels[name].replace("−", "-")) for name in ("before", "after"))
    assert after > before + 20  # nats a drive
    assert (folder / "report.html").stat().st_size < 6_000_000
