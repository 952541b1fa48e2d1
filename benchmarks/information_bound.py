"""How well drives can tell a parameter: the Cramér–Rao bound at the true parameters, all others unknown as well."""

from __future__ import annotations

import math
import statistics

import pyro
import torch
from pyro.infer import Trace_ELBO
from torch import Tensor

from steady_ppl import Constant, Joint, LookaheadGuide, Program, Trajectories, for_program, seeded
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import standard_noise
from steady_ppl.guides.path_guides import true_paths

RESAMPLED = 200


def information_bound(
    program: Program, simulated: Trajectories, parameter: str, *, drives: int, draws: int = 200
) -> tuple[float, float]:
    """Of a parameter's root mean square error (a place's: the root of both axes' squares) and its sd.

    A drive's score is the mean gradient of log p(states, y) over draws of its posterior (Fisher's identity); two
    independent means of each keep the noise of the draws out of the information. The linearised program's score would
    be wrong where a drive passes a landmark within centimetres.

    Args:
        program: at the true parameters; those that need a gradient are unknown.
        simulated: many drives, with their true states.
        parameter: its name among the program's `named_parameters()`; places in rows.
        drives: how many of them there are to learn from.
        draws: of each drive's posterior, twice.
    """
    data = for_program(program, simulated)
    joint = Joint(program, known_start=True)
    unknown = {name: value for name, value in program.named_parameters() if value.requires_grad}
    elbo = Trace_ELBO(num_particles=draws, vectorize_particles=True, max_plate_nesting=2)
    halves: tuple[list[Tensor], list[Tensor]] = [], []
    for drive in range(len(data)):
        one = data.subset([drive])
        guide = LookaheadGuide(program, particles=2 * draws, draws=draws, tempering=Constant(), known_start=True)
        true = true_paths(program, one)
        guide.remember(ReferencePath(true.states[0], standard_noise(program, one, true)[0]), one)
        for half in halves:
            with seeded("bound", drive, len(half), half is halves[0]), pyro.settings.context(module_local_params=True):
                guide.refresh(one, 0.0)
                gradients = torch.autograd.grad(elbo.differentiable_loss(joint, guide, one), list(unknown.values()))
            half.append(torch.cat([gradient.flatten() for gradient in gradients]).double())
    first, second = (torch.stack(half) for half in halves)
    sizes = [value.numel() for value in unknown.values()]

    def of(chosen: Tensor) -> float:
        information = first[chosen].T @ second[chosen] * drives / len(chosen)
        variances = torch.linalg.inv((information + information.T) / 2).diagonal()
        own = dict(zip(unknown, variances.split(sizes), strict=True))[parameter].reshape(unknown[parameter].shape)
        return math.sqrt(float((own.sum(-1) if own.ndim else own).mean()))

    with seeded("bootstrap"):
        again = [of(torch.randint(len(data), (len(data),))) for _ in range(RESAMPLED)]
    return of(torch.arange(len(data))), statistics.stdev(again)
