"""How a program is fitted to some drives and judged on others.

By likelihood: scoring steps of the linearised program, fast and exact where it is nearly linear. By draws: gradient
steps on paths drawn by the filter that looks ahead (generalised EM, as the recipe `steady` without tempering), for
programs whose linearised log p(y) has kinks or is off: acceleration limits that bind, noise that goes with the state.

Programs fitted to different drives judge with the size of their process noise in common. A few drives tell little of a
noise that the sensors nearly hide. Fitted to them alone it may vanish, and then other drives punish the program by tens
of nats, whatever its physics.
"""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.effects import attached
from steady_ppl.errors import FilterError
from steady_ppl.gaussian.information_filter import Lookahead
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import require_found, resting_path, smooth
from steady_ppl.guides.linearized import LookaheadGuide
from steady_ppl.guides.path_guides import Constant
from steady_ppl.likelihood.evidence import neglected
from steady_ppl.likelihood.maximize import Maximum, kept_maximum, maximise_each, maximise_sum, output_of
from steady_ppl.likelihood.objective import Term
from steady_ppl.likelihood.parameters import Element, elements, moved, set_values, values_of
from steady_ppl.likelihood.scores import channel_moments, substep_spreads
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.training.loop import Optimization, Validation, train
from steady_ppl.utils.random import seeded

MAX_LINEARISATION_ERROR = 0.5  # nats a drive by which the linearised log p(y) may be off
MAX_NATS_BETWEEN_FILTERS = 1.0  # a drive: beyond it a filter has lost its particles, as at a jump of the GPS
MIN_SHARE_OF_SURE_DRIVES = 0.5  # in which two filters agree; where they do in fewer, none can say
GUIDE_PARTICLES, JUDGE_PARTICLES = 100, 400  # of the guide and of the judge: see docs/discovery-fits.md
NOISE_FORMS = ("spread", "colour")  # of effects that are process noise
PROBE_MOVE = 0.1  # by how much a number is moved
SPREAD_TOLERANCE = 1e-3  # by which log spreads may change otherwise in one row than in another
MAX_JOINT_STEPS, JOINT_PRECISION = 25, 0.01  # scoring steps of the sum at most, and nats that another would gain

Fit = Callable[[], Maximum]


@dataclass(frozen=True)
class ByLikelihood:
    """Scoring steps of the linearised program's log p(y), which judges as well."""

    fit_each = staticmethod(maximise_each)

    def judge(self, problem: Problem, path: ReferencePath) -> tuple[Tensor, ReferencePath]:
        """Log p(y) of drives, `(B,)`, linearised along a path that is improved from here; and that path."""
        ahead = _smooth(problem, path)
        return ahead.log_likelihood, resting_path(ahead, problem.data)


@dataclass(frozen=True)
class ByDraws:
    """Gradient steps on paths drawn by the filter that looks ahead, which judges as well.

    Draws of the linearised program's posterior are cheaper. But where limits bind their slopes are not those of
    log p(y): fits end beside its maximum, and whatever moves them towards it is taken for an effect.
    """

    steps: int = 60  # E steps, each with a gradient step
    learning_rate: float = 0.1  # Adam's at the first step

    def fit(self, problem: Problem, path: ReferencePath) -> Maximum:
        """Move a program's parameters, in place."""
        return kept_maximum(problem.program, lambda: output_of(problem.program, lambda: self._train(problem, path)))

    def fit_each(self, problems: Sequence[Problem], paths: Sequence[ReferencePath], *_: Any) -> list[Fit]:
        """See `maximise_each`; they draw random numbers, so that none begins before its turn."""
        return [partial(self.fit, *one) for one in zip(problems, paths, strict=True)]

    def _train(self, problem: Problem, path: ReferencePath) -> Maximum:
        program, data, known_start = problem.program, problem.data, problem.known_start
        before, path = self.judge(problem, path)
        guide = LookaheadGuide(
            program, particles=GUIDE_PARTICLES, tempering=Constant(), known_start=known_start, search_again=math.inf
        )
        guide.remember(path, data)
        optimization = Optimization(self.steps, learning_rate=self.learning_rate, averaging=0.95)
        began = copy.deepcopy(program.state_dict())
        with torch.enable_grad():
            train(program, guide, data, Validation(), optimization, known_start=known_start, progress=False)
        after, ended = self.judge(problem, path)
        if not float(after.sum()) > float(before.sum()):
            program.load_state_dict(began)
            after, ended = before, path
        return Maximum(
            log_likelihood=after,
            objective=float(after.sum()),
            path=ended,
            names=(),
            information=torch.zeros(0, 0),
            steps=self.steps,
            decrement=None,
            gained=float((after - before).sum()),
        )

    def judge(self, problem: Problem, path: ReferencePath) -> tuple[Tensor, ReferencePath]:
        """See `ByLikelihood`."""
        ahead = _smooth(problem, path)
        more = _neglected(problem, ahead, particles=JUDGE_PARTICLES)
        return ahead.log_likelihood + more, resting_path(ahead, problem.data)


Fitting = ByLikelihood | ByDraws


def is_doubtful(problem: Problem, path: ReferencePath) -> bool:
    """Whether the linearised log p(y) is off by more than half a nat a drive, or no particle filter can say.

    Drives on which two filters disagree say nothing: there a wrong reading leaves few particles.
    """
    ahead = _smooth(problem, path)
    try:
        one, other = (_neglected(problem, ahead, seed=seed) for seed in (0, 1))
    except FilterError:
        return True
    sure = (one - other).abs() <= MAX_NATS_BETWEEN_FILTERS
    if float(sure.double().mean()) < MIN_SHARE_OF_SURE_DRIVES:
        return True
    return float((one + other)[sure].abs().mean()) / 2 > MAX_LINEARISATION_ERROR


def _smooth(problem: Problem, path: ReferencePath) -> Lookahead:
    ahead = smooth(problem, path, passes=15, tolerance=0.02)
    require_found(ahead, problem)
    return ahead


def neglected_along(problem: Problem, path: ReferencePath, seed: int = 0) -> Tensor:
    """What the program's linearised log p(y) neglects, nats, `(B,)`, along a path that is improved from here.

    Raises:
        FilterError: no filter follows the drives.
    """
    return _neglected(problem, _smooth(problem, path), seed=seed)


def _neglected(problem: Problem, ahead: Lookahead, particles: int = 200, seed: int = 0) -> Tensor:
    """Kernels are worth compiling: a program is asked of several folds and seeds."""
    given: dict[str, Any] = {"known_start": problem.known_start, "particles": particles, "kernels": True}
    with seeded(seed, "judge"):
        return neglected(problem.program, problem.data, ahead=ahead, **given)


@dataclass(frozen=True)
class Judges:
    """Programs, one a fold, that judge the drives they were not fitted to."""

    programs: list[Program]
    maxima: list[Maximum]  # where each ended
    common: tuple[str, ...] = ()  # parameters of the learnable numbers that are the same in all


def with_common_noise(problems: Sequence[Problem], maxima: Sequence[Maximum]) -> Judges:
    """Return copies of programs with their process noise in common, or the programs where they learn none.

    The sum of the folds' log p(y) is maximised in the noise of all and in every program's other numbers, from where
    their fits ended. A FilterError says that programs cannot follow their drives with one noise.
    """
    found = [noise_numbers(one.program, one.data, m.path) for one, m in zip(problems, maxima, strict=True)]
    if not (common := sorted(set().union(*found))):
        return Judges([problem.program for problem in problems], list(maxima))
    copies = [replace(problem, program=copy.deepcopy(problem.program)) for problem in problems]
    parts = [elements(problem.program) for problem in copies]
    own = [index for index in range(len(parts[0])) if index not in common]
    first = [[*common, *own].index(index) for index in range(len(parts[0]))]  # columns: those in common, then its own
    columns = [[at if at < len(common) else at + order * len(own) for at in first] for order in range(len(copies))]
    terms = [Term(one, m.path, part, at) for one, m, part, at in zip(copies, maxima, parts, columns, strict=True)]
    information, starts = _starts(terms, maxima)
    for last, start in enumerate(starts, 1):
        for term in terms:
            set_values(term.parts, start[term.columns])
        try:
            ended = maximise_sum(terms, information=information, steps=MAX_JOINT_STEPS, precision=JOINT_PRECISION)
            break
        except FilterError:
            if last == len(starts):
                raise
    return Judges([problem.program for problem in copies], ended, tuple(parts[0][index].owner for index in common))


@torch.no_grad()
def noise_numbers(program: Program, data: Trajectories, path: ReferencePath) -> set[int]:
    """Return which learnable numbers say how large the process noise is, or how it goes on, and nothing else.

    Those of the program itself multiply standard deviations of channels, in all rows alike, and leave their means.
    """
    forms = {variant.parameter: variant.effect.form for variant in attached(program)}
    mean, spread = _moments(program, data, path)

    def is_noise(part: Element) -> bool:
        if part.owner in forms:
            return forms[part.owner] in NOISE_FORMS
        with moved(part, PROBE_MOVE):
            mean_there, spread_there = _moments(program, data, path)
        change = (spread_there / spread).log().nan_to_num(0.0, 0.0, 0.0)
        alike = ((change - change.mean(1, keepdim=True)).abs() < SPREAD_TOLERANCE).all()
        still = ((mean_there - mean).abs() <= SPREAD_TOLERANCE * spread).all()
        return bool(alike & still & (change.abs() > SPREAD_TOLERANCE).any())

    return {index for index, part in enumerate(elements(program)) if is_noise(part)}


def _moments(program: Program, data: Trajectories, path: ReferencePath) -> tuple[Tensor, Tensor]:
    """Means of rows' channels and standard deviations of substeps' along a path, `(1, rows, C)` each."""
    states = path.states[:-1].unsqueeze(0)
    mean, spread = channel_moments(program, data, states)
    if program.substeps > 1:
        spread = substep_spreads(program, data, states)
    return mean[:, data.transitions], spread[:, data.transitions]


def _starts(terms: Sequence[Term], maxima: Sequence[Maximum]) -> tuple[Tensor, list[Tensor]]:
    """The information of all numbers, and where to begin: at the maximum of the sum of parabolas, and at the means."""
    count = 1 + max(max(term.columns) for term in terms)
    information = torch.zeros(count, count).double()
    pull, sums, weights = torch.zeros(3, count).double()
    for term, maximum in zip(terms, maxima, strict=True):
        index, values = torch.tensor(term.columns), values_of(term.parts)
        information[index[:, None], index] += maximum.information
        pull[index] += maximum.information @ values
        sums[index] += maximum.information.diagonal() * values
        weights[index] += maximum.information.diagonal()
    parabola, singular = torch.linalg.solve_ex(information, pull)
    has_maximum = not singular and bool(torch.isfinite(parabola).all())
    return information, [*([parabola] if has_maximum else []), sums / weights]
