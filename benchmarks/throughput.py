"""The bootstrap filter's speed through a Pyro program, beside other libraries on the same problem in the same run.

    python benchmarks/throughput.py --bench FOLDER --rivals PYTHON      minutes; one core
    python benchmarks/throughput.py --bench FOLDER --rivals PYTHON --only jax 'C, by hand'
    python benchmarks/throughput.py --quick                             one round, JAX only

FOLDER holds the problem (`problem.npz`: one drive of 100 rows, a 5→64→3 network, four bearings) and a script a rival;
PYTHON is an interpreter in which they are installed (`benchmarks/rivals.txt`), the present one by default. A rival that
does not run is named and left out. Every filter resamples systematically at every row, keeps the ancestors and traces
ten lineages. Several trajectories at once are run by `vmap` where the rival has it, else one after the other. Rounds
alternate between all of them, so that a busy machine slows all alike. Exits with 1 when a must is missed, with 2 where
JAX does not run and nothing can be judged.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from experiments import ROOT
from torch import nn, tensor

from steady_ppl import PlanarVehicle, Trajectories, bearings_to, dense, for_program, particle_filter, seeded, stack

BENCH = ROOT.parent / "shared" / "bench"
CASES = [(1, 20_000), (16, 200), (16, 2_000)]
MUSTS = {(1, 20_000): 1.0, (16, 200): 0.8, (16, 2_000): 0.8}  # of JAX's speed
MUST_OF_C = 0.6  # of that of C by hand, in each case
VMAPPED = {"jax": "bench_jax.py --mode count", "cuthbert": "bench_cuthbert.py", "tfp": "bench_tfp.py"}
ALONE = {
    "torch, plain": "bench_torch_plain.py",
    "torch, careful": "bench_torch_soa.py",
    "torch.compile": "bench_torch_plain.py --compile",
    "Pyro SMCFilter": "bench_pyro_smc.py",
    "numba, by hand": "bench_numba.py",
    "C, by hand": "bench_c.py",
}
EVIDENCE, NEAR = 371.37, 0.5  # of the iterated smoother, and what a filter of 20,000 particles may differ by


class Bench(PlanarVehicle):
    """The rivals' program: body-frame velocities as states, their noise grows with the root of the step."""

    controls = ("left [N]", "right [N]")

    def __init__(self, problem: dict[str, np.ndarray]) -> None:
        super().__init__()
        self.landmarks = problem["LM"].tolist()
        self.sd = float(problem["sig"])
        self.hidden, self.head = nn.Linear(5, 64), nn.Linear(64, 3)
        self.skip, self.noise = nn.Linear(5, 3), nn.Linear(5, 3)
        layers = (
            (self.hidden, "W1", "b1"),
            (self.head, "W2", None),
            (self.skip, "Wskip", "b2"),
            (self.noise, "Ws", "bs"),
        )
        with torch.no_grad():
            for layer, weight, bias in layers:
                layer.weight.copy_(tensor(problem[weight]).T)
                layer.bias.copy_(tensor(problem[bias])) if bias else layer.bias.zero_()
        self.register_buffer("mean", tensor(problem["x0m"]))
        self.register_buffer("spread", tensor(problem["x0s"]))

    def initial(self):
        return pyro.sample("start", dist.Normal(self.mean, self.spread).to_event(1))

    def transition(self, state, control, time, step):
        x, y, heading, forward, lateral, yaw_rate = state.unbind(-1)
        inputs = stack(forward, lateral, yaw_rate, *control.unbind(-1))
        mean = dense(self.head, dense(self.hidden, inputs).relu()) + dense(self.skip, inputs)
        sd = nn.functional.softplus(dense(self.noise, inputs))
        step = step.unsqueeze(-1)
        change = pyro.sample("change", dist.Normal(mean * step, sd * step.sqrt()).to_event(1)).unbind(-1)
        step, cos, sin = step.squeeze(-1), heading.cos(), heading.sin()
        return stack(
            x + step * (cos * forward - sin * lateral),
            y + step * (sin * forward + cos * lateral),
            heading + step * yaw_rate,
            forward + change[0],
            lateral + change[1],
            yaw_rate + change[2],
        )

    def observe(self, state):
        pyro.sample("bearing", bearings_to(self.landmarks, state, self.sd))


def drives(problem: dict[str, np.ndarray], count: int) -> Trajectories:
    """The problem's drive, `count` times."""
    rows, bearings = problem["Y"].shape
    controls = np.concatenate([problem["U"], np.zeros((1, 2), np.float32)])
    return Trajectories(
        time=(0.1 * torch.arange(rows, dtype=torch.float64)[:, None]).expand(-1, count),
        controls=tensor(controls)[:, None].expand(-1, count, -1),
        measurements=tensor(problem["Y"])[:, None].expand(-1, count, -1),
        observed=torch.ones(rows, count, bearings, dtype=torch.bool),
        lengths=torch.full((count,), rows),
        control_names=("left", "right"),
        measurement_names=tuple(f"bearing_{i}" for i in range(bearings)),
    )


def ours(problem: dict[str, np.ndarray], case: tuple[int, int], kernels: bool, runs: int) -> tuple[float, float]:
    """Million steps of particles a second, and the mean estimate of log p(y)."""
    trajectories, particles = case
    program = Bench(problem)
    data = for_program(program, drives(problem, trajectories))
    seconds, evidence = [], []
    for run in range(-1, runs):
        with seeded("throughput", run + 1):
            began = time.perf_counter()
            found = particle_filter(program, data, particles=particles, resample_below=math.inf, kernels=kernels)
            found.paths(10)
        if found.in_plain_torch:
            raise SystemExit(f"no kernels: {found.in_plain_torch}")
        if run >= 0:  # the first compiles
            seconds.append(time.perf_counter() - began)
            evidence.append(float(found.log_likelihood.mean()))
    return data.time.numel() * particles / statistics.median(seconds) / 1e6, statistics.fmean(evidence)


def rival(python: str, folder: Path, script: str, case: tuple[int, int]) -> tuple[float, float] | str:
    """The same of a rival; or why it does not run."""
    trajectories, particles = case
    name, *options = script.split()
    command = [python, str(folder / name), "--n", str(particles), "--reps", "3", *options]
    if trajectories > 1 and script in VMAPPED.values():
        vmapped = str(Path(__file__).with_name("vmapped.py"))
        command = [python, vmapped, str(folder / name), str(trajectories), str(particles), *options]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}
    )
    if done.returncode:
        return (done.stderr.strip().splitlines() or ["it fails without a word"])[-1]
    fields = done.stdout.strip().splitlines()[-1].split(",")
    return float(fields[4]), float(fields[5])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bench", type=Path, default=BENCH)
    parser.add_argument("--rivals", default=sys.executable, metavar="PYTHON")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--large", action="store_true", help="also one trajectory of 200,000 particles")
    parser.add_argument("--only", nargs="+", choices=[*VMAPPED, *ALONE], help="rivals to run")
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    if not (arguments.bench / "problem.npz").is_file():
        print(f"no problem.npz at {arguments.bench}: nothing to compare with", file=sys.stderr)
        return 2 if arguments.bench != BENCH else 0
    torch.set_num_threads(1)
    problem = dict(np.load(arguments.bench / "problem.npz"))
    chosen = arguments.only or (["jax"] if arguments.quick else [*VMAPPED, *ALONE])
    scripts = {name: (VMAPPED | ALONE)[name] for name in chosen}
    cases = CASES + ([(1, 200_000)] if arguments.large else [])
    missed = 0
    for case in cases:
        missed = max(missed, compare(problem, arguments, scripts, case))
    return missed


def compare(problem: dict[str, np.ndarray], arguments: argparse.Namespace, scripts: dict[str, str], case) -> int:
    """Rounds of everybody on one case; prints the table and judges ours against JAX."""
    found: dict[str, list[tuple[float, float]]] = {}
    absent: dict[str, str] = {}
    for _ in range(1 if arguments.quick else arguments.rounds):
        for name, kernels in (("steady-ppl", True), ("steady-ppl, plain torch", False)):
            found.setdefault(name, []).append(ours(problem, case, kernels, runs=3))
        for name, script in scripts.items():
            if name not in absent:
                result = rival(arguments.rivals, arguments.bench, script, case)
                if isinstance(result, str):
                    absent[name] = result
                else:
                    found.setdefault(name, []).append(result)
    jax = [speed for speed, _ in found.get("jax", [])]
    print(f"\n{case[0]} × {case[1]} particles: million steps of particles a second, mean ± sd of rounds")
    for name, results in found.items():
        speeds = [speed for speed, _ in results]
        sd = statistics.stdev(speeds) if len(speeds) > 1 else 0.0
        ratio = f"{statistics.median(speeds) / statistics.median(jax):6.2f} × JAX" if jax else ""
        evidence = statistics.fmean(value for _, value in results)
        print(f"  {name:24} {statistics.fmean(speeds):7.2f} ± {sd:5.2f}  {ratio}  log p(y) {evidence:.2f}", flush=True)
    for name, reason in absent.items():
        print(f"  {name:24} does not run: {reason[:90]}")
    missed = 0
    if "C, by hand" in found:
        ratio = statistics.median(one for one, _ in found["steady-ppl"])
        ratio /= statistics.median(one for one, _ in found["C, by hand"])
        missed |= ratio < MUST_OF_C
        print(f"  ours ÷ C {ratio:.2f}, must ≥ {MUST_OF_C:g}  {'MISSED' if ratio < MUST_OF_C else 'ok'}")
    if not jax:
        print("  JAX does not run: name an interpreter that has it with --rivals")
        missed = 2
    elif case in MUSTS:
        ratio = statistics.median(speed for speed, _ in found["steady-ppl"]) / statistics.median(jax)
        missed |= ratio < MUSTS[case]
        print(f"  ours ÷ JAX {ratio:.2f}, must ≥ {MUSTS[case]:g}  {'MISSED' if ratio < MUSTS[case] else 'ok'}")
    if case[1] >= 20_000:
        off = statistics.fmean(value for _, value in found["steady-ppl"]) - EVIDENCE
        missed |= abs(off) > NEAR
        verdict = "MISSED" if abs(off) > NEAR else "ok"
        print(f"  our log p(y) less {EVIDENCE}: {off:+.2f}, must be within {NEAR}  {verdict}")
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
