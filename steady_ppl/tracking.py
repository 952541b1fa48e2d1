"""Where the linearised program believes the vehicle was, row by row, and how log p(y) would change.

The scores are the derivatives of log p(y) by a push on the state of any row and by a shift of any measurement (de Jong
1989; Harvey and Koopman 1992 call them auxiliary residuals). Their sums over rows test for anything that pushes or
shifts. They are no estimates: the smoother has believed the program, so that a missing effect appears in them a tenth
of its size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from steady_ppl import kalman_recursions
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.linearization import Linearization, Path, linearize
from steady_ppl.model.program import Program


@dataclass(frozen=True)
class Tracked:
    """The Kalman filter and smoother of a linearised program, in double precision.

    Attributes:
        linearization: of the program, along the path that the last pass began with.
        states, covariances: `(T + 1, B, D)` and `(T + 1, B, D, D)`, given the measurements up to each row.
        smoothed: `(T + 1, B, D)`, the states given all measurements.
        noise: `(T, B, C)`, E[ε | y]: also the score of a push by each channel, per standard deviation of it.
        arrival: `(T + 1, B, D)`, the score of a push on the state that each row begins with.
        reading: `(T + 1, B, K)`, the score of a shift of each measurement; zero where it is missing.
        log_likelihood: `(B,)` log p(y).
    """

    linearization: Linearization
    states: Tensor
    covariances: Tensor
    smoothed: Tensor
    noise: Tensor
    arrival: Tensor
    reading: Tensor
    log_likelihood: Tensor

    def path(self, data: Trajectories) -> Path:
        """The posterior mean as a path to linearise along, the padding filled with the first row."""
        kind = data.controls.dtype
        return Path(
            states=torch.where(data.rows[..., None], self.smoothed, self.smoothed[:1]).to(kind),
            noise=torch.where(data.transitions[..., None], self.noise, 0.0).to(kind),
        )

    def variances_ahead(self, horizon: int) -> Tensor:
        """Variances of measurements predicted `horizon` rows ahead, `(T + 1 − horizon, B, K)`; NaN where missing."""
        linear = self.linearization
        rows, drives, components = linear.residual.shape
        out = np.empty((rows - horizon, drives, components))
        kalman_recursions.spread_ahead(
            horizon,
            _array(self.covariances),
            _moving(linear),
            _array(linear.measurement),
            _array(linear.precision),
            out,
        )
        return torch.from_numpy(out)


def track(
    program: Program,
    data: Trajectories,
    path: Path,
    *,
    known_start: bool,
    passes: int = 2,
    kernels: bool | None = None,
) -> Tracked:
    """Linearise along a path, filter and smooth, and again along what was smoothed.

    Args:
        program: with normal noise; see `linearize`.
        data: as returned by `for_program`.
        path: near the posterior's mode.
        known_start: the first state is certain.
        passes: linearisations.
        kernels: see `linearize`.
    """
    tracked = filter_and_smooth(linearize(program, data, path, known_start=known_start, kernels=kernels))
    for _ in range(passes - 1):
        path = tracked.path(data)
        tracked = filter_and_smooth(linearize(program, data, path, known_start=known_start, kernels=kernels))
    return tracked


def filter_and_smooth(linear: Linearization) -> Tracked:
    """Run the recursions along a linearization."""
    rows, drives, components, dimension = linear.measurement.shape
    filtered = np.empty((rows, drives, dimension)), np.empty((rows, drives, dimension, dimension))
    update = (
        np.empty((rows, drives, components)),
        np.empty((rows, drives, components)),
        np.empty((rows, drives, components, dimension)),
    )
    by_state, precision = _array(linear.measurement), _array(linear.precision)
    start = _array(linear.start_offset), _array(linear.start_noise)
    moving = _moving(linear)
    kalman_recursions.forward(start, moving, (_array(linear.residual), by_state, precision), filtered, update)
    arrival, reading, smoothed = np.empty_like(filtered[0]), np.empty_like(update[0]), np.empty_like(filtered[0])
    kalman_recursions.backward(filtered, update, moving, by_state, arrival, reading, smoothed)
    innovation, variance, _ = update
    with np.errstate(divide="ignore", invalid="ignore"):
        misfit = innovation**2 / variance + np.log(np.where(precision > 0, variance * precision, 1.0))
    pushes = torch.from_numpy(arrival)
    around = linear.path.states.double()
    return Tracked(
        linearization=linear,
        states=around + torch.from_numpy(filtered[0]),
        covariances=torch.from_numpy(filtered[1]),
        smoothed=around + torch.from_numpy(smoothed),
        noise=(linear.noise * pushes[1:].unsqueeze(-1)).sum(-2),
        arrival=pushes,
        reading=torch.from_numpy(reading),
        log_likelihood=linear.log_scale.sum(0) - 0.5 * torch.from_numpy(misfit).sum((0, 2)),
    )


def _moving(linear: Linearization) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return _array(linear.offset), _array(linear.state), _array(linear.noise)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.contiguous().numpy(force=True)
