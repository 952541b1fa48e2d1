"""Paths along which a program is linearised: anywhere, at the true states, and at the mode."""

from __future__ import annotations

import torch

from steady_ppl import seeded
from steady_ppl.gaussian.information_filter import Lookahead
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import find_path, smooth
from steady_ppl.likelihood.scores import Smoothed, smoothed
from steady_ppl.model.problem import Problem


def anywhere(program, data) -> ReferencePath:
    """A path that has nothing to do with the drives."""
    with seeded("anywhere"):
        states = 3 * torch.randn(*data.time.shape, len(program.states), dtype=torch.float64)
        return ReferencePath(states, torch.randn(*data.steps.shape, len(program.channels), dtype=torch.float64))


def near_the_truth(program, data) -> ReferencePath:
    """The true states, with no noise; finite also past a trajectory's end."""
    states = torch.where(data.rows[..., None], data.states, data.states[:1])
    return ReferencePath(states, states.new_zeros((*data.steps.shape, len(program.channels))))


def at_its_mode(program, data, *, known_start=True, **settings) -> Lookahead:
    """Smoothed until it rests, so that it does not matter how one got there."""
    settings = {"passes": 40, "tolerance": 1e-11} | settings
    return smooth(Problem(program, data, known_start), near_the_truth(program, data), **settings)


def settled(program, data, path: ReferencePath | None = None) -> tuple[Lookahead, ReferencePath]:
    """The linearised program about its own posterior means."""
    path = path or find_path(Problem(program, data, True))
    for _ in range(4):
        ahead = smooth(Problem(program, data, True), path, passes=5, kernels=False)
        path = ahead.path(data)
    return ahead, path


def at_rest(program, data) -> tuple[Smoothed, ReferencePath]:
    """What scores need of it, and the path of the means."""
    ahead, path = settled(program, data)
    return smoothed(ahead, data), path
