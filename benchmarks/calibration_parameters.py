"""Whether true parameters rank uniformly among the draws of their posterior, and how many an interval holds.

A data set is four drives of the hovercraft with drag, whose mass, inertia, drag and noise are drawn from priors about
what the program declares. Draws are `parameter_posterior`'s: of the linearised program's likelihood. The same values
weighed by bootstrap filters of 200 particles show what the paper's filter would make of them.
"""

from __future__ import annotations

import numpy as np
import pyro.distributions as dist
import torch
from examples import example
from torch import Tensor
from uniformity import inside, ranks, together, uniform

from steady_ppl import Program, Trajectories, run_filter, seeded, simulate
from steady_ppl.likelihood.maximize import maximise
from steady_ppl.likelihood.parameter_posterior import (
    MAX_TAIL_INDEX,
    LogLikelihood,
    about_maximum,
    adapt,
    log_likelihood_along,
    log_posterior,
    own_values,
    resampled,
)
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import for_program

DRAWS, DRIVES = 99, 4
VALUES = 400  # as many as users get
SPREAD = 0.4  # of the logarithms, a priori
BLIND, BLIND_VALUES = 200, 120  # particles of the bootstrap filter, and of how many values it judges


class Hovercraft(type(example("hovercraft:HovercraftTruth"))):
    """Its declared parameters are the priors' medians."""

    duration = 5.0

    def __init__(self) -> None:
        super().__init__()
        self.priors = {
            name: dist.LogNormal(getattr(self, name).detach().double().log(), SPREAD).to_event(
                getattr(self, name).dim()
            )
            for name in ("mass", "inertia", "drag", "noise")
        }


def drawn(seed: int) -> tuple[Program, Program, Trajectories]:
    """The program as declared, the truth, and its drives."""
    program, truth = Hovercraft().double(), Hovercraft().double()
    with seeded(seed, "truth"), torch.no_grad():
        for name, prior in truth.priors.items():
            setattr(truth, name, prior.sample())
    data = for_program(program, simulate(truth, DRIVES, seed=seed))
    return program, truth, data.without_truth()


def blind(data: Trajectories) -> LogLikelihood:
    """log p(y) by bootstrap filters."""

    def judge(program: Program) -> Tensor:
        found = run_filter(program, data, particles=BLIND, known_start=False, keep_history=False)
        return found.log_likelihood.sum()

    return judge


@torch.no_grad()
def ranked(seed: int) -> dict:
    """Ranks of a data set's true parameters among draws by either likelihood."""
    torch.set_num_threads(1)
    program, truth, data = drawn(seed)
    with seeded(seed, "parameters"):
        maximum = maximise(Problem(program, data))
        problem = Problem(program, data)
        shape = about_maximum(problem, maximum.path)
        judge = log_likelihood_along(problem, maximum.path)
        values, log_weights = adapt(program, shape, judge, VALUES)
        some = torch.randperm(VALUES)[:BLIND_VALUES]
        density = log_posterior(program, values[some], judge) - log_weights[some]
        blindly = log_posterior(program, values[some], blind(data)) - density
        record = {"names": list(maximum.names), "truth": own_values(truth).tolist()}
        for name, (at, weights) in {
            "linearised": (values, log_weights),
            f"bootstrap {BLIND}": (values[some], blindly),
        }.items():
            found = resampled(program, at, weights, DRAWS)
            record[name] = {
                "ranks": ranks(own_values(truth).numpy(), found.draws.numpy()).tolist(),
                "tail_index": found.tail_index,
            }
    return record


def summary(records: list[dict], name: str) -> dict:
    """How uniform the ranks of a likelihood's draws are, together and each, and how many intervals hold the truth."""
    found = np.array([record[name]["ranks"] for record in records])
    p_values = {number: uniform(found[:, i], DRAWS) for i, number in enumerate(records[0]["names"])}
    return {
        "p_value": together(np.array(list(p_values.values()))),
        "p_values": p_values,
        "inside_50": inside(found, DRAWS, 0.5),
        "inside_90": inside(found, DRAWS, 0.9),
        "reliable": sum(record[name]["tail_index"] <= MAX_TAIL_INDEX for record in records),
    }
