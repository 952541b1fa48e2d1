"""Settings of the paper's baselines, chosen by held-out log p(y): development drives only, nothing of a test split.

    python benchmarks/choose.py [--methods svi …] [--experiments hov …] [--data FOLDER] [--workers 2]

Hov: simulated drives of the data seeds 101 and 102; truck: train and valid split, draws 11 and 12 of the bearings, and
13 and 14 for two settings of SVI that tied and of which one had diverged on a test run.
What is printed is log p(y) of a held-out drive, by the filter that looks ahead at every row, of the parameters that the
training keeps, and the seconds. Candidates were added after those before them had been seen. Resumable: goes on with
the records in OUT; those by which was chosen are in `results/choices.*`.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from experiments import LOGS, ROOT, SIZES, STEADY_SETTINGS, hov, truck
from paper_methods import VERSION, learnt, named, told
from paper_settings import LONGER
from resumable import Record, run, stored

SEEDS = {"hov": (101, 102), "hov+": (101, 102), "truck": (11, 12)}
TIED = {("svi", "truck"): ([{}, {"learning_rate": 1e-2, "guide_rate": 0.3}], (13, 14))}  # within .03 nats: more seeds
SUPERVISED: list[dict[str, Any]] = [{}, {"weight_decay": 0.3}, LONGER, LONGER | {"weight_decay": 0.3}]
# FitTV's were kept at the first validation or the second.
GENTLER: list[dict[str, Any]] = [{"validate_every": 10, "patience": 15}, {"learning_rate": 2e-3}]
VARIATIONS = [{"regularization": one} for one in (0.01, 0.1, 0.3, 1.0, 3.0)]
TWICE = {"steps": 3000, "validate_every": 150}
SVI: list[dict[str, Any]] = [
    {},
    {"first_kl_weight": 1.0},
    {"learning_rate": 1e-2, "guide_rate": 0.3},
    {"centred": False},
    TWICE,
    TWICE | {"patience": 20, "annealing": 0.25},  # the default's tempering, then three times as many steps
]
# As STEADY's observation weight on the truck, which ends near 1 / 3; without patience it would stop where it began.
FINAL = {"annealing": 1.12, "patience": 20}
GUIDES: list[dict[str, Any]] = [{}, {"guide": "lookahead"}]  # STEADY's own is the Gaussian one
# Tried when SVI's figures on the test drives had been seen, as STEADY's noise in location is too wide on Hov; not used.
AFTERWARDS: list[dict[str, Any]] = [
    {"ramp": 0.25},
    {"ramp": 0.5},
    {"ramp": 2.0},
    {"weight_decay": 3.0},
    {"weight_decay": 3.0, "ramp": 0.5},
    {"weight_decay": 3.0, "steps": 500},
    {"learning_rate": 3e-3, "steps": 500},
    {"steps": 500, "patience": 10},
    {"draws": 100},
]
CANDIDATES: dict[tuple[str, str], list[dict[str, Any]]] = {
    ("svi", "hov"): SVI,
    ("svi", "truck"): [*SVI, FINAL],
    ("svi", "hov+"): [{"batch": 32}, {"batch": 32} | TWICE],
    ("fit-hand", "hov"): SUPERVISED,
    ("fit-hand", "hov+"): SUPERVISED,
    ("fit-hand", "truck"): [*SUPERVISED, {"steps": 4500, "validate_every": 450, "weight_decay": 0.3}],
    ("fit-tv", "hov"): [
        *VARIATIONS,
        *({"regularization": part} | one for part in (0.3, 1.0) for one in SUPERVISED[1:3]),
        *({"regularization": 1.0} | one for one in GENTLER),
    ],
    ("fit-tv", "truck"): [
        *VARIATIONS,
        *({"regularization": 0.1} | one for one in SUPERVISED[1:3]),
        *({"regularization": 0.1, "weight_decay": 0.3} | one for one in GENTLER),
    ],
    ("fit-truth", "hov+"): SUPERVISED,
    ("steady", "hov"): [*(STEADY_SETTINGS["gaussian", "hov"] | guide for guide in GUIDES), *AFTERWARDS],
    ("steady", "hov+"): [STEADY_SETTINGS["gaussian", "hov+"]],
    ("steady", "truck"): [STEADY_SETTINGS["gaussian", "truck"] | guide for guide in GUIDES],
}


def seeds(method: str, experiment: str, settings: dict[str, Any]) -> tuple[int, ...]:
    """By which these settings are judged."""
    tied, more = TIED.get((method, experiment), ([], ()))
    return SEEDS[experiment] + (more if settings in tied else ())


def judged(method: str, experiment: str, seed: int, settings: dict[str, Any], logs: Path) -> Record:
    """Held-out log p(y) of a fit; the test split is not even passed on."""
    torch.set_num_threads(1)
    train, valid, _ = truck(logs, seed) if experiment == "truck" else hov(seed, *SIZES[experiment][:2], test=1)
    began = time.perf_counter()
    fit = learnt(method, experiment, (train, valid, valid), seed, settings)
    assert fit.trained is not None
    (kept,) = (entry["log_likelihood"] for entry in fit.trained.history if entry["step"] == fit.trained.kept)
    return {
        "method": method,
        "experiment": experiment,
        "seed": seed,
        "settings": settings,
        "log_likelihood": kept,
        "kept_step": fit.trained.kept,
        "seconds": round(time.perf_counter() - began, 1),
        "notes": fit.notes,
    }


def table(records: dict[str, Record]) -> str:
    """Settings against held-out log p(y), a figure a seed; a fit that failed has none, and its settings no mean."""
    lines = [
        "| method | on | settings | mean log p(y) of a held-out drive | each seed | kept at step | seconds |",
        "|---|---|---|---|---|---|---|",
    ]
    for (method, experiment), candidates in CANDIDATES.items():
        for settings in candidates:
            judges = seeds(method, experiment, settings)
            names = [named(method, experiment, seed, settings) for seed in judges]
            tried = [records[name] for name in names if name in records]
            fits = [record for record in tried if "failed" not in record]
            whole = len(fits) == len(judges)
            columns = ([record.get(key) for record in tried] for key in ("log_likelihood", "kept_step", "seconds"))
            likelihoods, steps, seconds = (
                ", ".join("failed" if figure is None else f"{figure:.{digits}f}" for figure in column)
                for column, digits in zip(columns, (2, 0, 0), strict=True)
            )
            mean = f"{statistics.fmean(record['log_likelihood'] for record in fits):.2f}" if whole else "–"
            said = ", ".join(told(settings)).replace("=", " ") or "defaults"
            if tried:
                lines.append(f"| {method} | {experiment} | {said} | {mean} | {likelihoods} | {steps} | {seconds} |")
    return "\n".join([*lines, ""])


def main() -> None:
    """Run what is left and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    methods, experiments = (list(dict.fromkeys(pair[i] for pair in CANDIDATES)) for i in (0, 1))
    parser.add_argument("--data", type=Path, default=LOGS, help="the AlphaTruck logs: train/ and valid/")
    parser.add_argument("--methods", nargs="*", choices=methods, default=methods)
    parser.add_argument("--experiments", nargs="*", choices=experiments, default=experiments)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "choices")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    jobs = {}
    for (method, experiment), candidates in CANDIDATES.items():
        if method in options.methods and experiment in options.experiments:
            for settings in candidates:
                for seed in seeds(method, experiment, settings):
                    job = method, experiment, seed, settings
                    jobs[named(*job)] = (*job, options.data)
    run(
        judged,
        jobs,
        options.out / "choices.jsonl",
        version=VERSION,
        workers=options.workers,
        said=lambda record: f"log p(y) {record['log_likelihood']:.2f}, {record['seconds']:.0f} s",
    )
    text = table(stored(options.out / "choices.jsonl"))
    (options.out / "choices.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
