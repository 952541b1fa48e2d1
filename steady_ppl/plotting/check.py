"""The picture of a check: predictions of one drive, errors against references, and where and when they stand out."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from steady_ppl.criticism.baselines import Reference
from steady_ppl.criticism.result import Check, band, floor_name, measured_values, over_floor, strips, subject, verdict
from steady_ppl.errors import UsageError
from steady_ppl.model.program import unit_of
from steady_ppl.utils.text import with_unit

DATA_COLOR, NEAR_COLOR, FAR_COLOR, BASELINE_COLOR, FLOOR_COLOR = "black", "#0072b2", "#d55e00", "#cc79a7", "#009e73"
WRONG_COLOR = "#d00000"
MAX_COMPONENTS_SHOWN = 4  # panels
CHECK_TITLE_COLUMNS = 165  # letters of its line over the whole width


def check_picture(found: Check) -> Figure:
    """One figure of everything; made without pyplot's list of figures, so that nothing needs to be closed."""
    with plt.rc_context({"axes.titlesize": 9, "axes.labelsize": 8}):
        shown = min(MAX_COMPONENTS_SHOWN, len(found.program.measurement_names))
        figure = Figure(figsize=(13, 2.2 * max(shown, 3) + 1.3), layout="constrained")
        left, right = np.ravel(figure.subfigures(1, 2, width_ratios=(1.25, 1), squeeze=False))
        drive = representative(found)
        panels = left.subplots(shown, 1, sharex=True, squeeze=False)[:, 0]
        for component, axes in enumerate(panels):
            predictions(found, drive, component, axes)
        panels[0].set_title(f"measured and predicted, trajectory {found.data.labels[drive]}", parse_math=False)
        panels[-1].set_xlabel("time [s]")
        left.legend(*panels[0].get_legend_handles_labels(), fontsize=8, ncols=4, loc="outside lower center")
        figure.suptitle("\n".join(textwrap.wrap(verdict(found), CHECK_TITLE_COLUMNS)), fontsize=10)
        above, regime, against = right.subplots(3, 1, height_ratios=(1.2, 1, 1))
        where_and_when(found, above)
        regime_panel(found, regime)
        against_references(found, against)
        return figure


def representative(found: Check) -> int:
    """The drive of the clearest outlier, else of the strongest finding that names one, else the one that is predicted
    worst over the longest time."""
    if found.outliers.found:
        return max(found.outliers.found, key=lambda one: one.gain).drive
    for finding in found.misfit.significant:
        if "drive" in finding.cell.where:
            return int(finding.cell.where["drive"])
    far = found.predictions[max(found.predictions)]
    return int((far.standardised.square().sum((0, 2)) / far.observed.sum((0, 2)).clamp(min=1)).argmax())


def predictions(found: Check, drive: int, component: int, axes: Axes) -> None:
    """Measured against the nearest and the farthest prediction, with 90 % bands."""
    time = found.data.elapsed[:, drive].numpy(force=True)
    last = list(found.horizons)[-1]
    for name, color in zip(dict.fromkeys(("one step", last)), (NEAR_COLOR, FAR_COLOR), strict=False):
        at, middle, half = _with_breaks(time, *(values[:, drive, component] for values in band(found, name)))
        axes.fill_between(at, middle - half, middle + half, color=color, alpha=0.18, lw=0)
        axes.plot(at, middle, color=color, lw=1, label=f"{name} ahead, 90 % band")
    axes.plot(time, measured_values(found)[:, drive, component], ".", color=DATA_COLOR, ms=3, label="measured")
    if bool((wrong := found.outliers.wrong[:, drive]).any()):  # also where this component has none, for the legend
        there = wrong[:, component].numpy(force=True)
        logged = found.outliers.data.measurements[:, drive, component].numpy(force=True)
        axes.plot(time[there], logged[there], "x", color=WRONG_COLOR, ms=5, label="left out as wrong")
    program = found.program
    axes.set_ylabel(with_unit(program.measurement_names[component], program.measurement_units[component]))


def _with_breaks(time: np.ndarray, middle: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The rows that were measured, with a break wherever three of them, as they usually come, are missing."""
    seen = np.isfinite(half)
    time, middle, half = time[seen], middle[seen], half[seen]
    apart = np.diff(time)
    breaks = np.flatnonzero(apart > 3.5 * np.median(apart)) + 1 if len(apart) else np.zeros(0, int)
    return np.insert(time, breaks, np.nan), np.insert(middle, breaks, np.nan), np.insert(half, breaks, np.nan)


def where_and_when(found: Check, axes: Axes) -> None:
    """The strongest residual of every drive and strip of time."""
    times, every = strips(found)
    axes.set_title("where and when: strongest mean residual of each trajectory and strip")
    if not times:
        axes.text(0.5, 0.5, "too few rows for strips", ha="center", va="center", transform=axes.transAxes)
        axes.set_axis_off()
        return
    grid = np.take_along_axis(every, np.abs(np.nan_to_num(every)).argmax(0)[None], 0)[0]
    edges = [start for start, _ in times] + [times[-1][1]]
    mesh = axes.pcolormesh(edges, np.arange(len(grid) + 1) + 0.5, grid, cmap="RdBu_r", vmin=-6, vmax=6)
    for finding in found.misfit.significant:
        if finding.cell.map == "drive and time":
            axes.plot(sum(finding.cell.where["time"]) / 2, finding.cell.where["drive"] + 1, "k*", ms=5)
    step = max(1, len(grid) // 8)
    axes.set_yticks(np.arange(1, len(grid) + 1, step), found.data.labels[::step], fontsize=7, parse_math=False)
    axes.set(xlabel="time [s]  (★ significant)", ylabel="trajectory")
    axes.figure.colorbar(mesh, ax=axes).set_label("simulated sd")


def regime_panel(found: Check, axes: Axes) -> None:
    """The mean residual over the ranges of the variable in which it stands out most."""
    if not (cells := found.misfit.of_map("regime")):
        axes.set_axis_off()
        return
    strongest, _ = max(cells, key=lambda pair: abs(pair[1]))
    ((variable, _),) = strongest.where.items()
    chosen = [(cell, z) for cell, z in cells if cell.residual == strongest.residual and variable in cell.where]
    for cell, z in chosen:
        axes.fill_between(cell.where[variable], -2, 2, color="0.85", lw=0)
        axes.plot(cell.where[variable], [z, z], color=NEAR_COLOR, lw=3, solid_capstyle="butt")
    stand_out = [one.cell for one in found.misfit.significant if one.cell.map == "regime"]
    for cell, z in chosen:
        if cell in stand_out:
            axes.plot(sum(cell.where[variable]) / 2, z, "k*", ms=6)
    axes.axhline(0, color="black", lw=0.6)
    axes.set(xlabel=with_unit(variable, unit_of(found.program, variable)), ylabel="simulated sd")
    what = "in which regime" if stand_out else "strongest regime, not significant"
    axes.set_title(f"{what}: mean residual of {subject(found, strongest.residual)} (grey: ±2)")


def against_references(found: Check, axes: Axes) -> None:
    """Errors over the noise floor, root mean square over the components, against the time ahead."""
    horizons = list(found.horizons.values())
    seconds = [horizon * found.data.median_step for horizon in horizons]
    axes.axhline(1, color=FLOOR_COLOR, lw=1.5, label=floor_name(found))

    def line(errors: Mapping[int, tuple[Any, Any]], style: str, color: str, label: str) -> None:
        relative = [over_floor(*errors[horizon], found.floor[horizon]) for horizon in horizons]
        axes.plot(seconds, relative, style, color=color, label=label, ms=4)

    line({ahead: (one.error, one.observed) for ahead, one in found.predictions.items()}, "o-", NEAR_COLOR, "model")
    line(found.held, "s:", "0.5", "last measurement")
    if isinstance(found.reference, Reference):
        theirs = {ahead: (one.error, one.observed) for ahead, one in found.reference.predictions.items()}
        line(theirs, "^--", BASELINE_COLOR, "constant velocity")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("{x:g}")
    axes.set_title("against references: root mean square error over all measurements")
    axes.set(xlabel="predicted ahead [s]", ylabel=f"RMSE / {floor_name(found)}")
    axes.legend(fontsize=7)


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
    for component, (name, mark) in enumerate(zip(found.program.measurement_names, "os^Dvx+*" * 99, strict=False)):
        axes.plot(time, scores[:, component], mark, ms=3, label=name)
    axes.axhline(0, color="black", lw=0.6)
    axes.set(xlabel="time [s]", ylabel="innovation [standard deviations]")
    axes.set_title(f"trajectory {trajectory}", parse_math=False)
    axes.legend(fontsize=7, ncols=4)
    return axes
