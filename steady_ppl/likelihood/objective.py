"""A program's objective, log p(y) and log prior, where the program is, its slopes and its curvature; or the sum of
several programs'.

Log p(y) is that of the program linearised along its posterior means, which go with it: see `gaussian.smoother`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from steady_ppl.errors import FilterError
from steady_ppl.gaussian.information_filter import Lookahead
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.smoother import resting_path, smooth
from steady_ppl.likelihood.parameters import Element, elements, moved, on_both_sides, values_of
from steady_ppl.likelihood.scores import parameter_scores, smoothed
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program

PASSES, TOLERANCE = 3, 0.03  # linearisations a step, and when paths are at rest, in standard deviations of the noise
STALLED_PASSES = 15  # linearisations a step once no share of a step was accepted: some path swings about its mode
MAX_MOVE = 150  # steps of differences, 1.5 of a logarithm: the most that a number moves at once
MAX_MOVE_SD = 50.0  # standard deviations, of a number with a unit: it moves as far at once, if that is more
SHARE_OF_SD = 0.1  # by which a number is moved: over a whole standard deviation the score of a noise bends
LEAST_SHARE = 1e-6  # of a number, by which it is moved at least: single precision has seven digits
OBSERVED_SHARES = (0.01, 100.0)  # of what is known, within which what is observed is believed
RIDGE = 1e-3  # added to the information of a number, in that of one with a unit if that is smaller


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


def tried(terms: Sequence[Term], passes: int, least: float) -> LinearizedObjective | None:
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


def reach(parts: Sequence[Element], information: Tensor) -> Tensor:
    """The most that each number moves at once, `(P,)`, by what is known of them, `(P, P)`."""
    found = torch.tensor([MAX_MOVE * part.step for part in parts], dtype=torch.float64)
    is_open = torch.tensor([part.has_unit and not part.is_effect for part in parts], dtype=torch.bool)
    return torch.where(
        is_open, torch.maximum(found, MAX_MOVE_SD * information.diagonal().clamp(min=1e-30).rsqrt()), found
    )


def by_cross_products(here: LinearizedObjective) -> Tensor:
    """The information by the cross products of the drives' scores."""
    by_drive = here.scores - here.scores.mean(0)
    information = by_drive.T @ by_drive
    return regularised(information + 0.1 * torch.diag(information.diagonal()), here.has_unit)


@torch.no_grad()
def observed(term: Term, known: Tensor, passes: int = PASSES) -> Tensor | None:
    """Minus the second derivatives of an objective where its program is, `(P, P)`, by differences of scores.

    Each number is moved by a tenth of what `known` takes for its standard deviation. What is observed is believed
    within `OBSERVED_SHARES` of what is known. None where the program diverges or `known` is not positive.
    """
    root, failed = torch.linalg.cholesky_ex(known)
    if failed:
        return None
    here = linearised([term], passes)
    (there,), found = here.terms, torch.empty_like(known)
    limits = reach(term.parts, known).tolist()
    for part, column, own, most in zip(term.parts, term.columns, known.diagonal().tolist(), limits, strict=True):
        before = float(values_of([part]))
        by = min(max(SHARE_OF_SD * own**-0.5, LEAST_SHARE * abs(before)), most)
        with moved(part, by):
            step = float(values_of([part])) - before  # in the parameter's own precision
            found[column] = (here.gradient - linearised([there.term], passes).gradient) / step
    if not bool(torch.isfinite(found).all()):
        return None
    half = torch.linalg.solve_triangular(root, found + found.T, upper=False).T
    shares, turn = torch.linalg.eigh(torch.linalg.solve_triangular(root, half, upper=False) / 2)
    return (root @ turn * shares.clamp(*OBSERVED_SHARES)) @ (root @ turn).T


def regularised(information: Tensor, has_unit: Tensor) -> Tensor:
    """An information `(P, P)` with a little of its diagonal and `RIDGE` added, so that it can be inverted."""
    own = information.diagonal()
    of_unit = torch.where(own > 0, own.clamp(max=1.0), 1.0)  # nothing is known of a number that tells nothing
    return information + torch.diag(1e-6 * own + RIDGE * torch.where(has_unit, of_unit, 1.0))


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
        shares.get(name, 1.0) * float(prior.log_prob(getattr(program, name)).sum().detach())
        for name, prior in program.priors.items()
    )
