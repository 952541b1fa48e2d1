"""Learn a vehicle's dynamics from bearings and compare: Hand, learned (STEADY), FitTruth, and the true model if known.

python benchmarks/learn.py hov   --out out/learn
python benchmarks/learn.py truck --data FOLDER --out out/learn-truck     (FOLDER holds train/, valid/ and test/)
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import torch
from experiments import Split, hov, learn, truck

from steady_ppl import Fit, SteadyError, write_table
from steady_ppl.comparison.evaluate import evaluate, table_of
from steady_ppl.plotting import posterior_trajectories

NAMES = {"hand": "Hand", "steady": "learned", "fit-truth": "FitTruth", "truth": "true model"}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("vehicle", choices=["hov", "truck"])
    parser.add_argument("--data", type=Path, help="the AlphaTruck logs")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.vehicle == "truck" and arguments.data is None:
        parser.error("truck needs --data FOLDER")
    try:
        run(arguments.vehicle, arguments.data, arguments.out, arguments.seed)
    except SteadyError as error:
        print(f"learn: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def run(vehicle: str, folder: Path | None, out: Path, seed: int) -> None:
    """Tables, fits, evaluation and picture of one experiment."""
    torch.set_num_threads(1)
    began = time.perf_counter()
    data = hov(seed) if folder is None else truck(folder, seed)
    out.mkdir(parents=True, exist_ok=True)
    for name, part in zip(("train", "valid", "test"), data, strict=True):
        write_table(part, out / f"{name}.csv")
    print(f"{len(data[0])} drives to learn from, {len(data[1])} to stop, {len(data[2])} to judge: tables in {out}")
    methods = ["hand", "steady", "fit-truth"] + (["truth"] if vehicle == "hov" else [])
    fits = {}
    for method in methods:
        print(f"{NAMES[method]} …", flush=True)
        fits[method] = learn(method, vehicle, data, seed, guide="gaussian", progress=True)
        train = data[0] if method == "steady" else None
        fits[method].save(out / method, train=train, force=True)
    results = [evaluate(fits[method], data[2], rollouts=200) for method in methods]
    print(table_of(results, [NAMES[method] for method in methods]))
    print(
        "log p(y): per drive at 1 Hz; location m, angle rad, velocity m/s, yaw rate rad/s. forward: noisy roll-outs of"
    )
    print("ten steps from every true state (the paper's metric), mean: without noise, state: smoothed at 1 Hz.")
    picture = out / "posterior.png"
    draw(fits["hand"], fits["steady"], data, picture)
    print(f"picture {picture}, {time.perf_counter() - began:.0f} s in all")


def draw(before: Fit, after: Fit, data: Split, file: Path, drives: int = 4) -> None:
    """Posterior trajectories at 1 Hz on test drives under the hand-written and the learned program."""
    shown = data[2].subset(range(drives))
    figure, axes = plt.subplots(2, drives, figsize=(3.6 * drives, 7.4), sharex="col", sharey="col")
    for row, (fit, name) in enumerate(((before, "hand-written program"), (after, "learned from bearings"))):
        posterior = fit.posterior(shown, draws=50, every=10)
        for column, label in enumerate(shown.labels):
            one = posterior_trajectories(posterior, label, landmarks=after.program.landmarks, axes=axes[row, column])
            one.set_title(f"test drive {label}, {name}", fontsize=9)
            if row == 0:
                one.set_xlabel("")
            if column > 0:
                one.set_ylabel("")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    for handle in handles:
        handle.set_alpha(1)
    figure.legend(handles, labels, loc="lower center", ncols=3, frameon=False)
    figure.tight_layout(rect=(0, 0.04, 1, 1))
    figure.savefig(file, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
