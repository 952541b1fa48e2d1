"""Pictures for notebooks and papers; each function draws on matplotlib axes and returns them.

Of a posterior: `posterior_trajectories`, `posterior_states`, `posterior_velocities`, `effective_sizes`. Of a forecast:
`forecast_band`. Of a fit: `held_out_curve`, `observation_noise`, `particle_curve`. Of a check: `innovations`. Of a
discovery: `unknown_effect`. Of a proof: `open_loop_picture`. Names and units are those of the program's components.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes

from steady_ppl.errors import UsageError
from steady_ppl.model.program import names
from steady_ppl.posterior_pictures import (
    LANDMARK,
    TRUTH,
    effective_sizes,
    posterior_states,
    posterior_trajectories,
    posterior_velocities,
    require_trajectory,
    with_unit,
)
from steady_ppl.proof_pictures import open_loop_picture
from steady_ppl.training_pictures import held_out_curve, observation_noise, particle_curve
from steady_ppl.utils.angles import nearest_turn

if TYPE_CHECKING:
    import arviz

    from steady_ppl.criticism.result import Check
    from steady_ppl.discovery import Discovery

__all__ = [
    "effective_sizes",
    "forecast_band",
    "held_out_curve",
    "innovations",
    "observation_noise",
    "open_loop_picture",
    "particle_curve",
    "posterior_states",
    "posterior_trajectories",
    "posterior_velocities",
    "unknown_effect",
]


def forecast_band(
    found: arviz.InferenceData, trajectory: str, of: str, *, axes: Axes | None = None, color: str = LANDMARK
) -> Axes:
    """Median and 90 % of a forecast, what was measured before and, where the table has any, after the moment.

    Args:
        found: of `Fit.forecast`.
        trajectory: its label.
        of: a state component or a measurement; `measured_…` for a measurement that is called like a state.
        axes: drawn on; new ones when not given.

    Raises:
        UsageError: nothing of that name was forecast, or there is no such trajectory.
    """
    require_trajectory(found, trajectory)
    variables, later = found["predictions"], found["predictions_constant_data"]
    name = of if of in variables else f"measured_{of}"
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
        after = later[name].sel(trajectory=trajectory).values[there]
        if np.isfinite(after).any():
            after = nearest_turn(after, median) if variables[name].attrs["circular"] else after
            axes.plot(time[there], after, "x", color=TRUTH, ms=4, label="measured later")
    elif f"true_{of}" in found["constant_data"]:
        axes.plot(
            time, found["constant_data"][f"true_{of}"].sel(trajectory=trajectory), "--", color=TRUTH, label="truth"
        )
    axes.set_xlabel("time [s]")
    axes.set_ylabel(with_unit(of, variables[name]))
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
    axes.set_title(f"trajectory {trajectory}", parse_math=False)
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
