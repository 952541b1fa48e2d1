"""Knees, widths and places: the best of a candidate's, and what not knowing them adds to its coefficient's variance."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from steady_ppl.discovery.candidates import Candidate, Settings, gain_of_first_fold, judged
from steady_ppl.discovery.refits import NEVER, Refit, refit_with
from steady_ppl.effects import Variant

BETTER = 0.3  # nats by which another knee or place has to be likelier
NEAR = 0.25  # of the grid's spacing, at which a place's likelihood is compared with its neighbours'


def at_its_best_place(now: Refit, candidate: Candidate, settings: Settings) -> Candidate:
    """A candidate with the knee, width or place at which it gains most: on its grid, and then between its points."""
    if isinstance(candidate.refit, str) or not candidate.variant.profiled:
        return candidate
    grid = _grid(now, candidate)
    start, at = candidate.refit.coefficient(candidate.variant), candidate.variant
    best = gain_of_first_fold(now, candidate.refit)

    def better(variants: Iterable[Variant]) -> bool:
        nonlocal at, best, start
        before = best
        for variant in variants:
            refit = refit_with(now, variant, start, known_start=settings.known_start, worth=NEVER)
            if isinstance(refit, Refit) and gain_of_first_fold(now, refit) > best + BETTER:
                at, best, start = variant, gain_of_first_fold(now, refit), refit.coefficient(variant)
        return best > before

    better(variant for variant in grid if variant.label != candidate.variant.label)
    for share in (0.5, 0.25):
        for name in at.profiled:
            better(_beside(at, grid, name, share))
    if at is candidate.variant:
        return candidate
    refit = refit_with(now, at, start, known_start=settings.known_start)
    other = judged(now, replace(candidate.tested, column=replace(candidate.tested.column, variant=at)), refit)
    return other if other.total > candidate.total else candidate


def variance_of_places(now: Refit, candidate: Candidate, known_start: bool) -> Tensor:
    """What the uncertainty of knees, widths and places adds to the variance of a coefficient, `(k,)`.

    By the delta method along the profile likelihood of each alone; one that these drives do not tell is taken as
    uncertain within its grid.

    Args:
        now: the program without the candidate.
        candidate: fitted at its best place.
        known_start: the first states are certain.
    """
    assert isinstance(candidate.refit, Refit)
    start = candidate.refit.coefficient(candidate.variant)
    best = gain_of_first_fold(now, candidate.refit)
    added = torch.zeros(start.numel(), dtype=torch.float64)
    for name in candidate.variant.profiled:
        grid = _grid(now, candidate)
        values = {variant.profiled[name] for variant in grid}
        sides = []
        for variant in _beside(candidate.variant, grid, name, NEAR):
            refit = refit_with(now, variant, start, known_start=known_start, worth=NEVER)
            if isinstance(refit, Refit):
                sides.append((refit.coefficients(variant)[0].flatten().double(), gain_of_first_fold(now, refit)))
        if len(sides) == 2:
            change = (sides[0][0] - sides[1][0]) / 2
            fall = 2 * best - sides[0][1] - sides[1][1]  # twice the mean: the curvature, in steps to the side
            added += change.square() / max(fall, (2 * NEAR / max(1, len(values) - 1)) ** 2)
    return added


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
