"""Figures of several seeds beside what they must be and what was published."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Bound:
    """What a figure must be, where a must is set, beside what was published."""

    high: float = math.inf
    low: float = 0.0
    published: str = "–"


def run_jobs(learn_and_judge: Callable[[Any], dict], jobs: Sequence[Any], file: Path | None) -> list[dict]:
    """Two processes; a line a result, and all of them as JSON if a file is named."""
    results = []
    with ProcessPoolExecutor(2) as pool:
        for result in pool.map(learn_and_judge, jobs):
            results.append(result)
            forward, mean = result["forward"], result["forward_mean"]
            print(
                f"{result['method']} seed {result['seed']}: forward {forward['location']:.4f} m {forward['angle']:.4f} "
                f"rad, mean {mean['location']:.4f} m {mean['angle']:.4f} rad, log p(y) {result['log_likelihood']:.2f}, "
                f"learnt in {result['seconds']:.0f} s {result.get('found', '')}".rstrip(),
                flush=True,
            )
    if file:
        file.write_text(json.dumps(results, indent=1) + "\n")
    return results


def report(methods: Sequence[str], results: list[dict], bounds: Mapping[tuple[str, str], Bound]) -> int:
    """Print the table; 1 if a bound is missed."""
    missed = 0
    print(f"\n{'':15} {'figure':26} {'mean ± sd':>18} {'best':>8}  {'must':16} published")
    for method in methods:
        runs = [result for result in results if result["method"] == method]
        for name, values in figures(runs).items():
            missed |= line(method, name, values, bounds.get((method, name), Bound()))
    return missed


def figures(runs: list[dict]) -> dict[str, list[float]]:
    """What is printed of several runs, by name."""
    named = {
        f"{name} {group}": [run[name][group] for run in runs]
        for name in ("forward", "forward_mean", "state_estimation")
        for group in ("location", "angle")
    }
    named["log p(y) at 1 Hz"] = [run["log_likelihood"] for run in runs]
    named["seconds to learn"] = [run["seconds"] for run in runs]
    return named | {name: [run["guides"][name] for run in runs] for name in runs[0].get("guides", {})}


def line(method: str, name: str, values: list[float], bound: Bound) -> int:
    """Print one figure; 1 if it misses its bound."""
    mean = statistics.fmean(values)
    sd = statistics.stdev(values) if len(values) > 1 else 0.0
    best = max(values) if name.startswith(("log p", "lookahead")) else min(values)
    digits = 4 if abs(mean) < 5 else 1
    verdict = must = ""
    if math.isfinite(bound.high):
        must = f"≤ {bound.high:g}" if not bound.low else f"{bound.low:g} – {bound.high:g}"
        verdict = "  ok" if bound.low <= mean <= bound.high else "  MISSED"
    figure = f"{mean:.{digits}f} ± {sd:.{digits}f}"
    print(f"{method:15} {name:26} {figure:>18} {best:8.{digits}f}  {must:16} {bound.published}{verdict}".rstrip())
    return int(verdict.strip() == "MISSED")
