"""The picture of a discovery: what every candidate gains, what could have been seen, the curve, before and after."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from steady_ppl.discovery.candidates import Candidate
from steady_ppl.discovery.curves import variables_along
from steady_ppl.discovery.finding import Finding, gain_interval
from steady_ppl.discovery.refits import Fold, Refit
from steady_ppl.discovery.result import Discovery, limit_of, sentences
from steady_ppl.discovery.screening import Tested
from steady_ppl.effects import Variant
from steady_ppl.errors import UsageError
from steady_ppl.gaussian.predict import HALF_WIDTH
from steady_ppl.model.program import Program
from steady_ppl.plotting.comparison import open_loop_picture
from steady_ppl.utils.text import with_unit

CHOSEN_COLOR, ALIAS_COLOR, OTHER_COLOR, LIMIT_COLOR = "#d55e00", "#e69f00", "#0072b2", "#009e73"  # Okabe and Ito
MAX_CANDIDATES = 9  # candidates of a group
MAX_OTHERS = 20  # effects that were not found, beside those that were
DISCOVERY_TITLE_COLUMNS = 125  # letters of its line over the whole width
LETTER_POINTS = 8  # size of small letters
MAX_RUG_TICKS = 400


class GainRow(NamedTuple):
    """A line of a panel: a value with an interval, in the panel's unit, and what is written beside it."""

    label: str
    value: float
    interval: tuple[float, float] | None
    color: str
    beside: str = ""


def discovery_picture(found: Discovery) -> Figure:
    """One figure of everything; made without pyplot's list of figures, so that nothing needs to be closed."""
    groups = _groups(found)
    lines = sum(2 + sum(bool(row.label) for row in group) for group in groups)
    height = max(7.5, 4.5 + 0.24 * lines) if groups else 2.2 + 0.19 * len(_remaining(found))
    figure = Figure(figsize=(12, height), layout="constrained")
    if groups:
        left, right = np.ravel(figure.subfigures(1, 2, width_ratios=(1, 1.05), squeeze=False))
        rows = [row for group in groups for row in group]
        if found.proof is None:
            gains(rows, left.subplots())
        else:
            above, below = left.subplots(2, 1, height_ratios=(height - 3.5, 3))
            gains(rows, above)
            open_loop_picture(found.proof, axes=below)
            titled(below, "prediction error on the validation trajectories", below.get_xlabel())
        if found.shape:
            unknown_effect(found, axes=right.subplots())
        else:
            coefficients(found, right.subplots())
    else:
        left, right = figure.subplots(1, 2, width_ratios=(1, 1.3))
        tests(found, left)
        coefficients(found, right, rest=len(_remaining(found)))
    figure.suptitle("\n".join(textwrap.wrap(" ".join(sentences(found)), DISCOVERY_TITLE_COLUMNS)), fontsize=10)
    return figure


def gains(rows: Sequence[GainRow], axes: Axes) -> None:
    """Held-out log p(y) that each fitted candidate brings, one group for each effect that was found."""
    most = max(row.value for row in rows if row.label)
    left = min([-0.25 * most, *(row.interval[0] for row in rows if row.interval and row.color != OTHER_COLOR)])
    for place, row in enumerate(rows):
        if row.value < left:
            axes.annotate(f"◂ {row.value:.0f}", (left, place), color=row.color, fontsize=LETTER_POINTS, va="center")
        elif row.label:
            _point(axes, row, place, hollow=row.interval is None)
    about = "held-out log p(y) gained [nats], 95 % interval"
    titled(axes, "held-out gain of each candidate", about, [row.label or row.beside for row in rows])
    for text, row in zip(axes.get_yticklabels(), rows, strict=True):
        text.set_fontweight("normal" if row.label else "bold")
    axes.set_xlim(left - 0.05 * (most - left), None)
    axes.axvline(0, color="black", lw=0.6)
    kinds = {CHOSEN_COLOR: "chosen", ALIAS_COLOR: "cannot be told from it", OTHER_COLOR: "other candidates"}
    for color in [color for color in kinds if any(row.label and row.color == color for row in rows)]:
        axes.plot([], [], "o", color=color, ms=5, label=kinds[color])
    if any(row.label and row.interval is None and row.value >= left for row in rows):
        axes.plot([], [], "o", mfc="none", color=OTHER_COLOR, ms=5, label="stopped after half of the trajectories")
    axes.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3)


def coefficients(found: Discovery, axes: Axes, rest: int = MAX_OTHERS) -> None:
    """Coefficients in units of what could have been seen: those that were found, then those of the last tests."""
    rows = [row for finding in found.findings for row in _of_finding(found, finding)]
    rows += [row for tested in _remaining(found)[:rest] for row in _of_test(tested)]
    for place, row in enumerate(rows):
        _point(axes, row, place)
        axes.text(1.01, place, row.beside, transform=axes.get_yaxis_transform(), fontsize=7, va="center")
    axes.axvspan(-1, 1, color=LIMIT_COLOR, alpha=0.15, lw=0)
    axes.axvline(0, color="black", lw=0.6)
    if max((abs(row.value) for row in rows), default=0.0) > 8:
        axes.set_xscale("symlog", linthresh=1)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.margins(x=0.06)
    axes.text(1.01, 1.01, "limit", transform=axes.transAxes, fontsize=7, va="bottom")
    title = "effects found, and effects that remain" if found.findings else "detection limits"
    about = "coefficient / detection limit, 90 % interval (green: can be missed)"
    titled(axes, title, about, [row.label for row in rows])


def tests(found: Discovery, axes: Axes) -> None:
    """Every candidate's own p-value against the one that keeps the family-wise level; where nothing was fitted."""
    screened = found.search.rounds[0].screening.tests
    shown = [tested for tested in screened.tested if not tested.untestable]
    for place, tested in enumerate(shown):
        color = CHOSEN_COLOR if tested.p_value <= screened.critical else OTHER_COLOR
        axes.plot(max(tested.p_value, 1e-16), place, "o", color=color, ms=4)
    axes.axvline(screened.critical, color=CHOSEN_COLOR, lw=1, ls="--", label="5 % level of the whole catalogue")
    axes.set_xscale("log")
    axes.invert_xaxis()
    axes.legend(fontsize=7, loc="lower right")
    title, names = f"score tests: family-wise p = {found.p_value:.2g}", [_label(tested.variant) for tested in shown]
    titled(axes, title, "p-value of each candidate alone; beyond the line something is missing", names)


def _groups(found: Discovery) -> list[list[GainRow]]:
    """What was fitted: alone, and in the place of each effect, best first; a heading is a line without a label."""
    search = found.search

    def group(heading: str, candidates: list[Candidate], chosen: list[str], like: Sequence[str] = ()) -> list[GainRow]:
        rows = [GainRow("", 0.0, None, OTHER_COLOR, heading)] if heading else []
        for candidate in candidates:
            label = _label(candidate.variant)
            color = CHOSEN_COLOR if label in chosen else ALIAS_COLOR if label in like else OTHER_COLOR
            rows.append(GainRow(label, candidate.total, gain_interval(candidate, found.before.seed), color))
        return rows

    if found.shape is not None or not search.found:
        candidates = _fitted([*search.rounds[0].candidates, *search.curves])
        return [group("", candidates, [_label(search.curve.variant)] if search.curve else [])] if candidates else []
    ordered = sorted(search.found, key=lambda one: -one.candidate.total)
    chosen = [_label(one.candidate.variant) for one in ordered]
    aliases = [[_label(candidate.variant) for candidate in one.aliases] for one in ordered]
    if len(ordered) == 1:
        return [group("", _fitted(ordered[0].candidates), chosen, aliases[0])]
    groups = [group("each alone", _fitted(search.rounds[0].candidates), chosen)]
    if all(len(one.candidates) == 1 for one in ordered):
        together = [candidate for one in ordered for candidate in _fitted(one.candidates)]
        return [*groups, group("each beside the others", together, chosen)]
    for own, one, like in zip(chosen, ordered, aliases, strict=True):
        others = [label for label in chosen if label != own]
        beside = others[0] if len(others) == 1 else f"the other {len(others)}"
        groups.append(group(f"beside {beside}", _fitted(one.candidates), [own], like))
    return groups


def _fitted(candidates: Sequence[Candidate]) -> list[Candidate]:
    return sorted((c for c in candidates if math.isfinite(c.total)), key=lambda c: -c.total)[:MAX_CANDIDATES]


def _remaining(found: Discovery) -> list[Tested]:
    """Named effects of the last tests whose coefficient can be compared with a limit."""
    tested = found.search.rounds[-1].screening.tests.tested
    alive = [t for t in tested if not (t.untestable or t.is_curve or t.departure)]
    return [t for t in alive if math.isfinite(t.variant.effect.null) and (t.detection_limit > 0).all()]


def _of_finding(found: Discovery, finding: Finding) -> list[GainRow]:
    variant, absent = finding.variant, finding.variant.effect.null
    tests_of = (one.screening.tests.tested for one in found.search.rounds)
    first = next((t for tested in tests_of for t in tested if t.variant.name == variant.name), None)
    if first is None or not math.isfinite(absent):
        return []
    values, ends = np.array(finding.coefficient) - absent, np.array(finding.interval) - absent
    return _in_limits(variant, values, ends, limit_of(found, first), CHOSEN_COLOR)


def _of_test(tested: Tested) -> list[GainRow]:
    half = HALF_WIDTH * tested.sd
    ends = np.stack([tested.coefficient - half, tested.coefficient + half], -1)
    return _in_limits(tested.variant, tested.coefficient, ends, tested.detection_limit, OTHER_COLOR)


def _in_limits(variant: Variant, values: np.ndarray, ends: np.ndarray, limits: np.ndarray, color: str) -> list[GainRow]:
    """A line for each component: its value and interval `(k, 2)` over its detection limit."""
    label = _label(variant)
    labels = [f"{label} {part}" for part in variant.effect.components] or [label] * len(values)
    rows = zip(labels, values / limits, ends / limits[:, None], limits, strict=True)
    return [GainRow(name, value, (low, high), color, _with_unit(at, variant)) for name, value, (low, high), at in rows]


def _with_unit(limit: float, variant: Variant) -> str:
    if limit > variant.limit:
        return "beyond the physical"
    return f"{limit:.2g}" + ("" if variant.unit in ("", "1") else f" {variant.unit}")


def _label(variant: Variant) -> str:
    """An effect's name; of a curve what it adds to and what it depends on."""
    to, tilde, of = variant.at.partition("~")
    return f"{to}: a curve of {of}" if tilde else variant.label


def _point(axes: Axes, row: GainRow, place: float, hollow: bool = False) -> None:
    if row.interval is not None:
        axes.plot(row.interval, (place, place), "-", color=row.color, lw=1.6)
    axes.plot(row.value, place, "o", color=row.color, ms=5, mfc="none" if hollow else row.color)


def unknown_effect(found: Discovery, *, axes: Axes | None = None) -> Axes:
    """The curve that explains the trajectories where no effect does, with its band; grey where no trajectory was.

    Raises:
        UsageError: the verdict is another one: there is no curve.
    """
    shape, chosen = found.shape, found.search.curve
    if shape is None:
        raise UsageError(f"there is no curve to draw: the verdict is {found.verdict}")
    assert chosen is not None and isinstance(chosen.refit, Refit)
    axes = axes if axes is not None else plt.subplots(figsize=(6, 4), layout="constrained")[1]
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
    axes.fill_between(points, heights - band, heights + band, color=CHOSEN_COLOR, alpha=0.2, lw=0, label="90 % band")
    axes.plot(points, heights, "o-", color=CHOSEN_COLOR, ms=4, label="curve")
    rug = np.random.default_rng(0).choice(values, min(len(values), MAX_RUG_TICKS), replace=False)
    axes.plot(rug, np.full(len(rug), 0.015), "|", color="black", ms=6, alpha=0.3, transform=axes.get_xaxis_transform())
    axes.axhline(0, color="black", lw=0.6)
    times = f", times {shape.times}" if shape.times else ""
    axes.set_ylabel(f"missing from {shape.channel}{times}{f' [{shape.unit}]' if shape.unit not in ('', '1') else ''}")
    axes.legend(fontsize=7, loc="upper right" if heights[0] > heights[-1] else "upper left")
    variable = with_unit(shape.variable, shape.variable_unit)
    return titled(axes, "the curve that is missing, in no catalogue", f"{variable}; ticks: where the trajectories were")


def titled(axes: Axes, title: str, about: str, lines: Sequence[str] | None = None) -> Axes:
    """Title, axis and what its lines are of, from above, in small letters."""
    if lines is not None:
        axes.set_yticks(range(len(lines)), lines)
        axes.set_ylim(len(lines) - 0.4, -0.6)
    axes.set_title(title, fontsize=9)
    axes.set_xlabel(about, fontsize=LETTER_POINTS)
    axes.yaxis.label.set_fontsize(LETTER_POINTS)
    axes.tick_params(which="both", labelsize=LETTER_POINTS)
    return axes


def _visited(program: Program, variant: Variant, fold: Fold) -> np.ndarray:
    """Values of what a curve depends on, on the drives of a fold."""
    data = fold.drives
    if "chosen" in variant.options:
        index = [program.measurement_names.index(name) for name in variant.options["chosen"]]
        return data.measurements[..., index][data.observed[..., index]].double().numpy(force=True)
    along, _ = variables_along(program, data, fold.path.states[..., : len(program.states)])
    values = along[variant.options["variable"]].expand(data.transitions.shape)
    return values[data.transitions].double().numpy(force=True)
