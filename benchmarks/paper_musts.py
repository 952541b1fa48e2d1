"""What the tables of `paper.py` must show: each must is met, MISSED or not run."""

from __future__ import annotations

import statistics
from dataclasses import dataclass
from itertools import product

from paper_filters import judged
from paper_records import CELLS, EXPERIMENTS, METHODS, RIVALS, Records, deviation, published, values

MET, MISSED, NOT_RUN = "met", "MISSED", "not run"


@dataclass(frozen=True)
class Must:
    """That a method's mean error is below a rival's, at most `bar`, or (with neither) right beside the published."""

    experiment: str
    metric: str
    group: str
    method: str
    rival: str | None = None
    bar: float | None = None

    @property
    def claim(self) -> str:
        """It without the metric."""
        if self.rival:
            what = f"better than {METHODS[self.rival]}"
        elif self.bar is not None:
            what = "near the true program"
        elif self.method == "svi":
            what = "no worse than published"
        else:
            what = f"{'within one sd of' if self.experiment == 'truck' else 'better than'} published"
        return f"{EXPERIMENTS[self.experiment]}, {METHODS[self.method]} {what}"


@dataclass(frozen=True)
class Verdict:
    """Of one must, with the figures or the runs that lack."""

    must: Must
    outcome: str
    why: str


MUSTS = [
    *(Must(at, *cell, "steady", rival) for at, rival, cell in product(EXPERIMENTS, RIVALS, CELLS)),
    *(Must(at, *cell, method) for at, method, cell in product(EXPERIMENTS, ("steady", "svi"), CELLS)),
    Must("hov+", "forward", "location", "fit-truth", bar=0.0275),
    Must("hov+", "forward", "angle", "fit-truth", bar=0.0121),
]


def verdicts(records: Records, runs: int) -> list[Verdict]:
    """Of every must, by the means of so many runs, by the bootstrap filter's figures where the filters differ."""
    by_filter = judged(records)
    return [_verdict(must, by_filter, runs) for must in MUSTS]


def all_met(records: Records, runs: int) -> bool:
    """Whether all were run and met."""
    return all(verdict.outcome == MET for verdict in verdicts(records, runs))


def shown(records: Records, runs: int) -> list[str]:
    """Lines: how many are met, and by name those that are missed or were not run."""
    found = verdicts(records, runs)
    count = {outcome: sum(one.outcome == outcome for one in found) for outcome in (MET, MISSED, NOT_RUN)}
    lines = [f"{len(found)} musts: " + ", ".join(f"{number} {outcome}" for outcome, number in count.items())]
    for one in found:
        if one.outcome == MISSED:
            metric = one.must.metric.replace("_", " ")
            lines.append(f"{MISSED} {one.must.claim}, {metric} {one.must.group}: {one.why}")
    lacking = dict.fromkeys((one.must.claim, one.why) for one in found if one.outcome == NOT_RUN)
    return lines + [f"{NOT_RUN}: {claim} ({why})" for claim, why in lacking]


def _verdict(must: Must, records: Records, runs: int) -> Verdict:
    methods = [must.method, must.rival] if must.rival else [must.method]
    figures = {m: values(records, must.metric, must.group, must.experiment, m) for m in methods}
    lacking = [f"{METHODS[m]}: {len(found)} of {runs} runs" for m, found in figures.items() if len(found) < runs]
    if lacking:
        return Verdict(must, NOT_RUN, ", ".join(lacking))
    mean = {method: statistics.fmean(found) for method, found in figures.items()}
    ours = mean[must.method]
    if must.rival:
        met, bar = ours < mean[must.rival], f"{METHODS[must.rival]} {mean[must.rival]:.4f}"
    elif must.bar is not None:
        met, bar = ours <= must.bar, f"must be at most {must.bar:g}"
    else:
        average = float(published()[must.metric, must.group, must.experiment, must.method]["average"])
        bar = f"published {average:g}"
        if must.method == "svi":
            met = ours <= average
        elif must.experiment == "truck":
            met = ours <= average + deviation(figures[must.method])
        else:
            met = ours < average
    return Verdict(must, MET if met else MISSED, f"{METHODS[must.method]} {ours:.4f}, {bar}")
