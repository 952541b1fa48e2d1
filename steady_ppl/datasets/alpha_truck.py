"""The AlphaTruck drives: a 1:10 truck under motion capture, with bearings simulated from its pose.

The logs are published as `datasets/alpha_truck` of the repository MrVPlusOne/STEADY on GitHub (the code of STEADY,
IROS 2022). No licence is stated there, hence they are not part of this package. Each of the folders `train`, `valid`
and `test` holds `vrpn-pose.csv` (poses at 100 Hz) and `vesc_drive.csv` (commands at 20 Hz).

Known flaws, kept so that results compare with the published ones: motion capture drops out for 2.12 s in the middle
of the 12th training trajectory, and the motion interpolated there is not the truck's.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from steady_ppl.data.table import fail, finite_numbers
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError, UsageError
from steady_ppl.model.planar_vehicle import bearings_to
from steady_ppl.utils.angles import wrap
from steady_ppl.utils.files import require_file
from steady_ppl.utils.random import seeded

LANDMARKS = ((-1.230314, -0.606814), (0.797073, 0.889471), (-3.496525, 0.207874), (0.0, 6.0))  # m, as published
TRAJECTORY_ROWS = 100  # of a trajectory, which spans a little more than 10 s
MAX_HEADER_LENGTH = 1_000_000  # characters; the reader takes minutes for a line of ten million
MAX_STAMP_SECONDS = 2**33  # s since 1970, whose nanoseconds fit into 64 bits
STAMP_COLUMNS = ("header.stamp.secs", "header.stamp.nsecs")
POSE_COLUMNS = ("pose.position.x", "pose.position.y", "pose.orientation.z", "pose.orientation.w")
COMMAND_COLUMNS = ("twist.linear.x", "twist.angular.z")


def read_alpha_truck(
    folder: str | Path,
    *,
    sigma_degrees: float = 5.0,
    seed: int = 0,
    landmarks: Sequence[Sequence[float]] = LANDMARKS,
    centred: bool = False,
) -> Trajectories:
    """Read one split, resampled as the authors of STEADY do.

    The window in which both logs run is cut into n = ⌊window in s⌋ // 10 trajectories. Position, cos and sin of the
    heading and both commands are interpolated linearly at 100 n evenly spaced times over the whole window; velocities
    are forward differences there, the last one repeated: those of half a row later, which suit an explicit Euler step.
    Centred ones, the displacement from half a row before to half a row after, are those of the row itself. Nothing is
    filtered. Times are the messages' header stamps, by which a log is sorted.

    Args:
        folder: holds `vrpn-pose.csv` and `vesc_drive.csv`.
        sigma_degrees: standard deviation of the bearings, degrees; larger within 0.1 m of a landmark, see
            `bearings_to`.
        seed: of the bearings' noise, drawn once; the folder's name makes it another for each split.
        landmarks: `(K, 2)` m.
        centred: take centred velocities.

    Returns:
        n trajectories of 100 rows, float64, each starting at time 0, with controls speed (m/s) and turn (rad/s),
        measurements bearing_0, … (rad) and states x, y (m), heading (rad, in [−π, π]), vx, vy (m/s, world frame) and
        yaw_rate (rad/s).

    Raises:
        DataError: a missing file or column, a cell that is no finite number, or logs that overlap by less than 10 s.
        UsageError: a sigma that is not positive.
    """
    if not (sigma_degrees > 0 and math.isfinite(sigma_degrees)):
        raise UsageError(f"the bearings' standard deviation must be positive and finite, got {sigma_degrees} degrees")
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"{folder.name}: no such folder; expected one with vrpn-pose.csv and vesc_drive.csv")
    pose_stamps, pose = _read_log(folder / "vrpn-pose.csv", POSE_COLUMNS)
    command_stamps, command = _read_log(folder / "vesc_drive.csv", COMMAND_COLUMNS)
    begin, end = max(pose_stamps[0], command_stamps[0]), min(pose_stamps[-1], command_stamps[-1])
    window = (end - begin) * 1e-9
    if (count := int(window) // 10) < 1:
        overlap = f"overlap by {window:.3g} s" if window > 0 else f"do not overlap (they are {-window:.3g} s apart)"
        raise DataError(f"{folder.name}: vrpn-pose.csv and vesc_drive.csv {overlap}, expected 10 s or more")

    grid = np.linspace(0.0, window, TRAJECTORY_ROWS * count)
    step = window / (TRAJECTORY_ROWS * count - 1)

    def resample(stamps: np.ndarray, values: np.ndarray, at: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.interp(at, (stamps - begin) * 1e-9, values))

    def poses(at: np.ndarray) -> torch.Tensor:
        x, y, qz, qw = pose.T
        angle = 2 * np.arctan2(qz, qw)
        x, y, cos, sin = (resample(pose_stamps, values, at) for values in (x, y, np.cos(angle), np.sin(angle)))
        return torch.stack([x, y, torch.atan2(sin, cos)], -1)

    if centred:
        before, after = (grid - step / 2).clip(0.0, window), (grid + step / 2).clip(0.0, window)
        change, spans = poses(after) - poses(before), torch.from_numpy(after - before).unsqueeze(-1)
    else:
        change, spans = poses(grid).diff(dim=0), torch.full((1, 1), step, dtype=torch.float64)
        change = torch.cat([change, change[-1:]])
    change[:, 2] = wrap(change[:, 2])
    states = torch.cat([poses(grid), change / spans], -1)
    controls = torch.stack([resample(command_stamps, values, grid) for values in command.T], -1)
    states, controls = (block.unflatten(0, (count, TRAJECTORY_ROWS)).transpose(0, 1) for block in (states, controls))

    with seeded(seed, "bearings", folder.resolve().name):
        bearings = bearings_to(landmarks, states, sd=math.radians(sigma_degrees)).sample()
    return Trajectories(
        time=(torch.arange(TRAJECTORY_ROWS, dtype=torch.float64) * step)[:, None].repeat(1, count),
        controls=controls,
        measurements=bearings,
        observed=torch.ones_like(bearings, dtype=torch.bool),
        lengths=torch.full((count,), TRAJECTORY_ROWS),
        states=states,
        control_names=("speed", "turn"),
        measurement_names=tuple(f"bearing_{i}" for i in range(len(landmarks))),
        state_names=("x", "y", "heading", "vx", "vy", "yaw_rate"),
    )


def _read_log(path: Path, columns: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """The header stamps `(N,)` in ns, in order, and the named columns `(N, ·)`."""
    where = f"{path.parent.name}/{path.name}"
    require_file(path, DataError)
    try:
        with path.open("rb") as file:
            if len(file.readline(MAX_HEADER_LENGTH + 1)) > MAX_HEADER_LENGTH:
                raise DataError(f"{where}: the first line has more than {MAX_HEADER_LENGTH} characters: is it a log?")
        log = pd.read_csv(path, low_memory=False)
    except FileNotFoundError as error:
        raise DataError(f"{where}: there is no such file") from error
    except pd.errors.EmptyDataError as error:
        raise DataError(f"{where}: the log is empty") from error
    except (OSError, ValueError) as error:
        raise DataError(f"{where}: cannot be read as csv: {str(error).partition(chr(10))[0]}") from error
    for column in (*STAMP_COLUMNS, *columns):
        if column not in log.columns:
            raise DataError(f"{where}: column {column} is missing", column=column)
        log[column] = finite_numbers(log[column], where, np.ones(len(log), dtype=bool))
    if len(log) == 0:
        raise DataError(f"{where}: the log has no rows")
    for column, most in zip(STAMP_COLUMNS, (MAX_STAMP_SECONDS, 10**9), strict=True):
        for row in np.flatnonzero((log[column] < 0) | (log[column] >= most))[:1].tolist():
            problem = f"got {log[column].iloc[row]:g}, expected a part of a time stamp, 0 to {most}"
            fail(where, problem, column=column, row=row + 1)
    stamps = log[STAMP_COLUMNS[0]].to_numpy(np.int64) * 10**9 + log[STAMP_COLUMNS[1]].to_numpy(np.int64)
    order = stamps.argsort(kind="stable")
    return stamps[order], log[list(columns)].to_numpy(np.float64)[order]
