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
    mended = st.doctor(written(tmp_path, room["table"]))
    assert mended.findings == []
    assert len(st.read_table(file)) == 5 if kind != "one row" else True


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
