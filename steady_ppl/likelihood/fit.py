"""Maximum likelihood from declared values: noise that is too small is widened first, outlying drives are refitted.

For programs of some dozens of learnable numbers with normal noise. System identification calls it the prediction-error
method; its predictor is the linearised program (Ljung 1999, System Identification, section 7.4).
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.information_filter import Lookahead
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import resting_path
from steady_ppl.likelihood.maximize import Maximum, maximum_of
from steady_ppl.likelihood.parameters import elements, set_values, values_of
from steady_ppl.likelihood.problem import Problem
from steady_ppl.likelihood.scores import smoothed, widens
from steady_ppl.model.program import Program
from steady_ppl.utils.progress import stages

MAX_ROUGHNESS = 1.5  # mean square deviation, in the program's own, from which noise is widened before a fit
OUTLIER_SD, SEARCHES = 6.0, 3  # standard deviations by which an outlier is less likely, and searches for its path


def fit_by_likelihood(program: Program, data: Trajectories, *, known_start: bool = False) -> Maximum:
    """Move a program's parameters, in place, to where log p(y) of the linearised program plus the log prior is largest.

    Paths are found by random starts: run it in a `seeded` block.

    Args:
        program: with normal noise, its parameters as declared or as another fit left them.
        data: as returned by `for_program`.
        known_start: the first state is certain.

    Raises:
        UsageError: more learnable numbers than can be looked at one by one.
        FilterError: the drives cannot be smoothed.
    """
    problem = Problem(program, data, known_start)
    with stages(("finding paths", 1), ("scoring steps", 3), ("drives that strayed", 1)) as begin:
        begin()
        path = widen_noise(problem)
        begin()
        found = maximum_of(problem, path)
        begin()
        return refit_outliers(problem, found)


def refit_outliers(problem: Problem, maximum: Maximum) -> Maximum:
    """Search again for the paths of drives far less likely than the others, which were found before the program was
    fitted, and refit where they are better."""
    for _ in range(SEARCHES):
        each = maximum.log_likelihood / problem.data.observed.sum((0, 2)).clamp(min=1)
        middle = each.median()
        usual = 1.5 * (each - middle).abs().median()
        outliers = (~(each >= middle - OUTLIER_SD * usual)).nonzero().flatten()
        if not len(outliers):
            break
        part = problem.subset(outliers)
        there = part.smooth(part.find_path(), kernels=False)
        better = there.log_likelihood > maximum.log_likelihood[outliers] + 1
        if not bool(better.any()):
            break
        states, noise = maximum.path.states.clone(), maximum.path.noise.clone()
        found = resting_path(there, part.data)
        states[:, outliers[better]], noise[:, outliers[better]] = found.states[:, better], found.noise[:, better]
        before = maximum.gained - maximum.objective
        maximum = maximum_of(problem, ReferencePath(states, noise))
        maximum = replace(maximum, gained=maximum.objective + before)
    return maximum


def widen_noise(problem: Problem, path: ReferencePath | None = None) -> ReferencePath:
    """Widen the program's noise, in place, where the drives are much rougher than it says; return paths, found anew.

    A program that lacks a strong effect explains nothing at its declared noise: scores there lead nowhere. A path that
    is given is returned where the noise is wide enough.
    """
    path = path or problem.find_path()
    ahead = problem.smooth(path, kernels=False)
    every = elements(problem.program)
    parts = [part for part, wider in zip(every, widens(problem.program, every, problem.data), strict=True) if wider]
    while parts and _roughness(ahead, problem.data) > MAX_ROUGHNESS:
        before = values_of(parts)
        for part in parts:
            part.move(math.log(3.0))
        wider_path = problem.find_path()
        there = problem.smooth(wider_path, kernels=False)
        if not float(there.log_likelihood.sum()) > float(ahead.log_likelihood.sum().nan_to_num(-math.inf)):
            set_values(parts, before)
            break
        path, ahead = wider_path, there
    return path


def _roughness(ahead: Lookahead, data: Trajectories) -> float:
    """Posterior mean square of the channels' or the measurements' standardised deviations, whichever is larger; 1 where
    the program is right."""
    at = smoothed(ahead, data)
    parts = (at.channels, at.measurements)
    means = [(p.mean.square() + p.variance)[p.present].mean() for p in parts if bool(p.present.any())]
    return max(float(mean.nan_to_num(torch.inf)) for mean in means)
