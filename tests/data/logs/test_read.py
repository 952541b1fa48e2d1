"""Logs become the table that the mapping says, and the table says what was so in the world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from log_writing import Kind, Sent, dataflash, dropout, ulog
from rover_logs import ardupilot, px4, world
from small import steady

from steady_ppl import DataError, LogColumn, LogMapping, Trajectories, read_logs, read_table
from steady_ppl.data.logs.geodesy import LocalFrame

SECONDS = 20.0
TRUTH = world(SECONDS)


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def ready(name: str) -> LogMapping:
    return LogMapping.read(name)


def column(data: Trajectories, name: str, trajectory: int = 0) -> np.ndarray:
    """The cells of a measurement or a control, NaN where there is none."""
    if name in data.control_names:
        return data.controls[:, trajectory, data.control_names.index(name)].numpy()
    i = data.measurement_names.index(name)
    seen = data.observed[:, trajectory, i].numpy()
    return np.where(seen, data.measurements[:, trajectory, i].numpy(), np.nan)


def wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def taken(log: Path, *columns: LogColumn, say=lambda line: None, **more) -> Trajectories:
    return read_logs([log], LogMapping(columns, more.pop("step", 0.1)), say, **more)


Y = LogColumn("y.a", "a", "value")


def sent(times: list[float], values: list[float], name: str = "a", instance: int = 0, **more) -> Sent:
    """Messages of a number, times in s."""
    fields = {"timestamp": ("uint64_t", [round(t * 1e6) for t in times])} | more | {"value": ("double", values)}
    return Sent(name, fields, instance)


# --- the world and its logs -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["px4", "px4 before 1.15", "ardupilot"])
def test_a_table_says_what_was_so_in_the_world(tmp_path: Path, kind: str) -> None:
    """Positions to half a unit of 1e-7 degrees where they are whole, headings to that of 32 bits."""
    content = ardupilot(TRUTH) if kind == "ardupilot" else px4(TRUTH, old=kind != "px4")
    log = written(tmp_path / ("drive.bin" if kind == "ardupilot" else "drive.ulg"), content)
    said: list[str] = []
    data = read_logs([log], ready("ardupilot-rover" if kind == "ardupilot" else "px4-rover"), said.append)
    rows = np.arange(200) * 100  # ms; the last row has the end of the log
    assert data.labels == ("drive",) and np.array_equal(data.time[:200, 0], np.arange(200) * 0.1)
    half = 1e-6 if kind == "px4" else 0.0112  # the first position is rounded too
    np.testing.assert_allclose(column(data, "gps_x")[:200], TRUTH.x[rows] - TRUTH.x[0], rtol=0, atol=half)
    np.testing.assert_allclose(column(data, "gps_y")[:200], TRUTH.y[rows] - TRUTH.y[0], rtol=0, atol=half)
    compass = column(data, "compass")[:200]
    assert np.abs(compass).max() <= np.pi and np.abs(wrapped(compass - TRUTH.heading[rows])).max() < 1e-6
    np.testing.assert_allclose(column(data, "gyro")[:200], TRUTH.turning[rows], rtol=0, atol=1e-7)
    rounding = 1e-3 if kind == "ardupilot" else 1e-7  # half a µs of pulses
    np.testing.assert_allclose(column(data, "throttle")[:200], TRUTH.commands[rows, 0] / 4, rtol=0, atol=rounding)
    np.testing.assert_allclose(column(data, "steering")[:200], TRUTH.commands[rows, 1] / 0.5, rtol=0, atol=rounding)
    assert "x = y = 0 is its first position, 47.39" in said[0]


def test_commands_of_an_autopilot_are_in_metres_and_radians(tmp_path: Path) -> None:
    log = written(tmp_path / "drive.bin", ardupilot(TRUTH))
    data = read_logs([log], ready("ardupilot-rover-commands"), lambda line: None)
    commands = np.stack([column(data, "speed"), column(data, "turn")], -1)[:200]
    np.testing.assert_allclose(commands, TRUTH.commands[:20000:100], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("px4-boat", {"left": (1, 2.0), "right": (0, 0.25)}),
        ("px4-multicopter-plane", {"east": (1, 1.0), "north": (0, 1.0), "turn": (1, -1.0)}),
        ("ardupilot-boat", {"left": (1, -2.0), "right": (0, 0.25)}),
    ],
)
def test_other_ready_mappings_take_the_controls_that_they_say(tmp_path: Path, name: str, expected: dict) -> None:
    """Of which command, and how many times it."""
    log = written(tmp_path / "drive", ardupilot(TRUTH) if name.startswith("a") else px4(TRUTH))
    data = read_logs([log], ready(name), lambda line: None)
    assert set(data.control_names) == set(expected)
    for control, (which, factor) in expected.items():
        truth = factor * TRUTH.commands[:20000:100, which]
        np.testing.assert_allclose(column(data, control)[:200], truth, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("content", "topic", "field"),
    [(px4, "vehicle_gps_position", "latitude_deg longitude_deg"), (ardupilot, "GPS", "Lat Lng")],
)
def test_a_second_receiver_is_an_instance_and_both_share_the_origin(tmp_path: Path, content, topic, field) -> None:
    log = written(tmp_path / "drive", content(TRUTH))
    first = LogColumn("y.first", topic, field, reading="east")
    data = taken(log, first, LogColumn("y.second", f"{topic}[1]", field, reading="east"))
    apart = data.measurements[:, 0, 1] - data.measurements[:, 0, 0]
    np.testing.assert_allclose(apart, 1.0, rtol=0, atol=1e-6 if content is px4 else 0.0112)


def test_several_logs_share_the_origin_and_a_given_one_is_taken(tmp_path: Path) -> None:
    east = LogColumn("y.x", "vehicle_gps_position", "latitude_deg longitude_deg", reading="east")
    logs = [written(tmp_path / f"{i}.ulg", px4(world(3.0, i))) for i in range(2)]
    said: list[str] = []
    data = read_logs(logs, LogMapping((east,), 0.1), said.append)
    assert data.labels == ("0", "1") and len([line for line in said if "first position" in line]) == 1
    start = world(3.0, 1).x[0] - world(3.0, 0).x[0]
    assert float(data.measurements[0, 1, 0]) == pytest.approx(start, abs=1e-6)
    given = read_logs(logs, LogMapping((east,), 0.1, origin=(47.3977420, 8.5455938)), said.append)
    assert float(given.measurements[5, 0, 0]) == pytest.approx(world(3.0).x[500], abs=1e-6)


def test_positions_without_a_fix_are_not_taken(tmp_path: Path) -> None:
    fix = np.full(200, 3)
    fix[:20] = 0
    log = written(tmp_path / "drive.ulg", px4(TRUTH, fix=fix))
    data = read_logs([log], ready("px4-rover"), lambda line: None)
    assert np.isnan(column(data, "gps_x")[:20]).all() and column(data, "gps_x")[20] == 0.0
    assert not np.isnan(column(data, "compass")[:20]).any()
    with pytest.raises(DataError, match="there is no position where fix_type >= 3"):
        read_logs([written(tmp_path / "none.ulg", px4(TRUTH, fix=0))], ready("px4-rover"), lambda line: None)


# --- geodesy ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("latitude", [-70.0, 0.0, 47.4, 89.0])
def test_small_displacements_follow_the_radii_of_curvature(latitude: float) -> None:
    """Metres per degree of WGS 84: the meridian's radius and that of the parallel."""
    a, squared, phi = 6378137.0, 0.0066943799901413165, np.radians(latitude)
    w = np.sqrt(1 - squared * np.sin(phi) ** 2)
    small = 1e-6
    east, north = LocalFrame(latitude, 179.9999999).east_north(
        np.array([latitude + small, latitude]), np.array([179.9999999, 179.9999999 + small - 360])
    )
    np.testing.assert_allclose(north[0] / np.radians(small), a * (1 - squared) / w**3, rtol=1e-6)
    np.testing.assert_allclose(east[1] / np.radians(small), a * np.cos(phi) / w, rtol=1e-6)
    assert abs(east[0]) < 1e-8 and abs(north[1]) < 1e-7


# --- clocks and times -------------------------------------------------------------------------------------------------


def test_the_time_of_the_sample_is_exact_and_that_of_logging_is_late(tmp_path: Path) -> None:
    log = written(tmp_path / "drive.ulg", px4(TRUTH))
    rows = np.arange(190) * 50
    heading = {}
    for clock in ("sample", "log"):
        compass = LogColumn("y.h", "vehicle_attitude", "q", reading="yaw from north", clock=clock)
        data = taken(log, LogColumn("u.t", "actuator_motors", "control[0]"), compass, step=0.05)
        heading[clock] = np.abs(wrapped(column(data, "h")[:190] - TRUTH.heading[rows]))
    assert np.nanmax(heading["sample"]) < 1e-6 and np.nanmax(heading["log"]) < 1e-6  # the same rows at 20 Hz
    fine = {}
    for clock in ("sample", "log"):
        compass = LogColumn("y.h", "vehicle_attitude", "q", reading="yaw from north", clock=clock)
        data = taken(log, LogColumn("u.t", "actuator_motors", "control[0]"), compass, step=0.001)
        at = np.flatnonzero(~np.isnan(column(data, "h")))
        fine[clock] = at % 50
    assert set(fine["sample"]) == {0} and fine["log"].min() >= 3 and fine["log"].max() <= 23


def test_the_receivers_clock_is_moved_onto_the_logs(tmp_path: Path) -> None:
    """50 ppm fast, delays of 20 to 200 ms, the least near both ends: right but for those 20 ms."""
    delay = np.random.default_rng(0).integers(30_000, 200_000, 200)
    delay[[2, -3]] = 20_000
    log = written(tmp_path / "drive.ulg", px4(TRUTH, delay=delay))
    said: list[str] = []
    east = LogColumn(
        "y.x", "vehicle_gps_position", "latitude_deg longitude_deg", reading="east", clock="gps", late=0.02
    )
    data = taken(log, LogColumn("u.t", "actuator_motors", "control[0]"), east, step=0.001, say=said.append)
    at = np.flatnonzero(~np.isnan(column(data, "x")))
    assert (at % 100 == 0).all() and len(at) == 200
    np.testing.assert_allclose(column(data, "x")[at], TRUTH.x[at] - TRUTH.x[0], rtol=0, atol=1e-6)
    assert any("its clock was" in line and "gained 50.0" in line for line in said)


def test_ardupilots_gps_time_is_week_and_milliseconds(tmp_path: Path) -> None:
    log = written(tmp_path / "drive.bin", ardupilot(TRUTH))
    speed, east = LogColumn("u.v", "THR", "DesSpeed"), LogColumn("y.x", "GPS", "Lat Lng", reading="east", clock="gps")
    data = taken(log, speed, east, step=0.001)
    assert set(np.flatnonzero(~np.isnan(column(data, "x"))) % 100) == {0}


def test_messages_are_put_in_order_and_that_is_said(tmp_path: Path) -> None:
    stamps = [200_000, 100_000, 400_000, 400_000]
    messages = sent([0.1, 0.2, 0.4, 0.4], [1, 2, 4, 5], timestamp_sample=("uint64_t", stamps))
    log = written(tmp_path / "d.ulg", ulog([messages]))
    said: list[str] = []
    data = taken(log, LogColumn("y.a", "a", "value", clock="sample"), say=said.append)
    np.testing.assert_array_equal(column(data, "a"), [2.0, 1.0, np.nan, 4.0])
    assert "d.ulg: a: the time goes back 1 time; messages are put in the order of their times" in said
    assert "d: measurements left out, because another was nearer to their row: 1 of 4 y.a" in said


def test_a_clock_that_nobody_set_is_refused(tmp_path: Path) -> None:
    log = written(tmp_path / "d.ulg", ulog([sent([0.1, 0.2], [1, 2], timestamp_sample=("uint64_t", [0, 0]))]))
    with pytest.raises(DataError, match='the times on clock "sample" are all zero'):
        taken(log, LogColumn("y.a", "a", "value", clock="sample"))
    with pytest.raises(DataError, match='it has no clock "gps"; expected "log" or "sample"'):
        taken(log, LogColumn("y.a", "a", "value", clock="gps"))


# --- what trajectories are cut by -------------------------------------------------------------------------------------


def test_each_span_in_which_it_is_armed_is_a_trajectory(tmp_path: Path) -> None:
    log = written(tmp_path / "drive.ulg", px4(TRUTH, armed=[(2.0, 8.0), (11.0, 1e9)]))
    said: list[str] = []
    data = read_logs([log], ready("px4-rover"), said.append)
    assert data.labels == ("drive-1", "drive-2") and data.lengths.tolist() == [61, 91]
    for i, start in enumerate((2000, 11000)):
        rows = start + np.arange(60) * 100
        np.testing.assert_allclose(column(data, "gps_x", i)[:60], TRUTH.x[rows] - TRUTH.x[0], rtol=0, atol=1e-6)
        np.testing.assert_allclose(column(data, "throttle", i)[:60], TRUTH.commands[rows, 0] / 4, rtol=0, atol=1e-7)
    assert any("u.throttle" in line and "it is not known (NaN) in 250 of 1000 messages" in line for line in said)


def test_a_log_that_is_never_armed_is_refused_and_one_that_does_not_say_is_read_whole(tmp_path: Path) -> None:
    never = written(tmp_path / "d.ulg", px4(TRUTH, armed=[(1e8, 1e9)]))
    with pytest.raises(DataError, match="it is never armed: vehicle_status: arming_state == 2 holds in none of 1 mess"):
        read_logs([never], ready("px4-rover"), lambda line: None)
    silent = written(tmp_path / "s.ulg", ulog([sent([0.1, 0.2], [1, 2])]))
    said: list[str] = []
    assert len(read_logs([silent], LogMapping((Y,), 0.1, armed="b: c == 1"), said.append)) == 1
    assert said == ["s.ulg: it has no b, by which it would be cut where it is armed: it is read whole"]


def test_a_control_that_is_always_nan_is_refused(tmp_path: Path) -> None:
    log = written(tmp_path / "d.ulg", ulog([sent([0.1, 0.2], [1, 2]), sent([0.1], [np.nan], "b")]))
    with pytest.raises(DataError, match="column u.b, topic b, field value: there is no message, and a control must be"):
        taken(log, Y, LogColumn("u.b", "b", "value"))


def test_from_and_to_leave_out_what_is_before_and_after(tmp_path: Path, capsys, refused) -> None:
    log = written(tmp_path / "drive.ulg", px4(TRUTH))
    words = ("import-log", log, "px4-rover", "--out", tmp_path / "t.csv")
    assert steady(*words, "--from", 5, "--to", 9.95) == 0
    data = read_table(tmp_path / "t.csv")
    rows = 5000 + np.arange(50) * 100
    np.testing.assert_allclose(column(data, "gps_x")[:50], TRUTH.x[rows] - TRUTH.x[0], rtol=0, atol=1e-6)
    assert "they are outside of what was to be read: 150 of 200 y.gps_x" in capsys.readouterr().err
    (tmp_path / "t.csv").unlink()
    refused(2, "there is nothing between 9 s and 5 s", *words, "--from", 9, "--to", 5)
    refused(2, "drive.ulg: it has 19.98", *words, "--from", 900)
    refused(2, "nothing of it is from 0 s to -3 s", *words, "--to=-3")


def test_a_pause_of_a_control_cuts_as_in_bags(tmp_path: Path) -> None:
    times = [i / 10 for i in range(1, 41) if not 11 < i < 26]
    log = written(tmp_path / "d.ulg", ulog([sent(times, times, "u"), sent([i / 10 for i in range(1, 41)], [0.0] * 40)]))
    data = taken(log, Y, LogColumn("u.u", "u", "value", longest=0.5))
    assert data.labels == ("d-1", "d-2") and data.lengths.tolist() == [11, 15]


# --- formats ----------------------------------------------------------------------------------------------------------


def test_every_type_of_dataflash_is_read(tmp_path: Path) -> None:
    form, names = "QbBhHiIfdcCeEL", "TimeUS,b,B,h,H,i,I,f,d,c,C,e,E,L"
    row = (-3, 200, -300, 60000, -70000, 4_000_000_000, 0.5, 1e-9, -1234, 35999, -123456, 123456, 473977420)
    kinds = [Kind("ALL", form, names, [(t, *row) for t in (100_000, 200_000)])]
    array = np.arange(-16, 16).astype("<i2").tobytes()
    kinds.append(Kind("ARR", "Qa", "TimeUS,D", [(t, array) for t in (100_000, 200_000)]))
    log = written(tmp_path / "d.bin", dataflash(kinds))
    columns = [LogColumn(f"y.{name}{i}", "ALL", name) for i, name in enumerate(names.split(",")[1:])]
    data = taken(log, *columns, LogColumn("y.array", "ARR", "D[31]"))
    assert data.measurements[0, 0].tolist() == [*row[:8], -12.34, 359.99, -1234.56, 1234.56, 47.397742, 15.0]


def test_a_topic_that_a_log_begins_anew_goes_on(tmp_path: Path) -> None:
    log = written(tmp_path / "d.ulg", ulog([sent([0.1, 0.2], [1, 2]), sent([0.3], [3])]))
    np.testing.assert_array_equal(column(taken(log, Y), "a"), [1, 2, 3])


def test_seconds_count_from_where_a_ulog_starts(tmp_path: Path) -> None:
    """The first message of a topic may be older."""
    log = written(tmp_path / "d.ulg", ulog([sent([0.5, 10.0, 10.1, 10.2, 10.3], [0, 1, 2, 3, 4])], start=10_000_000))
    np.testing.assert_array_equal(column(taken(log, Y, begin=0.1, end=0.2), "a"), [2, 3])


def test_dropouts_are_said(tmp_path: Path) -> None:
    log = written(tmp_path / "d.ulg", ulog([sent([0.1, 0.2], [1, 2])], extra=dropout(30) + dropout(1200)))
    said: list[str] = []
    taken(log, Y, say=said.append)
    assert said == ["d.ulg: in 2 places, 1.230 s in all, it was not logged (dropouts)"]


def test_pyulog_that_is_missing_is_named(tmp_path: Path, monkeypatch, refused) -> None:
    log = written(tmp_path / "d.ulg", ulog([sent([0.1, 0.2], [1, 2])]))
    monkeypatch.setitem(__import__("sys").modules, "pyulog", None)
    refused(2, "ULog is read by pyulog, which is missing: pip install 'steady-ppl[logs]'", "import-log", log)
