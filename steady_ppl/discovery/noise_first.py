"""What is wrong with readings and declared noise, which is put right before effects are looked for.

One wrong reading may decide which effect is named, so that outliers are left out. A program that learns its noise says
itself how large it is. One that declares it would have what its sensors' data sheet got wrong in every test: too wide a
noise hides effects, too narrow a one makes them of chance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.discovery.candidates import CLEAR_GAIN, TIE_NATS, Screening
from steady_ppl.discovery.refits import Refit, fit_near, judged_fits, refit_with
from steady_ppl.discovery.screening import NOISE_SIZES, is_learned, sizes_of_noise
from steady_ppl.effects import Variant, attached, catalogue
from steady_ppl.gaussian.predict import HALF_WIDTH
from steady_ppl.likelihood.outliers import AS_TAILS, Outliers, find_outliers, too_many
from steady_ppl.model.program import Program
from steady_ppl.utils.text import reason_of

MAX_FITS = 6  # without the outliers that were found in the fit before
WIDE = 3.0  # a factor to begin with where the process noise was fitted many times wider: it may stand for the sensor's
MIN_FACTOR = 1.25  # by which declared noise must be wrong; a smaller one is tested beside the effects


@dataclass(frozen=True)
class Correction:
    """A factor on declared standard deviations, or heavy tails, in all fits that follow."""

    variant: Variant
    gain: float  # nats of held-out log p(y) that it brought, at the time step at which it was found


class Suited(NamedTuple):
    """A fitted program with noise that the drives do not contradict."""

    base: Refit
    corrections: list[Correction]

    @property
    def tails(self) -> Variant | None:
        """The heavy tails among the corrections."""
        return next((one.variant for one in self.corrections if one.variant.effect.form == "tails"), None)

    @property
    def log_likelihood(self) -> float:
        """Of all drives, each under the program that was fitted to it."""
        return sum(float(maximum.log_likelihood.sum()) for maximum in self.base.maxima)


class Cleaned(NamedTuple):
    """Fits without outliers."""

    refit: Refit  # as declared
    suited: Suited
    outliers: list[Outliers]  # of the training and of the validation drives
    whole: Refit  # the fit to all readings


def without_outliers(
    fit: Callable[[Trajectories, Trajectories], Refit],
    train: Trajectories,
    valid: Trajectories,
    wanted: Callable[[Variant], bool],
) -> Cleaned:
    """What `fit` makes of training and validation drives without the outliers that its fits show.

    None is left out where they are too many, or where all readings are likelier by noise with heavy tails, if it is
    `wanted`. Then the noise has such tails, if they help.
    """
    none = [Outliers(data, [], torch.zeros_like(data.observed)) for data in (train, valid)]
    found, whole = none, fit(train, valid)
    refit, tails, kept = whole, _tails_of(whole.program, wanted), ""
    for _ in range(MAX_FITS):
        try:
            folds = zip(refit.programs, refit.folds, strict=True)
            more = [find_outliers(fold.fitting(program), fold.path, against_tails=False) for program, fold in folds]
            every = [one.with_more(other) for one, other in zip(found, more, strict=True)]
            kept = next(filter(None, (too_many(one.data, one.wrong) or one.note for one in every)), "")
            if kept or not any(one.found for one in more):
                break
            refit, found = fit(*(one.left for one in every)), every
        except Exception as error:  # also of the program's own code
            found = [
                replace(found[0], note=f"wrong readings were not looked for further: {reason_of(error)}"),
                found[1],
            ]
            break
    if not kept:
        suited = with_suitable_noise(refit, wanted)
        if refit is whole or tails is None:
            return Cleaned(refit, suited, found, whole)
        likely = suited.log_likelihood - sum(one.cost for one in found)
    with_all = with_suitable_noise(whole, wanted, tails)
    if not kept and (with_all.tails is None or with_all.log_likelihood <= likely):
        return Cleaned(refit, suited, found, whole)
    return Cleaned(whole, with_all, [replace(none[0], note=kept or AS_TAILS), none[1]], whole)


def _tails_of(program: Program, wanted: Callable[[Variant], bool]) -> Variant | None:
    """Student t measurement noise, where the program has none and it is looked for."""
    there = {variant.name for variant in attached(program)}
    able = (effect.variant() for effect in catalogue(program) if effect.form == "tails" and effect.name not in there)
    return next(filter(wanted, able), None)


def with_suitable_noise(own: Refit, wanted: Callable[[Variant], bool], tails: Variant | None = None) -> Suited:
    """A fitted program with `tails`, if they help, and factors on the noise that it declares too wide or too narrow."""
    base, found, there = own, list[Correction](), {variant.name for variant in attached(own.program)}
    if tails is not None and isinstance(tailed := refit_with(own, tails, tails.effect.typical), Refit):
        gain = float((tailed.held_out - own.held_out).sum()) if len(tailed.programs) == len(own.programs) else 0.0
        if gain > CLEAR_GAIN:
            base = tailed if tailed.converged else _fitted_further(own, tailed, tails)
            found = [Correction(tails, gain)]
    for variant in [one for name in reversed(NOISE_SIZES) for one in sizes_of_noise(base.program, name)]:
        if variant.name in there or not wanted(variant) or is_learned(variant, base.program, base.folds[0]):
            continue
        starts = (1.0,) if base.unwidened is None else (1.0, WIDE)
        refits = [refit for start in starts if isinstance(refit := refit_with(base, variant, start), Refit)]
        refit = max((one for one in refits if len(one.programs) == len(base.programs)), key=_held_out, default=base)
        if refit is base:
            continue
        gain, factor = float((refit.held_out - base.held_out).sum()), float(refit.coefficient(variant))
        if gain > CLEAR_GAIN and abs(math.log(factor)) > math.log(MIN_FACTOR):
            base = refit if refit.converged else _fitted_further(base, refit, variant)
            found.append(Correction(variant, gain))
    for one in found[:-1]:  # it may have stood for one that was added later
        is_small = one.variant is tails or abs(math.log(float(base.coefficient(one.variant)))) <= math.log(MIN_FACTOR)
        if is_small and (fewer := without([one], own, base)) is not None:
            base = fewer
            found.remove(one)
    return Suited(base, found)


def with_same_noise(own: Refit, suited: Refit, corrections: list[Correction]) -> Suited | None:
    """A fitted program with the corrections that it has at another time step, fitted from there.

    None where that fails, has not converged, or brings too little here: they may have stood for the other step.
    """
    near = fit_near(own, suited, [one.variant for one in corrections]) if own.fitting == suited.fitting else ""
    refit = near if isinstance(near, str) else judged_fits(near)
    if isinstance(refit, str) or not refit.converged or float((refit.held_out - own.held_out).sum()) <= CLEAR_GAIN:
        return None
    return Suited(replace(refit, unwidened=own.unwidened), corrections)


def _held_out(refit: Refit) -> float:
    return float(refit.held_out.sum())


def _fitted_further(base: Refit, refit: Refit, variant: Variant) -> Refit:
    """From where a fit with a factor has come: it is far from where that began."""
    near = fit_near(base, refit, [variant])
    further = near if isinstance(near, str) else judged_fits(near)
    return refit if isinstance(further, str) else replace(further, unwidened=refit.unwidened)


def needless(corrections: Sequence[Correction], final: Refit, screening: Screening) -> list[Correction]:
    """Those that may be absent beside the effects that were found: what was missing looked like noise."""

    def may_be_absent(correction: Correction) -> bool:
        effect, value = correction.variant.effect, float(final.coefficient(correction.variant))
        sd = float(screening.spread_of(final, correction.variant))
        is_at_its_most = value >= effect.between[1]  # where drives tell no spread
        return not is_at_its_most and abs(math.log(value) if effect.null == 1 else value) < HALF_WIDTH * sd

    return [one for one in corrections if may_be_absent(one)]


def without(corrections: Sequence[Correction], as_it_stands: Refit, fitted: Refit) -> Refit | None:
    """A fitted program without some corrections; None where it explains less of the held-out drives, or fails."""
    dropped = {one.variant.name for one in corrections}
    kept = [variant for variant in attached(fitted.program) if variant.name not in dropped]
    own = {variant.name for variant in attached(as_it_stands.program)}
    near = fit_near(as_it_stands, fitted, [variant for variant in kept if variant.name not in own])
    refit = near if isinstance(near, str) else judged_fits(near)
    if isinstance(refit, str) or float((refit.held_out - fitted.held_out).sum()) < -TIE_NATS:
        return None
    return replace(refit, unwidened=fitted.unwidened)
