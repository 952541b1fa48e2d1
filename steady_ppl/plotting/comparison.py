"""The picture of a proof: how the error grows with the time ahead."""

from __future__ import annotations

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from steady_ppl.comparison.result import NOISE_FLOOR, Proof, units_of_states
from steady_ppl.errors import UsageError
from steady_ppl.utils.text import with_unit

COLORS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "black")  # Okabe and Ito
MARKERS = "os^Dvx+"


def open_loop_picture(found: Proof, *, of: str | None = None, axes: Axes | None = None) -> Axes:
    """Root mean square error of open-loop predictions against the seconds ahead, what noise alone leaves in grey.

    Args:
        found: by `prove`.
        of: a unit of the measurements, or an error group of the states where the truth is known; the first
            measurement's unit when not given.
        axes: drawn on; new ones when not given.

    Raises:
        UsageError: the proof has no such error.
    """
    states = units_of_states(found)
    of = found.rows[found.reference].program.measurement_units[0] if of is None else of
    every = {name: found.open_loop(name) for name in found.rows}
    curves = {name: one.get(("state", of)) or one.get(("measurement", of), []) for name, one in every.items()}
    if not curves[found.reference]:
        have = {key.of for key in found.rows[found.reference].sums if key.kind in ("measurement", "state")}
        raise UsageError(f"there is no open-loop error of {of!r}; there are {', '.join(sorted(have))}")
    axes = axes if axes is not None else plt.subplots(figsize=(6, 4), layout="constrained")[1]
    floor = curves.pop(NOISE_FLOOR, [])
    curves = {name: curve for name, curve in curves.items() if curve}
    for index, (name, curve) in enumerate(curves.items()):
        mark, color = MARKERS[index % len(MARKERS)], COLORS[index % len(COLORS)]
        axes.plot(*zip(*curve, strict=True), f"{mark}-", color=color, ms=4, lw=1.4, label=name)
    axes.set(xscale="log", yscale="log", xlabel="predicted ahead [s]")
    for axis in (axes.xaxis, axes.yaxis):  # 0.1 and 20 rather than powers of ten
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")  # twos and fives
    axes.tick_params(which="minor", labelsize=7)
    if floor:
        seconds, errors = zip(*floor, strict=True)
        lowest = 0.8 * min(error for curve in (floor, *curves.values()) for _, error in curve)
        axes.fill_between(seconds, lowest, errors, color="0.85", lw=0, label=NOISE_FLOOR, zorder=0)
        axes.set_ylim(bottom=lowest)
    unit, what = (states[of], of) if of in states else (of, "measured")
    axes.set_ylabel(with_unit(f"{what}, root mean square error", unit))
    axes.legend(fontsize=8)
    return axes


def proof_picture(found: Proof) -> Figure:
    """The same as a figure of its own; made without pyplot's list of figures, so that nothing needs to be closed."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    open_loop_picture(found, axes=figure.subplots())
    return figure
