"""What an E step costs with the second-order step and with substeps, against the explicit Euler step.

    python benchmarks/step_cost.py [--seeds 5] [--rounds 5]

One thread. For each data seed every guide runs in turn on 16 drives of the hovercraft with drag; a figure is the ratio
of median seconds within one round, mean ± sd over seeds. Exits with 1 when K = 1 takes more than 1.3 times as long as
explicit Euler, or K = 4 more than 4.5 times.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from models.hovercraft import HovercraftTruth  # noqa: E402
from models.paper import PaperHovercraftTruth  # noqa: E402
from steady_ppl import (  # noqa: E402
    Constant,
    GaussianGuide,
    LookaheadGuide,
    PathGuide,
    Program,
    SMCGuide,
    for_program,
    seeded,
    simulate,
    with_substeps,
)

MUSTS = {"K = 1": 1.3, "K = 4": 4.5}


def guides(program: Program) -> dict[str, PathGuide]:
    """Every guide of the recipe `steady` for a program."""
    settings = {"draws": 100, "tempering": Constant(1.0), "known_start": True}
    return {
        "bootstrap, N = 20000": SMCGuide(program, particles=20_000, **settings),
        "bootstrap, N = 200": SMCGuide(program, particles=200, **settings),
        "lookahead, N = 100": LookaheadGuide(program, particles=100, **settings),
        "gaussian": GaussianGuide(program, **settings),
    }


def ratios(seed: int, rounds: int) -> dict[tuple[str, str], float]:
    """(Guide, step) → median seconds over those of explicit Euler, on one set of drives."""
    euler, ours = PaperHovercraftTruth(), HovercraftTruth()
    steps = {"Euler": euler, "K = 1": ours, "K = 2": with_substeps(ours, 2), "K = 4": with_substeps(ours, 4)}
    data = for_program(ours, simulate(ours, 16, seed=seed))
    every = {step: guides(program) for step, program in steps.items()}
    seconds: dict[tuple[str, str], list[float]] = {}
    for step in steps:
        for guide in every[step].values():
            guide.refresh(data, 1.0)  # finds the paths, compiles
    for number in range(rounds):  # in turns: whatever else the machine does slows all of them
        for step in steps:
            for name, guide in every[step].items():
                with seeded(seed, number):
                    began = time.perf_counter()
                    guide.refresh(data, 1.0)
                    seconds.setdefault((name, step), []).append(time.perf_counter() - began)
    middle = {key: statistics.median(values) for key, values in seconds.items()}
    return {(name, step): value / middle[name, "Euler"] for (name, step), value in middle.items() if step != "Euler"}


def main() -> int:
    """Print a line a guide and step, and judge them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    found = [ratios(seed, arguments.rounds) for seed in range(1, arguments.seeds + 1)]
    missed = 0
    print("| guide | step | times Euler | must |\n|---|---|---|---|")
    for name, step in found[0]:
        values = [one[name, step] for one in found]
        spread = statistics.stdev(values) if len(values) > 1 else 0.0
        mean, must = statistics.fmean(values), MUSTS.get(step)
        missed |= int(must is not None and mean > must)
        print(f"| {name} | {step} | {mean:.2f} ± {spread:.2f} | {f'≤ {must}' if must else ''} |")
    return missed


if __name__ == "__main__":
    sys.exit(main())
