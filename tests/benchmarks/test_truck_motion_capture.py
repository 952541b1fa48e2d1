"""The analysis of the truck's motion capture returns the numbers of a synthetic truck within its own intervals."""

from __future__ import annotations

import json
import math

import numpy as np
import pandas as pd
import pytest
from truck_capture_logs import as_rows, numbered, on_time, read_split
from truck_capture_regressions import (
    euler_from_continuous,
    lateral,
    lateral_by_euler,
    lateral_by_instruments,
    regression,
)
from truck_capture_responses import LATERAL_RESPONSES, SPEED_RESPONSES, TURN_RESPONSES, fitted, process_noise
from truck_logs import stamped
from truck_motion_capture import main, markdown, values, with_interval, write

TRUTH = {"lever": 0.38, "slip": -0.085, "crab": -0.013, "settling": 0.04}
SPEED = {"gain": 0.91, "lag": 0.2, "delay": 0.1}
TURN = {"gain": 0.82, "lag": 0.08, "delay": 0.11, "share": 0.75, "caster": 1.2}
NOISE = (0.6, 0.6, 1.2)  # m/s², m/s², rad/s², held for .1 s
TICK = 0.001  # s, of the synthetic truck
SECONDS = 120.0


def commands(generator: np.random.Generator) -> np.ndarray:
    """Return speeds (m/s) and turn rates (rad/s) every .05 s, held for about a second, backwards now and then."""
    count = round(SECONDS / 0.05)
    row = np.cumsum(generator.random(count) < 0.06)
    speed = generator.choice([-1.5, 1.0, 1.5, 2.0], p=[0.2, 0.2, 0.3, 0.3], size=row[-1] + 1)[row]
    row = np.cumsum(generator.random(count) < 0.06)
    curvature = generator.uniform(-0.78, 0.78, size=row[-1] + 1)[row]
    return np.column_stack([speed, speed * curvature])


def drive(told: np.ndarray, pushes: np.ndarray) -> np.ndarray:
    """Return x, y (m) and heading (rad) every .01 s of a truck that moves in steps of 1 ms."""
    x, y, heading, v, w, yaw_rate = 0.0, 0.0, 0.4, 0.0, 0.0, 0.0
    poses, rows, pushed, count = [], told.tolist(), pushes.tolist(), round(SECONDS / TICK)
    for i in range(count):
        if i % 10 == 0:
            poses.append((x, y, heading))
        along, across, around = pushed[i // 100]
        speed = rows[max(0, i - round(SPEED["delay"] / TICK)) // 50][0]
        fast, turn = rows[max(0, i - round(TURN["delay"] / TICK)) // 50]
        turned = turn + TURN["share"] * (turn * fast * v / (fast**2 + 0.05**2) - turn)
        target = (TRUTH["lever"] + TRUTH["slip"] * v) * yaw_rate + TRUTH["crab"] * v
        middle = heading + yaw_rate * TICK / 2
        x += TICK * (v * math.cos(middle) - w * math.sin(middle))
        y += TICK * (v * math.sin(middle) + w * math.cos(middle))
        heading += yaw_rate * TICK
        v += TICK * ((SPEED["gain"] * speed - v) / SPEED["lag"] + along)
        w += TICK * ((target - w) / TRUTH["settling"] + across)
        yaw_rate += TICK * ((TURN["gain"] * turned - yaw_rate) / TURN["lag"] - TURN["caster"] * v * yaw_rate + around)
    return np.array(poses)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """A split with noise of 1 mm and .002 rad, a gap of two seconds and a message that comes twice."""
    generator = np.random.default_rng(4)
    told = commands(generator)
    pushes = NOISE * generator.normal(size=(round(SECONDS * 10), 3))
    poses = drive(told, pushes)
    x, y, heading = (poses + generator.normal(size=poses.shape) * (0.001, 0.001, 0.002)).T
    zero = np.zeros_like(x)
    position = {"x": x, "y": y, "z": zero}
    orientation = {"x": zero, "y": zero, "z": np.sin(heading / 2), "w": np.cos(heading / 2)}
    columns = {f"pose.position.{axis}": column for axis, column in position.items()}
    columns |= {f"pose.orientation.{axis}": column for axis, column in orientation.items()}
    time = np.arange(len(x)) / 100
    late = np.where(generator.random(len(x)) < 0.05, 0.008, 0.0)
    pose = stamped(time + late, columns)
    pose = pose[(time < 70) | (time > 72)]
    folder = tmp_path_factory.mktemp("logs") / "train"
    folder.mkdir()
    pd.concat([pose[:500], pose[499:]]).to_csv(folder / "vrpn-pose.csv", index=False)
    log = stamped(np.arange(len(told)) * 0.05, {"twist.linear.x": told[:, 0], "twist.angular.z": told[:, 1]})
    log.to_csv(folder / "vesc_drive.csv", index=False)
    return folder


@pytest.fixture(scope="module")
def segments(logs):
    return numbered(read_split(logs))


def holds(fit, truth, *, within=()):
    """Assert that each interval holds the truth, or that the value is as close to it as `within` says."""
    assert set(fit["parameters"]) == set(truth)
    for name, entry in fit["parameters"].items():
        near = abs(entry["value"] - truth[name]) <= dict(within).get(name, 0.0)
        assert near or entry["low"] <= truth[name] <= entry["high"], (name, entry)


def test_a_gap_splits_the_log_and_blocks_stay_within_segments(segments):
    first, second = segments
    assert first.time[-1] < 70.01 and second.time[0] > 71.99
    assert first.block.max() + 1 == second.block.min()
    assert all(np.ptp(s.time[s.block == b]) < 12 for s in segments for b in np.unique(s.block))


def test_late_messages_get_their_time_back_and_lost_frames_keep_theirs():
    regular = 0.01 * np.arange(400) + 0.01 * (np.arange(400) > 200)
    late = regular + 0.008 * (np.arange(400) % 7 == 3)
    assert np.abs(on_time(late) - regular).max() < 1e-9


LAW = {name: TRUTH[name] for name in ("lever", "slip", "crab", "settling")}


def test_lateral_response_is_found(segments):
    response = LATERAL_RESPONSES["held: lever, slip, settling, crab"]
    fit = fitted(response, segments)
    holds(fit, LAW)


def test_regression_finds_lever_and_slip_at_each_window(logs):
    for window in (0.15, 0.41):
        segments = numbered(read_split(logs, window=window))
        fit = lateral(segments, ("lever", "slip", "crab", "offset"))
        law = {name: TRUTH[name] for name in ("lever", "slip", "crab")} | {"offset": 0.0}
        holds(fit, law, within={"lever": 0.012, "slip": 0.005})  # it leaves out that the truck settles


def test_instruments_agree_with_least_squares(logs, segments):
    odd, even = (numbered(read_split(logs, frames=slice(i, None, 2))) for i in (0, 1))
    by_instruments = lateral_by_instruments(odd, even, ("lever", "slip"))["parameters"]
    plain = lateral(segments, ("lever", "slip"))["parameters"]
    for name, entry in plain.items():
        assert by_instruments[name]["value"] == pytest.approx(entry["value"], abs=0.004)


def test_instruments_undo_the_attenuation_by_noise():
    generator = np.random.default_rng(0)
    x, block = generator.normal(size=4000), np.arange(4000) // 100
    one, other = (x + 0.5 * generator.normal(size=4000) for _ in range(2))
    plain = regression(2 * x, {"lever": one}, block)
    right = regression(2 * x, {"lever": one}, block, instruments={"lever": other})
    assert plain["parameters"]["lever"]["high"] < 1.75
    holds(right, {"lever": 2.0})


def test_euler_form_finds_the_sign_that_is_predicted(segments):
    fit = lateral_by_euler(segments, ("lever", "slip"))["parameters"]
    alone = lateral_by_euler(segments, ("lever",))["parameters"]["lever"]["value"]
    continuous = values(lateral(segments, ("lever", "slip")))
    predicted = euler_from_continuous(segments, **continuous)
    assert continuous["slip"] < 0 < fit["slip"]["low"]
    assert fit["slip"]["value"] == pytest.approx(predicted["slip, Euler [s]"], abs=0.02)
    assert alone == pytest.approx(predicted["lever alone, Euler [m]"], abs=0.03)


def test_speed_and_turn_responses_are_found(segments):
    holds(fitted(SPEED_RESPONSES["lag"], segments), SPEED)
    fit = fitted(TURN_RESPONSES["lag, share, caster"], segments)
    holds(fit, TURN)


def test_a_row_ahead_finds_the_same_numbers_and_the_noise(segments):
    rows = as_rows(segments)
    holds(fitted(SPEED_RESPONSES["lag"], rows), SPEED)
    fit = fitted(TURN_RESPONSES["lag, share, caster"], rows)
    holds(fit, TURN, within={"gain": 0.015, "lag": 0.015, "delay": 0.01, "caster": 0.12})  # by the smoothing
    law = {name: TRUTH[name] for name in ("lever", "slip", "settling")}
    noise = process_noise(segments, {"speed": SPEED, "turn rate": TURN, "lateral response": law})
    for sd, entry in zip(NOISE, noise["channels"].values(), strict=True):
        assert 0.7 * sd < entry["sd"]["value"] < 1.3 * sd  # rows begin within the intervals that noise is held for
    assert noise["rows"] == sum((len(s.time) - 1) // 10 for s in segments)


def test_what_the_data_do_not_tell_has_no_interval():
    fit = regression(np.arange(10.0), {"lever": np.arange(10.0), "slip": np.zeros(10)}, np.arange(10) // 2)
    assert fit["parameters"]["slip"]["low"] is None
    assert "not determined" in with_interval("slip", fit["parameters"]["slip"])


def test_missing_logs_are_skipped_with_one_line(tmp_path, capsys):
    assert main(["--data", str(tmp_path / "none")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("skipped: ") and "train/" in line
    for name in ("train", "valid", "test"):
        (tmp_path / name).mkdir()
    assert main(["--data", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("skipped: train/vrpn-pose.csv")


def test_tables_and_numbers_are_written(segments, tmp_path):
    fits = [
        {"part": "lateral velocity", "split": "together", "variant": "0.25 s", "form": "lever"}
        | lateral(segments, ("lever",))
    ]
    noise = process_noise(segments, {"speed": SPEED, "turn rate": TURN, "lateral response": LAW})
    result = {
        "settings": {"window [s]": 0.25, "degree": 3, "block [s]": 8.0, "draws": 1000, "seed": 0},
        "fits": fits,
        "euler": {"together": euler_from_continuous(segments, 0.38, -0.085)},
        "noise": {"together": noise},
    }
    text = markdown(result)
    assert "| lever | together | 0.25 s | lever ." in text and "| forward | together |" in text
    file = tmp_path / "new" / "numbers.json"
    write(file, json.dumps(result, allow_nan=False))
    assert json.loads(file.read_text()) == json.loads(json.dumps(result))
    assert [entry.name for entry in file.parent.iterdir()] == ["numbers.json"]
