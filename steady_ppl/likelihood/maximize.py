"""Maximum likelihood (with priors, the posterior's mode) of a linearised program by scoring steps.

For programs of some dozens of learnable numbers with normal noise. System identification calls it the prediction-error
method; its predictor is the linearised program (Ljung 1999, System Identification, section 7.4).

Steps solve the information matrix against the score. It begins as the cross products of the drives' scores (Berndt,
Hall, Hall and Hausman 1974) unless it is known, and learns on the way (Broyden, Fletcher, Goldfarb and Shanno). Where
that says that the maximum is reached, the observed information is found, by differences of scores, and steps go on with
it: cross products of a program that lacks something may be twenty times as large, and then a fit seems to have ended.
"""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
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
from steady_ppl.likelihood.parameters import Element, elements, moved, on_both_sides, set_values, values_of
from steady_ppl.likelihood.scores import parameter_scores, smoothed, widens
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.utils.cores import Computation, Output, in_batches, one_thread
from steady_ppl.utils.journal import journaled
from steady_ppl.utils.progress import stages

PASSES, TOLERANCE = 3, 0.03  # linearisations a step, and when paths are at rest, in standard deviations of the noise
MAX_OBSERVED = 24  # learnable numbers: of more the information stays as scoring steps have it
OBSERVED_SHARES = (0.01, 100.0)  # of the cross products, between which what is observed is believed
MAX_NATS_OF_INFORMATION = 10.0  # gained, beyond which the information at the beginning may not hold at the end
STALLED_PASSES = 15  # linearisations a step once no share of a step was accepted: some path swings about its mode
MAX_STEPS = 25  # scoring steps of a fit, where nothing else is said
STEPS_SEEN, STEPS_FORESEEN = 3, 4
"""A fit is given up after the first, if the second would not do: so many more steps, each of which gains as much as the
better of the last two did, or as the next one promises."""
MAX_MOVE = 150  # steps of differences, 1.5 of a logarithm: the most that a number moves at once
MAX_WIDENED, SHARE_OF_SLOPE = 16.0, 0.7
"""A move that was cut short may be twice as long the next time, up to so many times as long, where the objective rose
by more than this share of what its slope foresaw."""
MAX_MOVE_SD = 50.0  # standard deviations, of a number with a unit: it moves as far at once, if that is more
RIDGE = 1e-3  # added to the information of a number, in that of one with a unit if that is smaller
SHARE_AGAINST_SCORE = 1 / 3
"""Of that, for a number whose own score points the other way: noise or a friction that is driven to nothing early has
no score there, and a fit cannot return."""
SHARE_THAT_GOES_ON = 0.8  # share of fits that take one step more, by which the time left is told
CONVERGED_DECREMENT = 0.1  # nats that another step may gain where a fit has converged
MAX_DECREASE = 0.3  # nats below the most so far to which an objective may fall: paths are nearly at rest
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
    informations: Sequence[Tensor | None],
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
class Term:
    """What a program adds to an objective. Programs whose `columns` name the same place have this number in common."""

    problem: Problem  # its program's parameters are moved in place
    path: ReferencePath  # near the posterior means of its drives
    parts: list[Element]  # its learnable numbers
    columns: list[int]  # the place of each among all numbers of the objective, counted from 0 without gaps
    angles: tuple[int, ...] | None = None  # of its linearization, as the program is where the fit begins

    @classmethod
    def alone(cls, problem: Problem, path: ReferencePath) -> Term:
        parts = elements(problem.program)
        return cls(problem, path, parts, list(range(len(parts))))


@torch.no_grad()
def maximise_sum(
    terms: Sequence[Term],
    *,
    information: Tensor | None = None,
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
    began = [at.objective for at in here.terms]
    is_near = information is not None  # to where it is known
    if information is None or len(information) < len(here.gradient):
        own = _by_cross_products(here)
        information = own if information is None else completed(information, own)
    information = _regularised(information, here.has_unit)
    reach, is_open = torch.zeros_like(here.gradient), torch.zeros_like(here.has_unit)
    for term in terms:
        reach[term.columns] = torch.tensor([MAX_MOVE * part.step for part in term.parts], dtype=torch.float64)
        is_open[term.columns] = torch.tensor([part.has_unit and not part.is_effect for part in term.parts]).bool()
    reach = torch.where(is_open, torch.maximum(reach, MAX_MOVE_SD * information.diagonal().rsqrt()), reach)
    taken, decrement, passes, widened = 0, 0.0, PASSES, 1.0
    few_drives = len(here.scores) < 2 * len(information)  # they know too little: what they say is seen twice
    is_small, is_observed, most = False, len(information) > MAX_OBSERVED or len(terms) > 1, here.objective
    rises = list[float]()  # of log p(y) by accepted steps
    with stages(*(("", SHARE_THAT_GOES_ON**step) for step in range(steps + 1))) as begin:
        for taken in range(steps + 1):
            begin()
            move, singular = torch.linalg.solve_ex(information, here.gradient)
            if not singular and not float(here.gradient @ move) >= 0:  # it has ceased to be positive
                information = _by_cross_products(here)
                move, singular = torch.linalg.solve_ex(information, here.gradient)
            if singular:
                raise FilterError(
                    "the likeliest parameters cannot be found: the drives do not tell them apart (singular)"
                )
            decrement = 0.5 * float(here.gradient @ move)
            is_far = not is_near or taken == 0 or here.objective - sum(began) > MAX_NATS_OF_INFORMATION
            if decrement < precision and is_far and not is_observed:
                is_observed, information = True, observed(here.terms[0].term, _by_cross_products(here))
                move = torch.linalg.solve(information, here.gradient)
                decrement = 0.5 * float(here.gradient @ move)
            most_left = STEPS_FORESEEN * max(0.0, decrement, *rises[-2:])
            behind = len(rises) >= STEPS_SEEN and here.log_likelihood + most_left < hopeless
            was_small, is_small = is_small, decrement < precision
            if (is_small and (is_observed or was_small or not few_drives or taken == 0)) or taken == steps or behind:
                break
            length = float((move.abs() / reach).max())
            move = move * min(1.0, widened / max(1e-9, length))
            against = move * here.gradient < 0
            move = torch.where(against, move.clamp(-SHARE_AGAINST_SCORE * reach, SHARE_AGAINST_SCORE * reach), move)
            share, there = _line_search(here, move, passes, most - MAX_DECREASE)
            risen = -math.inf if there is None else there.objective - here.objective
            if share < 1:
                widened = 1.0
            elif length > widened and risen > SHARE_OF_SLOPE * float(here.gradient @ move):
                widened = min(2 * widened, MAX_WIDENED)
            if there is not None:
                information = _bfgs_update(information, share * move, here.gradient - there.gradient)
                rises.append(there.log_likelihood - here.log_likelihood)
                here, most = there, max(most, there.objective)
                if passes == STALLED_PASSES and risen < CONVERGED_DECREMENT:
                    break
            elif passes == STALLED_PASSES:
                break
            else:
                passes = STALLED_PASSES
                further = linearised([at.term for at in here.terms], passes)
                if not bool(torch.isfinite(further.gradient).all()):  # a path diverges on its way to its mode
                    break
                here = further
                information, most = _by_cross_products(here), here.objective
                rises.append(math.inf)  # along other paths
    return [
        Maximum(
            log_likelihood=at.ahead.log_likelihood,
            objective=at.objective,
            path=at.term.path,
            names=tuple(part.name for part in at.term.parts),
            information=information[at.term.columns][:, at.term.columns],
            steps=taken,
            decrement=decrement,
            gained=at.objective - before,
        )
        for at, before in zip(here.terms, began, strict=True)
    ]


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
        if (there := _tried(terms, passes, least)) is not None:
            return share, there
        share /= 3
    for term, values in zip(terms, before, strict=True):
        set_values(term.parts, values)
    return 0.0, None


def _by_cross_products(here: LinearizedObjective) -> Tensor:
    """The information by the cross products of the drives' scores."""
    by_drive = here.scores - here.scores.mean(0)
    information = by_drive.T @ by_drive
    return _regularised(information + 0.1 * torch.diag(information.diagonal()), here.has_unit)


def completed(known: Tensor, wide: Tensor) -> Tensor:
    """The information of numbers of which it is `known` for the first ones, and elsewhere `wide` for all."""
    count = len(known)
    through = torch.linalg.lstsq(wide[:count, :count], wide[:count, count:]).solution
    rest = wide[count:, count:] - wide[count:, :count] @ through  # what is told of the others beside the first ones
    across = known @ through
    return torch.cat([torch.cat([known, across], 1), torch.cat([across.T, rest + through.T @ across], 1)])


def observed(term: Term, crossed: Tensor) -> Tensor:
    """Minus the second derivatives of an objective where its program is, `(P, P)`, by differences of scores over what
    cross products take for a standard deviation; these themselves where the program diverges."""
    here = linearised([term])
    (there,), found = here.terms, torch.empty_like(crossed)
    for part, column, own in zip(term.parts, term.columns, crossed.diagonal().tolist(), strict=True):
        step = min(own**-0.5, MAX_MOVE * part.step)
        with moved(part, step):
            found[column] = (here.gradient - linearised([there.term]).gradient) / step
    if not bool(torch.isfinite(found).all()):
        return crossed
    root = torch.linalg.cholesky(crossed)
    within = torch.linalg.solve_triangular(
        root, torch.linalg.solve_triangular(root, found + found.T, upper=False).T, upper=False
    )
    shares, turn = torch.linalg.eigh(within / 2)
    return (root @ turn * shares.clamp(*OBSERVED_SHARES)) @ (root @ turn).T


def _regularised(information: Tensor, has_unit: Tensor) -> Tensor:
    own = information.diagonal()
    of_unit = torch.where(own > 0, own.clamp(max=1.0), 1.0)  # nothing is known of a number that tells nothing
    return information + torch.diag(1e-6 * own + RIDGE * torch.where(has_unit, of_unit, 1.0))


@dataclass(frozen=True)
class LinearizedTerm:
    """A term's objective where its program is."""

    term: Term  # along the path that its drives have here
    shares: dict[str, float]  # in the log prior of parameters, which other terms may have in common with it
    ahead: Lookahead
    objective: float


@dataclass(frozen=True)
class LinearizedObjective:
    """A sum of terms where their programs are."""

    terms: list[LinearizedTerm]
    scores: Tensor  # (B, P), of the drives of all terms
    gradient: Tensor  # (P,)
    has_unit: Tensor  # (P,) bool, see `Element`

    @property
    def objective(self) -> float:
        return sum(term.objective for term in self.terms)

    @property
    def log_likelihood(self) -> float:
        return sum(float(term.ahead.log_likelihood.sum()) for term in self.terms)


def linearised(terms: Sequence[Term], passes: int = PASSES) -> LinearizedObjective:
    """The objective of programs where they are, with its scores; not finite where one diverges."""
    return _scored(_valued(terms, passes))


def _tried(terms: Sequence[Term], passes: int, least: float) -> LinearizedObjective | None:
    """None where the step went too far: the objective falls below `least`, or a program diverges there."""
    try:
        found = _valued(terms, passes)
        broken = any(bool(term.ahead.is_broken.any()) for term in found)
        if broken or not sum(term.objective for term in found) >= least:
            return None
        here = _scored(found)
    except FilterError:
        return None
    return here if bool(torch.isfinite(here.gradient).all()) else None


def _valued(terms: Sequence[Term], passes: int) -> list[LinearizedTerm]:
    found, owners = [], Counter(column for term in terms for column in term.columns)
    for term in terms:
        names = [part.owner for part in term.parts]
        shares = {name: 1 / owners[column] for name, column in zip(names, term.columns, strict=True)}
        ahead = smooth(term.problem, term.path, passes=passes, tolerance=TOLERANCE, angles=term.angles)
        objective = float(ahead.log_likelihood.sum()) + log_prior(term.problem.program, shares)
        rested = resting_path(ahead, term.problem.data)
        there = replace(term, path=rested, angles=ahead.linearization.angles)
        found.append(LinearizedTerm(there, shares, ahead, objective))
    return found


def _scored(found: list[LinearizedTerm]) -> LinearizedObjective:
    columns, by_drive = {column for at in found for column in at.term.columns}, []
    gradient, has_unit = torch.zeros(len(columns), dtype=torch.float64), torch.zeros(len(columns), dtype=torch.bool)
    for at in found:
        has_unit[at.term.columns] = torch.tensor([part.has_unit for part in at.term.parts], dtype=torch.bool)
        program, data = at.term.problem.program, at.term.problem.data
        own = parameter_scores(program, data, smoothed(at.ahead, data), at.term.parts)
        gradient[at.term.columns] += own.sum(0) + _slope_of_prior(program, at.term.parts, at.shares)
        wide = own.new_zeros((len(own), len(gradient)))
        wide[:, at.term.columns] = own
        by_drive.append(wide)
    return LinearizedObjective(found, torch.cat(by_drive), gradient, has_unit)


def posterior_score(problem: Problem, path: ReferencePath) -> Tensor:
    """The slope of log p(y) and the log prior where the program is, `(P,)`, along the best path near `path`.

    Raises:
        FilterError: the program diverges there.
    """
    return linearised([Term.alone(problem, path)], STALLED_PASSES).gradient


def _slope_of_prior(program: Program, parts: list[Element], shares: dict[str, float]) -> Tensor:
    """Of the log prior in the unconstrained space, without the Jacobian: for the parameter's own mode, `(P,)`."""
    slope = torch.zeros(len(parts), dtype=torch.float64)
    for index, part in enumerate(parts):
        if part.owner in program.priors:
            up, down = on_both_sides(part, lambda: log_prior(program, shares))
            slope[index] = (up - down) / (2 * part.step)
    return slope


def log_prior(program: Program, shares: Mapping[str, float] | None = None) -> float:
    """Of the parameters that have one, of their own values; of some only a share."""
    shares = shares or {}
    return sum(
        shares.get(name, 1.0) * float(prior.log_prob(getattr(program, name)).sum())
        for name, prior in program.priors.items()
    )


def _bfgs_update(information: Tensor, step: Tensor, fall: Tensor) -> Tensor:
    """The BFGS update with `fall` of the score along `step`, damped where no positive curvature is seen (Powell)."""
    through = information @ step
    expected, seen = float(step @ through), float(step @ fall)
    if seen < 0.2 * expected:
        share = 0.8 * expected / (expected - seen)
        fall = share * fall + (1 - share) * through
        seen = float(step @ fall)
    return information - torch.outer(through, through) / expected + torch.outer(fall, fall) / seen


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
        FilterError: the drives cannot be smoothed.
    """
    problem = Problem(program, data, known_start)
    with stages(("finding paths", 1), ("scoring steps", 3), ("drives that strayed", 1)) as begin:
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
