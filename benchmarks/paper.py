"""The paper's two tables: every method on Hov, Hov+ and Truck under one likelihood, beside the published figures.

    python benchmarks/paper.py [--data FOLDER] [--quick] [--out FOLDER] [--workers 2]      (make paper, QUICK=1)

Three runs of each method, each on drives (for the truck: on a draw of the bearings) of its own, the same for all
methods; known start, as in the paper. Every run is one line of OUT/paper.jsonl; runs that are there already, by the
same source and settings, are left out, so that it can be interrupted and gone on with. Two processes of one thread
each. The tables are printed at the end and written beside (paper.md), with what must hold and does not; the fits of the
truck's first run are kept there too, for the picture of velocities. What was filed is in `results/paper.*`. Exits with
1, and says why, unless every run came off and every must was run and met; a quick run judges nothing, and exits with 1
only when a run failed.

What each method fits to: Hand nothing; FitTV the measurements; FitHand, SVI and STEADY the measurements and the true
first state of each drive; FitTruth all true states. Those that learn, FitTV too, stop on held-out log p(y) of the valid
drives, filtered from their true first states; every method is judged from true first states.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import matplotlib as mpl

mpl.use("Agg")
import torch
from experiments import LOGS, ROOT, SIZES, hov, truck
from paper_methods import VERSION, Settings, by_bootstrap, learnt, named
from paper_musts import all_met
from paper_records import EXPERIMENTS, METHODS, RUNS, done
from paper_settings import CHOSEN
from paper_tables import tables
from resumable import Record, run

from steady_ppl import Fit
from steady_ppl.comparison.evaluate import evaluate
from steady_ppl.plotting import posterior_velocities

FEW = {"steps": 100, "validate_every": 50}
QUICK: dict[str, Settings] = {"svi": FEW, "steady": FEW, "steady-minus": FEW, "fit-tv": {"iterations": 5}}
LEFT_OUT = {("truth", "truck")}  # nobody knows it
KEPT, COLORS = ("steady", "fit-hand"), ("#0072b2", "#d55e00")


def judged(method: str, experiment: str, seed: int, settings: Settings, logs: Path, checked: bool, out: Path) -> Record:
    """One run's record, and what the bootstrap filter says, if it is to be checked by that."""
    torch.set_num_threads(1)
    data = truck(logs, seed) if experiment == "truck" else hov(seed, *SIZES[experiment])
    began = time.perf_counter()
    fit = learnt(method, experiment, data, seed, settings)
    seconds = time.perf_counter() - began
    if (experiment, seed) == ("truck", 1) and method in KEPT:
        fit.save(out / f"{experiment}-{method}-{seed}", force=True)
    kept = fit.trained.kept if fit.trained else None
    record: Record = {
        "experiment": experiment,
        "method": method,
        "seed": seed,
        "seconds": round(seconds, 1),
        "kept_step": kept,
    }
    record |= {"settings": fit.settings, "notes": fit.notes} | evaluate(fit, data[2])
    return record | ({"bootstrap": by_bootstrap(fit, data[2])} if checked else {})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="the AlphaTruck logs: train/, valid/ and test/")
    parser.add_argument(
        "--out",
        type=Path,
        default=ROOT / "out" / "paper",
        help="paper.jsonl, which it goes on with, paper.md, fits and picture of the truck",
    )
    parser.add_argument("--experiments", nargs="*", choices=list(EXPERIMENTS), default=list(EXPERIMENTS))
    parser.add_argument("--methods", nargs="*", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("--quick", action="store_true", help="one run of few steps, without the bootstrap")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    experiments, methods, runs = arguments.experiments, arguments.methods, arguments.runs
    if arguments.data and not arguments.data.is_dir():
        parser.error(f"--data {arguments.data}: there is no such folder")
    logs = arguments.data or LOGS
    if not logs.is_dir() and "truck" in experiments:
        print("Truck is left out: name the folder with the AlphaTruck logs (--data, make paper DATA=)", file=sys.stderr)
        experiments = [experiment for experiment in experiments if experiment != "truck"]
    if arguments.quick:
        runs, methods = 1, [method for method in methods if method != "steady-bootstrap"]
    out = arguments.out / "quick" if arguments.quick else arguments.out
    results = out / "paper.jsonl"
    jobs = {}
    for seed in range(1, 1 + runs):
        for experiment, method in itertools.product(experiments, methods):
            settings = CHOSEN.get((method, experiment), {})
            if arguments.quick:
                settings = settings | QUICK.get(method, {})
            if (method, experiment) not in LEFT_OUT:
                job = method, experiment, seed, settings
                jobs[named(*job)] = (*job, logs, not arguments.quick, out)
    records = run(judged, jobs, results, version=VERSION, workers=arguments.workers, said=said)
    text = tables(records, runs, quick=arguments.quick)
    results.with_suffix(".md").write_text(text)
    print(text)
    shown = {METHODS[method]: out / f"truck-{method}-1" for method in KEPT}
    lacking = [name for name, folder in shown.items() if not folder.is_dir()]
    if "truck" in experiments and lacking:
        print(
            f"no picture of velocities: no fit of {' and '.join(lacking)} is in {out}; delete their lines to fit again"
        )
    elif "truck" in experiments:
        print(f"picture {draw_velocities(shown, logs, out / 'velocities.png')}")
    failed = len(records) - len(done(records))
    missed = not (arguments.quick or all_met(records, runs))
    if failed:
        print(f"exit status 1: {failed} runs failed")
    elif missed:
        print("exit status 1: not every must was run and met, see above")
    return int(failed > 0 or missed)


def draw_velocities(runs: dict[str, Path], logs: Path, file: Path, drive: int = 3) -> Path:
    """Posterior velocities at 1 Hz on one of the truck's test drives, in the body frame."""
    test = truck(logs, 1)[2].subset([drive])
    axes = None
    for (name, folder), color in zip(runs.items(), COLORS, strict=True):
        posterior = Fit.load(folder).posterior(test, draws=200, every=10)
        axes = posterior_velocities(posterior, test.labels[0], axes=axes, color=color, label=name)
    assert axes is not None
    axes[0].set_title(f"AlphaTruck, test drive {test.labels[0]}, from bearings at 1 Hz")
    axes[0].legend(frameon=False, ncols=3)
    axes[0].figure.tight_layout()
    axes[0].figure.savefig(file, dpi=110)
    return file


def said(record: Record) -> str:
    """A line of a run."""
    forward = record["forward"]
    return (
        f"forward {forward['location']:.4f} m {forward['angle']:.4f} rad, log p(y) {record['log_likelihood']:.2f}, "
        f"{record['seconds']:.0f} s"
    )


if __name__ == "__main__":
    sys.exit(main())
