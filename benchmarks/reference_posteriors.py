"""The reference posteriors of `tests/reference`: long runs of NUTS on three small problems.

    python benchmarks/reference_posteriors.py               all three, minutes each
    python benchmarks/reference_posteriors.py pendulum      one of them

Each file holds every number of a problem (parameters, controls, measurements, the true states) and, of every state at
every row, the posterior mean and standard deviation with their Monte-Carlo standard errors. NUTS runs the same program
as the filters do, its start and channel noise as functions of standard normals (`Standardised`), step by step and in
double precision; it shares neither weights nor linearisation with them.

Chains are copies of the drive that one NUTS moves together: the posterior of the copies is the product of theirs, and
32 cost as much time as one. A file is written only if R-hat is below 1.01.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import pyro
import torch
from pyro.infer import MCMC, NUTS
from torch import Tensor

with warnings.catch_warnings():
    warnings.simplefilter("ignore", FutureWarning)  # an advertisement of arviz 1, once a day
    import arviz

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from examples import copies, drives  # noqa: E402
from references import FOLDER, PROBLEMS, rolled_out  # noqa: E402

from steady_ppl import Program, Trajectories, seeded  # noqa: E402

CHAINS, PILOT, WARMUP = 32, 60, 50
DATA = ("time", "controls", "measurements", "observed", "lengths", "states")


@dataclass(frozen=True)
class Settings:
    """A drive's rows, of which every n-th is measured; its seed; and how many draws a chain keeps."""

    rows: int
    every: int
    seed: int
    draws: int


SETTINGS = {
    "hovercraft": Settings(rows=16, every=1, seed=3, draws=400),
    "network": Settings(rows=13, every=4, seed=4, draws=450),
    "pendulum": Settings(rows=21, every=10, seed=3, draws=1000),
}


def problem(name: str) -> tuple[Program, Trajectories]:
    """The program and one simulated drive of it; the network's weights are drawn, its noise is near 0.2 m/s²."""
    settings = SETTINGS[name]
    program = PROBLEMS[name]().double().requires_grad_(False)
    if name == "network":
        with seeded(1, "weights"):
            for parameter in program.parameters():
                parameter.normal_(0, 0.2)
        program.noise.bias -= 1.5
    return program, drives(program, 1, settings.rows, seed=settings.seed).observed_every(settings.every)


class Posterior:
    """The posterior as a density of one vector a chain, of the start's noise and every interval's.

    Args:
        data: one drive, or copies of it.
    """

    def __init__(self, program: Program, data: Trajectories) -> None:
        self.program, self.data = program, data
        self.start, self.channels = len(program.states), len(program.channels)
        self.size = self.start + (len(data.time) - 1) * self.channels

    def split(self, noise: Tensor) -> tuple[Tensor, Tensor]:
        """`(B, size)` as the start's noise `(B, D)` and that of the intervals `(T, B, C)`."""
        return noise[:, : self.start], noise[:, self.start :].unflatten(1, (-1, self.channels)).transpose(0, 1)

    def rolled_out(self, noise: Tensor) -> tuple[Tensor, Tensor]:
        """States `(T + 1, B, D)` and log p(y) given them, `(B,)`."""
        return rolled_out(self.program, self.data, *self.split(noise))

    def energy(self, noise: Tensor) -> Tensor:
        """Less the log density but for a constant, summed over chains."""
        return 0.5 * noise.square().sum() - self.rolled_out(noise)[1].sum()


def mode_and_scale(posterior: Posterior) -> tuple[Tensor, Tensor]:
    """The mode `(1, size)` and a square root of the inverse curvature there."""
    mode = torch.zeros(1, posterior.size, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([mode], max_iter=200, tolerance_grad=1e-8, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        energy = posterior.energy(mode)
        energy.backward()
        return energy

    optimizer.step(closure)
    curvature = torch.autograd.functional.hessian(lambda noise: posterior.energy(noise[None]), mode.detach()[0])
    return mode.detach(), torch.linalg.inv(torch.linalg.cholesky(curvature))


def run_nuts(posterior: Posterior, begin: Tensor, centre: Tensor, scale: Tensor, draws: int) -> tuple[Tensor, int]:
    """NUTS on `(noise − centre) scale⁻¹`: the noise of its draws, `(draws, B, size)`, and how many steps diverged."""

    def potential(parameters: Mapping[str, Tensor]) -> Tensor:
        return posterior.energy(centre + parameters["white"] @ scale)

    chains = MCMC(
        NUTS(potential_fn=potential, adapt_mass_matrix=False, target_accept_prob=0.7),
        draws,
        warmup_steps=WARMUP,
        initial_params={"white": (begin - centre) @ torch.linalg.inv(scale)},
        disable_progbar=not sys.stderr.isatty(),
    )
    chains.run()
    divergences = sum(len(found) for found in chains.diagnostics()["divergences"].values())
    return centre + chains.get_samples()["white"] @ scale, divergences


def sample(program: Program, data: Trajectories, draws: int) -> tuple[Tensor, int]:
    """Draws of the posterior's noise, `(draws, chains, size)`, and how many steps diverged.

    A pilot begins twice as widely as the posterior, in coordinates of unit curvature at its mode; where its chains end
    the long run begins, in coordinates of unit covariance. Either is a dense mass matrix by another name.
    """
    mode, scale = mode_and_scale(Posterior(program, data))
    posterior = Posterior(program, copies(data, CHAINS))
    begin = mode + 2 * torch.randn(CHAINS, posterior.size, dtype=torch.float64) @ scale
    pilot = run_nuts(posterior, begin, mode, scale, PILOT)[0]
    covariance = torch.cov(pilot.flatten(0, 1).T)
    return run_nuts(posterior, pilot[-1], pilot.mean((0, 1)), torch.linalg.cholesky(covariance).T, draws)


def summary(states: Tensor) -> tuple[dict[str, Tensor], dict[str, float]]:
    """Moments with their standard errors, each `(T + 1, D)`, and the worst diagnostics of them all."""
    mean, sd = states.mean((0, 2)), states.transpose(1, 2).flatten(0, 1).std(0)
    squares = (states - mean[:, None]).square()

    def diagnosed(diagnostic: Callable, values: Tensor, **settings: str) -> Tensor:
        found = diagnostic(arviz.convert_to_dataset({"x": values.permute(2, 0, 1, 3).numpy()}), **settings)
        return torch.from_numpy(found["x"].values)

    moments = {
        "mean": mean,
        "mean_error": diagnosed(arviz.mcse, states),
        "sd": sd,
        "sd_error": diagnosed(arviz.mcse, squares) / (2 * sd),
    }
    figures = {
        "r_hat": float(diagnosed(arviz.rhat, states).max()),
        "ess_bulk": float(diagnosed(arviz.ess, states, method="bulk").min()),
        "ess_tail": float(diagnosed(arviz.ess, states, method="tail").min()),
        "mean_error_in_sd": float((moments["mean_error"] / moments["sd"]).max()),
        "sd_error_in_sd": float((moments["sd_error"] / moments["sd"]).max()),
    }
    return moments, {name: float(f"{value:.5g}") for name, value in figures.items()}


def make(name: str) -> None:
    """Run one problem, print what NUTS did and write its file.

    Raises:
        RuntimeError: the chains do not agree.
    """
    settings, began = SETTINGS[name], time.perf_counter()
    program, data = problem(name)
    with seeded(0, "nuts"):
        noise, divergences = sample(program, data, settings.draws)
    posterior = Posterior(program, copies(data, CHAINS))
    with torch.no_grad():
        states, log_likelihoods = (torch.stack(v) for v in zip(*map(posterior.rolled_out, noise), strict=True))
    moments, figures = summary(states)
    print(f"{name}: {CHAINS} chains of {settings.draws} draws, {divergences} divergent, {figures}")
    print(f"{name}: {time.perf_counter() - began:.0f} s", flush=True)
    if figures["r_hat"] >= 1.01:
        raise RuntimeError(f"{name}: R-hat is {figures['r_hat']}, must be below 1.01: raise its draws")
    start, steps = posterior.split(noise[-1, :1])
    last = {"start": start, "noise": steps, "states": states[-1, :, :1], "log_likelihood": log_likelihoods[-1, :1]}
    content = {
        "problem": {"what": " ".join(type(program).__doc__.split()), "made by": f"benchmarks/{Path(__file__).name}"},
        "sampler": {"chains": CHAINS, "draws": settings.draws, "warmup": WARMUP, "divergences": divergences} | figures,
        "versions": {module.__name__: module.__version__ for module in (torch, pyro, arviz)}
        | {"python": platform.python_version()},
        "program": listed(program.state_dict()),
        "data": listed({field: getattr(data, field) for field in DATA}),
        "posterior": listed({key: rounded(value) for key, value in moments.items()}),
        "a_draw": listed(last),
    }
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / f"{name}.json").write_text(written(content))


def listed(tensors: Mapping[str, Tensor]) -> dict[str, list]:
    """As JSON has them; Python writes a float such that it is read as the same."""
    return {name: tensor.tolist() for name, tensor in tensors.items()}


def rounded(values: Tensor) -> Tensor:
    """To seven decimals, a thousandth of what NUTS leaves open."""
    return values.round(decimals=7)


def written(content: Mapping[str, Mapping[str, object]]) -> str:
    """JSON with an entry a line."""
    parts = []
    for name, entries in content.items():
        lines = ",\n".join(f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in entries.items())
        parts.append(f"{json.dumps(name)}: {{\n{lines}\n}}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", default=list(SETTINGS), help=", ".join(SETTINGS))
    torch.set_num_threads(1)
    for name in parser.parse_args().problems:
        make(name)


if __name__ == "__main__":
    main()
