"""Maximum likelihood (with priors, the posterior's mode) of a linearised program by scoring steps.

For programs of some dozens of learnable numbers with normal noise. System identification calls it the prediction-error
method; its predictor is the linearised program (Ljung 1999, System Identification, section 7.4).

Steps solve the information matrix against the score. It begins as the cross products of the drives' scores (Berndt,
Hall, Hall and Hausman 1974) unless it is known, and learns on the way (Broyden, Fletcher, Goldfarb and Shanno). Cross
products of a program that lacks something may be twenty times its information, and a fit would seem to have ended. So
where a maximum seems to be reached, the information is observed by differences of scores, and steps go on with it.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import FilterError
from steady_ppl.gaussian.information_filter import Lookahead
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import find_path, require_found, resting_path, smooth
from steady_ppl.kernels.rows import kernel_failures, note_failures
from steady_ppl.likelihood.objective import (
    PASSES,
    STALLED_PASSES,
    LinearizedObjective,
    Term,
    by_cross_products,
    linearised,
    observed,
    reach,
    regularised,
    tried,
)
from steady_ppl.likelihood.parameters import elements, set_values, values_of
from steady_ppl.likelihood.scores import smoothed, widens
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.utils.cores import Computation, Output, in_batches, one_thread
from steady_ppl.utils.journal import journaled
from steady_ppl.utils.progress import stages

MAX_OBSERVED = 24  # learnable numbers: of more the information stays as scoring steps have it
MAX_NATS_OF_INFORMATION = 10.0  # gained, beyond which the information at the beginning may not hold at the end
MAX_STEPS = 25  # scoring steps of a fit, where nothing else is said
STEPS_SEEN, STEPS_FORESEEN = 3, 4
"""A fit is given up after the first, if the second would not do: so many more steps, each of which gains as much as the
better of the last two did, or as the next one promises."""
MAX_WIDENED, SHARE_OF_SLOPE = 16.0, 0.7
"""A move that was cut short may be twice as long the next time, and so on up to the first.
It has to raise the objective by more than the second of what its slope foresaw."""
SHARE_AGAINST_SCORE = 1 / 3
"""Of that, for a number whose own score points the other way: noise or a friction that is driven to nothing early has
no score there, and a fit cannot return."""
SHARE_THAT_GOES_ON = 0.8  # share of fits that take one step more, by which the time left is told
CONVERGED_DECREMENT = 0.1  # nats that another step may gain where a fit has converged
MAX_DECREASE = 0.3  # nats below the most so far to which an objective may fall: paths are nearly at rest
MIN_GAIN_OF_START = 1.0  # nats by which a fit from another start must be likelier
MAX_ROUGHNESS = 1.5  # mean square deviation, in the program's own, from which noise is widened before a fit
OUTLIER_SD, SEARCHES = 6.0, 3  # standard deviations by which an outlier is less likely, and searches for its path


@dataclass(frozen=True)
class Maximum:
    """A program at its maximum."""

    log_likelihood: Tensor  # (B,), log p(y) of the linearised program
    objective: float  # their sum and the log prior
    path: ReferencePath  # the posterior means of the drives, along which it is linearised
    names: tuple[str, ...]  # of the learnable numbers
    information: Tensor  # (P, P) in the unconstrained space
    steps: int  # scoring steps taken
    decrement: float | None  # what another step would still gain, nats; None where nobody has looked
    gained: float  # objective above that at the parameters from which it began, nats

    @property
    def converged(self) -> bool:
        """Whether a step would gain less than a tenth of a nat."""
        return self.decrement is None or self.decrement < CONVERGED_DECREMENT


def maximise(
    problem: Problem,
    path: ReferencePath | None = None,
    *,
    steps: int = MAX_STEPS,
    precision: float = 0.02,
    hopeless: float = -math.inf,
) -> Maximum:
    """Move a program's parameters, in place, to where log p(y) of the linearised program plus the log prior is largest.

    Args:
        problem: its program with normal noise; see `linearize`.
        path: of the drives, near their posterior means; found from the measurements when None.
        steps: scoring steps at most.
        precision: stop when another step would gain less, nats.
        hopeless: give up where log p(y) will not reach this, see `STEPS_FORESEEN`.

    Raises:
        FilterError: the program cannot be smoothed at its initial parameters.
    """
    given = {"steps": steps, "precision": precision, "hopeless": hopeless}
    return kept_maximum(problem.program, lambda: _maximum_of_copy(problem, path or find_path(problem), **given))


def maximise_each(
    problems: Sequence[Problem],
    paths: Sequence[ReferencePath],
    informations: Sequence[Tensor | Information | None],
    hopeless: Sequence[float],
) -> list[Callable[[], Maximum]]:
    """Calls of `maximise` for several programs, to be made in this order; where cores are free the next ones begin. A
    program moves when its call is made."""
    computations = [
        partial(_maximum_of_copy, problem, path, information=information, hopeless=least)
        for problem, path, information, least in zip(problems, paths, informations, hopeless, strict=True)
    ]
    outputs = zip(problems, in_batches(computations), strict=True)
    return [partial(kept_maximum, problem.program, output) for problem, output in outputs]


def _maximum_of_copy(problem: Problem, path: ReferencePath, **settings: Any) -> Output:
    """The output of `maximise_sum` for a copy of a program: whether its kernels are given up on the way is no matter of
    the program, which may be fitted in another process or come from a journal."""
    own = replace(problem, program=copy.deepcopy(problem.program))
    return output_of(own.program, lambda: maximise_sum([Term.alone(own, path)], **settings)[0])


def output_of(program: Program, find: Callable[[], Maximum]) -> Output:
    """Run `find`, which moves the program, and return what `kept_maximum` takes."""
    why: dict[str, str] = {}
    try:
        with kernel_failures() as why:
            found = find()
    finally:
        note_failures(why)
    tensors = {name: getattr(found, name) for name in ("log_likelihood", "information")}
    path = {"states": found.path.states, "noise": found.path.noise, "variance": found.path.variance}
    tensors |= {name: value for name, value in path.items() if value is not None}
    tensors |= {f"program/{name}": value for name, value in program.state_dict().items()}
    values = {name: getattr(found, name) for name in ("objective", "names", "steps", "decrement", "gained")}
    return tensors, {"found": values, "in plain torch": why}


def kept_maximum(program: Program, compute: Computation) -> Maximum:
    """A maximum as a piece of a journal: what `compute` returns, see `output_of`, with the program moved there."""
    tensors, values = journaled(compute)
    note_failures(values["in plain torch"])
    program.load_state_dict({name: tensors[f"program/{name}"] for name in program.state_dict()})
    path = ReferencePath(tensors["states"], tensors["noise"], tensors.get("variance"))
    found = {**values["found"], "names": tuple(values["found"]["names"])}
    return Maximum(log_likelihood=tensors["log_likelihood"], information=tensors["information"], path=path, **found)


@dataclass(frozen=True)
class Information:
    """What is known of the information before a fit of one program."""

    matrix: Tensor  # (N, N), of some numbers
    names: tuple[str, ...]  # of these
    rest: Tensor | None = None  # (P, P), of all numbers, by which the matrix is completed; None: their cross products

    def completed(self, names: Sequence[str], own: Tensor) -> Tensor:
        """For all numbers, `(P, P)`; `own` are cross products. What is no number is left to these.

        The other numbers depend on the known ones as `rest` says, each in its standard deviations, and have what it
        tells of them beside those.
        """
        if tuple(names) == self.names:
            return self.matrix
        wide = own if self.rest is None else self.rest
        known = [names.index(name) for name in self.names]
        others = [index for index in range(len(names)) if index not in known]
        size = wide.diagonal().clamp(min=1e-30).rsqrt()
        scaled = size * wide * size[:, None]
        inverse = torch.linalg.pinv(scaled[known][:, known].nan_to_num(), hermitian=True)
        through = inverse @ scaled[known][:, others]
        size[known] = self.matrix.diagonal().clamp(min=1e-30).rsqrt()
        within = size[known] * self.matrix * size[known][:, None]
        across = within @ through
        beside = scaled[others][:, others] - scaled[others][:, known] @ through
        blocks = torch.cat([torch.cat([within, across], 1), torch.cat([across.T, beside + through.T @ across], 1)])
        back = torch.tensor([*known, *others]).argsort()
        found = blocks[back][:, back] / size / size[:, None]
        return found if bool(torch.isfinite(found).all()) else own


@dataclass
class _Curvature:
    """The information of a fit on its way: given, seen by cross products, learned by steps or observed."""

    matrix: Tensor  # (P, P)
    is_known: bool  # whether it was given or observed, and is not the drives' cross products
    known_at: float  # the objective where it became known
    may_observe: bool  # by differences of scores
    few_drives: bool  # of fewer than two a number: their cross products know too little

    @classmethod
    def of_fit(cls, here: LinearizedObjective, given: Tensor | Information | None) -> _Curvature:
        """At its beginning."""
        matrix = own = by_cross_products(here)
        if given is not None:
            names = [part.name for part in here.terms[0].term.parts]
            whole = given.completed(names, own) if isinstance(given, Information) else given
            matrix = regularised(whole, here.has_unit)
        may_observe = len(here.terms) == 1 and len(matrix) <= MAX_OBSERVED
        return cls(matrix, given is not None, here.objective, may_observe, len(here.scores) < 2 * len(matrix))

    def step(self, here: LinearizedObjective) -> tuple[Tensor, float]:
        """To where the maximum seems to be, and what it gains, nats.

        Raises:
            FilterError: the drives do not tell the numbers apart.
        """
        move, singular = torch.linalg.solve_ex(self.matrix, here.gradient)
        if not singular and not float(here.gradient @ move) >= 0:  # it has ceased to be positive
            self.forget(here)
            move, singular = torch.linalg.solve_ex(self.matrix, here.gradient)
        if singular:
            raise FilterError(
                "the likeliest parameters cannot be found: the trajectories do not tell them apart (singular)"
            )
        return move, 0.5 * float(here.gradient @ move)

    def forget(self, here: LinearizedObjective) -> None:
        self.matrix, self.is_known = by_cross_products(here), False

    def check(self, here: LinearizedObjective, passes: int, *, begins: bool) -> bool:
        """Look again where a fit seems to rest, if what is known may be too much. Returns whether it looked."""
        is_far = here.objective - self.known_at > MAX_NATS_OF_INFORMATION
        if self.is_known and not (begins or is_far or self._is_denied(here)):
            return False
        if self.is_known and not self.few_drives:
            self.matrix = by_cross_products(here)
        seen = observed(here.terms[0].term, self.matrix, passes) if self.may_observe else None
        self.matrix = self.matrix if seen is None else seen
        self.is_known, self.known_at = seen is not None, here.objective
        return True

    def _is_denied(self, here: LinearizedObjective) -> bool:
        """Whether by cross products a step gains what a converged fit may not; few drives tell of each number alone."""
        own, score = by_cross_products(here), here.gradient
        if self.few_drives:
            return bool((score.square() > CONVERGED_DECREMENT * own.diagonal()).any())
        return 0.5 * float(score @ torch.linalg.solve(own, score)) > CONVERGED_DECREMENT

    def learn(self, step: Tensor, fall: Tensor) -> None:
        """The BFGS update with `fall` of the score along `step`, damped where that is too small (Powell)."""
        through = self.matrix @ step
        expected, seen = float(step @ through), float(step @ fall)
        if seen < 0.2 * expected:
            share = 0.8 * expected / (expected - seen)
            fall = share * fall + (1 - share) * through
            seen = float(step @ fall)
        self.matrix = self.matrix - torch.outer(through, through) / expected + torch.outer(fall, fall) / seen


@torch.no_grad()
def maximise_sum(
    terms: Sequence[Term],
    *,
    information: Tensor | Information | None = None,
    steps: int = MAX_STEPS,
    precision: float = 0.02,
    hopeless: float = -math.inf,
) -> list[Maximum]:
    """Move the numbers of programs, in place, towards where the sum of their objectives is largest.

    A number that several terms have in common has its log prior once. Settings are those of `maximise`, of the sum.

    Returns:
        Of each program where it ended, with its own part of the information; `decrement` and `steps` are of the sum.

    Raises:
        FilterError: the programs cannot be smoothed where they begin, or the drives do not tell their numbers apart.
    """
    here = linearised(terms)
    for at in here.terms:
        require_found(at.ahead, at.term.problem)
    began, most = [at.objective for at in here.terms], here.objective
    curvature = _Curvature.of_fit(here, information)
    limits = _reach(terms, curvature.matrix)
    taken, decrement, passes, widened = 0, 0.0, PASSES, 1.0
    is_small, is_over = False, False
    rises = list[float]()  # of log p(y) by accepted steps
    with stages(*(("", SHARE_THAT_GOES_ON**step) for step in range(steps + 1))) as begin:
        for taken in range(steps + 1):
            begin()
            move, decrement = curvature.step(here)
            if decrement < precision and len(terms) == 1 and curvature.check(here, passes, begins=taken == 0):
                move, decrement = curvature.step(here)
            is_sure = curvature.is_known and curvature.may_observe
            most_left = STEPS_FORESEEN * max(0.0, decrement, *rises[-2:])
            behind = len(rises) >= STEPS_SEEN and here.log_likelihood + most_left < hopeless
            was_small, is_small = is_small, decrement < precision
            is_over |= is_small and (is_sure or was_small or not curvature.few_drives or taken == 0)
            if is_over or taken == steps or behind:
                break
            length = float((move.abs() / limits).max())
            move = move * min(1.0, widened / max(1e-9, length))
            against = move * here.gradient < 0
            most_against = SHARE_AGAINST_SCORE * limits
            move = torch.where(against, move.clamp(-most_against, most_against), move)
            share, there = _line_search(here, move, passes, most - MAX_DECREASE)
            risen = -math.inf if there is None else there.objective - here.objective
            if share < 1:
                widened = 1.0
            elif length > widened and risen > SHARE_OF_SLOPE * float(here.gradient @ move):
                widened = min(2 * widened, MAX_WIDENED)
            if there is not None:
                curvature.learn(share * move, here.gradient - there.gradient)
                rises.append(there.log_likelihood - here.log_likelihood)
                here, most = there, max(most, there.objective)
                is_over = passes == STALLED_PASSES and risen < CONVERGED_DECREMENT
            elif passes == STALLED_PASSES:
                break
            else:
                passes = STALLED_PASSES
                further = linearised([at.term for at in here.terms], passes)
                if not bool(torch.isfinite(further.gradient).all()):  # a path diverges on its way to its mode
                    break
                here, most = further, further.objective
                curvature.forget(here)
                rises.append(math.inf)  # along other paths
    return [
        Maximum(
            log_likelihood=at.ahead.log_likelihood,
            objective=at.objective,
            path=at.term.path,
            names=tuple(part.name for part in at.term.parts),
            information=curvature.matrix[at.term.columns][:, at.term.columns],
            steps=taken,
            decrement=decrement,
            gained=at.objective - before,
        )
        for at, before in zip(here.terms, began, strict=True)
    ]


def _reach(terms: Sequence[Term], information: Tensor) -> Tensor:
    """The most that each number moves at once, `(P,)`."""
    found = torch.zeros(len(information), dtype=torch.float64)
    for term in terms:
        found[term.columns] = reach(term.parts, information[term.columns][:, term.columns])
    return found


def _line_search(
    here: LinearizedObjective, move: Tensor, passes: int, least: float
) -> tuple[float, LinearizedObjective | None]:
    """The share of a move that leads to the `least` objective or more, and where; None, and nothing is moved, if none
    does."""
    share, terms = 1.0 if bool(torch.isfinite(move).all()) else 0.0, [at.term for at in here.terms]
    before = [values_of(term.parts) for term in terms]
    while share > 0.01:
        for term, values in zip(terms, before, strict=True):
            set_values(term.parts, values + share * move[term.columns])
        if (there := tried(terms, passes, least)) is not None:
            return share, there
        share /= 3
    for term, values in zip(terms, before, strict=True):
        set_values(term.parts, values)
    return 0.0, None


@one_thread()
def fit_by_likelihood(
    program: Program, data: Trajectories, *, known_start: bool = False, steps: int = MAX_STEPS
) -> Maximum:
    """Move a program's parameters, in place, to where log p(y) of the linearised program plus the log prior is largest.

    Paths are found by random starts: run it in a `seeded` block.

    Args:
        program: with normal noise, its parameters as declared or as another fit left them.
        data: as returned by `for_program`.
        known_start: the first state is certain.
        steps: scoring steps at most.

    Raises:
        UsageError: more learnable numbers than can be looked at one by one.
        FilterError: the trajectories cannot be smoothed.
    """
    problem = Problem(program, data, known_start)
    with stages(("finding paths", 1), ("scoring steps", 3), ("trajectories that strayed", 1)) as begin:
        begin()
        path = widen_noise(problem)
        begin()
        found = maximise(problem, path, steps=steps)
        begin()
        return refit_outliers(problem, found, steps)


def refit_outliers(problem: Problem, maximum: Maximum, steps: int = MAX_STEPS) -> Maximum:
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
        there = smooth(part, find_path(part))
        better = there.log_likelihood > maximum.log_likelihood[outliers] + 1
        if not bool(better.any()):
            break
        found = resting_path(there, part.data).subset(better)
        again = maximise(problem, maximum.path.with_subset(outliers[better], found), steps=steps)
        maximum = replace(again, gained=again.objective + (maximum.gained - maximum.objective))
    return maximum


def widen_noise(problem: Problem, path: ReferencePath | None = None) -> ReferencePath:
    """Widen the program's noise, in place, where the drives are much rougher than it says; return paths, found anew.

    A program that lacks a strong effect explains nothing at its declared noise: scores there lead nowhere. A path that
    is given is returned where the noise is wide enough.
    """
    path = path or find_path(problem)
    ahead = smooth(problem, path)
    every = elements(problem.program)
    parts = [part for part, wider in zip(every, widens(problem.program, every, problem.data), strict=True) if wider]
    while parts and _roughness(ahead, problem.data) > MAX_ROUGHNESS:
        before = values_of(parts)
        for part in parts:
            part.move(math.log(3.0))
        wider_path = find_path(problem)
        there = smooth(problem, wider_path)
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
