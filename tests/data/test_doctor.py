"""What the doctor finds in a table, where, and what mends it."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from conftest import steady
from examples import example

import steady_ppl as st
from steady_ppl.data.table import to_frame
from steady_ppl.errors import DataError


@pytest.fixture(scope="module")
def clean() -> pd.DataFrame:
    """Five drives of a boat that water brakes, as a GPS and a compass see them."""
    program = st.load_program("models/gps_boat.py:GpsBoatTruth")
    return to_frame(st.simulate(program, 5, seed=3).without_truth())


def angle(values):
    return np.angle(np.exp(1j * values))


def put(column, rows, value):
    def spoil(frame):
        return frame.assign(**{column: frame[column].astype(object).where(~frame.index.isin(rows), value)})

    return spoil


def line(frame):
    """A gap that somebody filled up."""
    return frame.assign(**{"y.gps_x": frame["y.gps_x"].where(~frame.index.isin(range(20, 50))).interpolate()})


def apart(frame):
    since = frame["time"] - frame.groupby("trajectory")["time"].transform("first")
    return frame.iloc[np.argsort(since, kind="stable")].reset_index(drop=True)


def with_dates(frame):
    stamps = pd.to_datetime((frame["time"] + 1.7e9) * 1e9)
    return frame.assign(time=stamps.dt.strftime("%Y-%m-%dT%H:%M:%S.%f"))


SPOILED = {
    "code": (put("y.gps_y", [5, 40, 41], -9999.0), "y.gps_y", "-9999"),
    "degrees": (lambda f: f.assign(**{"y.compass": np.rad2deg(f["y.compass"]) % 360}), "y.compass", "degrees"),
    "heading": (lambda f: f.assign(**{"y.compass": angle(np.pi / 2 - f["y.compass"])}), "y.compass", "from north"),
    "time unit": (lambda f: f.assign(time=(f["time"] * 1e3).round()), "time", "milliseconds"),
    "dates": (with_dates, "time", "dates"),
    "text": (put("y.gps_x", [7], "n/a"), "y.gps_x", "n/a"),
    "constant": (lambda f: f.assign(**{"u.left": 3.0}), "u.left", "3 in every row"),
    "empty": (lambda f: f.assign(**{"y.sonar": np.nan}), "y.sonar", "every cell"),
    "outlier": (
        lambda f: f.assign(**{"y.gps_x": f["y.gps_x"] + 400.0 * f.index.isin([30, 31, 32])}),
        "y.gps_x",
        "3 readings jump",
    ),
    "copy": (lambda f: f.assign(**{"y.again": 3.6 * f["y.gps_x"]}), "y.again", "3.6 times y.gps_x"),
    "frozen": (line, "y.gps_x", "interpolated"),
    "gap": (lambda f: f.assign(time=f["time"] + 90.0 * (f.index >= 900)), "time", "longest 90.1"),
    "time": (lambda f: f.assign(time=f["time"].where(f.index != 12, f["time"].shift(2))), "time", "go back"),
    "one row": (lambda f: pd.concat([f.iloc[:1].assign(trajectory="a"), f]), None, "one row"),
    "apart": (apart, None, "several places"),
    "overlap": (lambda f: pd.concat([f, f.iloc[50:120].assign(trajectory="a")]), None, "overlap"),
}


def written(folder, frame, name="drives.csv"):
    file = folder / name
    frame.to_csv(file, index=False)
    return file


def test_nothing_is_suspicious_in_a_clean_table(clean, tmp_path):
    found = st.doctor(written(tmp_path, clean), example("gps_boat"))
    assert found.findings == [] and str(found) == "drives.csv: 5 trajectories, 1005 rows; nothing is suspicious."


@pytest.mark.parametrize("kind", SPOILED)
def test_what_is_wrong_is_named_with_its_column_and_alone(clean, tmp_path, kind):
    spoil, column, told = SPOILED[kind]
    found = st.doctor(written(tmp_path, spoil(clean)), example("gps_boat"))
    assert [one.kind for one in found.findings] == [kind]
    (one,) = found.findings
    assert one.column == column and told in one.why and one.mend and one.mend in str(found)


@pytest.mark.parametrize(
    "kind", ["code", "degrees", "heading", "time unit", "dates", "copy", "empty", "one row", "apart"]
)
def test_its_line_mends_the_table(clean, tmp_path, kind):
    """The doctor has nothing to say of the table that the line leaves."""
    spoil, *_ = SPOILED[kind]
    file = written(tmp_path, spoil(clean))
    (one,) = st.doctor(file).findings
    room = {"table": pd.read_csv(file, dtype={"trajectory": str}), "pd": pd, "np": np}
    exec(one.mend, room)
    mended = written(tmp_path, room["table"])
    assert st.doctor(mended).findings == []
    data = st.read_table(mended)
    assert len(data) == 5 and float(data.steps[data.transitions].mean()) == pytest.approx(0.1, rel=1e-3)


def test_the_line_that_reads_it_takes_every_dialect(clean, tmp_path):
    """Labels such as 007 stay as they are."""
    file = tmp_path / "drives.csv"
    header, _, rest = (
        clean.assign(trajectory="00" + clean["trajectory"].astype(str)).to_csv(index=False).partition("\n")
    )
    rest = rest.replace(",", ";").replace(".", ",")
    text = f"# from a boat\n{header.replace(',', ' ; ')}\n-;s;N;N;m;m;rad\n{rest}"
    file.write_bytes(text.encode("utf-16"))
    room = {}
    exec(st.doctor(file).reading.replace(repr(file.name), repr(str(file))), room)
    table = room["table"]
    assert list(table.columns) == list(clean.columns) and set(table["trajectory"]) == {f"00{k}" for k in range(1, 6)}
    assert np.allclose(table.drop(columns="trajectory").astype(float), clean.drop(columns="trajectory"), equal_nan=True)


def still(frame):
    """A vehicle that stands for two seconds at the beginning of each drive."""
    since = frame["time"] - frame.groupby("trajectory")["time"].transform("first")
    return frame.assign(**{"y.speed": np.where(since < 2, 0.0, 3 + 0.1 * np.sin(since) + 0.01 * frame["y.gps_x"])})


def resting(frame):
    return frame.assign(**{"u.left": np.where(frame.index % 100 < 80, 0.0, 1 + frame.index % 7)})


def oddly_named(frame):
    return frame.assign(**{"u.controller": 20 + frame["u.left"] ** 2, "y.roller_torque": frame["y.gps_x"] ** 2 + 60})


HARMLESS = {
    "a vehicle that stands still": still,
    "a joystick that is mostly at rest": resting,
    "an encoder's whole numbers": lambda f: f.assign(**{"y.ticks": np.floor(f.index % 201 / 15)}),
    "a range that is clipped": lambda f: f.assign(**{"y.range": (f["y.gps_x"].abs() + 1).clip(upper=8.0)}),
    "names that hold parts of angles": oddly_named,
    "rows of 30 s": lambda f: f.assign(time=300 * f["time"]),
}


@pytest.mark.parametrize("what", HARMLESS)
def test_what_logs_ordinarily_hold_is_not_suspicious(clean, tmp_path, what):
    program = example("gps_boat")
    if what == "rows of 30 s":
        program.step = 30.0
    assert st.doctor(written(tmp_path, HARMLESS[what](clean)), program).findings == []


def test_a_label_for_several_drives_gets_new_labels(clean, tmp_path):
    file = written(tmp_path, clean.assign(trajectory="all"))
    (one,) = st.doctor(file).findings
    assert one.kind == "time" and "one label for several trajectories" in one.why
    room = {"table": pd.read_csv(file, dtype={"trajectory": str})}
    exec(one.mend, room)
    assert len(st.read_table(written(tmp_path, room["table"]))) == 5


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("trajectory,time,y.range\n", "the table has no rows"),
        ("trajectory,time,y.range,y.range\na,0,1,1\na,1,2,2\n", "column y.range: this column appears twice"),
    ],
)
def test_a_table_that_holds_nothing_or_a_column_twice_is_refused(tmp_path, text, says):
    (tmp_path / "drives.csv").write_text(text)
    with pytest.raises(DataError, match=says):
        st.doctor(tmp_path / "drives.csv")


def test_what_the_reader_refuses_is_a_finding_beside_the_others(clean, tmp_path):
    """An empty command within a drive, and a code in another column."""
    frame = clean.assign(**{"u.left": clean["u.left"].where(clean.index != 50)})
    found = st.doctor(written(tmp_path, SPOILED["code"][0](frame)))
    assert [one.kind for one in found.findings] == ["code", "refused"] and "u.left" in found.findings[1].why


def test_a_command_that_cannot_read_a_table_names_the_doctor(clean, tmp_path, capsys):
    file = written(tmp_path, SPOILED["dates"][0](clean))
    assert steady("fit", "models/gps_boat.py", file, "--recipe", "hand", "--out", tmp_path / "run") == 2
    (told,) = capsys.readouterr().err.splitlines()
    assert "column time" in told and told.endswith(f"(`steady doctor {file}` says how to mend it)")


def test_axes_that_are_swapped_are_told_by_the_known_states(tmp_path):
    program = st.load_program("models/gps_boat.py:GpsBoatTruth")
    frame = to_frame(st.simulate(program, 5, seed=3)).rename(columns={"y.gps_x": "y.gps_y", "y.gps_y": "y.gps_x"})
    (found,) = st.doctor(written(tmp_path, frame)).findings
    assert found.kind == "axes" and "are y.gps_x and y.gps_y swapped" in found.why


def test_zeros_among_a_range_far_from_zero_are_codes(clean, tmp_path):
    rows = np.random.default_rng(0).choice(len(clean), 60, replace=False)
    far = clean.assign(**{"y.gps_x": clean["y.gps_x"] + 3000.0})
    far.loc[rows, "y.gps_x"] = 0.0
    (found,) = st.doctor(written(tmp_path, far)).findings
    assert (found.kind, found.column, found.cells) == ("code", "y.gps_x", 60)


def test_states_that_count_their_turns_are_no_degrees(tmp_path):
    program = example("gps_boat")
    data = st.simulate(program, 3, seed=0)
    frame = to_frame(data)
    frame["x.heading"] = frame["x.heading"] + 3 * frame["time"]  # a boat that spins
    assert "degrees" not in [one.kind for one in st.doctor(frame, program).findings]


def test_a_table_that_was_read_is_examined_as_well(clean):
    data = st.from_frame(clean.assign(**{"u.left": 3.0}))
    assert [one.kind for one in st.doctor(data).findings] == ["constant"]


def test_a_table_without_time_is_refused(clean, tmp_path):
    with pytest.raises(DataError, match="column time: this column is missing"):
        st.doctor(written(tmp_path, clean.drop(columns="time")))


def test_the_command_prints_a_screen_and_writes_the_findings(clean, tmp_path, capsys):
    file, figures = written(tmp_path, SPOILED["code"][0](clean)), tmp_path / "found.json"
    assert steady("doctor", file, "models/gps_boat.py", "--json", figures) == 0
    said = capsys.readouterr()
    assert said.err == "" and len(said.out.splitlines()) <= 24
    assert "1. y.gps_y, trajectory 1: 3 cells are -9999, all others between" in said.out
    assert 'table.loc[table["y.gps_y"] == -9999, "y.gps_y"] = float("nan")' in said.out
    (one,) = json.loads(figures.read_text())["findings"]
    assert (one["kind"], one["column"], one["trajectories"], one["cells"]) == ("code", "y.gps_y", ["1"], 3)


def test_a_row_of_units_and_comments_are_told(clean, tmp_path, capsys):
    file = tmp_path / "drives.csv"
    header, _, rest = clean.to_csv(index=False).partition("\n")
    file.write_text(f"# from a boat\n{header}\n-,s,N,N,m,m,rad\n{rest}")
    assert steady("doctor", file) == 0
    said = capsys.readouterr().out
    assert "Read with 1 comment line before the header, a row of units (-, s, N, N, m, m, rad)." in said
    assert "read it with --units-row" in said
    assert steady("doctor", file, "--units-row") == 0
    assert "nothing is suspicious" in capsys.readouterr().out


def test_commands_that_read_drives_say_what_is_suspicious(clean, tmp_path, capsys):
    file = written(tmp_path, SPOILED["code"][0](clean))
    assert steady("fit", "models/gps_boat.py", file, "--recipe", "hand", "--out", tmp_path / "run") == 0
    (noted,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("steady: drives.csv: y.gps_y")]
    assert "3 cells are -9999" in noted and noted.endswith(f"(`steady doctor {file}` says how to mend it)")
