"""`steady new`: from a log to a model that reads it, and one line for whatever is wrong."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pandas as pd
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
        ("name the vehicle by --vehicle KIND; there are car (speed [m/s], steering [rad])", []),
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
        ("log.csv: which columns are speed [m/s], turn [rad/s]? say it", ["log.csv", "--vehicle", "unicycle"]),
        ("--control v=foo: no vehicle has a control foo; there are car", ["log.csv", "--control", "v=foo"]),
        ("log.csv: no vehicle has its controls (v_kmh,", ["log.csv", "--control", "v=turn"]),
        ("log.csv has no columns of compass in rad; it has", ["log.csv", "--sensor", "heading=compass:0.1"]),
        (
            "--control nope=steering: log.csv has no column nope; it has v_kmh,",
            ["log.csv", "--control", "nope=steering"],
        ),
        ("--control v=right: v is named twice", ["--control", "v=left", "--control", "v=right"]),
        ("--control b=left: left is named twice", ["--control", "a=left", "--control", "b=left"]),
        ("from_north is true or false, got 'yes'", ["--vehicle", "car", "--sensor", "heading:1,from_north=yes"]),
        ("angle is not true or false, got 'true'", ["--vehicle", "car", "--sensor", "heading:1,angle=true"]),
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


def guessed_of(tmp_path: Path, capsys: pytest.CaptureFixture, columns: str, *flags: str, **cells: object) -> list[str]:
    """What `steady new` guesses of a table with some columns, of noise unless `cells` says what is in one."""
    noise = np.random.default_rng(0).normal(size=(40, 20))
    frame = pd.DataFrame({"trajectory": "1", "time": np.arange(40) / 10})
    for index, name in enumerate(columns.split()):
        frame[name] = cells.get(name.rpartition(".")[2], 0.1 * noise[:, index])
    frame.rename(columns=lambda name: name.replace("~", " ")).to_csv(tmp_path / "log.csv", index=False)
    out = ("--table-out", tmp_path / "drives.csv") if "~" in columns else ()
    assert steady("new", tmp_path / "mine.py", tmp_path / "log.csv", *flags, *out, "--force") == 0
    told = capsys.readouterr().out.partition("guessed, to be checked:\n")[2]
    return re.findall(r"^  (.*)$", told.partition("\nnext:")[0], re.MULTILINE)


def test_a_vehicle_s_own_columns_are_its_own_sensors(tmp_path: Path, capsys) -> None:
    program = st.load_program(MODELS / "differential_drive.py")
    program.duration = 6.0
    table = written(tmp_path / "drives.csv", st.simulate(program, 2, seed=0))
    assert steady("new", tmp_path / "mine.py", table) == 0
    named = [(type(one), one.name, getattr(one, "left", None), getattr(one, "size", None)) for one in program.sensors]
    mine = st.load_program(tmp_path / "mine.py").sensors
    assert [(type(one), one.name, getattr(one, "left", None), getattr(one, "size", None)) for one in mine] == named
    assert "fits as well" not in capsys.readouterr().out


def test_a_wheel_is_on_its_side_or_said_to_stand_in_the_middle(tmp_path: Path, capsys) -> None:
    drive = "u.left_wheel u.right_wheel y.tag_x y.tag_y y.wheel_speed_left y.right_odo~[m/s] y.odo~[m]"
    told = guessed_of(tmp_path, capsys, drive, "--sensor=encoder=odo")
    wheels = {one.name: one for one in st.load_program(tmp_path / "mine.py").sensors}
    assert (wheels["wheel_speed_left"].left, wheels["right_odo"].left) == ("half_track", "minus_half_track")
    assert wheels["odo"].kind == "encoder" and "odo: left = 0 m, it stands on the middle line" in told
    assert not any("wheel_speed_left: left" in one for one in told)
    told = guessed_of(tmp_path, capsys, "u.speed u.steering y.gps_x y.gps_y y.encoder")
    assert "encoder: encoder; wheel speed fits as well" in told
    told = guessed_of(tmp_path, capsys, "u.speed u.steering y.gps_x y.gps_y y.encoder~[m/s]")
    assert st.load_program(tmp_path / "mine.py").sensors[1].kind == "wheel speed"
    assert not any("fits as well" in one and "encoder" in one for one in told)


def test_two_sensors_do_not_share_what_is_learned(tmp_path: Path, capsys) -> None:
    told = guessed_of(tmp_path, capsys, "u.speed u.steering y.tag_x y.tag_y y.gps_x y.gps_y")
    sensors = {one.name: one for one in st.load_program(tmp_path / "mine.py").sensors}
    assert sensors["gps"].offset == "antenna" and sensors["tag"].offset is None
    assert "offset of tag: none (antenna is that of another sensor)" in told


def test_the_simplest_vehicle_is_taken_and_a_compass_s_north_is_asked_for(tmp_path: Path, capsys) -> None:
    columns = "u.speed u.steering y.gps_x y.gps_y y.compass"
    told = guessed_of(tmp_path, capsys, columns)
    assert told[0] == "the vehicle: car; --vehicle dynamic_bicycle fits as well"
    (north,) = [one for one in told if one.startswith("compass counts from x anticlockwise; if from north: ")]
    told = guessed_of(tmp_path, capsys, columns, *north.partition("north: ")[2].split())
    assert not any("counts from" in one for one in told)
    assert {one.name: one for one in st.load_program(tmp_path / "mine.py").sensors}["compass"].from_north is True
    (north,) = [one for one in guessed_of(tmp_path, capsys, f"{columns[:-9]} y.gps_heading") if "counts from" in one]
    assert (
        north == "gps_heading counts from x anticlockwise; if from north: --sensor heading=gps_heading,from_north=true"
    )
    told = guessed_of(tmp_path, capsys, "u.left u.right y.gps_x y.gps_y y.compass")
    assert told[0] == "the vehicle: thruster_boat; --vehicle planar_quadrotor fits as well"


def test_units_that_nobody_said_are_listed(tmp_path: Path, capsys) -> None:
    columns, sticks = "u.speed u.steering y.gps_x y.gps_y y.gyro~[deg/s]", np.linspace(-1, 1, 40)
    told = guessed_of(tmp_path, capsys, columns, steering=sticks)
    assert {"u.speed is taken in m/s", "u.steering is taken in rad", "y.gps_x, y.gps_y are taken in m"} < {*told}
    assert "u.steering looks like a share of full lock, not rad" in told and not any("y.gyro" in one for one in told)
    assert "u.steering looks like degrees, not rad" in guessed_of(tmp_path, capsys, columns, steering=30 * sticks)
    told = guessed_of(tmp_path, capsys, columns, steering=0.5 * sticks)
    assert not any("looks like" in one for one in told)


@pytest.mark.parametrize(
    ("says", "cells", "renamed"),
    [
        ("column u.steering, trajectory 1, row 1: got an empty cell", {"u.steering": np.nan}, {}),
        ("there is no column trajectory: name a table", {}, {"trajectory": None}),
        ("are these microseconds? call it timestamp_us", {"time": 1e5 * np.arange(40)}, {"time": "timestamp"}),
        ("begins at 1.7e+09, rows are 60 apart: are these milliseconds?", {"time": 1.7e9 + 60 * np.arange(40)}, {}),
    ],
)
@pytest.mark.filterwarnings("error:All-NaN")
def test_nothing_is_written_for_a_table_that_is_refused(
    says: str, cells: dict, renamed: dict, log: Path, tmp_path: Path, refused
) -> None:
    frame = pd.DataFrame({"trajectory": "1", "time": np.arange(40) / 10, "u.speed": 1.0, "u.steering": 0.1})
    frame = frame.assign(**{"y.gps_x": np.random.default_rng(0).normal(size=40)}).assign(**{"y.gps_y": frame.time})
    frame = frame.assign(**cells).rename(columns={old: now for old, now in renamed.items() if now})
    frame.drop(columns=[old for old, now in renamed.items() if not now]).to_csv(tmp_path / "bad.csv", index=False)
    out = [] if renamed.get("trajectory", "") is None else ["--table-out", tmp_path / "drives.csv"]
    refused(2, says, "new", tmp_path / "mine.py", tmp_path / "bad.csv", "--sensor=position=gps:0.3", *out)
    assert not (tmp_path / "mine.py").exists() and not (tmp_path / "drives.csv").exists()


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
