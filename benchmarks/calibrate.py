"""Whether what is said to be uncertain is as uncertain as is said: the calibration suite.

    python benchmarks/calibrate.py [--quick] [--results FILE] [--workers 2]

Smoothed states and learned parameters rank uniformly among their draws (simulation-based calibration, Talts et al.
2018), p(y) is right on average, moments are those of NUTS, p-values of `discover` are uniform where nothing is missing,
intervals hold the truth as often as they say; and the bootstrap filter of 200 particles, which must fail, does. Each
job is one line of the results, what is there already is left out. The tables are printed and written beside the results
(`.md`). Exits with 1 when a must is missed.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests")]

import calibration_discovery as discovery  # noqa: E402
import calibration_evidence as evidence  # noqa: E402
import calibration_parameters as parameters  # noqa: E402
import calibration_states as states  # noqa: E402
from calibration_tables import tables  # noqa: E402
from calibration_variational import FAMILIES  # noqa: E402
from resumable import Record, digest, run  # noqa: E402

import steady_ppl  # noqa: E402

RESULTS = Path(__file__).parent / "results" / "calibration.jsonl"
WORK: dict[str, Callable[..., Record]] = {
    "states": states.ranked,
    "nuts": states.beside_nuts,
    "evidence": evidence.unbiased,
    "parameters": parameters.ranked,
    "discovery": discovery.judged,
    "check": discovery.checked,
}


@dataclass(frozen=True)
class Size:
    """How much is done."""

    drives: int
    runs: int
    data_sets: int
    clean: int
    single: int
    checks: int
    problems: tuple[str, ...] = states.STATES
    guides: tuple[str, ...] = tuple(states.GUIDES)


QUICK_GUIDES = tuple(guide for guide in states.GUIDES if guide not in FAMILIES)  # SVI's are trained, a minute each
FULL = Size(drives=states.DRIVES, runs=evidence.COUNT, data_sets=120, clean=60, single=52, checks=60)
QUICK = Size(  # of six data sets whose draws have collapsed, ranks at either end leave p < 3.4e-5; of four, 1.1e-2
    drives=200, runs=200, data_sets=6, clean=1, single=1, checks=1, problems=("cart", "pendulum"), guides=QUICK_GUIDES
)


def work(kind: str, *arguments: Any) -> Record:
    """One job's record."""
    return {"kind": kind, "of": list(arguments), **WORK[kind](*arguments)}


def jobs(size: Size) -> dict[str, tuple[Any, ...]]:
    """The arguments of every job, by its name."""
    every: list[tuple[Any, ...]] = [
        ("states", problem, guide, size.drives) for problem in size.problems for guide in size.guides
    ]
    every += [("nuts", problem, guide) for problem in size.problems if problem != "cart" for guide in size.guides]
    every += [
        ("evidence", problem, which, size.runs)
        for problem in size.problems
        for which in evidence.ESTIMATORS
        if which in size.guides
    ]
    every += [("parameters", seed) for seed in range(1, size.data_sets + 1)]
    every += [("discovery", "clean", index) for index in range(size.clean)]
    every += [("discovery", "single", index) for index in range(size.single)]
    every += [("check", kind, index) for kind in discovery.CLEAN for index in range(size.checks)]
    return {" ".join(map(str, arguments)): arguments for arguments in every}


def main(arguments: list[str] | None = None) -> int:
    """Run what is left, print the tables; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two programs and a few sets, in two minutes")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", choices=list(WORK), help="run these jobs alone, and print no tables")
    chosen = parser.parse_args(arguments)
    version = digest(Path(steady_ppl.__file__).parent, ROOT / "tests", Path(__file__).parent)
    size = QUICK if chosen.quick else FULL
    wanted = {name: job for name, job in jobs(size).items() if chosen.only in (None, job[0])}
    records = run(work, wanted, chosen.results, version=version, workers=chosen.workers)
    if chosen.only:
        return any("failed" in record for record in records)
    text, missed = tables(sorted(records, key=lambda record: list(wanted).index(record["set"])))
    chosen.results.with_suffix(".md").write_text(text)
    print(text)
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main())
