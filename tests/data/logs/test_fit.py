"""From logs of a rover in a world of milliseconds to the numbers of the world."""

from __future__ import annotations

from pathlib import Path

import pytest
from examples import MODELS
from rover_logs import ardupilot, px4, world

from inference.likelihood import fit
from steady_ppl import LogColumn, LogMapping, load_program, read_logs
from steady_ppl.sensors import Heading, Position, YawRate

NOISE = (0.3, 0.02, 0.01)  # m, rad, rad/s
ON_BOARD = (Heading(sd=0.02, name="compass"), YawRate(sd=0.01, name="gyro"))


def parts(name: str) -> type:
    """A class of `models/`."""
    return type(load_program(str(MODELS / f"{name}.py")))


class Rover(parts("unicycle")):
    landmarks = ()
    sensors = (Position(sd=0.3, name="gps"), *ON_BOARD)


class SteeredRover(parts("car")):
    sensors = (Position(sd=0.3, name="gps", offset="antenna"), *ON_BOARD)


@pytest.mark.slow
def test_a_cars_wheelbase_is_found_from_a_ulog(tmp_path: Path) -> None:
    for seed in range(3):
        (tmp_path / f"{seed}.ulg").write_bytes(px4(world(40.0, seed, wheelbase=1.4), seed=seed, noise=NOISE))
    sensors = LogMapping.read("px4-rover").columns[2:]
    speed = LogColumn("u.speed", "actuator_motors", "control[0]", scale=4.0)
    steering = LogColumn("u.steering", "actuator_servos", "control[0]", scale=-0.5)
    mapping = LogMapping((speed, steering, *sensors), 0.1, origin=(47.3977420, 8.5455938))
    drives = read_logs(sorted(tmp_path.glob("*.ulg")), mapping, lambda line: None)
    car = SteeredRover()
    assert car.measurement_names == drives.measurement_names and car.control_names == drives.control_names
    fit(car, drives, seed=0)
    assert car.wheelbase.item() == pytest.approx(1.4, rel=0.01)
    assert car.antenna.tolist() == pytest.approx([0.0, 0.0], abs=0.1)


@pytest.mark.slow
def test_gains_of_a_unicycle_are_found_from_dataflash(tmp_path: Path) -> None:
    for seed in range(3):
        (tmp_path / f"{seed}.bin").write_bytes(ardupilot(world(40.0, seed, gains=(0.8, 1.2)), seed=seed, noise=NOISE))
    drives = read_logs(sorted(tmp_path.glob("*.bin")), LogMapping.read("ardupilot-rover-commands"), lambda line: None)
    rover = Rover()
    fit(rover, drives, seed=0)
    assert rover.speed_gain.item() == pytest.approx(0.8, rel=0.01)
    assert rover.turn_gain.item() == pytest.approx(1.2, rel=0.01)
