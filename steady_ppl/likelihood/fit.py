"""Maximum likelihood from declared values: noise that is too small is widened first, strays are led back.

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
from steady_ppl.gaussian.smoother import find_path, resting_path, smooth
from steady_ppl.likelihood.maximize import Maximum, maximise
from steady_ppl.likelihood.parameters import elements
from steady_ppl.likelihood.scores import smoothed, widens
from steady_ppl.model.program import Program
from steady_ppl.utils.progress import stages

MAX_ROUGHNESS = 1.5
"""Mean square deviation, in the program's own, from which its noise is widened before anything is fitted."""
MAX_STRAY_SD, SEARCHES = (
    6.0,
    3,
)  # standard deviations by which a drive strays from the others, and searches for its path


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
    with stages(("finding paths", 1), ("scoring steps", 3), ("drives that strayed", 1)) as begin:
        begin()
        first = roomy_path(program, data, known_start)
        begin()
        found = maximise(program, data, first, known_start=known_start)
        begin()
        return led_back(program, data, found, known_start)


def led_back(program: Program, data: Trajectories, maximum: Maximum, known_start: bool) -> Maximum:
    """A fit whose strays have found another path: drives far less likely than the others, whose paths were found before
    the program was fitted."""
    for _ in range(SEARCHES):
        cells = data.observed.sum((0, 2)).clamp(min=1)
        each = maximum.log_likelihood / cells
        middle = each.median()
        usual = 1.5 * (each - middle).abs().median()
        strays = (~(each >= middle - MAX_STRAY_SD * usual)).nonzero().flatten()
        if not len(strays):
            break
        part = data.subset(strays)
        found = find_path(program, part, known_start=known_start)
        there = smooth(program, part, found, known_start=known_start, kernels=False)
        better = there.log_likelihood > maximum.log_likelihood[strays] + 1
        if not bool(better.any()):
            break
        states, noise = maximum.path.states.clone(), maximum.path.noise.clone()
        found = resting_path(there, part)
        states[:, strays[better]], noise[:, strays[better]] = found.states[:, better], found.noise[:, better]
        before = maximum.gained - maximum.objective
        maximum = maximise(program, data, ReferencePath(states, noise), known_start=known_start)
        maximum = replace(maximum, gained=maximum.objective + before)
    return maximum


def roomy_path(
    program: Program, data: Trajectories, known_start: bool, path: ReferencePath | None = None
) -> ReferencePath:
    """Find paths; where the drives are much rougher than the program says, widen its noise first, in place.

    A program that lacks a strong effect explains nothing at its declared noise: scores there lead nowhere. A path that
    is given is returned where the noise is wide enough.
    """
    path = path or find_path(program, data, known_start=known_start)
    ahead = smooth(program, data, path, known_start=known_start, kernels=False)
    every = elements(program)
    parts = [part for part, wider in zip(every, widens(program, every, data), strict=True) if wider]
    while parts and _roughness(ahead, data) > MAX_ROUGHNESS:
        before = [part.parameter.data.clone() for part in parts]
        for part in parts:
            part.move(math.log(3.0))
        wider = find_path(program, data, known_start=known_start)
        there = smooth(program, data, wider, known_start=known_start, kernels=False)
        if not float(there.log_likelihood.sum()) > float(ahead.log_likelihood.sum().nan_to_num(-math.inf)):
            for part, value in zip(parts, before, strict=True):
                part.parameter.data.copy_(value)
            break
        path, ahead = wider, there
    return path


def _roughness(ahead: Lookahead, data: Trajectories) -> float:
    """Posterior mean square of the channels' or the measurements' standardised deviations, whichever is larger; 1 where
    the program is right."""
    at = smoothed(ahead, data)
    parts = (at.channels, at.measurements)
    means = [(p.mean.square() + p.variance)[p.present].mean() for p in parts if bool(p.present.any())]
    return max(float(mean.nan_to_num(torch.inf)) for mean in means)
