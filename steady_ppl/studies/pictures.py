"""Pictures of a study: what was found against an axis of it, beside what others have published."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter
from pandas.api.types import infer_dtype
from scipy import stats

from steady_ppl.errors import UsageError
from steady_ppl.plotting.comparison import COLORS, MARKERS
from steady_ppl.studies.job import IN_LIMITS
from steady_ppl.studies.plan import MAX_MAGNITUDE, Picture, Plan
from steady_ppl.studies.table import NUMERIC_KINDS
from steady_ppl.utils.text import printable

SIZE_EDGES = (-1.0, 0.0, *(1.25 ** (place - 0.5) for place in range(-6, 12)), math.inf)
"""Ends of ranges of what is missing, in detection limits: each a quarter wider than the one before, one of them around
a limit; the first is of trajectories that lack nothing."""
SHARE_COLUMNS = ("found", "right", "in_class")
PUBLISHED = "published"  # in the legend
PUBLISHED_LOOK: dict[str, Any] = {"ls": "--", "marker": "*", "ms": 7, "lw": 0.9, "alpha": 0.6}


def study_picture(plan: Plan, results: pd.DataFrame) -> Figure:
    """The panels of a study: means of the seeds with their standard deviations, lines of methods and of what else was
    varied; of shares (true or false) exact 95 % intervals; a horizontal line where a method has no x; a cross at the
    upper edge where a job has failed.

    Raises:
        UsageError: it has no `[picture]`, nothing of it is done yet, or a column is not there or holds no numbers.
    """
    picture = plan.picture
    if picture is None:
        raise UsageError("the study has no [picture]: say there which columns x and y are")
    order = {job.key: place for place, job in enumerate(plan.jobs)}
    own = results[results["key"].isin(order)]
    if len(own):  # else it may have no other columns
        own = own[~own["method"].isin(picture.leave_out)]
    if not len(own) or not (own["outcome"] == "done").any():
        raise UsageError("no job of the study is done yet")
    if missing := [name for name in picture.columns if name not in own]:
        raise UsageError(f"the table has no column {missing[0]}; it has {', '.join(map(str, own))}")
    own = own.assign(**{name: _numbers(own, name) for name in picture.columns})
    own = own.iloc[np.argsort([order[key] for key in own["key"]], kind="stable")]
    if picture.chosen_by:
        own = best_settings(picture, own)
    figure = Figure(figsize=(4.2 * len(picture.y), 4.6), layout="constrained")
    figure.suptitle(printable(plan.title), fontsize=11, parse_math=False)
    lines = _lines(picture, own)
    panels = figure.subplots(1, len(picture.y), squeeze=False, sharex=picture.x == IN_LIMITS)[0]
    for panel, column in zip(panels, picture.y, strict=True):
        _panel(panel, picture, column, lines)
    entries = {str(line.get_label()): line for panel in figure.axes for line in panel.get_legend_handles_labels()[0]}
    if PUBLISHED in entries:  # of every method in its own colour
        entries[PUBLISHED] = Line2D([], [], color="0.4", **PUBLISHED_LOOK)
    if entries:
        legend = figure.legend(
            entries.values(), entries, loc="outside lower center", ncols=2 * len(picture.y), fontsize=8
        )
        for text in legend.get_texts():
            text.set_parse_math(False)
    return figure


def _numbers(rows: pd.DataFrame, name: str) -> pd.Series:
    """A column as numbers, or as true and false; NaN where a job has none, and where it is beyond what can be drawn."""
    kind = infer_dtype(rows[name])
    if kind in ("boolean", "empty"):
        return rows[name].astype(object)
    if kind not in NUMERIC_KINDS:
        raise UsageError(f"column {name} of the table holds no numbers")
    numbers = rows[name].astype(float)
    return numbers.where(numbers.abs() <= MAX_MAGNITUDE)


def best_settings(picture: Picture, rows: pd.DataFrame) -> pd.DataFrame:
    """Of each method's settings on the same data those whose mean of `chosen_by` is largest, by the seeds that all of
    them have; settings with which more of these have failed come last, and what is beyond every number does so too."""
    settings = [name for name in rows if str(name).startswith("settings.")]
    data = [name for name in rows if str(name).startswith("data.")]
    kept = []
    for _, own in rows.groupby("method", sort=False):
        varied = [name for name in settings if own[name].nunique(dropna=False) > 1]
        for _, tried in own.groupby(data, sort=False, dropna=False):
            groups = [part for _, part in tried.groupby(varied, sort=False, dropna=False)] if varied else [tried]
            shared = set.intersection(*(set(part["seed"]) for part in groups))
            best = max(groups, key=lambda part: _merit(part[part["seed"].isin(shared)], picture.chosen_by))
            kept.append(best.assign(**dict.fromkeys(varied)))
    return pd.concat(kept)


def _merit(rows: pd.DataFrame, column: str) -> tuple[int, float]:
    failed = rows["outcome"] == "failed"
    values = rows[column][~failed].astype(float).fillna(-math.inf)
    return -int(failed.sum()), float(values.mean()) if len(values) else -math.inf


def _lines(picture: Picture, rows: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Rows of a method, apart where a setting or what is said of the data was varied besides x."""
    x = "data.effect" if picture.x == IN_LIMITS else picture.x
    axes = [name for name in rows if str(name).startswith(("data.", "settings.")) and name != x]
    found = []
    for method, own in rows.groupby("method", sort=False):
        varied = [name for name in axes if own[name].nunique(dropna=False) > 1]
        for values, part in own.groupby(varied, sort=False, dropna=False) if varied else [((), own)]:
            said = [f"{name.partition('.')[2]} {value}" for name, value in zip(varied, values, strict=True)]
            found.append((", ".join([picture.labels.get(str(method), str(method)), *said]), part))
    return found


def _panel(axes: Axes, picture: Picture, column: str, lines: Sequence[tuple[str, pd.DataFrame]]) -> None:
    given = picture.published.get(column, {})
    published = {picture.labels.get(name, name): others for name, others in given.items()}
    crosses = Counter[float]()
    for index, (name, rows) in enumerate(lines):
        look, said = _look(index), printable(name, kept="")
        found = points(rows, picture.x, column)
        if rows[picture.x].isna().all() and rows[column].notna().any():  # the same wherever x is
            axes.axhline(float(rows[column].astype(float).mean()), color=look["color"], lw=1.5, ls=":", label=said)
        elif found:
            x, middle, low, high = zip(*found, strict=True)
            axes.errorbar(x, middle, (low, high), ms=5, lw=1.5, capsize=3, label=said, **look)
        _published(axes, published.pop(name, []), look["color"], PUBLISHED)
        _failed(axes, rows, picture.x, look, said, crosses)
    for index, (name, others) in enumerate(published.items(), len(lines)):
        _published(axes, others, _look(index)["color"], f"{printable(name, kept='')}, {PUBLISHED}")
    _scale(axes, picture, column, lines)
    axes.set_xlabel(printable(picture.labels.get(picture.x, picture.x)), parse_math=False)
    axes.set_ylabel(printable(picture.labels.get(column, column)), parse_math=False)
    axes.grid(alpha=0.25)


def _look(index: int) -> dict[str, Any]:
    """A colour, a mark and a line that no other of the first 49 has together."""
    turn, place = divmod(index, len(COLORS))
    return {"color": COLORS[place], "marker": MARKERS[(place + turn) % len(MARKERS)], "ls": ("-", "-.")[turn % 2]}


def _published(axes: Axes, points: Sequence[Sequence[float]], color: str, name: str) -> None:
    if points:
        axes.plot(*zip(*points, strict=True), label=name, color=color, **PUBLISHED_LOOK)


def _failed(
    axes: Axes, rows: pd.DataFrame, x: str, look: Mapping[str, Any], name: str, crosses: Counter[float]
) -> None:
    """A cross at the upper edge for each place where jobs have failed, below those that are there already; one in the
    legend alone where it is a result that says the place."""
    failed = rows[rows["outcome"] == "failed"]
    edge = axes.get_xaxis_transform()
    style: dict[str, Any] = {"ls": "", "marker": "x", "ms": 8, "mew": 2, "color": look["color"]}
    if len(failed):
        places = failed[x].dropna().unique()
        heights, said = [0.98 - 0.04 * crosses[place] for place in places], f"{len(failed)} of {len(rows)} failed"
        axes.plot(places, heights, transform=edge, clip_on=False, label=f"{name}: {said}", **style)
        crosses.update(places)
    nowhere = int((rows["outcome"].eq("done") & rows[x].isna()).sum()) if x == IN_LIMITS else 0
    if nowhere:
        said = f"{nowhere} of {len(rows)} without a detection limit"
        axes.plot([], [], label=f"{name}: {said}", **style | {"marker": "+"})


def _scale(axes: Axes, picture: Picture, column: str, lines: Sequence[tuple[str, pd.DataFrame]]) -> None:
    """Logarithmic, with a tick a value, where x goes over a factor of four or more; and y where it goes over five."""
    own = [rows[picture.x].dropna().to_numpy(float) for _, rows in lines]
    others = [point[0] for points in picture.published.get(column, {}).values() for point in points]
    values = np.unique(np.concatenate([*own, others]))
    if picture.x != IN_LIMITS and len(values) and values[0] > 0 and values[-1] >= 4 * values[0]:
        axes.set_xscale("log")
        if len(values) <= 12:
            axes.set_xticks(values, [f"{value:g}" for value in values])
            axes.minorticks_off()
    if column in SHARE_COLUMNS:
        axes.set_ylim(-0.05, 1.05)
        return
    heights = [height for _, rows in lines for _, height, *_ in points(rows, picture.x, column)]
    if heights and 0 < 5 * min(heights) <= max(heights):
        axes.set_yscale("log", nonpositive="clip")
        axes.set_ylim(bottom=min(heights) / 1.3)
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())


def points(rows: pd.DataFrame, x: str, y: str) -> list[tuple[float, float, float, float]]:
    """What is drawn of a line: places on x, middles and how far bars reach below and above."""
    rows = rows[rows[x].notna() & rows[y].notna()]
    share = infer_dtype(rows[y]) == "boolean"
    found = []
    for _, part in rows.groupby(pd.cut(rows[x], SIZE_EDGES), observed=True) if x == IN_LIMITS else rows.groupby(x):
        values = part[y].astype(float)
        middle = float(values.mean())
        if share:
            low, high = stats.binomtest(int(values.sum()), len(values)).proportion_ci(0.95)
        else:
            spread = float(values.std()) if len(values) > 1 else 0.0
            low, high = middle - spread, middle + spread
        found.append((float(part[x].mean()), middle, middle - low, high - middle))
    return found
