"""Pictures for notebooks and papers; each function draws on matplotlib axes and returns them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes

if TYPE_CHECKING:
    import arviz

POSTERIOR, TRUTH, LANDMARK = "#0072b2", "black", "#d55e00"


def posterior_trajectories(
    posterior: arviz.InferenceData,
    trajectory: str,
    *,
    landmarks: Sequence[Sequence[float]] | torch.Tensor = (),
    axes: Axes | None = None,
    color: str = POSTERIOR,
    label: str = "posterior draws",
    shown: int = 50,
) -> Axes:
    """Draws of one trajectory in the plane, with the truth where it is known, and the landmarks.

    Args:
        posterior: of `Fit.posterior`, of a program with the state components x and y.
        trajectory: its label.
        landmarks: `(K, 2)` m.
        axes: drawn on; new ones when not given.
        shown: draw at most so many paths.
    """
    axes = axes if axes is not None else plt.subplots(figsize=(5, 5))[1]
    draws = posterior["posterior"].sel(trajectory=trajectory, chain=0)
    for index in range(min(shown, draws.sizes["draw"])):
        draw = draws.isel(draw=index)
        axes.plot(draw["x"], draw["y"], color=color, alpha=0.15, lw=0.8, label=label if index == 0 else None)
    constants = posterior["constant_data"].sel(trajectory=trajectory)
    if "true_x" in constants and bool(constants["true_x"].notnull().sum() > 1):
        axes.plot(constants["true_x"], constants["true_y"], color=TRUTH, lw=1.4, ls="--", label="truth")
    if len(landmarks):
        xs, ys = torch.as_tensor(landmarks).detach().cpu().unbind(-1)
        axes.plot(xs, ys, "^", color=LANDMARK, ms=8, label="landmark", clip_on=True)
    unit: Any = draws["x"].attrs.get("units", "")
    axes.set_xlabel(f"x [{unit}]")
    axes.set_ylabel(f"y [{unit}]")
    axes.set_aspect("equal", "box")
    axes.set_title(f"trajectory {trajectory}")
    for line in axes.get_lines():
        if line.get_label() == label:
            line.set_rasterized(True)
    return axes


def posterior_velocities(
    posterior: arviz.InferenceData,
    trajectory: str,
    *,
    axes: Sequence[Axes] | None = None,
    color: str = POSTERIOR,
    label: str = "posterior",
) -> Sequence[Axes]:
    """Longitudinal and lateral velocity in the body frame: median and 90 % of the draws, and the truth where it
    is known.

    Args:
        posterior: of `Fit.posterior`, of a planar vehicle.
        trajectory: its label.
        axes: two, drawn on; new ones when not given.
    """
    axes = axes if axes is not None else plt.subplots(2, 1, figsize=(7, 4.5), sharex=True)[1]
    draws = posterior["posterior"].sel(trajectory=trajectory, chain=0)
    constants = posterior["constant_data"].sel(trajectory=trajectory)
    time = constants["time"]
    found = _in_body_frame(draws["heading"], draws["vx"], draws["vy"])
    true = None
    if "true_vx" in constants and bool(constants["true_vx"].notnull().sum() > 1):
        true = _in_body_frame(*(constants[f"true_{name}"] for name in ("heading", "vx", "vy")))
    for index, (one, name) in enumerate(zip(axes, ("longitudinal", "lateral"), strict=True)):
        low, median, high = found[index].quantile([0.05, 0.5, 0.95], dim="draw")
        one.fill_between(time, low, high, color=color, alpha=0.25, lw=0)
        one.plot(time, median, color=color, lw=1.4, label=label)
        if true is not None and not any(line.get_label() == "truth" for line in one.get_lines()):
            one.plot(time, true[index], color=TRUTH, lw=1.2, ls="--", label="truth")
        one.set_ylabel(f"{name} [m/s]")
    axes[-1].set_xlabel("time [s]")
    return axes


def _in_body_frame(heading: Any, vx: Any, vy: Any) -> tuple[Any, Any]:
    cos, sin = np.cos(heading), np.sin(heading)
    return cos * vx + sin * vy, cos * vy - sin * vx
