"""The tests of a fitted program: of every effect at once, and of its noise against the declared.

A Lagrange-multiplier (score) test (Rao 1948) of each candidate, the fitted parameters projected out, calibrated by
drives that the fitted program makes itself. The largest of all candidates is compared with the largest in each
simulated set (Westfall and Young 1993), so that the level holds for the whole catalogue.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy import optimize, special
from torch import Tensor

from steady_ppl.discovery.curves import CURVE, prior_covariance
from steady_ppl.discovery.effect_scores import Column
from steady_ppl.discovery.refits import Fold, Refit, as_declared
from steady_ppl.effects import Variant, attached, catalogue
from steady_ppl.likelihood.parameter_posterior import pseudo_inverse, ridged_inverse
from steady_ppl.likelihood.parameters import Element, elements, on_both_sides
from steady_ppl.likelihood.scores import measured, substep_spreads
from steady_ppl.model.program import Program
from steady_ppl.utils.text import reason_of

FAMILY_LEVEL, POWER = 0.05, 0.95  # of the tests of all candidates together, and at a detection limit
MIN_SHARE_OF_INFORMATION = 1e-4  # of a column, that the fitted parameters must leave for it to be tested
CONTAINED = "the fitted parameters already explain it"
NOISE_SIZES = ("process_noise", "measurement_noise")  # the effects that multiply a standard deviation
UNEXCITED = "these trajectories never excite it"
NOT_FINITE = "its test is not finite"
MAX_NONCENTRALITY = 1e4  # of a detection limit's χ²


@dataclass(frozen=True)
class Tested:
    """A candidate's test: of its best column where it has several."""

    column: Column
    place: slice  # of its numbers among those of all columns
    statistic: float  # the Lagrange multiplier; of a curve, with its prior
    p_values: np.ndarray  # of this candidate alone, on the drives and then on every simulated set, (1 + S,)
    coefficient: np.ndarray  # one scoring step from zero, (k,)
    sd: np.ndarray  # its standard deviation, (k,)
    detection_limit: np.ndarray  # found with 95 % power at the family-wise level, each number alone, (k,)
    evidence: float = 0.0  # log Bayes factor of a curve
    untestable: str | None = None  # why it has no test
    alone: np.ndarray | None = None  # standard deviation of each number when the others are zero, (k,)
    effective: float = 1.0  # how many independent tests the best of its columns is like
    departure: bool = False  # whether it says that a fitted σ is not the declared: there is nothing left to fit then

    @property
    def p_value(self) -> float:
        """Of this candidate alone, on the drives."""
        return float(self.p_values[0])

    @property
    def variant(self) -> Variant:
        return self.column.variant

    def at(self, variant: Variant) -> Tested:
        """The same test, of the effect at another knee or place."""
        return replace(self, column=replace(self.column, variant=variant))

    @property
    def is_curve(self) -> bool:
        return self.column.is_curve

    def rank(self) -> tuple[float, float]:
        """Small where much is found, also where p-values are too small to be told apart."""
        return self.p_value, -self.statistic


@dataclass(frozen=True)
class Screened:
    """All candidates' tests."""

    tested: list[Tested]  # one a candidate, the smallest p-value first; all curves together are one
    curves: list[Tested]  # every curve's test, the largest evidence first
    p_value: float  # family-wise, of the smallest
    critical: float  # the single p-value below which the family-wise level is kept
    fitted: tuple[float, int]  # Lagrange multiplier of the fitted parameters, large at a bound; how many they are
    correlations: Tensor  # candidate × candidate, the largest canonical correlation of their projected columns
    information: Tensor  # covariance of a set's summed scores, of the parameters and then of the columns, (N, N)


def screen(
    observed: Tensor,
    simulated: Tensor,
    fitted: int,
    columns: Sequence[Column],
    departures: Sequence[Departure] = (),
    failed: Sequence[tuple[Column, str]] = (),
) -> Screened:
    """Test every candidate.

    Args:
        observed: scores of the drives, `(B, N)`: of the `fitted` parameters first and then of the columns, in order.
        simulated: the same of simulated sets, `(S, B, N)`.
        departures: of the fitted noise from the declared.
        failed: columns that have no scores, and why.
    """
    sums = simulated.sum(1)
    bias = sums.mean(0)
    apart = simulated - simulated.mean(0)  # of each drive among the sets
    own_score = observed.sum(0)[:fitted]  # as it is: where log p(y) is biased, so are the sets' scores
    information = torch.einsum("sbi,sbj->ij", apart, apart) / (len(apart) - 1)
    scores = torch.cat([(observed.sum(0) - bias).unsqueeze(0), sums - bias])
    own, rest = slice(0, fitted), slice(fitted, None)
    inverse = pseudo_inverse(information[own, own])
    solved = inverse @ information[own, rest]
    left = information[rest, rest] - information[rest, own] @ solved
    left = (left + left.T) / 2
    projected = scores[:, rest] - scores[:, own] @ solved
    before = information[rest, rest].diagonal()
    ends = [*itertools.accumulate(column.size for column in columns)]
    places = [slice(end - column.size, end) for column, end in zip(columns, ends, strict=True)]
    groups = defaultdict[str, list[int]](list)
    for index, column in enumerate(columns):
        groups[CURVE if column.is_curve else column.variant.name].append(index)
    tests, curves = list[Tested](), list[Tested]()
    for members in groups.values():
        found = [_test(columns[i], places[i], projected, left, before) for i in members]
        if alive := [test for test in found if isinstance(test, Tested)]:
            tests.append(_best_of(alive))
        else:
            why = next((why for why in found if why != UNEXCITED), UNEXCITED)
            tests.append(_untested(columns[members[0]], places[members[0]], str(why), len(scores)))
        curves += [_best_of([test]) for test in alive if test.is_curve]
    for column, why in failed:
        if (name := CURVE if column.is_curve else column.variant.name) not in groups:
            groups[name] = []
            tests.append(_untested(column, slice(0, 0), why, len(scores)))
    tests += [_departed(departure, information[own, own], scores[:, own]) for departure in departures]
    tests.sort(key=Tested.rank)
    family = np.stack([np.ones(len(scores)), *(test.p_values for test in tests)]).min(0)
    critical = _critical(family[1:])
    return Screened(
        tested=[replace(test, detection_limit=_limit(test, critical)) for test in tests],
        curves=sorted(curves, key=lambda test: -test.evidence),
        p_value=(1 + float((family[1:] <= family[0]).sum())) / len(family),
        critical=critical,
        fitted=(float(own_score @ inverse @ own_score), fitted),
        correlations=_largest_canonical_correlations(left, [test.place for test in tests]),
        information=information,
    )


def _critical(simulated: np.ndarray) -> float:
    """The largest p-value below which the family's own p-value, (1 + sets as extreme) / (1 + sets), keeps the level."""
    allowed = int(FAMILY_LEVEL * (len(simulated) + 1)) - 1
    return float(np.nextafter(np.sort(simulated)[max(0, allowed)], 0.0))


def _best_of(tests: list[Tested]) -> Tested:
    """The test of the best of several columns, corrected for how many independent tests they are like."""
    effective, smallest = 1.0, np.stack([test.p_values for test in tests]).min(0)
    if len(tests) > 1:
        median = float(np.clip(np.median(smallest[1:]), 1e-6, 0.5))
        effective = max(1.0, math.log(0.5) / math.log1p(-median))
    together = -np.expm1(effective * np.log1p(-np.minimum(smallest, 1 - 1e-12)))
    return replace(min(tests, key=Tested.rank), p_values=together, effective=effective)


def _limit(tested: Tested, critical: float) -> np.ndarray:
    """The size of each number, the others zero, at which a noncentral χ² passes the family's level with 95 %."""
    size = len(tested.coefficient)
    if tested.untestable or tested.is_curve or tested.alone is None or not math.isfinite(tested.variant.effect.null):
        return np.full(size, math.inf)
    threshold = special.chdtri(size, -math.expm1(math.log1p(-critical) / tested.effective))

    def more_power(away: float) -> float:
        return float(1 - special.chndtr(threshold, size, away) - POWER)

    if not more_power(MAX_NONCENTRALITY) > 0:  # simulated drives look as wrong as can be
        return np.full(size, math.inf)
    least = 1e-6
    needed = least if more_power(least) > 0 else optimize.brentq(more_power, least, MAX_NONCENTRALITY)
    return math.sqrt(needed) * tested.alone


def _untested(column: Column, place: slice, why: str, sets: int) -> Tested:
    nothing, endless = np.zeros(column.size), np.full(column.size, math.inf)
    return Tested(column, place, 0.0, np.ones(sets), nothing, endless, endless, untestable=why)


def _test(column: Column, place: slice, projected: Tensor, left: Tensor, before: Tensor) -> Tested | str:
    """A column's test, or why it has none."""
    own, scores = left[place, place], projected[:, place]
    if not bool((before[place] > 0).any()):
        return UNEXCITED
    try:
        if column.is_curve:
            found = _test_of_curve(column, place, scores, own) if bool((own.diagonal() > 0).any()) else None
        else:
            enough = (before[place] > 0) & (own.diagonal() > MIN_SHARE_OF_INFORMATION * before[place])
            found = _test_of_effect(column, place, scores, own) if bool(enough.all()) else None
    except RuntimeError as error:  # of a matrix that is singular
        return reason_of(error)
    if found is None:
        return CONTAINED
    return found if math.isfinite(found.statistic) and bool(np.isfinite(found.p_values).all()) else NOT_FINITE


def _test_of_effect(column: Column, place: slice, scores: Tensor, own: Tensor) -> Tested:
    steps = torch.linalg.solve(own, scores.T).T
    statistics = (scores * steps).sum(-1).numpy()
    p_values = special.chdtrc(column.size, statistics.clip(min=0))  # by rounding some are negative
    sd, alone = torch.linalg.inv(own).diagonal().sqrt().numpy(), own.diagonal().rsqrt().numpy()
    return Tested(column, place, float(statistics[0]), p_values, steps[0].numpy(), sd, sd, alone=alone)


def _test_of_curve(column: Column, place: slice, scores: Tensor, own: Tensor) -> Tested:
    """A score test against the prior (Liu, Lin and Ghosh 2007): a weighted sum of χ² of one degree of freedom, matched
    by a scaled χ² of the same mean and variance (Satterthwaite)."""
    covariance = prior_covariance(column.variant.effect)
    root = torch.linalg.cholesky(covariance)
    values, turn = torch.linalg.eigh(root.T @ own @ root)
    values = values.clamp(min=0)
    weights = values / (1 + values)
    scale, freedom = float(weights.square().sum() / weights.sum()), float(weights.sum() ** 2 / weights.square().sum())
    statistics = ((scores @ root @ turn).square() / (1 + values)).sum(-1).numpy()
    posterior = torch.linalg.inv(own + torch.linalg.inv(covariance))
    sd = posterior.diagonal().sqrt().numpy()
    return Tested(
        column,
        place,
        float(statistics[0]),
        special.chdtrc(freedom, statistics / scale),
        coefficient=(posterior @ scores[0]).numpy(),
        sd=sd,
        detection_limit=sd,
        evidence=0.5 * float(statistics[0]) - 0.5 * float(torch.log1p(values).sum()),
        alone=own.diagonal().rsqrt().numpy(),
    )


def _departed(departure: Departure, information: Tensor, scores: Tensor) -> Tested:
    """A Wald test of the fitted noise against the declared."""
    step = ridged_inverse(information) @ departure.slope  # a vanished noise has no information
    sd = float((departure.slope @ step).sqrt())
    if not (math.isfinite(departure.away) and 0 < sd < math.inf):
        return replace(_untested(Column(departure.variant), slice(0, 0), NOT_FINITE, len(scores)), departure=True)
    z = torch.cat([torch.tensor([departure.away]).double(), scores[1:] @ step]).numpy() / sd
    p_values = 2 * special.ndtr(-np.abs(z))
    factor = math.exp(departure.on_all)
    sds = np.array([sd * (math.sqrt(departure.share) * factor)])
    column, nowhere, change = Column(departure.variant), slice(0, 0), np.array([factor - 1])
    return Tested(column, nowhere, float(z[0] ** 2), p_values, change, sds, sds, alone=sds, departure=True)


def _largest_canonical_correlations(left: Tensor, places: Sequence[slice]) -> Tensor:
    def whitening(own: Tensor) -> Tensor:
        if not bool((own.diagonal() > 0).all()):
            return torch.zeros_like(own)
        root, failed = torch.linalg.cholesky_ex(own + 1e-10 * torch.diag(own.diagonal()))
        return torch.zeros_like(own) if failed else torch.linalg.inv(root)

    whitened = [whitening(left[place, place]) for place in places]
    correlations = torch.eye(len(places), dtype=torch.float64)
    for j, i in itertools.combinations(range(len(places)), 2):
        across = whitened[i] @ left[places[i], places[j]] @ whitened[j].T
        correlations[i, j] = correlations[j, i] = float(torch.linalg.matrix_norm(across, 2).clamp(max=1.0))
    return correlations


@dataclass(frozen=True)
class Departure:
    """Of the fitted standard deviations of some channels, or of the measurements, from the declared."""

    variant: Variant  # `process_noise` of these channels, or `measurement_noise`
    away: float  # log ratio of fitted to declared, their mean, on the drives that are tested
    on_all: float  # the same of the judges, on the drives of all folds
    share: float  # of the drives that are tested among all
    slope: Tensor  # derivative of `away` in the fitted parameters, (P,)


@torch.no_grad()
def departures(declared: Program, now: Refit, parts: Sequence[Element]) -> list[Departure]:
    """Departures of every group of channels and of the measurements, where their noise is learned and no guess.

    `declared` is the program before it was fitted, `parts` are the learnable numbers of the first fold's program. What
    effects that were added to the program do to its noise is no departure.
    """
    if not parts:
        return []
    program, fold = now.program, now.folds[0]
    effects = {known.parameter for known in attached(program)}
    own = torch.tensor([part.owner not in effects for part in parts])
    guessed = torch.tensor([any(part.name.startswith(guess) for guess in program.guesses) for part in parts])
    found = []
    for name in NOISE_SIZES:
        slope = _slopes_of_spreads(name, program, fold, parts) * own.unsqueeze(-1)
        is_tested = (slope != 0).any(0) & ~(slope[guessed] != 0).any(0)
        away, *judged = (
            _log_spreads(name, one, drives) - _log_spreads(name, as_declared(declared, one), drives)
            for one, drives in zip((program, *now.judges.programs), (fold, *now.folds), strict=True)
        )
        mean = now.mean(judged)
        for variant in sizes_of_noise(program, name):
            if index := [i for i in _places(program, variant, slope.shape[1]) if is_tested[i]]:
                of_first, of_all = float(away[index].mean()), float(mean[index].mean())
                found.append(Departure(variant, of_first, of_all, now.first_share, slope[:, index].mean(1)))
    return found


def sizes_of_noise(program: Program, name: str) -> list[Variant]:
    """One of `NOISE_SIZES` wherever it could act on a program."""
    return [v for effect in catalogue(program) if effect.name == name for v in effect.variants(program)]


@torch.no_grad()
def is_learned(variant: Variant, program: Program, fold: Fold) -> bool:
    """Whether the program's own numbers move the noise that one of `NOISE_SIZES` multiplies."""
    if not (parts := elements(program)):
        return False
    slope = _slopes_of_spreads(variant.effect.name, program, fold, parts)
    return bool((slope[:, _places(program, variant, slope.shape[1])] != 0).any())


def _places(program: Program, variant: Variant, count: int) -> Sequence[int]:
    """The channels or measurements whose noise it multiplies, of `count`."""
    channels = [program.channel_names.index(name) for name in variant.options.get("channels", ())]
    return channels or variant.options.get("columns") or range(count)


def _slopes_of_spreads(effect: str, program: Program, fold: Fold, parts: Sequence[Element]) -> Tensor:
    """Derivatives of `_log_spreads` in learnable numbers, `(P, C)` or `(P, K)`."""
    sides = [on_both_sides(part, partial(_log_spreads, effect, program, fold)) for part in parts]
    return torch.stack([(up - down) / (2 * part.step) for part, (up, down) in zip(parts, sides, strict=True)])


def _log_spreads(effect: str, program: Program, fold: Fold) -> Tensor:
    """Mean log standard deviations over the drives, of the channels `(C,)` or the measurements `(K,)`."""
    if effect == "process_noise":
        spread, there = substep_spreads(program, fold.drives, fold.path.states[None, :-1]), fold.drives.transitions
    else:
        spread, there = measured(program, fold.path.states.unsqueeze(0)).spread, fold.drives.rows
    return spread[0][there].log().mean(0).double()
