"""What the ready studies found, from their tables.

    python benchmarks/studies.py [STUDY=DIR …]

Tables of `steady study studies/STUDY.toml --out DIR` are filed as results/STUDY.parquet, and results/studies.md is
written from all that are: means ± standard deviations of seeds, and whether the musts hold; exits with 1 where one does
not.
"""

from __future__ import annotations

import math
import shutil
import sys
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd

from steady_ppl.studies.job import HELD_OUT, IN_LIMITS
from steady_ppl.studies.pictures import SIZE_EDGES, best_settings, points
from steady_ppl.studies.plan import Picture
from steady_ppl.studies.table import TABLE

RESULTS, STUDY_FILES = Path(__file__).parent / "results", Path(__file__).parents[1] / "studies"
SIGMAS = (1.25, 2.5, 5.0, 10.0, 20.0)
SIGMA, PARTICLES, DRIVES = "data.sigma_deg", "settings.particles", "data.train"
ERROR = "forward.total"
LEARNERS = ("FitHand", "FitTV", "SVI", "STEADY−", "STEADY−, bootstrap")  # without true states, besides STEADY
MEASURES = {
    ERROR: "errs least in roll-outs",
    "forward_mean.total": "errs least in means of roll-outs",
    "log_likelihood": "has the largest log p(y) of test drives",
}
MARGINS = {  # what, which way is worse, of what, how much is taken for the same, by the mean and two standard errors
    ERROR: ("roll-outs", 1, "%", 5.0),
    "state_estimation.location": ("estimated location", 1, "%", 5.0),
    "log_likelihood": ("log p(y) of test drives", -1, "nats", 0.5),
    HELD_OUT: ("log p(y) of valid drives", -1, "nats", 0.5),
}
WITHIN, VISIBLY, IN_TIME = 1.1, 1.1, 0.1
Musts = list[tuple[str, str, bool]]


def main(words: Sequence[str]) -> int:
    """File tables, write the page, and say whether all musts hold."""
    for word in words:
        name, _, folder = word.partition("=")
        shutil.copyfile(Path(folder) / TABLE, RESULTS / f"{name}.parquet")
    page, missed = tables(RESULTS)
    (RESULTS / "studies.md").write_text(page)
    print(page)
    return int(missed > 0)


def tables(folder: Path) -> tuple[str, int]:
    """The page of all studies that are filed, and how many musts are missed."""
    parts, missed = ["# The ready studies", "Means of seeds ± their standard deviation. Written by `studies.py`."], 0
    for name, part in STUDIES.items():
        if (folder / f"{name}.parquet").exists():
            text, musts = part(_in_order(pd.read_parquet(folder / f"{name}.parquet"), name))
            parts += [f"## {name}", text]
            missed += sum(not holds for _, _, holds in musts)
            if musts:
                lines = [f"| {what} | {found} | {'yes' if holds else '**no**'} |" for what, found, holds in musts]
                parts.append("\n".join(["| must | found | holds |", "|---|---|---|", *lines]))
    return "\n\n".join(parts) + "\n", missed


def _in_order(rows: pd.DataFrame, study: str) -> pd.DataFrame:
    """By its methods as the study names them: rows come in as they end."""
    with (STUDY_FILES / f"{study}.toml").open("rb") as file:
        names = [method["name"] for method in tomllib.load(file)["method"]]
    return rows.sort_values(["method", "seed"], key=lambda one: one.map(names.index) if one.name == "method" else one)


def table(rows: pd.DataFrame, x: str, column: str, title: str, digits: int = 3) -> str:
    """A row a method, a column a value of x."""
    places = sorted(rows[x].dropna().unique())
    lines = [f"| {title} | " + " | ".join(f"{place:g}" for place in places) + " |", "|---|" + "---|" * len(places)]
    for method, own in rows.groupby("method", sort=False):
        cells = [_cell(own[own[x] == place], column, digits) for place in places]
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(rows: pd.DataFrame, column: str, digits: int) -> str:
    done, failed = rows[column].dropna(), int((rows["outcome"] == "failed").sum())
    spread = f" ± {done.std():.{digits}f}" if len(done) > 1 else ""
    said = f"{done.mean():.{digits}f}{spread}" if len(done) else "–"
    return f"{said} ({failed} of {len(rows)} failed)" if failed else said


def observation_noise(rows: pd.DataFrame) -> tuple[str, Musts]:
    """Errors against the noise of the bearings; STEADY's ramp is chosen at each by held-out drives."""
    best = of_best_settings(rows)
    text = [
        f"{_extent(rows)} Of STEADY's three ramps that with the largest log p(y) of valid drives is taken at each "
        "noise; no other method has a choice. The musts compare it with the other learners; STEADY with the bootstrap "
        "is STEADY as well and no rival. That by the worst seed was added when two of three had been seen.",
        table(best, SIGMA, ERROR, "error of 1 s roll-outs, root of all squares, at °"),
        table(best, SIGMA, "forward_mean.total", "of the means of the roll-outs"),
        table(best, SIGMA, "state_estimation.location", "error of estimated location, m"),
        table(best, SIGMA, "log_likelihood", "log p(y) of a test drive at 1 Hz, nats", 2),
        table(best, SIGMA, "fit_seconds", "seconds of the fit", 0),
        *_ramps(rows[rows["method"] == "STEADY"]),
    ]
    musts: Musts = []
    for measure, what in MEASURES.items():
        musts += [_best_of_all(best[best[SIGMA] == sigma], measure, f"{what} at {sigma:g}°") for sigma in SIGMAS]
    what = "errs least in roll-outs of the worst seed"
    musts += [_best_of_all(best[best[SIGMA] == sigma], ERROR, f"{what} at {sigma:g}°", "max") for sigma in SIGMAS]
    for sigma, rival, least, what in (
        (1.25, "FitTruth", 1 / WITHIN, "STEADY within 10 % of FitTruth at 1.25°"),
        (1.25, "STEADY−", VISIBLY, "STEADY− worse than STEADY by 10 % and more at 1.25°"),
        (2.5, "STEADY−", VISIBLY, "STEADY− worse than STEADY by 10 % and more at 2.5°"),
    ):
        at = best[best[SIGMA] == sigma]
        ours, theirs = at[at["method"] == "STEADY"], at[at["method"] == rival]
        certain = len(ours) > 0 and len(theirs) > 0 and (ours["outcome"] == "done").all()
        holds = certain and theirs[ERROR].mean() >= least * ours[ERROR].mean()
        musts.append((what, f"{_cell(ours, ERROR, 3)} and {_cell(theirs, ERROR, 3)}", bool(holds)))
    return "\n\n".join(text), musts


def of_best_settings(rows: pd.DataFrame) -> pd.DataFrame:
    """Of each method's settings those with the largest log p(y) of valid drives, at each noise."""
    return best_settings(Picture(SIGMA, [ERROR], chosen_by=HELD_OUT), rows)


def _ramps(tried: pd.DataFrame) -> list[str]:
    """What STEADY's choice is of, and what it costs."""
    each = tried.assign(method=[f"STEADY, ramp {ramp:g}" for ramp in tried["settings.ramp"]])
    each = each.sort_values(["settings.ramp", "seed"])
    spent = tried.groupby([SIGMA, "seed"], as_index=False)["fit_seconds"].sum()
    return [
        table(each, SIGMA, HELD_OUT, "log p(y) of a valid drive, by which the ramp is chosen", 2),
        table(each, SIGMA, ERROR, "error of 1 s roll-outs"),
        table(spent.assign(method="STEADY", outcome="done"), SIGMA, "fit_seconds", "seconds of all three fits", 0),
    ]


def _best_of_all(rows: pd.DataFrame, column: str, what: str, of_seeds: str = "mean") -> tuple[str, str, bool]:
    """Whether STEADY is, of the learners that do not see the true states."""
    sign = -1 if column.endswith("likelihood") else 1
    means = _whole(rows, column, of_seeds)
    there = {name: sign * means[name] for name in LEARNERS if name in means}
    if "STEADY" not in means or not there:
        return f"STEADY {what}", "not all there", False
    rival = min(there, key=lambda name: there[name])
    found = f"{means['STEADY']:.3f}; the best other, {rival}, {means[rival]:.3f}"
    partial = [
        f"{name} ({_cell(rows[rows['method'] == name], column, 3)})" for name in _failed(rows) if name in LEARNERS
    ]
    if partial:
        found += f"; not counted, for a fit failed: {', '.join(partial)}"
    return f"STEADY {what}", found, bool(sign * means["STEADY"] < there[rival])


def _whole(rows: pd.DataFrame, column: str, of_seeds: str = "mean") -> dict[str, float]:
    """The mean or another figure of the seeds, of the methods of which no fit has failed."""
    whole = {str(name): own[column] for name, own in rows.groupby("method") if name not in _failed(rows)}
    return {name: float(values.agg(of_seeds)) for name, values in whole.items()}


def _failed(rows: pd.DataFrame) -> list[str]:
    """The methods of which a fit has."""
    return [str(name) for name, own in rows.groupby("method") if (own["outcome"] == "failed").any()]


def particles(rows: pd.DataFrame) -> tuple[str, Musts]:
    """What more particles buy."""
    text = [
        f"{_extent(rows)} The margins of the musts were fixed after a first look.",
        table(rows, PARTICLES, ERROR, "error of 1 s roll-outs, root of all squares, by particles"),
        table(rows, PARTICLES, "state_estimation.location", "error of estimated location, m"),
        table(rows, PARTICLES, HELD_OUT, "log p(y) of a valid drive at 1 Hz, nats", 2),
        table(rows, PARTICLES, "log_likelihood", "of a test drive", 2),
        table(rows, PARTICLES, "fit_seconds", "seconds of the fit, one core", 0),
    ]
    ours = rows[(rows["method"] == "lookahead") & (rows[PARTICLES] == 100)].set_index("seed")
    paper = rows[(rows["method"] == "bootstrap") & (rows[PARTICLES] == 20_000)].set_index("seed")
    whole = len(ours) == len(paper) and not _failed(pd.concat([ours, paper]))
    musts: Musts = []
    for column, (what, sign, margin, bound) in MARGINS.items():
        worse = sign * (ours[column] - paper[column])
        if margin == "%":
            worse = 100 * worse / paper[column]
        certain = float(worse.mean()) + 2 * float(worse.std()) / math.sqrt(len(worse))
        seeds = ", ".join(f"{one:+.2f}" for one in worse)
        found = f"{ours[column].mean():.3f} and {paper[column].mean():.3f}; worse by {seeds} {margin} at the seeds"
        musts.append(
            (f"{what}: lookahead 100 within {bound:g} {margin} of bootstrap 20,000", found, whole and certain <= bound)
        )
    ratio = ours["fit_seconds"] / paper["fit_seconds"]
    what = "lookahead 100 in at most a tenth of the time of bootstrap 20,000"
    musts.append((what, f"{ratio.mean():.3f} ± {ratio.std():.3f} of it", whole and bool(ratio.max() <= IN_TIME)))
    return "\n\n".join(text), musts


def data_size(rows: pd.DataFrame) -> tuple[str, Musts]:
    """Errors against the number of drives."""
    return "\n\n".join(
        [
            _extent(rows),
            table(rows, DRIVES, "forward.location", "location error of 1 s roll-outs, m, by drives", 4),
            table(rows, DRIVES, "state_estimation.location", "error of estimated location, m"),
            table(rows, DRIVES, "log_likelihood", "log p(y) of a test drive at 1 Hz, nats", 2),
            table(rows, DRIVES, "fit_seconds", "seconds of the fit", 0),
        ]
    ), []


def discovery(rows: pd.DataFrame) -> tuple[str, Musts]:
    """Shares against the size of what is missing, with exact 95 % intervals."""
    done = rows[rows["outcome"] == "done"]
    failed, unlimited = len(rows) - len(done), int(done[IN_LIMITS].isna().sum())
    text = [
        f"{_extent(rows, 'searches')} {failed} failed; {unlimited} are not in the table, for the tests could not have "
        "what was planted, so that it has no limit. Intervals are exact, at 95 %, for searches that are independent; "
        "those of one seed share their noise. The first row is of drives that lack nothing. Ranges are a quarter wide, "
        "one of them around a limit; they were narrowed when the results of wider ones had been seen."
    ]
    columns = ("found", "in_class", "right")
    lines = [
        "| size in detection limits | mean | searches | says that something is missing | its class | names it |",
        "|---|---|---|---|---|---|",
    ]
    shares = {column: {place: of for place, *of in points(done, IN_LIMITS, column)} for column in columns}
    ranges = done.groupby(pd.cut(done[IN_LIMITS], SIZE_EDGES), observed=True).size()
    for place, (ends, searches) in zip(shares["found"], ranges.items(), strict=True):
        cells = [_share(*shares[column][place]) if place in shares[column] else "" for column in columns]
        size = "0" if ends.right == 0 else f"{ends.left:.2f} to {ends.right:.2f}"
        lines.append(f"| {size} | {place:.2f} | {searches} | " + " | ".join(cells) + " |")
    return "\n\n".join([*text, "\n".join(lines)]), []


def _share(middle: float, low: float, high: float) -> str:
    return f"{middle:.0%} ({middle - low:.0%}–{middle + high:.0%})"


def _extent(rows: pd.DataFrame, what: str = "fits") -> str:
    seeds = ", ".join(str(seed) for seed in sorted(rows["seed"].unique()))
    return f"{len(rows)} {what}, seeds {seeds}, {rows['seconds'].sum() / 3600:.1f} hours of one core."


STUDIES: dict[str, Callable[[pd.DataFrame], tuple[str, Musts]]] = {
    "observation-noise": observation_noise,
    "particles": particles,
    "data-size": data_size,
    "discovery": discovery,
}

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
