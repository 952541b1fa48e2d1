"""How a program is fitted to some drives and judged on others.

By likelihood: scoring steps of the linearised program, fast and exact where it is nearly linear. By draws: gradient
steps on paths drawn from its posterior by the filter that looks ahead (generalised EM, as the recipe `steady` without
tempering), which judges as well, for programs whose linearised log p(y) has kinks or is off: acceleration limits that
bind, noise that goes with the state.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from steady_ppl.errors import FilterError
from steady_ppl.gaussian.information_filter import Lookahead
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import resting_path
from steady_ppl.guides.base import Constant
from steady_ppl.guides.linearized import LookaheadGuide
from steady_ppl.likelihood.evidence import neglected
from steady_ppl.likelihood.maximize import Maximum, kept_maximum, maximum_of
from steady_ppl.likelihood.problem import Problem
from steady_ppl.training.loop import Optimization, Validation, train
from steady_ppl.utils.random import seeded

MAX_LINEARISATION_ERROR = 0.5  # nats a drive by which the linearised log p(y) may be off
PARTICLES, JUDGING = 100, 400  # of the guide and of the judge: see docs/discovery.md, step 4


@dataclass(frozen=True)
class Judged:
    """Drives under a program: log p(y), `(B,)`, and the posterior means along which it was linearised."""

    log_likelihood: Tensor
    path: ReferencePath


@dataclass(frozen=True)
class ByLikelihood:
    """Scoring steps of the linearised program's log p(y), which judges as well."""

    def fit(self, problem: Problem, path: ReferencePath | None = None, **settings: Any) -> Maximum:
        """Move a program's parameters, in place.

        Args:
            problem: the program and the drives that it is fitted to.
            path: to linearise along at first, found when not given.
            settings: of `maximise`, by which scoring steps begin and give up; nothing for draws.

        Raises:
            FilterError: the program cannot follow the drives.
        """
        return maximum_of(problem, path, **settings)

    def judge(self, problem: Problem, path: ReferencePath) -> Judged:
        """Log p(y) of drives, linearised along a path that is improved from here."""
        ahead = _at_rest(problem, path)
        return Judged(ahead.log_likelihood, resting_path(ahead, problem.data))


@dataclass(frozen=True)
class ByDraws:
    """Gradient steps on paths drawn by the filter that looks ahead, which judges as well.

    Draws of the linearised program's posterior would be cheaper, but where limits bind their slopes are not those of
    log p(y): fits with them end beside its maximum, and whatever moves a fit towards it is then taken for an effect.

    Attributes:
        steps: E steps, each with a gradient step.
        learning_rate: Adam's at the first step.
    """

    steps: int = 60
    learning_rate: float = 0.1

    def fit(self, problem: Problem, path: ReferencePath | None = None, **_: Any) -> Maximum:
        """See `ByLikelihood`."""
        return kept_maximum(problem.program, lambda: self._climb(problem, path or problem.find_path()))

    def _climb(self, problem: Problem, path: ReferencePath) -> Maximum:
        program, data, known_start = problem.program, problem.data, problem.known_start
        before = self.judge(problem, path)
        guide = LookaheadGuide(
            program, particles=PARTICLES, tempering=Constant(), known_start=known_start, search_again=math.inf
        )
        guide.remember(before.path, data)
        optimization = Optimization(self.steps, learning_rate=self.learning_rate, averaging=0.95)
        began = copy.deepcopy(program.state_dict())
        with torch.enable_grad():
            train(program, guide, data, Validation(), optimization, known_start=known_start, progress=False)
        after = self.judge(problem, before.path)
        if not float(after.log_likelihood.sum()) > float(before.log_likelihood.sum()):
            program.load_state_dict(began)
            after = before
        return Maximum(
            log_likelihood=after.log_likelihood,
            objective=float(after.log_likelihood.sum()),
            path=after.path,
            names=(),
            information=torch.zeros(0, 0),
            steps=self.steps,
            decrement=None,
            gained=float((after.log_likelihood - before.log_likelihood).sum()),
        )

    def judge(self, problem: Problem, path: ReferencePath) -> Judged:
        """See `ByLikelihood`."""
        ahead = _at_rest(problem, path)
        more = _neglected(problem, ahead, particles=JUDGING)
        return Judged(ahead.log_likelihood + more, resting_path(ahead, problem.data))


Fitting = ByLikelihood | ByDraws


def is_doubtful(problem: Problem, path: ReferencePath) -> bool:
    """Whether the linearised program's log p(y) is off by more than half a nat a drive, or no particle filter that it
    leads can follow these drives to say so."""
    ahead = _at_rest(problem, path)
    try:
        return float(_neglected(problem, ahead).abs().mean()) > MAX_LINEARISATION_ERROR
    except FilterError:
        return True


def _at_rest(problem: Problem, path: ReferencePath) -> Lookahead:
    return problem.smooth_or_raise(path, passes=15, tolerance=0.02, kernels=False)


def _neglected(problem: Problem, ahead: Lookahead, particles: int = 200) -> Tensor:
    with seeded(0, "judge"):
        return neglected(
            problem.program, problem.data, known_start=problem.known_start, particles=particles, ahead=ahead
        )
