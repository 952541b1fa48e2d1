"""Candidates that are worth fitting, where their fits begin, and their best knees, widths and places."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate, combinations, pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from steady_ppl.discovery.curves import curves
from steady_ppl.discovery.effect_scores import Column, columns_of, scores_along, simulate_scores
from steady_ppl.discovery.refits import (
    BY_LIKELIHOOD,
    NO_THRESHOLD,
    Attempt,
    Fits,
    Refit,
    Threshold,
    attempt_with,
    begin,
    finish,
    fit_near,
    judged_fits,
    refit_with,
)
from steady_ppl.discovery.screening import FAMILY_LEVEL, Screened, Tested, departures, screen
from steady_ppl.effects import Effect, Sizes, Variant, attached, catalogue
from steady_ppl.effects.attach import SD_OF_LOG_FACTOR
from steady_ppl.errors import FilterError
from steady_ppl.gaussian.linearize import has_heavy_tails
from steady_ppl.gaussian.smoother import smooth
from steady_ppl.likelihood.parameter_posterior import ridged_inverse
from steady_ppl.likelihood.parameters import Element, elements
from steady_ppl.likelihood.scores import smoothed, typical_spreads
from steady_ppl.model.program import Program
from steady_ppl.utils.journal import journaled
from steady_ppl.utils.random import seeded

MIN_LEADERS, MIN_ALIAS_CORRELATION = 6, 0.85  # how many are refitted, and those whose columns are so like the first's
MAX_PLACES_OF_SENSOR_EFFECT = 2  # measurements at which one effect is refitted: of thirty landmarks each may be biased
MAX_NATS_OF_RIVAL = 12.0  # nats behind the best in its round, with which one is fitted again beside other effects
TIE_NATS = 2.0  # of held-out log p(y) within which two candidates cannot be told apart
CLEAR_GAIN = 10.0  # nats of held-out log p(y) for which a test need only be near the family's level
NEAR_FAMILY_LEVEL = FAMILY_LEVEL / 5  # p-value of a single test that is near it
MAX_NATS_BEHIND = 25.0  # nats behind the best on the drives of a fold, with which a candidate is hardly worth another
MIN_STATISTIC_TO_RETRY = 20.0  # statistic of a test from which a fit that gains nothing has gone astray
# forms of effects in proportion to the coefficient
LINEAR_FORMS = ("push", "command", "history", "between", "measured", "viewpoint")
OF_MEASUREMENTS = ("measured", "blur", "tails")  # forms of effects that act on one column or on a few
UNEXPLAINED = "colour"  # the form of effects that imitate whatever is missing, and may enter when nothing else does
MIN_GAIN_OF_PLACE = 0.3  # nats by which another knee or place has to be likelier
MAX_COORDINATE_SWEEPS = 4  # along all knees and places in turns, with steps of one size
MAX_STEPS_OF_PLACE = 4  # in one direction of one of them, one after another
MAX_NATS_BY_ONE_FOLD = 3.0  # by which one fold may like another place better, to make up for what the other loses
NOT_SIMULATED = "with it too many simulated trajectories diverge"
NEIGHBOUR_SHARE = 0.25  # of the grid's spacing, at which a place's likelihood is compared with its neighbours'


@dataclass(frozen=True)
class Screening:
    """Tests of a program, and what the refits need of them."""

    tests: Screened  # of all candidates
    parameters: list[Element]  # the program's learnable numbers, in the order of `information`
    information: Mapping[str, Tensor]  # of parameters and one candidate, by the candidate; the parameters' alone by ""

    def spread_of(self, fitted: Refit, variant: Variant) -> Tensor:
        """See the function `spread_of`, for an effect of the fitted program that was tested."""
        prior = SD_OF_LOG_FACTOR**-2 if variant.effect.null == 1 else 0.0  # of the others it is wide
        return spread_of(fitted, variant, self.parameters, self.information[""], prior)


def spread_of(
    fitted: Refit, variant: Variant, parts: Sequence[Element], information: Tensor, prior: float = 0.0
) -> Tensor:
    """Standard deviations `(k,)` of an effect of a program, of a fit to all drives: of the coefficient as it is
    learned, of a factor its logarithm. `information` is that of the first fold's drives on the numbers `parts`, and
    `prior` that of the coefficient's prior."""
    (there,) = [known for known in attached(fitted.program) if known.name == variant.name]
    index = [i for i, part in enumerate(parts) if part.owner == there.parameter]
    information = information.clone()
    information[index, index] += fitted.first_share * prior
    return (fitted.first_share * ridged_inverse(information).diagonal()[index]).clamp(min=0).sqrt()


@dataclass(frozen=True)
class Candidate:
    """A candidate that was fitted."""

    tested: Tested  # its score test
    refit: Refit | str  # the program with it, or why there is none
    gain: Tensor  # held-out log p(y) above that of the program without, nats, (B,)
    alone: Tensor  # the same of the programs fitted to one fold alone, which is all there is of those given up
    behind: Candidate | None = None  # what one fold was enough to show that this one is behind, if so
    is_confirmed: bool = False  # whether a particle filter was asked, see `ParticleJudge`

    @property
    def variant(self) -> Variant:
        return self.tested.variant

    @property
    def is_judged(self) -> bool:
        """Whether it was fitted on every fold."""
        return isinstance(self.refit, Refit) and len(self.refit.programs) > 1

    @property
    def total(self) -> float:
        """Held-out gain of all drives, nats, less `charge`; extrapolated where it was given up after one fold."""
        if self.is_judged or not isinstance(self.refit, Refit):
            return float(self.gain.sum()) - self.charge
        ahead = 0.0
        if self.behind is not None:
            ahead = self.behind.total - 2 * float(self.behind.alone[: len(self.alone)].sum())
        return ahead + 2 * float(self.alone.sum()) - self.charge

    @property
    def charge(self) -> int:
        """Nats for what the judging drives have told as well: each knee and place, and each number of common noise."""
        return len(self.variant.profiled) + (self.refit.in_common(self.variant) if isinstance(self.refit, Refit) else 0)

    def significant(self, critical: float) -> bool:
        """Whether its own test reaches the family's level, or nearly does and its gain leaves no doubt.

        The gain alone says little: beside a fit that ended short of its best, anything gains that moves the parameters.
        """
        if self.total > CLEAR_GAIN:
            return self.tested.p_value <= max(critical, NEAR_FAMILY_LEVEL)
        return self.total > TIE_NATS and self.tested.p_value <= critical

    @property
    def is_explanation(self) -> bool:
        """Whether it says what makes the error: that it lasts is no reason."""
        return self.variant.effect.form != UNEXPLAINED

    @property
    def against_its_sign(self) -> bool:
        """Whether physics gives the coefficient the other sign: then it is a symptom, not an effect."""
        sign = self.variant.effect.sign
        return bool(sign) and isinstance(self.refit, Refit) and sign * float(self.refit.coefficient(self.variant)) < 0


@torch.no_grad()
def screen_program(
    now: Refit, declared: Program, *, sets: int, seed: int, wanted: Callable[[Effect], bool] = lambda effect: True
) -> Screening:
    """Test every candidate that a fitted program does not have, on the drives of its first fold.

    `declared` is the program before it was fitted, `sets` counts the simulated ones, `wanted` says of
    an effect whether it is looked for.
    """
    program, fold = now.program, now.folds[0]
    problem, parts = fold.fitting(program), elements(program)
    there = {variant.name for variant in attached(program)}
    seen = replace(fold.drives, states=fold.path.states)
    ahead = smooth(problem, fold.path, passes=3, tolerance=0.01)
    away = departures(declared, now, parts)
    away = [one for one in away if one.variant.name not in there and wanted(one.variant.effect)]
    there |= {departure.variant.name for departure in away}
    tailed = has_heavy_tails(program, fold.path.states[:1, :1])  # as it stands
    effects = [e for e in catalogue(program) if wanted(e) and not (tailed and e.form == "tails")]
    sizes = Sizes(program, seen)
    variants = [sizes.of(v) for effect in effects for v in effect.variants(program, seen) if v.name not in there]
    spread, sharpness = typical_spreads(program, fold.drives, smoothed(ahead, fold.drives))
    variants += [curve for curve in curves(program, seen, spread, sharpness) if wanted(curve.effect)]
    columns, count = columns_of(variants), len(parts)
    own, found = scores_along(problem, ahead, parts, columns)
    failed = [(column, why) for column, why in zip(columns, found, strict=True) if isinstance(why, str)]
    columns = [column for column, scores in zip(columns, found, strict=True) if not isinstance(scores, str)]
    observed = torch.cat([own, *(scores for scores in found if not isinstance(scores, str))], -1)
    if broken := (~torch.isfinite(own).all(-1)).nonzero().flatten().tolist():
        raise FilterError(f"trajectory {fold.drives.labels[broken[0]]}: the fitted model diverges on it")
    starts = fold.path.states[0].expand(sets, -1, -1)  # known, or draws of their posterior
    if not fold.known_start:
        with seeded(seed, "starts"):
            starts = ahead.draws(sets)[1][:, 0].to(starts)
    simulated, _ = journaled(lambda: ({"scores": simulate_scores(problem, starts, parts, columns, seed=seed)}, {}))
    finite = torch.isfinite(simulated["scores"]).all(0).all(0)
    ends = accumulate((column.size for column in columns), initial=count)
    places = [slice(*pair) for pair in pairwise(ends)]
    for place in places:
        finite[place] = bool(finite[place].all())
    able = [(column, bool(finite[place.start])) for column, place in zip(columns, places, strict=True)]
    failed += [(column, NOT_SIMULATED) for column, is_able in able if not is_able]
    columns = [column for column, is_able in able if is_able]
    tests = screen(observed[:, finite], simulated["scores"][..., finite], count, columns, away, failed)
    information, first = {"": tests.information[:count, :count]}, count
    for column in columns:
        index = [*range(count), *range(first, first + column.size)]
        information[_key(column)] = tests.information[index][:, index]
        first += column.size
    return Screening(tests, parts, information)


def leaders(screened: Screened, first: bool) -> list[Tested]:
    """Those to fit: all that are nearly significant, of the best few in later rounds, and the aliases of the first; of
    an effect on measurements where it tells most.

    How far behind a test is says little where much is missing: scores look one step ahead, and a drag of which they see
    a trace may be what holds everything else in its wrong place.
    """
    alive = [(i, t) for i, t in enumerate(screened.tested) if not (t.untestable or t.departure or t.is_curve)]
    if not alive:
        return []
    top, places, able = alive[0][0], Counter[str](), list[tuple[int, Tested]]()
    for i, tested in alive:
        effect = tested.variant.effect
        places[effect.name] += effect.form in OF_MEASUREMENTS
        if places[effect.name] <= MAX_PLACES_OF_SENSOR_EFFECT:
            able.append((i, tested))
    best = [i for i, _ in able[:MIN_LEADERS]]
    near = [i for i, tested in able if tested.p_value < NEAR_FAMILY_LEVEL]
    few = {*best, *near} if first else {top, *(i for i in best if i in near)}
    return [tested for i, tested in alive if i in few or float(screened.correlations[top, i]) > MIN_ALIAS_CORRELATION]


def attempts(
    now: Refit, chosen: Sequence[Tested], screening: Screening, threshold: Threshold = NO_THRESHOLD
) -> list[Callable[[Threshold], Candidate]]:
    """Calls that fit the program with each candidate, in order, by the screening that tested it. Each is given what its
    drives must reach; one that stops fits early must be given here as well."""
    known = [_known(tested, screening) for tested in chosen]
    from_zero = [
        one is not None and tested.column.probe is None and now.fitting == BY_LIKELIHOOD
        for tested, one in zip(chosen, known, strict=True)
    ]  # scoring steps go from there as far as the likelihood rises
    starts = [t.variant.absent(now.held_out) if zero else _start(t) for t, zero in zip(chosen, from_zero, strict=True)]
    made = [attempt_with(now, [(t.variant, start)], one) for t, start, one in zip(chosen, starts, known, strict=True)]
    given = zip(chosen, begin(now, made, threshold), known, from_zero, strict=True)
    return [partial(_fitted, now, *one) for one in given]


def _fitted(
    now: Refit, tested: Tested, first: Attempt | str, known: Tensor | None, from_zero: bool, threshold: Threshold
) -> Candidate:
    candidate = judged(now, tested, finish(now, first, threshold))
    if from_zero or known is None or not tested.statistic > MIN_STATISTIC_TO_RETRY:
        return candidate
    if isinstance(candidate.refit, Refit) and gain_of_fits(now, candidate.refit, folds=1) >= 0:
        return candidate
    absent = tested.variant.absent(now.held_out)
    return judged(now, tested, refit_with(now, tested.variant, absent, information=known, threshold=threshold))


def _known(tested: Tested, screening: Screening) -> Tensor | None:
    """The information of the first fold's drives about a candidate whose effect is linear in its coefficient."""
    effect = tested.variant.effect
    return screening.information[_key(tested.column)] if effect.null == 0 and effect.form in LINEAR_FORMS else None


def judged(now: Refit, tested: Tested, refit: Refit | str) -> Candidate:
    """A fit and what it gains over the program without."""
    if isinstance(refit, str):
        none = torch.full_like(now.held_out, -math.inf)
        return Candidate(tested, refit, none, none)
    alone = refit.held_out_alone - now.held_out_alone[: len(refit.held_out_alone)]
    given_up = len(refit.programs) < len(now.programs)
    return Candidate(tested, refit, alone if given_up else refit.held_out - now.held_out, alone)


def bar_of(fits: Sequence[Refit]) -> Threshold:
    """What is so far behind these fits on the first fold that it is hardly worth another."""
    drives = [float(fit.maxima[0].log_likelihood.sum()) for fit in fits]
    held_out = [float(fit.held_out_alone[: len(fit.folds[0].held_out)].sum()) for fit in fits]
    return Threshold(max(drives, default=-math.inf) - MAX_NATS_BEHIND, max(held_out, default=-math.inf) - TIE_NATS)


def gain_of_fits(now: Fits, refit: Fits, folds: int | None = None) -> float:
    """Nats of log p(y) by which fits, of the first `folds` or all, explain better the drives they were fitted to."""
    pairs = zip(refit.maxima[:folds], now.maxima, strict=False)
    return float(sum((one.log_likelihood - other.log_likelihood).sum() for one, other in pairs))


def _start(tested: Tested) -> Any:
    """Where the coefficient begins: a scoring step from its absence, or near the probe that told most."""
    effect, probe = tested.variant.effect, tested.column.probe
    step = float(tested.coefficient[0])
    if probe is not None:
        return probe * min(max(step / probe, 0.3), 1.5) if math.isfinite(effect.null) else probe
    if effect.components:
        return (effect.null + tested.coefficient).tolist()
    if effect.form == "tails":
        return min(max(step, 0.02), 0.45)
    return max(effect.null + step, 0.2) if effect.null == 1 else effect.null + step


def _key(column: Column) -> str:
    return f"{column.variant.label} {column.probe}"


def at_its_best_place(now: Refit, candidate: Candidate) -> Candidate:
    """A candidate with its likeliest knee, width or place, on its grid and then between its points, as far as the
    held-out drives do not clearly deny that."""
    if isinstance(candidate.refit, str) or not candidate.variant.profiled:
        return candidate
    at = candidate.variant
    begun = candidate.refit if candidate.is_judged else refit_with(now, at, candidate.refit.coefficient(at))
    if isinstance(begun, str):
        return candidate
    for variant, best in reversed(likelier_places(now, begun, at)):
        refit = begun if best is begun else judged_fits(best)
        if isinstance(refit, Refit):
            there = judged(now, candidate.tested.at(variant), refit)
            if not candidate.is_judged or there.total >= candidate.total - CLEAR_GAIN:
                return there
    return candidate


def likelier_places(base: Refit, begun: Fits, at: Variant) -> list[tuple[Variant, Fits]]:
    """Knees, widths or places of an effect, on its grid and then between its points, and the fits there, each likelier
    than the one before: `begun` first, which has the effect there and perhaps others that `base` lacks."""
    grid, fits = _grid(base, at), [(at, begun)]
    beside = {known.name for known in attached(base.program)}
    lacking = [one for one in attached(begun.program) if one.name not in beside]

    def moves_to(variant: Variant) -> bool:
        """Add the fit at a place if it is likelier than the last."""
        there, best = fits[-1]
        more = _log_prior(there, grid) - _log_prior(variant, grid) + MIN_GAIN_OF_PLACE
        floors = [float(one.log_likelihood.sum()) + more - MAX_NATS_BY_ONE_FOLD for one in best.maxima]
        other = fit_near(base, best, [variant if one.name == at.name else one for one in lacking], floors)
        if isinstance(other, str) or not gain_of_fits(best, other) > more:
            return False
        if any(float(one.log_likelihood.sum()) < floor for one, floor in zip(other.maxima, floors, strict=True)):
            return False  # it may have been given up
        fits.append((variant, other))
        return True

    def walks(name: str, share: float, side: int) -> bool:
        """Go on to one side for as long as that is likelier; whether it was at all."""
        steps = 0
        while steps < MAX_STEPS_OF_PLACE and moves_to(_neighbours(fits[-1][0], grid, name, share)[side]):
            steps += 1
        return steps > 0

    for variant in grid:
        if variant.label != at.label:
            moves_to(variant)
    for share in (0.5, 0.25):
        for _ in range(MAX_COORDINATE_SWEEPS):
            moved = [walks(name, share, 0) or walks(name, share, 1) for name in at.profiled]
            if not any(moved):
                break
    return fits


def moved_to_likelier_place(base: Refit, refit: Refit, variant: Variant) -> Refit:
    """A fitted program with the knee or place of one of its effects, which `base` lacks, where it is likeliest."""
    if not variant.profiled:
        return refit
    *_, (_, fits) = likelier_places(base, refit, variant)
    if fits is refit or isinstance(moved := judged_fits(fits), str):
        return refit
    return moved


def variance_of_places(now: Refit, candidate: Candidate) -> Tensor:
    """What the uncertainty of knees, widths and places adds to the variance of a coefficient, `(k,)`.

    By the delta method along their profile likelihood, with a prior as wide as their grid. Where the program cannot be
    fitted on either side of one, its coefficient is as uncertain as it is large. `now` lacks the effect.
    """
    assert isinstance(candidate.refit, Refit)
    at, grid, near = candidate.variant, _grid(now, candidate.variant), candidate.refit
    here, best = near.mean_coefficient(at).flatten().double(), gain_of_fits(now, near)

    def moved_to(variant: Variant) -> tuple[Tensor, float] | None:
        """How the coefficient changes there, and by how much the likelihood falls, nats."""
        fits = fit_near(now, near, [variant])
        if isinstance(fits, str):
            return None
        return fits.mean_coefficient(variant).flatten().double() - here, best - gain_of_fits(now, fits)

    variance, steps = torch.zeros_like(here), list[_GridStep]()
    for name in at.profiled:
        beside = zip((1, -1), _neighbours(at, grid, name, NEIGHBOUR_SHARE), strict=True)
        sides = [(sign, variant, *found) for sign, variant in beside if (found := moved_to(variant))]
        if not sides:
            variance = variance + here.square()
            continue
        sign, variant, _, fall = sides[0]
        slope = torch.stack([sign * change for sign, _, change, _ in sides]).mean(0)
        bend = sum(2 * fall for *_, fall in sides) / len(sides)
        axis = _axis(at, grid, name)
        prior = (NEIGHBOUR_SHARE * axis.spacing / axis.half_width) ** 2
        steps.append(_GridStep(name, sign, variant, fall, slope, bend, prior))
    if not steps:
        return variance
    curvature = torch.diag(torch.tensor([step.bend for step in steps], dtype=torch.float64))
    for (i, one), (j, other) in combinations(enumerate(steps), 2):
        options = {**one.beside.options, other.name: other.beside.options[other.name]}
        if (both := moved_to(replace(one.beside, options=options))) is not None:
            curvature[i, j] = curvature[j, i] = one.sign * other.sign * (both[1] - one.fall - other.fall)
    if not bool(torch.isfinite(curvature).all()):
        return variance + here.square()
    values, turn = torch.linalg.eigh(curvature)
    along = torch.stack([step.slope for step in steps], -1) @ turn
    return variance + (along.square() / (values.clamp(min=0) + min(step.prior for step in steps))).sum(-1)


class _GridStep(NamedTuple):
    """A step beside a place, in one of its numbers."""

    name: str  # of the number
    sign: int  # which way it goes
    beside: Variant  # where that leads
    fall: float  # of the likelihood there, nats
    slope: Tensor  # change of the coefficient by a step up, (k,)
    bend: float  # curvature of the likelihood in steps
    prior: float  # precision of a normal as wide as the grid, in steps


def _grid(now: Refit, at: Variant) -> list[Variant]:
    """The effect at all places that were screened, with the same prior everywhere."""
    fold = now.folds[0]
    every = at.effect.variants(now.program, replace(fold.drives, states=fold.path.states))
    return [replace(variant, scale=at.scale) for variant in every if variant.name == at.name]


class _Axis(NamedTuple):
    """The grid of a knee, width or place, in the logarithm of what is uncertain by a factor."""

    to: Callable[[float], float]
    back: Callable[[float], float]
    spacing: float  # the least; of one point: a share of where it is now
    middle: float  # of one point: where it is now, so that its prior is flat
    half_width: float


def _axis(at: Variant, grid: Sequence[Variant], name: str) -> _Axis:
    by_factor = name in at.effect.by_factor
    to, back = (math.log, math.exp) if by_factor else (float, float)
    values, now = sorted({to(variant.profiled[name]) for variant in grid}), at.profiled[name]
    alone = math.log(1.8) if by_factor else 0.8 * abs(now) or 1.0
    values = values if len(values) > 1 else [to(now)]
    spacing = min((b - a for a, b in pairwise(values)), default=alone)
    return _Axis(to, back, spacing, 0.5 * (values[0] + values[-1]), 0.5 * max(values[-1] - values[0], spacing))


def _log_prior(at: Variant, grid: Sequence[Variant]) -> float:
    """Of a knee, width or place: a normal as wide as its grid."""
    axes = [(_axis(at, grid, name), value) for name, value in at.profiled.items()]
    return -0.5 * sum(((axis.to(value) - axis.middle) / axis.half_width) ** 2 for axis, value in axes)


def _neighbours(at: Variant, grid: Sequence[Variant], name: str, share: float) -> list[Variant]:
    """The effect on either side of a place, by a share of the grid's spacing."""
    axis, value = _axis(at, grid, name), at.profiled[name]
    beside = [axis.back(axis.to(value) + sign * share * axis.spacing) for sign in (1, -1)]
    return [replace(at, options={**at.options, name: place}) for place in beside]
