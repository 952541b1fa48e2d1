"""The picture of a curve that explains the drives where no named effect does."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.axes import Axes

from steady_ppl.discovery.curves import variables
from steady_ppl.discovery.refits import Fold, Refit
from steady_ppl.effects import Variant
from steady_ppl.model.interventions import channel_means
from steady_ppl.model.program import Program, names
from steady_ppl.model.substeps import acting_controls, row_controls

if TYPE_CHECKING:
    from steady_ppl.discovery.result import Discovery

CHOSEN = "#d55e00"  # Okabe and Ito
SMALL = 8  # points, of letters
TICKS = 400  # of the rug


def curve_panel(found: Discovery, axes: Axes) -> Axes:
    """The curve with its band, where the drives were, and greyed where they were not."""
    shape, chosen = found.shape, found.search.curve
    assert shape is not None and chosen is not None and isinstance(chosen.refit, Refit)
    points, heights, band = (np.array(values) for values in (shape.points, shape.curve, shape.band))
    program = found.before.program
    values = np.concatenate([_visited(program, chosen.variant, fold) for fold in chosen.refit.folds])
    if chosen.variant.options.get("circular") or shape.variable in program.angles:
        values = np.remainder(values - points[0], 2 * math.pi) + points[0]
        points = np.append(points, points[0] + 2 * math.pi)
        heights, band = np.append(heights, heights[0]), np.append(band, band[0])
    beyond = [min(values.min(), points[0]), max(values.max(), points[-1])]
    for low, high in ((beyond[0], points[0]), (points[-1], beyond[1])):
        axes.axvspan(low, high, color="0.92", lw=0)
    axes.plot([beyond[0], points[0]], [heights[0]] * 2, ":", color="0.4")
    axes.plot([points[-1], beyond[1]], [heights[-1]] * 2, ":", color="0.4", label="hardly visited")
    axes.fill_between(points, heights - band, heights + band, color=CHOSEN, alpha=0.2, lw=0, label="90 % band")
    axes.plot(points, heights, "o-", color=CHOSEN, ms=4, label="curve")
    rug = np.random.default_rng(0).choice(values, min(len(values), TICKS), replace=False)
    axes.plot(rug, np.full(len(rug), 0.015), "|", color="black", ms=6, alpha=0.3, transform=axes.get_xaxis_transform())
    axes.axhline(0, color="black", lw=0.6)
    times = f", times {shape.times}" if shape.times else ""
    axes.set_ylabel(f"missing from {shape.channel}{times}{f' [{shape.unit}]' if shape.unit not in ('', '1') else ''}")
    axes.legend(fontsize=7, loc="upper right" if heights[0] > heights[-1] else "upper left")
    about = (
        f"{shape.variable}{f' [{shape.variable_unit}]' if shape.variable_unit else ''}; ticks: where the drives were"
    )
    return titled(axes, "the curve that is missing, in no catalogue", about)


def titled(axes: Axes, title: str, about: str) -> Axes:
    """Title and axis in small letters."""
    axes.set_title(title, fontsize=9)
    axes.set_xlabel(about, fontsize=SMALL)
    axes.yaxis.label.set_fontsize(SMALL)
    axes.tick_params(which="both", labelsize=SMALL)
    return axes


@torch.no_grad()
def _visited(program: Program, variant: Variant, fold: Fold) -> np.ndarray:
    """Values of what a curve depends on, on the drives of a fold."""
    data = fold.drives
    if "chosen" in variant.options:
        index = [names(program.measurements).index(name) for name in variant.options["chosen"]]
        return data.measurements[..., index][data.observed[..., index]].double().numpy(force=True)
    states = fold.path.states[..., : len(program.states)]
    given = (states[:-1], row_controls(program, acting_controls(program, data))[:-1], data.elapsed[:-1])
    mean = channel_means(program, program.transition, *given, data.steps / program.substeps)
    values = variables(program, *given, mean)[variant.options["variable"]]
    return values.expand(data.transitions.shape)[data.transitions].double().numpy(force=True)
