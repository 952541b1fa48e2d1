"""Pictures for notebooks and papers; each function draws on matplotlib axes and returns them.

Of a posterior: `posterior_trajectories`, `posterior_velocities`, `effective_sizes`. Of a forecast: `forecast_band`.
Of a fit: `held_out_curve`, `observation_noise`, `particle_curve`. Of a check: `innovations`. Of a discovery:
`unknown_effect`. Of a proof: `open_loop_picture`. Names and units are those of the program's components.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes

from steady_ppl.errors import UsageError
from steady_ppl.program import names
from steady_ppl.proof_pictures import open_loop_picture
from steady_ppl.training_pictures import held_out_curve, observation_noise, particle_curve

if TYPE_CHECKING:
    import arviz

    from steady_ppl.checking import Check
    from steady_ppl.discovery import Discovery

__all__ = [
    "effective_sizes",
    "forecast_band",
    "held_out_curve",
    "innovations",
    "observation_noise",
    "open_loop_picture",
    "particle_curve",
    "posterior_trajectories",
    "posterior_velocities",
    "unknown_effect",
]

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


def effective_sizes(posterior: arviz.InferenceData, trajectory: str, *, axes: Axes | None = None) -> Axes:
    """How many particles the filter had in effect in each row, of N.

    Args:
        posterior: of `Fit.posterior`.
        trajectory: its label.
        axes: drawn on; new ones when not given.
    """
    axes = axes if axes is not None else plt.subplots(figsize=(6, 3), layout="constrained")[1]
    sizes = posterior["sample_stats"]["effective_size"].sel(trajectory=trajectory, chain=0)
    about = posterior["posterior"].attrs
    axes.plot(
        posterior["constant_data"]["time"].sel(trajectory=trajectory), sizes, color=POSTERIOR, label=about["filter"]
    )
    axes.axhline(about["particles"], color="black", lw=0.6, label="N")
    axes.set_yscale("log")
    axes.set_xlabel("time [s]")
    axes.set_ylabel("effective sample size [particles]")
    axes.legend(fontsize=8)
    return axes


def forecast_band(
    found: arviz.InferenceData, trajectory: str, of: str, *, axes: Axes | None = None, color: str = LANDMARK
) -> Axes:
    """Median and 90 % of a forecast, what was measured before and, where there is any, after it.

    Args:
        found: of `Fit.forecast`.
        trajectory: its label.
        of: a measurement or a state component.
        axes: drawn on; new ones when not given.

    Raises:
        UsageError: nothing of that name was forecast.
    """
    variables = found["predictions"]
    name = f"measured_{of}" if f"measured_{of}" in variables else of
    if name not in variables:
        raise UsageError(f"no forecast of {of!r}; there are {', '.join(map(str, variables.data_vars))}")
    axes = axes if axes is not None else plt.subplots(figsize=(7, 3), layout="constrained")[1]
    time = found["constant_data"]["time"].sel(trajectory=trajectory)
    draws = variables[name].sel(trajectory=trajectory, chain=0)
    there = np.isfinite(draws.values).all(0)
    low, median, high = np.quantile(draws.values[:, there], [0.05, 0.5, 0.95], axis=0)
    axes.fill_between(time[there], low, high, color=color, alpha=0.25, lw=0, label="forecast, 90 %")
    axes.plot(time[there], median, color=color, lw=1.4, label="forecast, median")
    if name in found["observed_data"]:
        axes.plot(time, found["observed_data"][name].sel(trajectory=trajectory), ".", color=TRUTH, ms=3, label="used")
    elif f"true_{of}" in found["constant_data"]:
        axes.plot(
            time, found["constant_data"][f"true_{of}"].sel(trajectory=trajectory), "--", color=TRUTH, label="truth"
        )
    axes.set_xlabel("time [s]")
    unit = variables[name].attrs.get("units", "")
    axes.set_ylabel(f"{of} [{unit}]" if unit else of)
    axes.legend(fontsize=8)
    return axes


def innovations(found: Check, trajectory: str, *, axes: Axes | None = None) -> Axes:
    """Measured less predicted one step ahead, in standard deviations of the prediction; 95 % belong into the grey.

    Args:
        found: by `check`.
        trajectory: its label.
        axes: drawn on; new ones when not given.

    Raises:
        UsageError: no such trajectory.
    """
    if trajectory not in found.data.labels:
        raise UsageError(f"no trajectory {trajectory!r}; there are {', '.join(found.data.labels)}")
    axes = axes if axes is not None else plt.subplots(figsize=(7, 3), layout="constrained")[1]
    drive, prediction = found.data.labels.index(trajectory), found.predictions[1]
    time = found.data.elapsed[1:, drive].numpy(force=True)
    scores = torch.where(prediction.observed, prediction.standardised, torch.nan)[:, drive].numpy(force=True)
    axes.axhspan(-1.96, 1.96, color="0.9", lw=0)
    for component, (name, mark) in enumerate(zip(names(found.program.measurements), "os^Dvx+*" * 99, strict=False)):
        axes.plot(time, scores[:, component], mark, ms=3, label=name)
    axes.axhline(0, color="black", lw=0.6)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("innovation [standard deviations]")
    axes.set_title(f"trajectory {trajectory}")
    axes.legend(fontsize=7, ncols=4)
    return axes


def unknown_effect(found: Discovery, *, axes: Axes | None = None) -> Axes:
    """The curve that explains the drives where no effect of the catalogue does, with its band.

    Raises:
        UsageError: the verdict is another one: there is no curve.
    """
    from steady_ppl.discovery.curve_pictures import curve_panel

    if found.shape is None:
        raise UsageError(f"there is no curve to draw: the verdict is {found.verdict}")
    return curve_panel(found, axes if axes is not None else plt.subplots(figsize=(6, 4), layout="constrained")[1])


def _in_body_frame(heading: Any, vx: Any, vy: Any) -> tuple[Any, Any]:
    cos, sin = np.cos(heading), np.sin(heading)
    return cos * vx + sin * vy, cos * vy - sin * vx
