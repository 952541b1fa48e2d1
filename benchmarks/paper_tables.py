"""The tables of `paper.py`: ours beside the published, in Markdown; below them what must hold and does not."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence

import paper_filters
import paper_musts
from paper_records import EXPERIMENTS, GROUPS, METHODS, RUNS, Records, deviation, done, published, values

TABLES = {
    "State estimation from bearings at 1 Hz (smoothed): location [m]": ("state_estimation", "location", 3),
    "State estimation from bearings at 1 Hz (smoothed): angle [rad]": ("state_estimation", "angle", 4),
    "Forward prediction of one second, noisy roll-outs: location [m]": ("forward", "location", 4),
    "Forward prediction of one second, noisy roll-outs: angle [rad]": ("forward", "angle", 4),
    "Forward prediction of one second, mean roll-out: location [m]": ("forward_mean", "location", 4),
    "Forward prediction of one second, mean roll-out: angle [rad]": ("forward_mean", "angle", 4),
    "Spread of the noisy roll-outs, location [m]": ("spread", "location", 4),
    "Spread of the noisy roll-outs, angle [rad]": ("spread", "angle", 4),
    "log p(y) of a test drive at 1 Hz [nats]": ("log_likelihood", "", 2),
    "Seconds to learn, one thread": ("seconds", "", 0),
}
HAND = (
    "The published row of Hand on Hov and Hov+ is an artefact in state estimation and log p(y): the authors' code has "
    "one noise a step for all particles, which then cannot follow a drive; done right the same program has .549 m, "
    ".038 rad and +32.6 nats (re-simulated)."
)
SHORT = (("forward", "forward prediction, noisy roll-outs", 4), ("state_estimation", "state estimation at 1 Hz", 3))
NOISE = (
    "A noisy roll-out's error counts the width of the process noise: noise that is too narrow makes it smaller. On Hov "
    "and Hov+ the spread should be the true program's. On Truck controls act with a lag that a program without memory "
    "cannot hold, so the likelihood asks for wide noise; STEADY's observation weight ends near 1 / 3 there, which was "
    "chosen on the valid split."
)
Marks = Mapping[tuple[str, str, str], str]
FILTERED = ("state_estimation", "log_likelihood")
QUICK = "A quick run judges nothing: it is one run of few steps, without the bootstrap filter. No must was looked at."


def tables(records: Records, runs: int = RUNS, *, quick: bool = False) -> str:
    """All tables and what follows from them.

    Args:
        records: of all runs, those that failed included.
        runs: how many of each method were asked for.
        quick: nothing is judged.
    """
    theirs = {cell: _theirs(row) for cell, row in published().items()}
    failed = {record["set"]: " ".join(record["failed"].split()) for record in records if "failed" in record}
    tried = {tuple(name.split()[:2]) for name in failed}
    by_filter = paper_filters.judged(records)
    marks = {(metric, *cell): paper_filters.MARK for metric in FILTERED for cell in paper_filters.differing(records)}
    parts = [
        "Ours: mean ± sd over runs, each on drives (for the truck: a draw of the bearings) of its own, Hov and Hov+ "
        "with the same test drives; the best in brackets, and how many runs there are where some lack. Published: "
        "average of three runs; ± and the best, in brackets, where printed.\n"
    ]
    parts += [_in_short(by_filter, marks, *short) for short in SHORT]
    for title, (metric, group, digits) in TABLES.items():
        lines = [f"## {title}\n", f"| | {' | '.join(f'{name} | published' for name in EXPERIMENTS.values())} |"]
        lines.append("|---|" + "---|---|" * len(EXPERIMENTS))
        for method, name in METHODS.items():
            cells = []
            for experiment in EXPERIMENTS:
                figures = values(by_filter, metric, group, experiment, method)
                asked = runs if figures or (experiment, method) in tried else 0
                mark = marks.get((metric, experiment, method), "")
                cells.append(_ours(figures, digits, asked, higher=metric == "log_likelihood") + mark)
                cells.append(theirs.get((metric, group, experiment, method), "–"))
            if any(cell != "–" for cell in cells):
                lines.append(f"| {name} | {' | '.join(cells)} |")
        parts.append("\n".join(lines) + "\n")
    parts += [HAND + "\n", NOISE + "\n", *_guides(records)]
    if failed:
        parts += ["## Runs that failed\n", _listed(f"{name}: {why}" for name, why in failed.items())]
    if quick:
        parts.append(QUICK)
    else:
        parts += ["## The filter\n", paper_filters.TEXT + "\n", _listed(paper_filters.filters(records))]
        parts += ["## What must hold\n", _listed(paper_musts.shown(records, runs))]
    return "\n".join(parts).rstrip() + "\n"


def _guides(records: Records) -> list[str]:
    """By which guide STEADY learned."""
    used = {
        EXPERIMENTS[one["experiment"]]: one["settings"]["guide"]
        for one in done(records)
        if one["method"] == "steady" and "settings" in one
    }
    said = ", ".join(f"{guide} on {experiment}" for experiment, guide in sorted(used.items()))
    return [f"STEADY's guide: {said}; STEADY− has the same.\n"] if used else []


def _in_short(records: Records, marks: Marks, metric: str, title: str, digits: int) -> str:
    """Means alone, location / angle, ours and in brackets the published."""
    theirs = published()
    lines = [f"## In short: {title}, location [m] / angle [rad], ours (published)\n"]
    lines += [f"| | {' | '.join(EXPERIMENTS.values())} |", "|---" * (len(EXPERIMENTS) + 1) + "|"]
    for method, name in METHODS.items():
        cells = []
        for experiment in EXPERIMENTS:
            ours = [values(records, metric, group, experiment, method) for group in GROUPS]
            rows = [theirs.get((metric, group, experiment, method)) for group in GROUPS]
            cell = _pair(map(statistics.fmean, ours), digits) if all(ours) else "–"
            beside = _pair([float(row["average"]) for row in rows if row], digits)
            cells.append(cell + marks.get((metric, experiment, method), "") + (f" ({beside})" if beside else ""))
        if any(cell[0] != "–" for cell in cells):
            lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _pair(figures: Iterable[float], digits: int) -> str:
    return " / ".join(f"{figure:.{digits}f}" for figure in figures)


def _listed(lines: Iterable[str]) -> str:
    return "".join(f"- {line}\n" for line in lines)


def _ours(figures: Sequence[float], digits: int, asked: int, higher: bool) -> str:
    lack = f" ({len(figures)} of {asked})" if len(figures) < asked else ""
    if not figures:
        return f"–{lack}"
    mean = f"{statistics.fmean(figures):.{digits}f}"
    if len(figures) == 1:
        return mean + lack
    best = max(figures) if higher else min(figures)
    return f"{mean} ± {deviation(figures):.{digits}f} ({best:.{digits}f}){lack}"


def _theirs(row: Mapping[str, str]) -> str:
    around = f" ± {row['spread']}" if row["spread"] else ""
    best = f" ({row['best']})" if row["best"] else ""
    return row["average"] + around + best
