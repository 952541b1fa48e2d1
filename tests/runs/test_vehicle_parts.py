"""Model files from parts: every vehicle with every sensor, what stays of its text and what does not."""

from __future__ import annotations

from pathlib import Path

import pytest
from examples import MODELS

import steady_ppl as st
from steady_ppl.errors import UsageError
from steady_ppl.runs.table_header import required_settings
from steady_ppl.runs.vehicle_parts import (
    Vehicle,
    as_code,
    needs_landmarks,
    sensor_kinds,
    vehicles,
    with_settings,
    write_model,
)
from steady_ppl.sensors import Bearings, Heading, Position, Ranges, WheelSpeed

MAP = ((0.0, 0.0), (6.0, 0.0), (6.0, 10.0))


def test_vehicles_are_the_files_that_list_sensors() -> None:
    found = vehicles()
    assert {"car", "unicycle"} <= found.keys() and "gps_boat" not in found and "pendulum" not in found
    assert found["car"].about == "A car commanded by a speed and a steering angle"


@pytest.mark.parametrize("kind", sorted(vehicles()))
@pytest.mark.parametrize("sensor", sorted(sensor_kinds()))
def test_every_vehicle_carries_every_sensor(kind: str, sensor: str, tmp_path: Path) -> None:
    """It passes the probe, simulates, and reads what it has simulated."""
    vehicle, of = vehicles()[kind], sensor_kinds()[sensor]
    carried = with_settings(of, dict.fromkeys(required_settings(of), 0.1) | {"name": "mine"}, vehicle)
    names = [f"a{index}" for index in range(len(vehicle.program.controls))]
    places = MAP if needs_landmarks([carried]) else ()
    program = write_model(tmp_path / "my_own.py", vehicle, controls=names, sensors=[carried], landmarks=places)
    assert type(program).__name__ == "MyOwn" and program.control_names == tuple(names)
    assert program.roles == dict(zip(names, vehicle.program.control_names, strict=True))
    assert program.sensors == (carried,) and all(name.startswith("mine") for name in program.measurement_names)
    program.duration = 5 * program.step
    drives = st.for_program(program, st.simulate(program, 2, seed=0))
    assert len(drives) == 2
    assert max(map(len, (tmp_path / "my_own.py").read_text().splitlines())) <= 120


def test_a_control_without_a_role_is_given_none(tmp_path: Path) -> None:
    """The vehicle is a user's own: a control has no role, or another unit than the role."""
    text = (MODELS / "car.py").read_text().replace('"speed [m/s]", "steering [rad]"', '"speed [V]", "valve"')
    (tmp_path / "car.py").write_text(text)
    own = Vehicle("car", tmp_path / "car.py")
    program = write_model(tmp_path / "mine.py", own, controls=("a", "b"), sensors=[Position(sd=1.0)])
    assert program.control_names == ("a", "b") and not program.roles


def test_a_setting_that_nothing_asks_for_is_taken_out(tmp_path: Path) -> None:
    car = vehicles()["car"]
    write = {"controls": ("speed", "steering"), "force": True}
    with_gps = write_model(tmp_path / "mine.py", car, sensors=[with_settings(Position, {"sd": 1.0}, car)], **write)
    assert with_gps.antenna.shape == (2,) and "antenna" in with_gps.guesses
    assert "roles" not in (tmp_path / "mine.py").read_text()
    with_compass = write_model(tmp_path / "mine.py", car, sensors=[Heading(sd=0.1, from_north=True)], **write)
    assert not hasattr(with_compass, "antenna") and with_compass.guesses == ("noise",)
    assert "from_north=True" in (tmp_path / "mine.py").read_text()


def test_a_start_is_where_fixes_are_or_anywhere_on_the_map(tmp_path: Path) -> None:
    unicycle = vehicles()["unicycle"]
    write = {"controls": ("speed", "turn"), "landmarks": MAP, "force": True}
    seeing = write_model(tmp_path / "mine.py", unicycle, sensors=[Ranges(sd=0.1)], fastest=2.0, **write)
    assert not seeing.start and seeing.landmarks == MAP
    starts = st.simulate(seeing, 400, seed=0, substeps=1).states[0]
    assert abs(float(starts[:, 1].mean()) - 5) < 1 and 4 < float(starts[:, 1].std()) < 6
    assert 1.7 < float(starts[:, 3].std()) < 2.3
    fixed = write_model(tmp_path / "mine.py", unicycle, sensors=[Bearings(sd=0.1), Position(sd=0.5)], **write)
    assert fixed.start == "first measurements"


def test_a_sensor_is_written_as_it_is() -> None:
    wheel = WheelSpeed(sd=0.1, name="odo", size="radius")
    assert as_code(wheel) == 'WheelSpeed(sd=0.1, name="odo", size="radius")'
    assert as_code(Position(sd=0.3, offset=(1.0, 0.5))) == "Position(sd=0.3, offset=(1.0, 0.5))"
    assert as_code(Heading(sd="spread", name="kompaß")) == 'Heading(sd="spread", name="kompaß")'
    assert as_code(Ranges(sd=0.1)) == "Ranges(sd=0.1)"


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("mine.txt", "expected a name such as my_car.py"),
        ("2fast.py", "expected a name such as my_car.py"),
        ("there.py", "exists: choose another name, or --force"),
        ("position.py", "its class would be Position, which steady_ppl has"),
        ("no/mine.py", "there is no folder"),
    ],
)
def test_a_file_that_cannot_be_is_refused(name: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "there.py").write_text("")
    with pytest.raises(UsageError, match=says):
        write_model(tmp_path / name, vehicles()["car"], controls=("a", "b"), sensors=[Position(sd=1.0)])


def test_the_texts_of_models_are_not_touched(tmp_path: Path) -> None:
    before = (MODELS / "car.py").read_bytes()
    write_model(tmp_path / "car.py", vehicles()["car"], controls=("v", "d"), sensors=[Position(sd=1.0)])
    assert (MODELS / "car.py").read_bytes() == before
