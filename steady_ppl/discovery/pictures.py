"""The picture of a discovery: what every candidate gains, what could have been seen, the curve, before and after."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from steady_ppl.discovery.candidates import Candidate
from steady_ppl.discovery.curves import variables
from steady_ppl.discovery.discovery_report import limit_of, sentence
from steady_ppl.discovery.finding import Finding, gain_interval
from steady_ppl.discovery.refits import Fold, Refit
from steady_ppl.discovery.screening import Tested
from steady_ppl.effects import Variant
from steady_ppl.program import Program, acting_controls, names
from steady_ppl.proof_pictures import open_loop_picture

if TYPE_CHECKING:
    from steady_ppl.discovery.discovery import Discovery

CHOSEN, ALIKE, OTHER, LIMIT = "#d55e00", "#e69f00", "#0072b2", "#009e73"  # Okabe and Ito
MOST = 9  # candidates of a group
REST = 10  # effects that were not found, beside those that were
WIDTH = 125  # letters of a line over the whole width
SMALL = 8


class Row(NamedTuple):
    """A line of a panel: a value with an interval, in the panel's unit, and what is written beside it."""

    label: str
    value: float
    interval: tuple[float, float] | None
    color: str
    beside: str = ""


def discovery_picture(found: Discovery) -> Figure:
    """One figure of everything; made without pyplot's list of figures, so that nothing needs to be closed."""
    title = "\n".join(textwrap.wrap(sentence(found), WIDTH))
    if not _groups(found):
        count = len(_remaining(found))
        figure = Figure(figsize=(12, 2.2 + 0.19 * count), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(1, 1.3))
        tests(found, left)
        coefficients(found, right, rest=count)
    else:
        rows = sum(2 + len(candidates[:MOST]) for _, candidates, _ in _groups(found))
        figure = Figure(figsize=(12, max(7.0, 1.5 + 0.24 * rows)), layout="constrained")
        left, right = figure.subfigures(1, 2, width_ratios=(1, 1.1))
        gains(found, left.subplots())
        above, below = right.subplots(2, 1)
        (curve if found.shape else coefficients)(found, above)
        open_loop_picture(found.proof, axes=below)
        below.set_title("predictions of the validation drives", fontsize=9)
    figure.suptitle(title, fontsize=10)
    return figure


def gains(found: Discovery, axes: Axes) -> Axes:
    """Held-out log p(y) that each fitted candidate brings, one group for each effect that was found."""
    place, ticks, labels = 0.0, [], []
    for heading, candidates, alike in _groups(found):
        if heading:
            axes.annotate(heading, (0.01, place), xycoords=("axes fraction", "data"), fontsize=SMALL, va="center")
            place += 1
        for candidate in candidates[:MOST]:
            color = CHOSEN if candidate is alike[0] else ALIKE if candidate in alike else OTHER
            interval = gain_interval(candidate, found.before.seed)
            _point(axes, Row("", candidate.total, interval, color), place, hollow=interval is None)
            ticks.append(place)
            labels.append(_label(candidate.variant))
            place += 1
        place += 0.5
    axes.set_yticks(ticks, labels, fontsize=SMALL)
    axes.set_ylim(place, -1)
    axes.axvline(0, color="black", lw=0.6)
    axes.set_xlabel("log p(y) gained on drives not fitted [nats], 95 % interval over drives", fontsize=SMALL)
    axes.set_title("what each candidate brings", fontsize=9)
    shown = {"chosen": CHOSEN, "cannot be told from it": ALIKE, "other candidates": OTHER}
    marks = [axes.plot([], [], "o", color=color, ms=5, label=name)[0] for name, color in shown.items()]
    marks.append(
        axes.plot([], [], "o", mfc="none", color=OTHER, ms=5, label="given up after one half of the drives")[0]
    )
    axes.legend(handles=marks, fontsize=7, loc="lower right")
    return axes


def coefficients(found: Discovery, axes: Axes, rest: int = REST) -> Axes:
    """Coefficients in units of what could have been seen: those that were found, then those of the last tests."""
    rows = [row for finding in found.findings for row in _of_finding(found, finding)]
    rows += [row for tested in _remaining(found)[:rest] for row in _of_test(found, tested)]
    for place, row in enumerate(rows):
        _point(axes, row, place)
        axes.annotate(
            row.beside,
            (1.01, place),
            xycoords=("axes fraction", "data"),
            fontsize=7,
            va="center",
            annotation_clip=False,
        )
    axes.axvspan(-1, 1, color=LIMIT, alpha=0.15, lw=0)
    axes.axvline(0, color="black", lw=0.6)
    axes.set_yticks(range(len(rows)), [row.label for row in rows], fontsize=SMALL)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    if max((abs(row.value) for row in rows), default=0.0) > 8:
        axes.set_xscale("symlog", linthresh=1)
    axes.set_xlabel("coefficient / detection limit, 90 % interval (band: not seen with 95 % power)", fontsize=SMALL)
    what = "what was found, and what is left in the last tests" if found.findings else "what could have been seen"
    axes.set_title(what, fontsize=9)
    axes.annotate("limit", (1.01, 1.01), xycoords="axes fraction", fontsize=7, va="bottom", annotation_clip=False)
    return axes


def tests(found: Discovery, axes: Axes) -> Axes:
    """Every candidate's own p-value against the one that keeps the family-wise level; where nothing was fitted."""
    screened = found.search.rounds[0].screening.tests
    shown = [tested for tested in screened.tested if not tested.untestable]
    for place, tested in enumerate(shown):
        color = CHOSEN if tested.p_value <= screened.critical else OTHER
        axes.plot(max(tested.p_value, 1e-16), place, "o", color=color, ms=4)
    axes.axvline(screened.critical, color=CHOSEN, lw=1, ls="--", label="5 % level of the whole catalogue")
    axes.set_xscale("log")
    axes.invert_xaxis()
    axes.set_yticks(range(len(shown)), [_label(tested.variant) for tested in shown], fontsize=SMALL)
    axes.set_ylim(len(shown) - 0.4, -0.6)
    axes.set_xlabel("p-value of each candidate alone (right: more is missing)", fontsize=SMALL)
    axes.set_title(f"score tests: family-wise p = {found.p_value:.2g}", fontsize=9)
    axes.legend(fontsize=7, loc="lower right")
    return axes


def curve(found: Discovery, axes: Axes) -> Axes:
    """The curve with its band, where the drives were, and greyed where they were not."""
    shape, chosen = found.shape, found.search.curve
    assert shape is not None and chosen is not None and isinstance(chosen.refit, Refit)
    points, heights, band = (np.array(values) for values in (shape.points, shape.curve, shape.band))
    program = found.before.program
    if chosen.variant.options.get("circular") or shape.variable in program.angles:
        points = np.append(points, points[0] + 2 * math.pi)
        heights, band = np.append(heights, heights[0]), np.append(band, band[0])
    values = np.concatenate([_visited(program, chosen.variant, fold) for fold in chosen.refit.folds])
    beyond = [min(values.min(), points[0]), max(values.max(), points[-1])]
    for low, high in ((beyond[0], points[0]), (points[-1], beyond[1])):
        axes.axvspan(low, high, color="0.92", lw=0)
    axes.plot([beyond[0], points[0]], [heights[0]] * 2, ":", color="0.4")
    axes.plot([points[-1], beyond[1]], [heights[-1]] * 2, ":", color="0.4", label="hardly visited")
    axes.fill_between(points, heights - band, heights + band, color=CHOSEN, alpha=0.2, lw=0, label="90 % band")
    axes.plot(points, heights, "o-", color=CHOSEN, ms=4, label="curve")
    rug = np.random.default_rng(0).choice(values, min(len(values), 400), replace=False)
    axes.plot(rug, np.full(len(rug), 0.015), "|", color="black", ms=6, alpha=0.3, transform=axes.get_xaxis_transform())
    axes.axhline(0, color="black", lw=0.6)
    axes.set_xlabel(f"{shape.variable}{f' [{shape.variable_unit}]' if shape.variable_unit else ''}", fontsize=SMALL)
    about = shape.channel if shape.channel in names(program.channels) else f"measured {shape.channel}"
    axes.set_ylabel(f"what {about} lacks [{shape.unit}]", fontsize=SMALL)
    axes.set_title("in no catalogue: the curve that is missing", fontsize=9)
    axes.legend(fontsize=7)
    return axes


def _groups(found: Discovery) -> list[tuple[str, list[Candidate], Sequence[Candidate | None]]]:
    """What was fitted in the place of each effect, under a heading: candidates, best first, and the chosen one's class;
    nothing where nothing was fitted."""
    search = found.search
    if found.shape is None and search.found:
        order = sorted(search.found, key=lambda one: -one.candidate.total)
        labels = [one.candidate.variant.label for one in order]
        beside = [", ".join(label for label in labels if label != own) for own in labels]
        headings = [
            f"for {own}, beside {others}:" if others else "" for own, others in zip(labels, beside, strict=True)
        ]
        pairs = zip(headings, order, strict=True)
        return [(heading, _fitted(one.candidates), one.alike) for heading, one in pairs]
    candidates = _fitted([*search.rounds[0].candidates, *search.curves])
    return [("", candidates, [search.curve])] if candidates else []


def _fitted(candidates: Sequence[Candidate]) -> list[Candidate]:
    return sorted((c for c in candidates if math.isfinite(c.total)), key=lambda c: -c.total)


def _remaining(found: Discovery) -> list[Tested]:
    """Named effects of the last tests whose coefficient can be compared with a limit."""
    tested = found.search.rounds[-1].screening.tests.tested
    alive = [t for t in tested if not (t.untestable or t.is_curve or t.departure)]
    return [t for t in alive if math.isfinite(t.variant.effect.null) and (t.detection_limit > 0).all()]


def _of_finding(found: Discovery, finding: Finding) -> list[Row]:
    variant = finding.variant
    tests_of = (one.screening.tests.tested for one in found.search.rounds)
    first = next((t for tested in tests_of for t in tested if t.variant.name == variant.name), None)
    if first is None or not math.isfinite(variant.effect.null):
        return []
    limits, absent = limit_of(found, first), variant.effect.null
    return [
        Row(_component(variant, i), (value - absent) / limits[i], _scaled(interval, absent, limits[i]), CHOSEN, beside)
        for i, (value, interval) in enumerate(zip(finding.coefficient, finding.interval, strict=True))
        for beside in [_with_unit(limits[i], variant)]
    ]


def _of_test(found: Discovery, tested: Tested) -> list[Row]:
    values, halves = tested.coefficient, 1.645 * tested.sd
    return [
        Row(
            _component(tested.variant, i),
            float(value / limit),
            _scaled((value - half, value + half), 0.0, limit),
            OTHER,
            _with_unit(limit, tested.variant),
        )
        for i, (value, half, limit) in enumerate(zip(values, halves, tested.detection_limit, strict=True))
    ]


def _scaled(interval: tuple[float, float], absent: float, limit: float) -> tuple[float, float]:
    return (interval[0] - absent) / limit, (interval[1] - absent) / limit


def _component(variant: Variant, index: int) -> str:
    parts = variant.effect.components
    return f"{_label(variant)} {parts[index]}" if parts else _label(variant)


def _with_unit(limit: float, variant: Variant) -> str:
    unit = variant.effect.unit
    return f"{limit:.2g}" + ("" if unit in ("", "1") else f" {unit}")


def _label(variant: Variant) -> str:
    """An effect's name; of a curve what it adds to and what it depends on."""
    to, tilde, of = variant.at.partition("~")
    return f"{to}: a curve of {of}" if tilde else variant.label


def _point(axes: Axes, row: Row, place: float, hollow: bool = False) -> None:
    if row.interval is not None:
        axes.plot(row.interval, (place, place), "-", color=row.color, lw=1.6)
    axes.plot(row.value, place, "o", color=row.color, ms=5, mfc="none" if hollow else row.color)


@torch.no_grad()
def _visited(program: Program, variant: Variant, fold: Fold) -> np.ndarray:
    """Values of what a curve depends on, on the drives of a fold."""
    data = fold.drives
    if "chosen" in variant.options:
        index = [names(program.measurements).index(name) for name in variant.options["chosen"]]
        return data.measurements[..., index][data.observed[..., index]].double().numpy(force=True)
    from steady_ppl.altering import channel_means

    states = fold.path.states[..., : len(program.states)]
    given = (states[:-1], acting_controls(program, data)[:-1], data.elapsed[:-1])
    mean = channel_means(program, program.transition, *given, data.steps)
    values = variables(program, *given, mean)[variant.options["variable"]]
    return values.expand(data.transitions.shape)[data.transitions].double().numpy(force=True)
