"""`steady new`: from a log to a model that reads it, and one line for whatever is wrong."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import typer
from examples import MODELS
from small import steady, written

import steady_ppl as st
from steady_ppl.cli.main import app
from steady_ppl.data.table import to_frame

OPTIONS = [name for one in typer.main.get_command(app).commands["new"].params for name in one.opts]
CASES = MODELS.parents[1] / "shared" / "cases"
MAP = [f"--landmark={x},{y}" for x, y in ((0, 0), (5, 0), (5, 5), (0, 5))]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A log with names and units of its own, whose drives begin kilometres apart."""
    program = st.load_program(MODELS / "car.py")
    program.duration = 6.0
    frame = to_frame(st.simulate(program, 5, seed=3))
    away = frame.trajectory.astype(int) * 1000.0
    own = frame[["time"]].rename(columns={"time": "t"})
    own["v_kmh"], own["delta_deg"] = 3.6 * frame["u.speed"], np.degrees(frame["u.steering"])
    own["easting [m]"], own["northing [m]"] = frame["y.gps_x"] + away, frame["y.gps_y"] - away
    own["gyro_dps"], own["battery"] = np.degrees(frame["y.gyro"]), 12.0
    own.insert(0, "Lap", frame.trajectory)
    own.to_csv(tmp_path / "log.csv", index=False)
    return tmp_path / "log.csv"


def test_a_log_with_names_of_its_own_becomes_a_model_and_a_table(
    log: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    assert steady("new", "mine.py", "log.csv", "--sensor", "position=gps:0.4", "--table-out", "drives.csv") == 0
    said = capsys.readouterr().out
    assert "controls: v (speed), delta (steering)" in said and "sensors: gps (position), gyro (yaw rate)" in said
    assert "sd of gyro" in said and "sd of gps" not in said and "not used: battery" in said
    assert "steady fit mine.py drives.csv --recipe likelihood --out runs/mine" in said
    program, drives = st.load_program("mine.py"), st.read_table("drives.csv")
    assert program.sensors[0].sd == 0.4 and program.start == "first measurements"
    assert drives.control_names == ("v", "delta") and float(drives.controls[..., 1].abs().max()) < 0.5
    read = st.for_program(program, drives)
    assert len(read) == 5 and float(read.measurements[0, 4, 0]) > 4500


def test_a_table_of_ranges_and_bearings_needs_its_landmarks(tmp_path: Path, capsys, refused) -> None:
    program = st.load_program(MODELS / "unicycle.py")
    program.duration = 4.0
    table = written(tmp_path / "drives.csv", st.simulate(program, 3, seed=0))
    refused(2, "the sensors see 4 landmarks: name each by --landmark X,Y", "new", tmp_path / "robot.py", table)
    refused(2, "are of 4 landmarks, --landmark names 3", "new", tmp_path / "robot.py", table, *MAP[:3])
    capsys.readouterr()
    assert steady("new", tmp_path / "robot.py", table, *MAP) == 0
    said = capsys.readouterr().out
    assert "the vehicle: unicycle" in said and "next:" in said
    robot = st.load_program(tmp_path / "robot.py")
    assert {*robot.measurement_names} == {*program.measurement_names} and robot.landmarks[2] == (5.0, 5.0)
    assert 0.05 < robot.sensors[0].sd < 0.2  # .1 m
    refused(2, "exists: choose another name, or --force", "new", tmp_path / "robot.py", table, *MAP)


def test_the_section_of_the_page_is_what_it_says(log: Path, monkeypatch, capsys) -> None:
    """But for the figures of its drives."""
    monkeypatch.chdir(log.parent)
    page = (MODELS.parent / "docs" / "own-data.md").read_text()
    section = page.partition("## From its columns to a model")[2].partition("\n## ")[0]
    (command,) = re.findall(r"```sh\nsteady (.*)\n```", section)
    (told,) = re.findall(r"```text\n(.*?)\n```", section, re.DOTALL)
    header = log.read_text().partition("\n")[0]
    assert header in section and steady(*command.split()) == 0
    without_figures = [re.sub(r"\d\S*", "#", text).split() for text in (told, capsys.readouterr().out)]
    assert without_figures[0] == without_figures[1]
    assert set(re.findall(r"^\| `(--[a-z]+)", section, re.MULTILINE)) < {*OPTIONS}


@pytest.mark.parametrize(
    ("says", "arguments"),
    [
        ("name the vehicle by --vehicle KIND; there are car (speed, steering)", []),
        ("there is no such vehicle; there are car", ["--vehicle", "boot"]),
        ("no kind of sensor is 'sonar'; there are ", ["--vehicle", "car", "--sensor", "sonar:1"]),
        ("sd is a number above zero, got -1", ["--vehicle", "car", "--sensor", "position=gps:-1"]),
        ("'foo' is no setting; there are sd, name, offset", ["--vehicle", "car", "--sensor", "position:1,foo=1"]),
        ("its standard deviation is missing", ["--vehicle", "car", "--sensor", "wheel-speed"]),
        ("a sensor's name is one word, got 'a b'", ["--vehicle", "car", "--sensor", "position=a b:1"]),
        ("expected two numbers, X,Y in m", ["--vehicle", "car", "--sensor", "range:1", "--landmark", "1"]),
        ("no sensor of this model sees landmarks", ["--vehicle", "car", "--landmark", "1,1"]),
        ("car has no control foo; it has speed, steering", ["--vehicle", "car", "--control", "v=foo"]),
        ("expected COLUMN=CONTROL", ["--vehicle", "car", "--control", "v"]),
        ("no.csv: there is no such file", ["no.csv"]),
        ("its columns have other names than a model's", ["log.csv"]),
        ("log.csv: which columns are speed, turn? say it by --control", ["log.csv", "--vehicle", "unicycle"]),
        ("log.csv: no vehicle has its controls (v_kmh,", ["log.csv", "--control", "v=foo"]),
        ("log.csv has no columns of compass", ["log.csv", "--sensor", "heading=compass:0.1"]),
        ("is the table itself: choose another name", ["log.csv", "--table-out", "log.csv", "--force"]),
    ],
)
def test_what_is_wrong_is_one_line(says: str, arguments: list[str], log: Path, monkeypatch, refused) -> None:
    monkeypatch.chdir(log.parent)
    refused(2, says, "new", "mine.py", *arguments, folder=log.parent)


def test_at_a_terminal_it_asks_for_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    answers, asked = iter(["unicycle", "0,0 4,0"]), []
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    monkeypatch.setattr("typer.prompt", lambda question, **_: asked.append(question) or next(answers))
    assert steady("new", tmp_path / "robot.py") == 0
    assert asked[0].startswith("Vehicle: ") and asked[1].startswith("Places of the landmarks")
    assert st.load_program(tmp_path / "robot.py").landmarks == ((0.0, 0.0), (4.0, 0.0))
    assert "the sensors: those of the vehicle's own file" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.skipif(not CASES.is_dir(), reason="needs the published logs in ../shared/cases")
@pytest.mark.parametrize("case", ["victoria_park", "mrclam"])
def test_a_published_log_is_fitted_without_an_edit(case: str, tmp_path: Path, monkeypatch, capsys) -> None:
    """Six drives of each; landmarks and standard deviations are flags."""
    owners = st.load_program(next(file for file in (CASES / case).glob("*.py") if file.stem in ("robot", "car")))
    table = st.read_table(CASES / case / "train.csv")
    st.write_table(table.subset(range(6)), tmp_path / "train.csv")
    monkeypatch.chdir(tmp_path)
    flags = [f"--landmark={x},{y}" for x, y in owners.landmarks]
    flags += (
        ["--sensor=position=gps:0.3"] if case == "victoria_park" else ["--sensor=range:0.09", "--sensor=bearing:0.03"]
    )
    assert steady("new", "mine.py", "train.csv", *flags) == 0
    said = capsys.readouterr().out
    assert "sd of" not in said
    (fit,) = [words for words in commands_of(said) if words[0] == "fit"]
    assert steady(*fit) == 0
    fitted = st.Fit.load("runs/mine").program
    if case == "mrclam":
        assert 0.8 < float(fitted.speed_gain.detach()) < 1.1 and 0.7 < float(fitted.turn_gain.detach()) < 1.1
    else:
        assert 2.3 < float(fitted.wheelbase.detach()) < 3.2


def commands_of(said: str) -> list[list[str]]:
    """The commands that are proposed."""
    page = said.partition("next:\n")[2]
    return [line.split()[1:] for line in page.splitlines() if line.strip().startswith("steady ")]
