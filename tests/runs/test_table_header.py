"""What columns are, by their names and units: as people call them, and what is none of it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from steady_ppl.errors import DataError
from steady_ppl.runs.table_header import KINDS, Column, Header, controls_of, sensors_in
from steady_ppl.runs.vehicle_parts import sensor_kinds, vehicles


def header(tmp_path: Path, *columns: str, rows: int = 40) -> Header:
    rng = np.random.default_rng(0)
    frame = pd.DataFrame(rng.normal(size=(rows, len(columns))), columns=list(columns))
    time = next((one for one in columns if one.split(" ")[0].lower() in ("t", "time", "time_ms")), None)
    if time is not None:
        frame[time] = np.arange(rows) / 10
    frame.to_csv(tmp_path / "log.csv", index=False)
    return Header.read(tmp_path / "log.csv")


def seen(found: Header, *taken: str) -> dict[str, tuple[str, list[str]]]:
    return {
        one.name: (one.kind.kind, list(one.columns.values()))
        for one in sensors_in(found, list(sensor_kinds().values()), taken)
    }


@pytest.mark.parametrize(
    ("raw", "stem", "factor", "unit"),
    [
        ("u.v", "v", 1.0, ""),
        ("delta [deg]", "delta", math.pi / 180, "rad"),
        ("y.compass_deg", "compass", math.pi / 180, "rad"),
        ("speed_kmh", "speed", 1 / 3.6, "m/s"),
        ("v_ms", "v_ms", 1.0, ""),
        ("t_ms", "t", 0.001, "s"),
        ("y.gps_x", "gps_x", 1.0, ""),
        ("pos_n", "pos_n", 1.0, ""),
        ("range (cm)", "range", 0.01, "m"),
        ("u.left [N]", "left", 1.0, "N"),
        ("y.level [V]", "level", 1.0, "V"),
    ],
)
def test_a_column_is_parted_into_name_and_unit(raw: str, stem: str, factor: float, unit: str) -> None:
    column = Column.parse(raw)
    assert (column.stem, column.factor, column.unit) == (stem, pytest.approx(factor), unit)


def test_words_are_of_kinds_that_there_are(tmp_path: Path) -> None:
    assert {*KINDS} <= {one.kind for one in sensor_kinds().values()}
    assert seen(header(tmp_path, "t", "y.imu_forward", "y.imu_lateral")) == {
        "imu": ("accelerometer", ["imu_forward", "imu_lateral"])
    }


def test_a_unit_of_another_kind_is_none_of_it(tmp_path: Path) -> None:
    assert seen(header(tmp_path, "t", "y.wheel [m]", "y.gyro [V]")) == {}
    thrusts = header(tmp_path, "t", "left [N]", "right [N]")
    assert controls_of(vehicles()["differential_drive"], thrusts, {}) is None
    assert controls_of(vehicles()["thruster_boat"], thrusts, {}) is not None


@pytest.mark.parametrize(
    ("kind", "columns"),
    [
        ("car", ("u.speed", "u.steering")),
        ("car", ("v", "delta")),
        ("car", ("Velocity [m/s]", "Steering_Angle [deg]")),
        ("unicycle", ("u.v", "u.omega")),
        ("unicycle", ("linear_x", "angular_z")),
    ],
)
def test_controls_are_known_by_what_people_call_them(tmp_path: Path, kind: str, columns: tuple[str, str]) -> None:
    found = controls_of(vehicles()[kind], header(tmp_path, "t", *columns, "y.gyro"), {})
    assert found is not None and [one.raw for one in found] == list(columns)


def test_other_names_are_controls_if_somebody_says_so(tmp_path: Path) -> None:
    car, table = vehicles()["car"], header(tmp_path, "t", "a", "b", "gyro")
    assert controls_of(car, table, {}) is None and controls_of(car, table, {"a": "steering"}) is None
    found = controls_of(car, table, {"b": "speed", "a": "steering"})
    assert found is not None and [one.raw for one in found] == ["b", "a"]


def test_sensors_are_known_by_their_columns(tmp_path: Path) -> None:
    found = header(tmp_path, "time", "u.a", "y.gps_x", "y.gps_y", "y.compass", "y.yaw_rate", "y.wheel_speed", "y.foo")
    assert seen(found) == {
        "gps": ("position", ["gps_x", "gps_y"]),
        "compass": ("heading", ["compass"]),
        "yaw_rate": ("yaw rate", ["yaw_rate"]),
        "wheel_speed": ("wheel speed", ["wheel_speed"]),
    }


def test_parts_of_a_reading_have_other_names_too(tmp_path: Path) -> None:
    assert seen(header(tmp_path, "t", "easting", "northing")) == {
        "position": ("position", ["position_x", "position_y"])
    }
    assert seen(header(tmp_path, "t", "pos_e", "pos_n")) == {"pos": ("position", ["pos_x", "pos_y"])}
    assert seen(header(tmp_path, "t", "latitude", "longitude", "lat", "lon")) == {}


def test_landmarks_are_counted_from_nought_or_one(tmp_path: Path) -> None:
    (dist,) = seen(header(tmp_path, "t", *(f"dist_{i}" for i in range(1, 4)))).values()
    assert dist == ("range", [f"dist_{i}" for i in range(3)])
    found = seen(header(tmp_path, "t", *(f"y.{kind}_{i}" for kind in ("range", "bearing") for i in range(15))))
    assert sum(len(columns) for _, columns in found.values()) == 30


def test_noise_is_told_by_neighbouring_readings(tmp_path: Path) -> None:
    time = np.arange(4000) / 10
    noise = np.random.default_rng(0).normal(size=4000)
    frame = pd.DataFrame({"t": time, "drive": "a", "slow": 50 * np.sin(0.1 * time) + 0.3 * noise, "still": 1.0})
    frame["rare"] = np.where(np.arange(4000) < 10, frame["slow"], np.nan)
    frame.to_csv(tmp_path / "log.csv", index=False)
    found = Header.read(tmp_path / "log.csv")
    assert found.noise("slow") == pytest.approx(0.3, rel=0.1)
    assert found.noise("still") is None and found.noise("rare") is None


def test_a_table_needs_a_time(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no column is a time, expected time or t among a, b"):
        header(tmp_path, "a", "b")
