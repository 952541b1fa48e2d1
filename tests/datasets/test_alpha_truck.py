"""The AlphaTruck reader, on logs of a known motion and, where they are at hand, on the real ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from truck_logs import RADIUS, TURN_RATE, command_log, pose_log, write

from steady_ppl.data.frozen_sensors import frozen_stretches
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.datasets.alpha_truck import LANDMARKS, read_alpha_truck
from steady_ppl.errors import DataError, UsageError
from steady_ppl.utils.angles import wrap

REAL = Path(__file__).parents[3] / "shared/data/alpha_truck"


@pytest.fixture
def circle(tmp_path: Path) -> Path:
    """Poses over 0.5–25 s and commands over 0–24.75 s: a window of 24.25 s, two trajectories."""
    return write(tmp_path, pose_log(begin=0.5), command_log(end=24.75))


def clock(data: Trajectories) -> torch.Tensor:
    """`(100, 2)` the time of the synthetic log at every row, s."""
    return torch.linspace(0.5, 24.75, 200, dtype=torch.float64).reshape(2, 100).T


def test_the_window_is_cut_into_equal_trajectories(circle: Path) -> None:
    data = read_alpha_truck(circle)
    assert len(data) == 2 and data.lengths.tolist() == [100, 100] and data.labels == ("1", "2")
    assert torch.equal(data.time[0], torch.zeros(2, dtype=torch.float64))
    torch.testing.assert_close(data.steps, torch.full((99, 2), 24.25 / 199, dtype=torch.float64))
    assert bool(data.observed.all()) and data.measurements.shape == (100, 2, 4)
    assert data.control_names == ("speed", "turn")
    assert data.measurement_names == ("bearing_0", "bearing_1", "bearing_2", "bearing_3")
    assert data.state_names == ("x", "y", "heading", "vx", "vy", "yaw_rate")


def test_commands_are_interpolated_over_the_whole_window(circle: Path) -> None:
    data = read_alpha_truck(circle)
    t = clock(data)
    torch.testing.assert_close(data.controls, torch.stack([1.0 + 0.1 * t, 0.5 - 0.02 * t], -1))


def test_the_pose_is_that_of_the_motion(circle: Path) -> None:
    data = read_alpha_truck(circle)
    assert data.states is not None
    t = clock(data)
    # between poses 10 ms apart the chord leaves the circle by r (w dt)²/8 at most
    tolerance = RADIUS * (TURN_RATE * 0.01) ** 2 / 8 * 1.01
    place = RADIUS * torch.stack([torch.cos(TURN_RATE * t), torch.sin(TURN_RATE * t)], -1)
    torch.testing.assert_close(data.states[..., :2], place, rtol=0, atol=tolerance)
    assert float(wrap(data.states[..., 2] - TURN_RATE * t - math.pi / 2).abs().max()) < tolerance
    assert float(data.states[..., 2].abs().max()) <= math.pi


def test_velocities_are_forward_differences_in_the_world_frame(circle: Path) -> None:
    data = read_alpha_truck(circle)
    assert data.states is not None
    step = data.steps[0, 0]
    log = data.states.transpose(0, 1).reshape(200, 6)
    change = log[1:, :3] - log[:-1, :3]
    change[:, 2] = wrap(change[:, 2])
    torch.testing.assert_close(log[:-1, 3:], change / step)
    assert torch.equal(log[-1, 3:], log[-2, 3:])
    # the yaw rate sees no jump where the heading passes ±π
    torch.testing.assert_close(log[:, 5], torch.full((200,), TURN_RATE).double(), rtol=0, atol=1e-3)


def true_bearings(data: Trajectories, landmarks: torch.Tensor) -> torch.Tensor:
    assert data.states is not None
    there = landmarks - data.states[..., None, :2]
    return torch.atan2(there[..., 1], there[..., 0]) - data.states[..., 2:3]


def test_bearings_are_the_true_ones_plus_noise_of_the_given_size(circle: Path) -> None:
    for degrees in (1.25, 5.0):
        data = read_alpha_truck(circle, sigma_degrees=degrees, seed=3)
        noise = wrap(data.measurements - true_bearings(data, torch.tensor(LANDMARKS, dtype=torch.float64)))
        scaled = noise / math.radians(degrees)
        count = scaled.numel()
        assert float(data.measurements.abs().max()) <= math.pi
        assert abs(float(scaled.mean())) < 4 / math.sqrt(count)
        assert abs(float(scaled.var()) - 1) < 4 * math.sqrt(2 / count)


def test_other_landmarks(circle: Path) -> None:
    data = read_alpha_truck(circle, sigma_degrees=1e-6, landmarks=[(5.0, 0.0)])
    assert data.measurement_names == ("bearing_0",)
    error = wrap(data.measurements - true_bearings(data, torch.tensor([[5.0, 0.0]], dtype=torch.float64)))
    assert float(error.abs().max()) < 1e-6


def test_splits_of_one_seed_share_no_noise(circle: Path) -> None:
    folders = [circle / "train", circle / "valid"]
    noises = []
    for folder in folders:
        folder.mkdir()
        for log in circle.glob("*.csv"):
            (folder / log.name).write_bytes(log.read_bytes())
        data = read_alpha_truck(folder, seed=1)
        noises.append(wrap(data.measurements - true_bearings(data, torch.tensor(LANDMARKS, dtype=torch.float64))))
    one, other = (noise.flatten() for noise in noises)
    assert abs(float(torch.corrcoef(torch.stack([one, other]))[0, 1])) < 4 / math.sqrt(len(one))


def test_the_seed_decides_the_bearings_and_nothing_else(circle: Path) -> None:
    torch.manual_seed(11)
    before = torch.get_rng_state()
    first, again, other = (read_alpha_truck(circle, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(first.measurements, again.measurements)
    assert not bool((first.measurements == other.measurements).any())
    assert first.states is not None and other.states is not None and torch.equal(first.states, other.states)


def test_messages_out_of_order_are_sorted_by_their_stamps(circle: Path, tmp_path: Path) -> None:
    expected = read_alpha_truck(circle)
    folder = tmp_path / "shuffled"
    folder.mkdir()
    shuffle = {"frac": 1.0, "random_state": 0}
    write(folder, pose_log(begin=0.5).sample(**shuffle), command_log(end=24.75).sample(**shuffle))
    data = read_alpha_truck(folder)
    assert data.states is not None and expected.states is not None
    assert torch.equal(data.states, expected.states) and torch.equal(data.controls, expected.controls)


# --- what is wrong with the logs


def rejected(folder: Path) -> DataError:
    with pytest.raises(DataError) as caught:
        read_alpha_truck(folder)
    assert "\n" not in str(caught.value) and str(folder) not in str(caught.value)
    return caught.value


def test_missing_folder(tmp_path: Path) -> None:
    assert str(rejected(tmp_path / "train")).startswith("train: no such folder; expected one with vrpn-pose.csv")


@pytest.mark.parametrize("name", ["vrpn-pose.csv", "vesc_drive.csv"])
def test_missing_log(circle: Path, name: str) -> None:
    (circle / name).unlink()
    assert str(rejected(circle)) == f"{circle.name}/{name}: there is no such file"


@pytest.mark.parametrize(
    ("content", "says"),
    [(b"", "the log is empty"), (b"\xff\xfe\x00", "cannot be read as csv"), (b'a,b\n"1,2\n', "cannot be read as csv")],
)
def test_unreadable_log(circle: Path, content: bytes, says: str) -> None:
    (circle / "vesc_drive.csv").write_bytes(content)
    assert f"{circle.name}/vesc_drive.csv: {says}" in str(rejected(circle))


def test_a_log_without_rows(circle: Path) -> None:
    write(circle, pose_log().iloc[:0], command_log())
    assert str(rejected(circle)) == f"{circle.name}/vrpn-pose.csv: the log has no rows"


@pytest.mark.parametrize("column", ["header.stamp.nsecs", "pose.orientation.w", "twist.angular.z"])
def test_missing_column(circle: Path, column: str) -> None:
    write(circle, pose_log().drop(columns=column, errors="ignore"), command_log().drop(columns=column, errors="ignore"))
    error = rejected(circle)
    assert error.column == column and f"column {column} is missing" in str(error)


@pytest.mark.parametrize(("cell", "came"), [("abc", "'abc'"), ("", "an empty cell"), ("inf", "'inf'")])
def test_a_bad_cell(circle: Path, cell: str, came: str) -> None:
    command = command_log().astype({"twist.linear.x": str})
    command.loc[6, "twist.linear.x"] = cell
    write(circle, pose_log(), command)
    error = rejected(circle)
    assert (error.column, error.row) == ("twist.linear.x", 7)
    assert f"column twist.linear.x, row 7: got {came}, expected a finite number" in str(error)


@pytest.mark.parametrize(
    ("cut", "says"),
    [
        (lambda log: log(end=9.0), "overlap by 9 s, expected 10 s or more"),
        (lambda log: log(end=9.95), "overlap by 9.95 s, expected 10 s or more"),
        (lambda log: log(begin=30.0, end=60.0), "do not overlap (they are 5 s apart)"),
    ],
)
def test_too_little_overlap(circle: Path, cut: Callable, says: str) -> None:
    write(circle, pose_log(), cut(command_log))
    assert says in str(rejected(circle))


def test_ten_seconds_are_enough(circle: Path) -> None:
    write(circle, pose_log(), command_log(begin=3.0, end=13.0))
    data = read_alpha_truck(circle)
    assert len(data) == 1 and float(data.time[-1, 0]) == pytest.approx(10.0)


@pytest.mark.parametrize("degrees", [0.0, -5.0, math.nan, math.inf])
def test_a_sigma_that_is_not_positive(circle: Path, degrees: float) -> None:
    with pytest.raises(UsageError, match="must be positive and finite"):
        read_alpha_truck(circle, sigma_degrees=degrees)


# --- the published logs


@pytest.mark.skipif(not REAL.is_dir(), reason="the AlphaTruck logs are not part of this repository")
@pytest.mark.parametrize(
    ("split", "trajectories", "step"), [("train", 17, 0.103007), ("valid", 10, 0.107707), ("test", 14, 0.103389)]
)
def test_the_published_logs(split: str, trajectories: int, step: float) -> None:
    data = read_alpha_truck(REAL / split)
    assert len(data) == trajectories and data.lengths.tolist() == [100] * trajectories
    assert float(data.steps.mean()) == pytest.approx(step, abs=1e-6)
    assert float(data.steps.max() - data.steps.min()) < 1e-9
    assert data.states is not None and bool(data.states.isfinite().all())


@pytest.mark.skipif(not REAL.is_dir(), reason="the AlphaTruck logs are not part of this repository")
def test_the_published_drives_follow_their_commands() -> None:
    """Pose, heading and commands belong together: speed and yaw rate answer the commands of 0.2 s before, forwards."""
    data = read_alpha_truck(REAL / "test")
    assert data.states is not None
    heading, vx, vy, yaw_rate = data.states[..., 2:].unbind(-1)
    forward, lateral = heading.cos() * vx + heading.sin() * vy, heading.cos() * vy - heading.sin() * vx
    for response, command in ((forward, data.controls[..., 0]), (yaw_rate, data.controls[..., 1])):
        pair = torch.stack([response[2:].flatten(), command[:-2].flatten()])
        assert float(pair.corrcoef()[0, 1]) > 0.9
    gain = (forward[2:] * data.controls[:-2, :, 0]).sum() / data.controls[:-2, :, 0].square().sum()
    assert float(gain) == pytest.approx(0.89, abs=0.02)
    assert float(lateral.square().mean() / forward.square().mean()) < 0.05


@pytest.mark.skipif(not REAL.is_dir(), reason="the AlphaTruck logs are not part of this repository")
@pytest.mark.parametrize(
    ("split", "expected"),
    [("train", [("12", (56, 75), ("x.x", "x.y", "x.heading", "x.vx", "x.vy", "x.yaw_rate"))]), ("valid", [])],
)
def test_the_drop_out_of_the_motion_capture_is_found_without_being_told(split: str, expected: list) -> None:
    assert [(one.label, one.rows, one.columns) for one in frozen_stretches(read_alpha_truck(REAL / split))] == expected


def test_a_hostile_log_is_refused(tmp_path: Path) -> None:
    head = "header.stamp.secs,header.stamp.nsecs,"
    pose = "pose.position.x,pose.position.y,pose.orientation.z,pose.orientation.w\n"
    for text, says in (
        ("," * 2_000_000 + "\n", "the first line has more than"),
        (head + pose + f"{'9' * 400},0,0,0,0,1\n", "expected a finite number"),
        (head + pose + "1e300,0,0,0,0,1\n", "expected a part of a time stamp"),
        (head + pose + "1,-5,0,0,0,1\n", "expected a part of a time stamp"),
    ):
        (tmp_path / "vrpn-pose.csv").write_text(text)
        with pytest.raises(DataError, match=says):
            read_alpha_truck(tmp_path)
