"""Knees, widths and places: the best of a candidate's, and what not knowing them adds to its coefficient's variance."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from steady_ppl.discovery.candidates import Candidate, gain_of_fits, judged
from steady_ppl.discovery.refits import Refit, refit_near, refit_with
from steady_ppl.effects import Variant

MIN_GAIN_OF_PLACE = 0.3  # nats by which another knee or place has to be likelier
PASSES = 4  # along all knees and places in turns, with steps of one size
NEIGHBOUR_SHARE = 0.25  # of the grid's spacing, at which a place's likelihood is compared with its neighbours'


def at_its_best_place(now: Refit, candidate: Candidate) -> Candidate:
    """A candidate with the knee, width or place at which it gains most: on its grid, and then between its points."""
    if isinstance(candidate.refit, str) or not candidate.variant.profiled:
        return candidate
    grid, at, tested = _grid(now, candidate), candidate.variant, candidate.tested
    fit: Refit | str = candidate.refit
    if not candidate.is_judged:
        fit = refit_with(now, at, candidate.refit.coefficient(at))
        if isinstance(fit, str):
            return candidate

    def try_all(variants: Iterable[Variant]) -> None:
        nonlocal at, fit
        for variant in variants:
            assert isinstance(fit, Refit)
            other = refit_near(now, fit, [variant])
            if isinstance(other, Refit) and gain_of_fits(now, other) > gain_of_fits(now, fit) + MIN_GAIN_OF_PLACE:
                at, fit = variant, other

    try_all(variant for variant in grid if variant.label != candidate.variant.label)
    for share in (0.5, 0.25):
        for _ in range(PASSES):
            before = at
            for name in at.profiled:
                try_all(_beside(at, grid, name, share))
            if at is before:
                break
    there = judged(now, replace(tested, column=replace(tested.column, variant=at)), fit)
    return there if there.total > candidate.total else candidate


def variance_of_places(now: Refit, candidate: Candidate) -> Tensor:
    """What the uncertainty of knees, widths and places adds to the variance of a coefficient, `(k,)`.

    By the delta method along their profile likelihood, with a prior as wide as their grid. Where the program cannot be
    fitted on either side of one, its coefficient is taken as uncertain by its own size.

    Args:
        now: the program without the candidate.
        candidate: fitted at its best place.
    """
    assert isinstance(candidate.refit, Refit)
    at, grid, near = candidate.variant, _grid(now, candidate), candidate.refit
    here, best = near.coefficient(at).flatten().double(), gain_of_fits(now, near)

    def fitted(variant: Variant) -> tuple[Tensor, float] | None:
        """How the coefficient changes, and by how much the likelihood falls."""
        refit = refit_near(now, near, [variant])
        if isinstance(refit, str):
            return None
        return refit.coefficient(variant).flatten().double() - here, best - gain_of_fits(now, refit)

    variance, ways = torch.zeros_like(here), list[_Way]()
    for name in at.profiled:
        sides = [
            (sign, v, fit)
            for sign, v in zip((1, -1), _beside(at, grid, name, NEIGHBOUR_SHARE), strict=True)
            if (fit := fitted(v))
        ]
        if not sides:
            variance = variance + here.square()
            continue
        slope = torch.stack([sign * change for sign, _, (change, _) in sides]).mean(0)
        bend = sum(2 * fall for *_, (_, fall) in sides) / len(sides)
        count = len({variant.profiled[name] for variant in grid})
        sign, variant, (_, fall) = sides[0]
        ways.append(_Way(name, sign, variant, fall, slope, bend, (2 * NEIGHBOUR_SHARE / max(1, count - 1)) ** 2))
    if not ways:
        return variance
    curvature = torch.diag(torch.tensor([way.bend for way in ways], dtype=torch.float64))
    for (i, one), (j, other) in itertools.combinations(enumerate(ways), 2):
        both = fitted(replace(one.beside, options={**one.beside.options, other.name: other.beside.options[other.name]}))
        if both is not None:
            curvature[i, j] = curvature[j, i] = one.sign * other.sign * (both[1] - one.fall - other.fall)
    values, turn = torch.linalg.eigh(curvature)
    along = torch.stack([way.slope for way in ways], -1) @ turn
    return variance + (along.square() / (values.clamp(min=0) + min(way.prior for way in ways))).sum(-1)


@dataclass(frozen=True)
class _Way:
    """A step beside a place, in one of its numbers."""

    name: str  # of the number
    sign: int  # which way it goes
    beside: Variant  # where that leads
    fall: float  # of the likelihood there, nats
    slope: Tensor  # change of the coefficient by a step up, (k,)
    bend: float  # curvature of the likelihood in steps
    prior: float  # precision of a normal as wide as the grid, in steps


def _grid(now: Refit, candidate: Candidate) -> list[Variant]:
    """The effect at all places that were screened."""
    fold = now.folds[0]
    every = candidate.variant.effect.variants(now.program, replace(fold.drives, states=fold.path.states))
    return [variant for variant in every if variant.name == candidate.variant.name]


def _beside(at: Variant, grid: Sequence[Variant], name: str, share: float) -> list[Variant]:
    """The effect on either side of a place: by a share of the grid's spacing, or of the value where there is none."""
    value = at.profiled[name]
    values = sorted({float(variant.profiled[name]) for variant in grid})
    apart = min((b - a for a, b in itertools.pairwise(values)), default=0.8 * value)
    return [replace(at, options={**at.options, name: value + sign * share * apart}) for sign in (1, -1)]
