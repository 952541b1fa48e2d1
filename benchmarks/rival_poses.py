"""Where a vehicle was and how it moved, from bearings alone and without its program: what regressions begin with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from steady_ppl import Program, Trajectories
from steady_ppl.gaussian.predict import errors

POSE = 3  # of a planar vehicle's state x, y, heading come first
HEADINGS, PLACES, REACH = 16, 9, 1.5  # a search begins on a grid of so many, over so many times the landmarks' extent
PASSES = 25
VAGUE = 1e4  # variance beyond which a pose is not known at all


@dataclass(frozen=True)
class Poses:
    """Each row's pose and its variance, `(T + 1, B, 3)` m and rad; headings go on beyond a whole turn."""

    values: Tensor
    variance: Tensor


@dataclass(frozen=True)
class Motion:
    """States and their derivatives, `(T + 1, B, D)`, and the variance of the accelerations, `(T + 1, B, 3)`."""

    states: Tensor
    rates: Tensor
    variance: Tensor


@torch.no_grad()
def poses(program: Program, data: Trajectories) -> Poses:
    """Each row's pose by nonlinear least squares on its bearings (Levenberg 1944)."""
    pose = _on_a_grid(program, data)
    damping = torch.full((*data.time.shape, 1, 1), 1e-2, dtype=torch.double)
    wrong = _misfit(program, data, pose)
    for _ in range(PASSES):
        slope = _slopes(program, data, pose)
        square = slope.mT @ slope
        damped = square + damping * torch.diag_embed(square.diagonal(dim1=-2, dim2=-1) + 1e-9)
        tried = pose + torch.linalg.solve(damped, slope.mT @ wrong[..., None])[..., 0]
        then = _misfit(program, data, tried)
        better = (then.square().sum(-1) < wrong.square().sum(-1))[..., None]
        pose, wrong = torch.where(better, tried, pose), torch.where(better, then, wrong)
        damping = torch.where(better[..., None], damping / 4, damping * 4)
    slope = _slopes(program, data, pose) / program.bearing_sd
    known = slope.mT @ slope + torch.eye(POSE).double() / VAGUE
    turned = torch.from_numpy(np.unwrap(pose[..., 2].numpy(), axis=0))
    return Poses(torch.cat([pose[..., :2], turned[..., None]], -1), known.inverse().diagonal(dim1=-2, dim2=-1))


def moving(found: Poses, step: float, window: int) -> Motion:
    """Cubics through `window` rows around each (Savitzky and Golay 1964), weighted by the poses' variances.

    Without them a few rows far from the landmarks, where poses are metres off, decide everything. The program moves its
    pose by the velocity of the row before, so that this is the pose's derivative half a row later.
    """
    half = window // 2
    powers = torch.linspace(-1, 1, window).double()[:, None] ** torch.arange(4)
    seen = torch.nn.functional.pad(1 / found.variance, (0, 0, 0, 0, half, half)).unfold(0, window, 1)
    values = torch.nn.functional.pad(found.values, (0, 0, 0, 0, half, half)).unfold(0, window, 1)
    square = torch.einsum("tbiw,wm,wn->tbimn", seen, powers, powers)
    cubic = torch.linalg.solve(square, torch.einsum("tbiw,wm->tbim", seen * values, powers))
    scale = half * step
    velocity, acceleration = cubic[..., 1] / scale, 2 * cubic[..., 2] / scale**2
    velocity = (velocity + _next(velocity)) / 2
    return Motion(
        states=torch.cat([cubic[..., 0], velocity], -1),
        rates=torch.cat([velocity, _next(acceleration)], -1),
        variance=_next(4 * square.inverse()[..., 2, 2] / scale**4),
    )


def _next(values: Tensor) -> Tensor:
    """Those of the next row; the last ones stay."""
    return torch.cat([values[1:], values[-1:]])


def _misfit(program: Program, data: Trajectories, pose: Tensor) -> Tensor:
    """Measured less seen from a pose, rad, `(..., T + 1, B, K)`."""
    states = torch.cat([pose, pose.new_zeros((*pose.shape[:-1], len(program.states) - POSE))], -1)
    left = pose.shape[:-3]
    measurements, observed = (part.expand(*left, *part.shape) for part in (data.measurements, data.observed))
    return torch.where(observed, errors(program, states.to(data.controls), measurements, observed), 0.0).double()


def _slopes(program: Program, data: Trajectories, pose: Tensor) -> Tensor:
    """Derivatives of what is seen by the pose, `(T + 1, B, K, 3)`."""
    apart = 1e-3 * torch.eye(POSE, dtype=pose.dtype)[:, None, None]
    change = _misfit(program, data, pose - apart) - _misfit(program, data, pose + apart)
    return (change / 2e-3).movedim(0, -1)


def _on_a_grid(program: Program, data: Trajectories) -> Tensor:
    marks = torch.as_tensor(program.landmarks, dtype=torch.double)
    middle, half = (marks.amax(0) + marks.amin(0)) / 2, REACH * (marks.amax(0) - marks.amin(0)) / 2
    places = [torch.linspace(float(middle[i] - half[i]), float(middle[i] + half[i]), PLACES).double() for i in (0, 1)]
    headings = torch.linspace(-torch.pi, torch.pi, HEADINGS + 1)[:-1].double()
    best, least = data.time.new_zeros((*data.time.shape, POSE)), torch.full(data.time.shape, torch.inf).double()
    for heading in headings:
        grid = torch.cartesian_prod(*places, heading[None])[:, None, None].expand(-1, *data.time.shape, -1)
        wrong, which = _misfit(program, data, grid).square().sum(-1).min(0)
        best = torch.where((wrong < least)[..., None], grid[which, 0, 0], best)
        least = torch.minimum(least, wrong)
    return best
