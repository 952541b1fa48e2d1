"""What an E step costs and how much its gradients scatter: bootstrap, lookahead and Gaussian guides on one problem.

    python benchmarks/estep.py            Hov, 16 trajectories at once, a good and a first network: minutes
    python benchmarks/estep.py --quick    four runs instead of ten
    python benchmarks/estep.py --condition 1hz      also two-landmarks, 1.25deg, 20deg
    python benchmarks/estep.py --leak-free          no true pose: a start from the program's broad prior

One core. The scatter is √trace of the covariance of the M step's gradient at fixed parameters, mean over trajectories;
every guide draws the same number of paths from all its lineages. Cost is seconds × variance: the time for one unit of
gradient variance, which falls as 1/N and as 1/repeats. Exits with 1 when a must is missed; --leak-free and a condition
have none but the memory.
"""

from __future__ import annotations

import argparse
import math
import os
import resource
import sys
import time
from dataclasses import replace

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from bounds import Bound
from experiments import CONDITIONS, STANDARD, hov
from pyro.infer import Trace_ELBO

from inference import fit_truth
from models.neural_vehicle import NeuralHovercraft
from steady_ppl import (
    Constant,
    GaussianGuide,
    LookaheadGuide,
    PathGuide,
    Program,
    SMCGuide,
    Trajectories,
    for_program,
    particle_filter,
    seeded,
)
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.gaussian.twisted_proposal import Twist
from steady_ppl.model.problem import Joint, Problem

MUSTS = {"good": Bound(0.05), "first": Bound(0.1)}
CHEAPER = 20


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--condition", default="standard", choices=list(CONDITIONS), help="what is seen of the drives")
    parser.add_argument("--leak-free", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    trajectories, particles, runs = 16, 20_000, 4 if arguments.quick else 10
    condition, known_start = CONDITIONS[arguments.condition], not arguments.leak_free
    held = known_start and condition == STANDARD
    train, valid, _ = hov(1, condition=condition)
    missed = memory()  # first: what the process has ever used counts
    for name in ("good", "first"):
        with seeded(1, "program"):
            program = condition.of(NeuralHovercraft())
        if name == "good":
            fit_truth.fit(program, train, valid, known_start=True, progress=False)
        data = for_program(program, train).subset(range(trajectories))
        start = "known" if known_start else "broad"
        print(f"\n{name} network, {trajectories} trajectories at once, {start} start, {arguments.condition} condition")
        missed |= scatter_of_evidence(program, data, known_start, MUSTS[name].high if held else math.inf, runs=30)
        missed |= scatter_of_gradient(program, data, known_start, 1 / CHEAPER if held else math.inf, particles, runs)
    return missed


def scatter_of_evidence(program: Program, data: Trajectories, known_start: bool, must: float, runs: int) -> int:
    """sd of log p(y) of the lookahead filter with 100 particles."""
    with seeded("path"):
        ahead = find_and_smooth(Problem(program, data, known_start))
    with seeded("evidence"):
        values = [
            particle_filter(
                program, data, particles=100, known_start=known_start, proposal=Twist(ahead), keep_history=False
            ).log_likelihood
            for _ in range(runs)
        ]
    sd = float(torch.stack(values).std(0).mean())
    return judged(f"lookahead, N = 100: sd of log p(y) over {runs} runs", sd, must)


def scatter_of_gradient(
    program: Program, data: Trajectories, known_start: bool, must: float, particles: int, runs: int
) -> int:
    """Seconds an E step and the variance of the M step's gradient, guide by guide."""
    settings = {"draws": 100, "tempering": Constant(1.0), "known_start": known_start}
    guides: dict[str, PathGuide] = {
        f"bootstrap, N = {particles}": SMCGuide(program, particles=particles, **settings),
        "lookahead, N = 100": LookaheadGuide(program, particles=100, **settings),
        "gaussian": GaussianGuide(program, **settings),
    }
    for guide in guides.values():
        guide.refresh(data, 1.0)  # finds the paths, compiles
    seconds: dict[str, list[float]] = {name: [] for name in guides}
    gradients: dict[str, list[torch.Tensor]] = {name: [] for name in guides}
    for run in range(runs):  # in turns: whatever else the machine does slows all of them
        for name, guide in guides.items():
            for repeat in range(1 if name.startswith("bootstrap") else 3):
                with seeded("gradient", run, repeat):
                    began = time.perf_counter()
                    guide.refresh(data, 1.0)
                    seconds[name].append(time.perf_counter() - began)
                gradients[name].append(gradient_by_trajectory(program, guide, data, known_start))
    costs = {}
    for name in guides:
        by_trajectory = torch.stack(gradients[name]).var(0).sum(-1)
        variance, error = float(by_trajectory.mean()), float(by_trajectory.std()) / len(by_trajectory) ** 0.5
        taken = sorted(seconds[name])[len(seconds[name]) // 2]
        costs[name] = taken * variance
        print(
            f"  {name:22} {taken:8.3f} s an E step, gradient variance {variance:.4g} ± {error / variance:.0%} "
            f"over {len(seconds[name])} runs",
            flush=True,
        )
    bootstrap, *others = costs.values()
    missed = 0
    for name, cost in zip(list(costs)[1:], others, strict=True):
        missed |= judged(f"{name}: time for the bootstrap's gradient variance, as a share", cost / bootstrap, must)
    return missed


def gradient_by_trajectory(program: Program, guide: PathGuide, data: Trajectories, known_start: bool) -> torch.Tensor:
    """The M step's gradient of each trajectory alone, `(B, parameters)`."""
    gradients = []
    whole = guide.paths
    assert whole is not None
    for b in range(len(data)):
        start, noise = ({site: value[:, :, [b]] for site, value in part.items()} for part in (whole.start, whole.noise))
        guide.paths = replace(whole, states=whole.states[:, :, [b]], start=start, noise=noise)
        elbo = Trace_ELBO(num_particles=guide.draws, vectorize_particles=True, max_plate_nesting=2)
        loss = elbo.differentiable_loss(Joint(program, known_start=known_start), guide, data.subset([b]))
        grads = torch.autograd.grad(loss, list(program.parameters()), allow_unused=True)
        gradients.append(torch.cat([g.flatten() for g in grads if g is not None]))
    guide.paths = whole
    return torch.stack(gradients)


def memory() -> int:
    """Seconds and peak memory of one E step with 200,000 particles and 100 intervals, history kept."""
    with seeded(1, "program"):
        program = NeuralHovercraft()
    data = for_program(program, hov(1)[0]).subset([0])
    particle_filter(program, data, particles=100, known_start=True)
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    particle_filter(program, data, particles=200_000, known_start=True).paths(100)
    seconds = time.perf_counter() - began
    gigabytes = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e6
    judged("seconds of a 200,000 × 100 E step with 100 paths", seconds, math.inf)
    return judged("peak memory of a 200,000 × 100 E step beyond what was used before, GB", gigabytes, 1.5)


def judged(name: str, value: float, high: float) -> int:
    """Print one figure beside its must; 1 if it is missed."""
    ok = value <= high
    must = f" (must be ≤ {high:.4g}) {'ok' if ok else 'MISSED'}" if math.isfinite(high) else ""
    print(f"  {name}: {value:.4g}{must}", flush=True)
    return int(not ok)


if __name__ == "__main__":
    sys.exit(main())
