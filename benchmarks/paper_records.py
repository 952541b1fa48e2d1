"""What the records of `paper.py` and the paper say: the rows and columns of the tables, and their figures."""

from __future__ import annotations

import csv
import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

PUBLISHED = Path(__file__).parent / "published.csv"  # averages of three runs; ± and the best on test drives if printed
RUNS = 3
EXPERIMENTS = {"hov": "Hov", "hov+": "Hov+", "truck": "Truck"}
METHODS = {
    "hand": "Hand",
    "fit-hand": "FitHand",
    "fit-tv": "FitTV",
    "svi": "SVI",
    "steady": "STEADY",
    "steady-minus": "STEADY−",
    "steady-bootstrap": "STEADY, bootstrap",
    "fit-truth": "FitTruth",
    "truth": "true program",
}
RIVALS = ("hand", "fit-hand", "fit-tv", "svi")
GROUPS = ("location", "angle")
CELLS = [(metric, group) for metric in ("state_estimation", "forward") for group in GROUPS]
Record = Mapping[str, Any]
Records = Sequence[Record]


def done(records: Records) -> list[Record]:
    """Those of runs that did not fail."""
    return [record for record in records if "failed" not in record]


def values(records: Records, metric: str, group: str, experiment: str, method: str) -> list[float]:
    """One figure of each run of a method that did not fail; of `spread` how far noise carries a roll-out."""
    at = experiment, method
    found = [record for record in done(records) if (record["experiment"], record["method"]) == at]
    if metric == "spread":  # the noisy roll-outs' mean square is that of their mean and their variance
        variances = [record["forward"][group] ** 2 - record["forward_mean"][group] ** 2 for record in found]
        return [math.sqrt(variance) if variance >= 0 else math.nan for variance in variances]
    return [float(record[metric][group] if group else record[metric]) for record in found]


def deviation(figures: Sequence[float]) -> float:
    """The sd; 0 of one figure, NaN where one is not finite (`statistics` raises there)."""
    if not all(map(math.isfinite, figures)):
        return math.nan
    return statistics.stdev(figures) if len(figures) > 1 else 0.0


def published() -> dict[tuple[str, str, str, str], dict[str, str]]:
    """Rows by metric, group, experiment and method."""
    with PUBLISHED.open() as file:
        return {(row["metric"], row["group"], row["experiment"], row["method"]): row for row in csv.DictReader(file)}
