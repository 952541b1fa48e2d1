"""Pictures of a study: what was found against an axis of it, beside what others have published."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from steady_ppl.errors import UsageError
from steady_ppl.proof_pictures import COLORS, MARKS
from steady_ppl.studies.plan import Picture, Plan

SIZES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 10.0)  # ends of ranges of what is missing, in detection limits
IN_LIMITS = "in_limits"


def study_picture(plan: Plan, results: pd.DataFrame) -> Figure:
    """The panels of a study: means of the seeds with their standard deviations, lines of methods and of what else was
    varied; of shares (true or false) exact 95 % intervals.

    Args:
        plan: the study, with a `[picture]`.
        results: its table.

    Raises:
        UsageError: it has no picture, nothing of it is done yet, or it has no such column.
    """
    if plan.picture is None:
        raise UsageError("the study has no [picture]: say there which columns x and y are")
    keys = {job.key for job in plan.jobs}
    done = results[results["key"].isin(keys) & (results["outcome"] == "done")] if len(results) else results
    if not len(done):
        raise UsageError("no job of the study is done yet")
    missing = [name for name in (plan.picture.x, *plan.picture.y) if name not in done]
    if missing:
        numbers = ", ".join(name for name in done if pd.api.types.is_numeric_dtype(done[name]))
        raise UsageError(f"the table has no column {missing[0]}; of numbers it has {numbers}")
    figure = Figure(figsize=(6.2 * len(plan.picture.y), 4.4), layout="constrained")
    figure.suptitle(plan.title, fontsize=11, parse_math=False)
    lines = list(_lines(plan, done))
    for panel, column in zip(figure.subplots(1, len(plan.picture.y), squeeze=False)[0], plan.picture.y, strict=True):
        _panel(panel, plan.picture, column, lines)
    return figure


def _lines(plan: Plan, done: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Rows of a method, apart where a setting or what is said of the data was varied besides x."""
    assert plan.picture is not None
    axes = [name for name in done if name.startswith(("data.", "settings.")) and name != plan.picture.x]
    if plan.picture.x == IN_LIMITS:
        return [(str(method), rows) for method, rows in done.groupby("method", sort=False)]
    found = []
    for method, rows in done.groupby("method", sort=False):
        varied = [name for name in axes if rows[name].nunique(dropna=False) > 1]
        for values, part in rows.groupby(varied, sort=False, dropna=False) if varied else [((), rows)]:
            said = [f"{name.partition('.')[2]} {value}" for name, value in zip(varied, values, strict=True)]
            found.append((", ".join([str(method), *said]), part))
    return found


def _panel(axes: Axes, picture: Picture, column: str, lines: Sequence[tuple[str, pd.DataFrame]]) -> None:
    published = dict(picture.published.get(column, {}))
    for index, (name, rows) in enumerate(lines):
        mark, color = MARKS[index % len(MARKS)], COLORS[index % len(COLORS)]
        x, middle, low, high = _points(rows, picture.x, column)
        axes.errorbar(x, middle, (low, high), fmt=f"{mark}-", color=color, ms=5, lw=1.5, capsize=3, label=name)
        _published(axes, published.pop(name, []), color, f"{name}, published")
    for index, (name, points) in enumerate(published.items(), len(lines)):
        _published(axes, points, COLORS[index % len(COLORS)], f"{name}, published")
    values = np.array([value for _, rows in lines for value in rows[picture.x].dropna()], dtype=float)
    if picture.x != IN_LIMITS and len(values) and values.min() > 0 and values.max() > 4 * values.min():
        axes.set_xscale("log")
        axes.set_xticks(sorted(set(values)), [f"{value:g}" for value in sorted(set(values))], minor=False)
        axes.minorticks_off()
    axes.set_xlabel(picture.labels.get(picture.x, picture.x), parse_math=False)
    axes.set_ylabel(picture.labels.get(column, column), parse_math=False)
    axes.grid(alpha=0.25)
    axes.legend(fontsize=7)


def _published(axes: Axes, points: Sequence[Sequence[float]], color: str, name: str) -> None:
    if points:
        axes.plot(*zip(*points, strict=True), "--", color=color, marker="*", ms=7, lw=0.9, alpha=0.6, label=name)


def _points(rows: pd.DataFrame, x: str, y: str) -> tuple[list[float], list[float], list[float], list[float]]:
    """Places, middles and how far bars reach below and above."""
    rows = rows[rows[x].notna() & rows[y].notna()]
    share = rows[y].map(lambda value: isinstance(value, bool | np.bool_)).all()
    groups: Any = rows.groupby(pd.cut(rows[x], SIZES), observed=True) if x == IN_LIMITS else rows.groupby(x)
    found = []
    for _, part in groups:
        values = part[y].astype(float)
        middle = float(values.mean())
        if share:
            low, high = stats.binomtest(int(values.sum()), len(values)).proportion_ci(0.95)
        else:
            spread = float(values.std()) if len(values) > 1 else 0.0
            low, high = middle - spread, middle + spread
        found.append((float(part[x].mean()), middle, middle - low, high - middle))
    return tuple(map(list, zip(*found, strict=True))) if found else ([math.nan],) * 4  # type: ignore
