"""Programs with candidates, fitted to one half of the drives and judged on the other, both ways round."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.discovery.fitting import ByDraws, ByLikelihood, Fit, Fitting, Judges, is_doubtful, with_common_noise
from steady_ppl.effects import Variant, attach, attached, coefficient
from steady_ppl.errors import FilterError
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import find_path
from steady_ppl.likelihood.maximize import (
    MIN_GAIN_OF_START,
    Information,
    Maximum,
    fit_by_likelihood,
    maximise,
    refit_outliers,
)
from steady_ppl.likelihood.parameters import Element, elements, values_of
from steady_ppl.likelihood.scores import widens
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program, parameter_name
from steady_ppl.utils.random import seeded
from steady_ppl.utils.text import reason_of

MAX_LOG_NOISE_RATIO = math.log(20.0)  # of noise after a fit and before, beyond which a program explains nothing
AlongStates = TypeVar("AlongStates", bound=Trajectories | ReferencePath)
Value = float | Sequence[float] | Tensor  # of a coefficient
MAX_LOSS = 2.0  # nats below the program without, after which a fit is given up


@dataclass(frozen=True)
class Fold:
    """Drives to fit and drives to judge, with the paths along which they were last linearised."""

    drives: Trajectories
    path: ReferencePath
    held_out: Trajectories
    held_out_path: ReferencePath
    known_start: bool = False

    def fitting(self, program: Program) -> Problem:
        """A program with the drives to fit."""
        return Problem(program, self.drives, self.known_start)

    def judging(self, program: Program) -> Problem:
        """A program with the drives to judge."""
        return Problem(program, self.held_out, self.known_start)

    def wide(self, program: Program) -> Fold:
        """The fold for a program that has further, resting states."""
        own = (with_states_of(program, self.drives), with_states_of(program, self.path))
        others = (with_states_of(program, self.held_out), with_states_of(program, self.held_out_path))
        return Fold(*own, *others, self.known_start)


@dataclass(frozen=True)
class Threshold:
    """What log p(y) the drives of the first fold, or those kept from it, must reach for the second to be fitted."""

    drives: float = -math.inf
    held_out: float = -math.inf
    stops_early: bool = False  # whether a fit ends on its way where it will not reach that of its drives, which decides


NO_THRESHOLD = Threshold()
BY_LIKELIHOOD, BY_DRAWS, FIRST_BY_DRAWS = ByLikelihood(), ByDraws(), ByDraws(steps=180)


@dataclass(frozen=True)
class Fits:
    """A program fitted on each fold; folds come one after another."""

    programs: list[Program]  # one a fold, fitted to its drives alone
    maxima: list[Maximum]  # one a fold
    folds: list[Fold]  # with the paths of these programs
    fitting: Fitting  # how it was fitted, and how fits with an effect are

    @property
    def program(self) -> Program:
        """The one fitted on the first fold."""
        return self.programs[0]

    @property
    def effects(self) -> list[str]:
        """The labels of its program's effects."""
        return [variant.label for variant in attached(self.program)]

    def mean_coefficient(self, variant: Variant) -> Tensor:
        """An effect's coefficient in these fits, whose noise is each fold's own."""
        return self.mean(_coefficients(self.programs, variant))

    def mean(self, values: Sequence[Tensor]) -> Tensor:
        """Of values of the folds, weighted by their drives."""
        weights = [len(fold.drives) for fold in self.folds]
        return torch.stack([w * value for w, value in zip(weights, values, strict=True)]).sum(0) / sum(weights)


@dataclass(frozen=True)
class Refit(Fits):
    """What was fitted on each fold, and how it explains the drives that were kept from it."""

    judges: Judges  # the programs with their process noise in common, if fits by likelihood ended on every fold
    held_out: Tensor  # log p(y) of each drive under the judge not fitted to it, (B,); of one fold where given up
    held_out_alone: Tensor  # the same under the programs that were fitted to one fold alone
    unwidened: Program | None = None  # before its fit made its noise many times wider: fits begin there as well
    neglected: dict[int, Tensor | str] = field(default_factory=dict, init=False, repr=False, compare=False)
    """What the linearised log p(y) neglects of each held-out trajectory, nats, or why no filter follows it, by seed."""

    def coefficient(self, variant: Variant) -> Tensor:
        """An effect's, its mean over the folds: nearly that of a fit to all drives together."""
        return self.mean(_coefficients(self.judges.programs, variant))

    def mean_program(self) -> Program:
        """The folds' parameters averaged where they are learned: nearly what a fit to all drives together gives."""
        mean = copy.deepcopy(self.judges.programs[0])
        learned = [dict(program.named_parameters()) for program in self.judges.programs]
        for name, parameter in mean.named_parameters():
            if parameter.requires_grad:
                parameter.data.copy_(self.mean([values[name].data for values in learned]))
        return mean

    @property
    def first_share(self) -> float:
        """Share of all drives that the first fold fits."""
        return len(self.folds[0].drives) / sum(len(fold.drives) for fold in self.folds)

    @property
    def converged(self) -> bool:
        """Whether all fits did."""
        return all(maximum.converged for maximum in (*self.maxima, *self.judges.maxima))

    def in_common(self, variant: Variant) -> int:
        """How many numbers of an effect's coefficient all drives told, those that judge it as well."""
        return self.judges.common.count(_as_attached(self.program, variant).parameter)


def first_refit(problem: Problem, valid: Trajectories, *, seed: int, nearer: Program | None = None) -> Refit:
    """Fit the program as it stands, both ways round; `nearer` has parameters from which fits begin instead.

    Raises:
        FilterError: the drives cannot be smoothed.
    """
    program, train, known_start = problem.program, problem.data, problem.known_start
    own = copy.deepcopy(program if nearer is None else nearer)
    with seeded(seed, "paths"):
        one = fit_by_likelihood(own, train, known_start=known_start)
        other = Problem(copy.deepcopy(own), valid, known_start)
        second = refit_outliers(other, maximise(other, find_path(other)))
    first, one = _from(other.program, Problem(own, train, known_start), one)
    if first.program is not own:
        own = first.program
        other, second = _from(own, other, second)
    fold = Fold(train, one.path, valid, second.path, known_start)
    programs, folds = [own, other.program], [fold, Fold(valid, second.path, train, one.path, known_start)]
    parts = elements(own)
    grown = values_of(parts) - values_of(elements(program)) > MAX_LOG_NOISE_RATIO
    is_far_wider = bool((grown & torch.tensor(widens(own, parts, train))).any())
    unwidened = copy.deepcopy(program) if is_far_wider else None
    if unwidened is None and is_doubtful(fold.fitting(own), one.path):
        return first_by_draws(program, programs, folds, seed)
    return replace(_refit(programs, folds, [one, second]), unwidened=unwidened)


def _from(
    start: Program, problem: Problem, maximum: Maximum, path: ReferencePath | None = None
) -> tuple[Problem, Maximum]:
    """A fit, or the one that begins at the parameters of `start`, if that is likelier: there may be several maxima. It
    begins along the fit's own paths where no `path` is given."""
    again = replace(problem, program=copy.deepcopy(start))
    with suppress(FilterError):  # the drives cannot be followed from there
        found = maximise(again, path or maximum.path)
        if found.objective > maximum.objective + MIN_GAIN_OF_START:
            return again, found
    return problem, maximum


class Start(NamedTuple):
    """Where a fit by draws may begin."""

    program: Program
    path: ReferencePath  # of its drives
    log_likelihood: float  # that a filter finds for them all


def starts_by_draws(given: Program, fitted: Program, fold: Fold) -> list[Start]:
    """The given program and its linearised fit as starts, the likelier first, as far as they follow the drives."""
    found, failures = list[Start](), list[FilterError]()
    for program, near in ((given, None), (fitted, fold.path)):
        problem = fold.fitting(program)
        try:
            likely, path = FIRST_BY_DRAWS.judge(problem, near or find_path(problem))
            found.append(Start(program, path, float(likely.sum())))
        except FilterError as error:
            failures.append(error)
    if not found:
        raise failures[0]
    return sorted(found, key=lambda start: start.log_likelihood, reverse=True)


def first_by_draws(given: Program, fitted: list[Program], folds: list[Fold], seed: int) -> Refit:
    """Fit by draws from the likelier programs; where that diverges, once more from the program as given."""
    with seeded(seed, "paths by draws"):
        starts = [starts_by_draws(given, *pair) for pair in zip(fitted, folds, strict=True)]
    likelier = [ranked[0] for ranked in starts]
    as_given = [start for ranked in starts for start in ranked if start.program is given]

    def fit_from(begun: list[Start]) -> Refit:
        one, other = (start.path for start in begun)
        along = [replace(folds[0], path=one, held_out_path=other), replace(folds[1], path=other, held_out_path=one)]
        return _refit([copy.deepcopy(start.program) for start in begun], along, fitting=FIRST_BY_DRAWS)

    try:
        refit = fit_from(likelier)
    except FilterError:
        if len(as_given) < len(folds) or all(start.program is given for start in likelier):
            raise
        refit = fit_from(as_given)
    return replace(refit, fitting=BY_DRAWS)


@dataclass(frozen=True)
class Attempt:
    """A program with an effect, where its fits begin."""

    programs: list[Program]  # one a fold
    information: Tensor | Information | None  # of the first fold's drives, the coefficient last
    first: Fit | None = None  # the fit to these drives; None where it is made in its turn


def attempt_with(
    base: Refit, effects: Sequence[tuple[Variant, Value]], information: Tensor | Maximum | None = None
) -> Attempt | str:
    """The program with effects whose coefficients begin at these values, or why it cannot be had.

    `information` is that of the first fold's drives, the coefficients last, or a fit that learned all these numbers.
    """
    try:
        programs = [copy.deepcopy(program) for program in base.programs]
        for variant, value in effects:
            programs = [attach(program, variant, value) for program in programs]
        if isinstance(information, Maximum):
            return Attempt(programs, _information(information, elements(programs[0])))
        return Attempt(programs, information)
    except Exception as error:  # also of the program's own code, on parameters that nobody tried before
        return reason_of(error)


def begin(base: Refit, attempts: Sequence[Attempt | str], threshold: Threshold = NO_THRESHOLD) -> list[Attempt | str]:
    """Attempts whose first fits run side by side where cores are free; they are to be finished in this order.

    A `threshold` that stops fits early must be given here as well.
    """
    able = [one for one in attempts if isinstance(one, Attempt)]
    if base.unwidened is not None or not able:
        return list(attempts)
    folds = [base.folds[0].wide(one.programs[0]) for one in able]
    problems = [fold.fitting(one.programs[0]) for fold, one in zip(folds, able, strict=True)]
    floors = [_floor(base.maxima[0], threshold)] * len(able)
    known = [_guess(base.maxima[0], one.information, base.folds[0], base.folds[0]) for one in able]
    fits = iter(base.fitting.fit_each(problems, [fold.path for fold in folds], known, floors))
    return [replace(one, first=next(fits)) if isinstance(one, Attempt) else one for one in attempts]


def finish(base: Refit, attempt: Attempt | str, threshold: Threshold = NO_THRESHOLD) -> Refit | str:
    """What an attempt comes to, or why it cannot be fitted."""
    if isinstance(attempt, str):
        return attempt
    least = [_floor(base.maxima[0], threshold), *(_floor(maximum) for maximum in base.maxima[1:])]
    pairs = zip(base.maxima, base.folds, strict=True)
    guesses = [_guess(maximum, attempt.information, fold, base.folds[0]) for maximum, fold in pairs]
    given = (attempt.programs, base.folds, [None] * len(attempt.programs), guesses)
    try:
        return _refit(*given, least, threshold, base.unwidened, base.fitting, attempt.first)
    except Exception as error:  # also of the program's own code, on parameters that nobody tried before
        return reason_of(error)


def _floor(without: Maximum, threshold: Threshold = NO_THRESHOLD) -> float:
    """The log p(y) below which a fit is given up: a candidate at zero is the program without."""
    least = float(without.log_likelihood.sum()) - MAX_LOSS
    return max(least, threshold.drives) if threshold.stops_early else least


def refit_with(
    base: Refit,
    variant: Variant,
    value: Value,
    *,
    information: Tensor | Maximum | None = None,
    threshold: Threshold = NO_THRESHOLD,
) -> Refit | str:
    """The program with an effect, see `attempt_with`, fitted."""
    return finish(base, attempt_with(base, [(variant, value)], information), threshold)


def refit_with_all(base: Refit, effects: Sequence[tuple[Variant, Value]], near: Maximum) -> Refit | str:
    """The program with effects, see `attempt_with`, fitted; `near` has learned their numbers beside others."""
    return finish(base, attempt_with(base, effects, near))


def fit_near(
    base: Fits, near: Fits, variants: Sequence[Variant], floors: Sequence[float] = (-math.inf, -math.inf)
) -> Fits | str:
    """The program with effects, fitted from where another that shares parameters with it ended, or why it cannot be.

    `near` has one of the `variants` at another knee, width or place, or more of them; `base` has none. A fit that will
    not reach the log p(y) of its fold's floor ends on its way.
    """
    try:
        programs = [copy.deepcopy(program) for program in base.programs]
        for variant in variants:
            programs = [attach(program, variant) for program in programs]
        if programs[0].states != near.program.states:
            return "paths of other states are no start"
        for program, fitted in zip(programs, near.programs, strict=True):
            own = program.state_dict()
            program.load_state_dict(own | {name: value for name, value in fitted.state_dict().items() if name in own})
        folds = [fold.wide(program) for program, fold in zip(programs, near.folds, strict=True)]
        known = [_information(*one) for one in zip(near.maxima, map(elements, programs), strict=True)]
        maxima = [fit() for fit in _fits(near.fitting, programs, folds, known, floors)]
        folds = [replace(fold, path=maximum.path) for fold, maximum in zip(folds, maxima, strict=True)]
        return Fits(programs, maxima, folds, near.fitting)
    except Exception as error:  # also of the program's own code, on parameters that nobody tried before
        return reason_of(error)


def judged_fits(fits: Fits) -> Refit | str:
    """How a program explains the drives that were kept from its fits, or why it cannot follow them."""
    try:
        return _refit(fits.programs, fits.folds, fits.maxima, fitting=fits.fitting)
    except Exception as error:  # also of the program's own code, on parameters that nobody tried before
        return reason_of(error)


def as_declared(declared: Program, fitted: Program) -> Program:
    """A copy of a fitted program with its own parameters as declared; the coefficients of its effects stay."""
    program, values = copy.deepcopy(fitted), dict(declared.named_parameters())
    coefficients = {known.parameter for known in attached(fitted)}
    for name, parameter in program.named_parameters():
        if name in values and parameter_name(name) not in coefficients:
            parameter.data.copy_(values[name].data)
    return program


def _refit(
    programs: list[Program],
    folds: list[Fold],
    maxima: Sequence[Maximum | None] = (None, None),
    guesses: Sequence[Tensor | Information | None] = (None, None),
    least: Sequence[float] = (-math.inf, -math.inf),
    threshold: Threshold = NO_THRESHOLD,
    unwidened: Program | None = None,
    fitting: Fitting = BY_LIKELIHOOD,
    first: Fit | None = None,
) -> Refit:
    fitted, found, held_out, judged_folds = list[Program](), list[Maximum](), list[Tensor](), list[Fold]()
    folds = [fold.wide(program) for program, fold in zip(programs, folds, strict=True)]
    fits: Sequence[Fit | None] = [first, *[None] * (len(folds) - 1)]
    if unwidened is None and threshold == NO_THRESHOLD and first is None and not any(maxima):  # all are made
        fits = _fits(fitting, programs, folds, guesses, least)
    for program, fold, maximum, guess, fit, floor in zip(programs, folds, maxima, guesses, fits, least, strict=True):
        anew = None if unwidened is None else _fit_anew(fold.fitting(as_declared(unwidened, program)), floor)
        if anew is not None:
            floor = max(floor, float(anew[1].log_likelihood.sum()))
        if maximum is None:
            fit = fit or fitting.fit_each([fold.fitting(program)], [fold.path], [guess], [floor])[0]
            maximum = fit()
        held_out_path = fold.held_out_path
        if anew is not None and anew[1].objective > maximum.objective:
            program, maximum = anew
            held_out_path = find_path(fold.judging(program))
        judged, held_out_path = fitting.judge(fold.judging(program), held_out_path)
        fitted.append(program)
        found.append(maximum)
        held_out.append(judged)
        judged_folds.append(replace(fold, path=maximum.path, held_out_path=held_out_path))
        own, others = float(maximum.log_likelihood.sum()), float(judged.sum())
        if own < threshold.drives and (threshold.stops_early or others < threshold.held_out):
            break
    judges = Judges(fitted, found)
    if len(fitted) == len(folds) and fitting == BY_LIKELIHOOD:
        _begin_where_the_other_ended(fitted, found, held_out, judged_folds)
        problems = [fold.fitting(program) for program, fold in zip(fitted, judged_folds, strict=True)]
        judges = with_common_noise(problems, found)
    alone = torch.cat(held_out)
    if judges.common:
        held_out = [
            fitting.judge(fold.judging(program), fold.held_out_path)[0]
            for program, fold in zip(judges.programs, judged_folds, strict=True)
        ]
    return Refit(fitted, found, judged_folds, fitting, judges, torch.cat(held_out), alone, unwidened)


def _begin_where_the_other_ended(
    programs: list[Program], maxima: list[Maximum], held_out: list[Tensor], folds: list[Fold]
) -> None:
    """Fit again, in place, where a fold's drives are likelier under the program of the other fold: a fit has ended at
    another maximum, for example of process noise so wide that it goes through all readings."""
    for index, other in ((0, 1), (1, 0)):
        if float(held_out[other].sum() - maxima[index].log_likelihood.sum()) <= MIN_GAIN_OF_START:
            continue
        fold, ahead = folds[index], folds[other]
        problem, again = _from(programs[other], fold.fitting(programs[index]), maxima[index], ahead.held_out_path)
        if again is maxima[index]:
            continue
        with suppress(FilterError):  # it cannot follow the drives that it was not fitted to
            judged, path = BY_LIKELIHOOD.judge(fold.judging(problem.program), ahead.path)
            programs[index], maxima[index], held_out[index] = problem.program, again, judged
            folds[index] = replace(fold, path=again.path, held_out_path=path)


def _fits(
    fitting: Fitting,
    programs: Sequence[Program],
    folds: Sequence[Fold],
    informations: Sequence[Tensor | Information | None],
    least: Sequence[float],
) -> list[Fit]:
    """The fits of all folds, to be made in order."""
    problems = [fold.fitting(program) for program, fold in zip(programs, folds, strict=True)]
    return fitting.fit_each(problems, [fold.path for fold in folds], informations, least)


def _fit_anew(problem: Problem, floor: float) -> tuple[Program, Maximum] | None:
    """A fit along paths that are found anew; None where the program cannot follow its drives."""
    with suppress(FilterError):
        return problem.program, maximise(problem, hopeless=floor)
    return None


def _guess(
    without: Maximum, known: Tensor | Information | None, fold: Fold, first: Fold
) -> Tensor | Information | None:
    """The information on a fold's drives before a fit with an effect.

    That of the fit without it, completed by what is `known` on the first fold's drives of all numbers; or what a fit
    that learned them all knows.
    """
    share = len(fold.drives) / len(first.drives)
    if isinstance(known, Information):
        return replace(known, matrix=share * known.matrix)
    rest = None if known is None else share * known
    return Information(without.information, without.names, rest) if len(without.information) else rest


def _information(maximum: Maximum, parts: Sequence[Element]) -> Information | None:
    """Of learnable numbers, as a fit in which they and perhaps others were learned left it; None if some were not."""
    names = tuple(part.name for part in parts)
    if not set(names) <= set(maximum.names):
        return None
    index = [maximum.names.index(name) for name in names]
    return Information(maximum.information[index][:, index], names)


def _coefficients(programs: Sequence[Program], variant: Variant) -> list[Tensor]:
    return [coefficient(program, _as_attached(program, variant)).detach().clone() for program in programs]


def _as_attached(program: Program, variant: Variant) -> Variant:
    """The effect as a program has it, where its coefficient may have another name."""
    return next(known for known in attached(program) if known.name == variant.name)


def with_states_of(program: Program, along: AlongStates) -> AlongStates:
    """Drives, or a path, for a program that has further, resting states, or fewer."""
    states, count = along.states, len(program.states)
    if states is None:
        return along
    resting = states.new_zeros((*states.shape[:-1], max(0, count - states.shape[-1])))
    return replace(along, states=torch.cat([states[..., :count], resting], -1))
