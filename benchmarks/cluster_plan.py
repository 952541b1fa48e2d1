"""How long ten thousand fits take on a hundred machines, from what was measured on one.

    python benchmarks/cluster_plan.py

Reads results/cluster.json (of `cluster.py`) and results/observation-noise.parquet (of `studies.py`) and writes
results/cluster.md, which docs/cluster.md quotes. Fits are drawn from those of the noise study, and handed to workers
one after the other as the scheduler does; machines die at random (exponentially), and take what they compute with them.
"""

from __future__ import annotations

import heapq
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

RESULTS = Path(__file__).parent / "results"
FITS, MACHINES, CORES = 10_000, 100, 16
DRAWS = 20  # of fits, their order, and deaths
PLANS = (  # machines, hours until each dies in the mean, and whether the longest fits come first
    (MACHINES, math.inf, False),
    (MACHINES, 100.0, False),
    (MACHINES, 10.0, False),
    (MACHINES, math.inf, True),
    (MACHINES, 100.0, True),
    (MACHINES, 10.0, True),
    (MACHINES // 10, math.inf, False),
)
BACK = 300.0  # s until it is there again


def schedule(
    seconds: np.ndarray, machines: int, cores: int, life: float, generator: np.random.Generator
) -> tuple[float, float]:
    """Of fits in their order, each begun by the worker that is free first: when the last one ends, s, and the share of
    all the workers' time that was of use.

    Args:
        seconds: of each fit.
        machines: how many.
        cores: workers of each.
        life: of a machine, hours in the mean; all its workers die together, and are there again after `BACK`.
        generator: of the deaths.
    """
    deaths = [_deaths(life, generator) for _ in range(machines)]
    # when a worker is free, or has died: then the fit that it had begun is there again
    events: list[tuple[float, int, int, float | None]]
    events = [(0.0, machine, worker, None) for machine in range(machines) for worker in range(cores)]
    left, idle, last, done = list(reversed(seconds)), list[tuple[int, int]](), 0.0, 0
    while done < len(seconds):
        at, machine, worker, lost = heapq.heappop(events)
        death = next((death for death in deaths[machine] if death + BACK > at), math.inf)
        if lost is not None:
            left.append(lost)
        if death <= at:
            heapq.heappush(events, (death + BACK, machine, worker, None))
            if left and idle:
                heapq.heappush(events, (at, *idle.pop(), None))
        elif not left:
            idle.append((machine, worker))
        else:
            own = left.pop()
            if death < at + own:
                heapq.heappush(events, (death, machine, worker, own))
            else:
                done, last = done + 1, max(last, at + own)
                heapq.heappush(events, (at + own, machine, worker, None))
    return last, float(np.sum(seconds)) / (last * machines * cores)


def _deaths(life: float, generator: np.random.Generator) -> list[float]:
    """Until a month is over."""
    found, at = list[float](), 0.0
    while math.isfinite(life) and at < 30 * 86_400:
        at += generator.exponential(3600 * life)
        found.append(at)
        at += BACK
    return found


def tables(cluster: dict[str, Any], fits: pd.DataFrame) -> str:
    """What was measured, and what follows."""
    generator = np.random.default_rng(0)
    seconds = fits["seconds"].dropna().to_numpy(float)
    many, kept, killed = cluster["many"], cluster["kept"], cluster["killed"]
    client = many["client_ms_a_job"] + kept["ms_a_result"]  # at most: the first with rows that say little
    start = np.array(cluster["start"]["new"]) - np.array(cluster["start"]["used"])
    failed = int((fits["outcome"] == "failed").sum())
    least, most = stats.binomtest(failed, len(fits)).proportion_ci(0.95)
    measured = [
        ("a fit, one core", f"{seconds.mean():.0f} s ± {seconds.std(ddof=1):.0f}, at most {seconds.max():.0f} s"),
        ("memory of a worker", f"at most {fits['peak_mib'].max():.0f} MiB"),
        ("fits that fail by themselves", f"{failed} of {len(fits)}"),
        *_efficiency(cluster["efficiency"]),
        ("a job, to the worker", f"{many['bytes_a_job']} bytes"),
        ("a result, in the table", f"{kept['bytes_a_result']:.0f} bytes"),
        ("planning", f"{many['planning_s']:.1f} s for {many['jobs']:,} jobs"),
        ("a worker, until it has loaded what it needs", f"{_spread(start)} s"),
        (f"{many['jobs']:,} jobs that end at once, two workers", f"{many['a_second']:.0f} a second"),
        ("processor time of the client, such a job", f"{many['client_ms_a_job']:.1f} ms"),
        (f"to keep the result of a fit, {kept['columns']} columns", f"{kept['ms_a_result']:.1f} ms"),
        ("of the scheduler, a job", f"{many['scheduler_ms_a_job']:.1f} ms"),
        ("of the worker, a job that ends at once", f"{many['worker_ms_a_job']:.1f} ms"),
        ("memory of client and scheduler", f"{many['client_mib']:.0f} and {many['scheduler_mib']:.0f} MiB"),
        (
            "one of two workers killed again and again",
            f"{killed['kills']} times while {killed['jobs']} fits ran: {killed['seconds']:.0f} s instead of "
            f"{killed['undisturbed']:.0f}, {killed['failed']} failed",
        ),
    ]
    lines = ["| measured | |", "|---|---|", *(f"| {name} | {value} |" for name, value in measured)]
    slots = MACHINES * CORES
    rate = slots / seconds.mean()
    planned = [
        ("hours of one core", f"{FITS * seconds.mean() / 3600:,.0f}"),
        ("jobs that end in a second", f"{rate:.0f}; the client has processor time for {1000 / client:.0f}"),
        ("shortest fits for which that is enough", f"{slots * client / 1000:.0f} s"),
        ("sent to the workers", f"{FITS * many['bytes_a_job'] / 2**20:.1f} MiB"),
        ("table of results", f"{FITS * kept['bytes_a_result'] / 2**20:.1f} MiB"),
        ("memory of a machine", f"{CORES * fits['peak_mib'].max() / 1024:.0f} GiB"),
        (
            "fits that will have failed",
            f"{FITS * failed / len(fits):,.0f}; 95 %: {FITS * least:,.0f} to {FITS * most:,.0f}",
        ),
    ]
    lines += ["", f"| {FITS:,} such fits on {MACHINES} machines of {CORES} cores | |", "|---|---|"]
    lines += [f"| {name} | {value} |" for name, value in planned]
    lines += [
        "",
        "| machines | each dies, in the mean, every | fits come | minutes | of the workers' time is of use |",
        "|---|---|---|---|---|",
    ]
    for machines, life, longest_first in PLANS:
        found = []
        for _ in range(DRAWS):
            drawn = generator.choice(seconds, FITS)
            own = np.sort(drawn)[::-1] if longest_first else drawn
            found.append(schedule(own, machines, CORES, life, generator))
        minutes, used = np.array(found).T
        name = f"{life:,.0f} hours" if math.isfinite(life) else "never"
        order = "longest first" if longest_first else "as drawn"
        spread = f"{minutes.mean() / 60:.1f} ± {minutes.std(ddof=1) / 60:.1f}"
        lines.append(f"| {machines} | {name} | {order} | {spread} | {used.mean():.0%} |")
    return "\n".join(lines) + "\n"


def _efficiency(found: dict[str, Any]) -> list[tuple[str, str]]:
    """What two workers do of what one does twice, and what of the rest is the cluster's."""
    seconds, own = np.array(found["seconds"]["cluster, 2"]), np.array(found["seconds_a_fit"]["cluster, 2"])
    return [
        ("efficiency of two workers", _spread(np.array(found["cluster"]["rounds"]))),
        ("of two processes without a cluster", _spread(np.array(found["processes"]["rounds"]))),
        ("share of two workers' time that is in fits", _spread(found["jobs"] * own / (2 * seconds))),
        ("a fit beside another one takes, times", _spread(own / np.array(found["seconds_a_fit"]["cluster, 1"]))),
    ]


def _spread(found: np.ndarray) -> str:
    return f"{found.mean():.2f} ± {found.std(ddof=1):.2f}"


def main() -> int:
    """Write the tables."""
    cluster = json.loads((RESULTS / "cluster.json").read_text())
    found = tables(cluster, pd.read_parquet(RESULTS / "observation-noise.parquet"))
    (RESULTS / "cluster.md").write_text(found)
    print(found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
