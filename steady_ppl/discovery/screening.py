"""The score test of every effect at once, calibrated by drives that the fitted program makes itself.

A Lagrange-multiplier (score) test (Rao 1948) of each candidate, the fitted parameters projected out. The largest of all
candidates is compared with the largest in each simulated set (Westfall and Young 1993), so that the level holds for the
whole catalogue.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import optimize, stats
from torch import Tensor

from steady_ppl.discovery.curves import NAME as CURVE
from steady_ppl.discovery.effect_scores import Column, Simulated
from steady_ppl.discovery.noise_departure import Departure
from steady_ppl.effects import Variant

ALPHA, POWER = 0.05, 0.95
MIN_SHARE_OF_INFORMATION = 1e-4
"""Share of a column's information that the fitted parameters must leave for it to be tested."""
CONTAINED = "the fitted parameters already explain it"
UNEXCITED = "these drives never excite it"


@dataclass(frozen=True)
class Tested:
    """A candidate's test: of its best column where it has several.

    Attributes:
        column: which.
        statistic: the Lagrange multiplier; of a curve, with its prior.
        p_value: of this candidate alone.
        coefficient, sd: one scoring step from zero, and its standard deviation, `(k,)`.
        detection_limit: the coefficient found with 95 % power at the family-wise level, each number alone, `(k,)`.
        evidence: log Bayes factor of a curve, else zero.
        untestable: why it has no test, else None.
        alone: standard deviation of each number when the others are zero, `(k,)`.
        effective: how many independent tests the best of its columns is like.
        departure: whether it says that a fitted σ is not the declared one; there is nothing left to fit then.
    """

    column: Column
    statistic: float
    p_value: float
    coefficient: np.ndarray
    sd: np.ndarray
    detection_limit: np.ndarray
    evidence: float = 0.0
    untestable: str | None = None
    alone: np.ndarray | None = None
    effective: float = 1.0
    departure: bool = False

    @property
    def variant(self) -> Variant:
        """The effect."""
        return self.column.variant

    @property
    def is_curve(self) -> bool:
        """Whether it is no named effect."""
        return self.variant.effect.name == CURVE


@dataclass(frozen=True)
class Screened:
    """All candidates' tests.

    Attributes:
        tested: one a candidate, the smallest p-value first; all curves together are one.
        curves: every curve's test, the largest evidence first.
        p_value: family-wise, of the smallest.
        critical: the single p-value below which the family-wise level is kept.
        fitted: the Lagrange multiplier of the fitted parameters themselves, and how many they are: large where the fit
            has not converged.
        alike: candidate × candidate, the largest canonical correlation of their projected columns.
    """

    tested: list[Tested]
    curves: list[Tested]
    p_value: float
    critical: float
    fitted: tuple[float, int]
    alike: Tensor


def screen(
    observed: Tensor,
    simulated: Simulated,
    fitted: int,
    columns: Sequence[Column],
    departures: Sequence[Departure] = (),
) -> Screened:
    """Test every candidate.

    Args:
        observed: scores of the drives, `(B, N)`: of the `fitted` parameters first and then of the columns.
        simulated: the same of simulated sets.
        fitted: how many parameters were fitted.
        columns: in the order of the scores.
        departures: of the fitted noise from the declared.
    """
    sums = simulated.scores.sum(1)
    bias = sums.mean(0)
    information = simulated.information
    scores = torch.cat([(observed.sum(0) - bias).unsqueeze(0), sums - bias])
    own, rest = slice(0, fitted), slice(fitted, None)
    inverse = torch.linalg.pinv(information[own, own], hermitian=True)  # `lstsq` rounds differently from run to run
    solved = inverse @ information[own, rest]
    left = information[rest, rest] - information[rest, own] @ solved
    left = (left + left.T) / 2
    projected = scores[:, rest] - scores[:, own] @ solved
    before = information[rest, rest].diagonal()

    found, chosen, curves = [], [], []
    for members in _groups(columns):
        tests = [_test(columns[i], _slice(columns, i), projected, left, before) for i in members]
        alive = [test for test in tests if test is not None]
        excited = any(bool((before[_slice(columns, i)] > 0).any()) for i in members)
        found.append(_of_group(columns[members[0]], alive, len(sums), CONTAINED if excited else UNEXCITED))
        chosen.append(min(alive, key=lambda test: test.rank).at if alive else _slice(columns, members[0]))
        curves += [
            _of_group(test.column, [test], len(sums), "")[0]
            for test in alive
            if test.column.variant.effect.name == CURVE
        ]
    for departure in departures:
        found.append(_departed(departure, information[own, own], scores[:, own]))
        chosen.append(slice(0, 0))
    family = np.stack([p_values for _, p_values in found]).min(0)
    critical = _critical(family[1:])
    tested = [replace(t, detection_limit=_limit(t, critical)) for t, _ in found]
    own_step = inverse @ scores[0, own]
    order = sorted(range(len(tested)), key=lambda i: (tested[i].p_value, -tested[i].statistic))
    return Screened(
        tested=[tested[i] for i in order],
        curves=sorted(curves, key=lambda test: -test.evidence),
        p_value=(1 + float((family[1:] <= family[0]).sum())) / len(family),
        critical=critical,
        fitted=(float(scores[0, own] @ own_step), fitted),
        alike=_alike(left, [chosen[i] for i in order]),
    )


def _critical(simulated: np.ndarray) -> float:
    """The largest p-value below which the family's own p-value, (1 + sets as extreme) / (1 + sets), keeps the level."""
    allowed = int(ALPHA * (len(simulated) + 1)) - 1
    return float(np.nextafter(np.sort(simulated)[max(0, allowed)], 0.0))


@dataclass(frozen=True)
class _Found:
    column: Column
    at: slice
    statistic: float
    p_values: np.ndarray
    coefficient: np.ndarray
    sd: np.ndarray
    alone: np.ndarray
    evidence: float = 0.0

    @property
    def rank(self) -> tuple[float, float]:
        """Small where much is found, also where p-values are too small to be told apart."""
        return float(self.p_values[0]), -self.statistic


def _of_group(column: Column, alive: list[_Found], sets: int, otherwise: str) -> tuple[Tested, np.ndarray]:
    """The test of the best of several columns, and its p-values in every set; where there is none, why."""
    if not alive:
        nothing = np.zeros(column.size)
        endless = nothing + math.inf
        return Tested(column, 0.0, 1.0, nothing, endless, endless, untestable=otherwise), np.ones(sets + 1)
    p_values = np.stack([test.p_values for test in alive])
    effective = _effective(p_values[:, 1:].min(0)) if len(alive) > 1 else 1.0
    best = min(alive, key=lambda test: test.rank)
    together = -np.expm1(effective * np.log1p(-np.minimum(p_values.min(0), 1 - 1e-12)))
    tested = Tested(
        column=best.column,
        statistic=best.statistic,
        p_value=float(together[0]),
        coefficient=best.coefficient,
        sd=best.sd,
        detection_limit=best.sd,
        evidence=best.evidence,
        alone=best.alone,
        effective=effective,
    )
    return tested, together


def _limit(tested: Tested, critical: float) -> np.ndarray:
    """The size of each number, the others zero, at which a noncentral χ² passes the family's level with 95 %."""
    nothing = np.full(len(tested.coefficient), math.inf)
    if tested.untestable or tested.is_curve or tested.alone is None or not math.isfinite(tested.variant.effect.null):
        return nothing
    size = len(tested.coefficient)
    level = -math.expm1(math.log1p(-critical) / tested.effective)
    threshold = stats.chi2.isf(level, size)
    needed = optimize.brentq(lambda away: stats.ncx2.sf(threshold, size, away) - POWER, 1e-6, 1e4)
    return math.sqrt(needed) * tested.alone


def _test(column: Column, at: slice, projected: Tensor, left: Tensor, before: Tensor) -> _Found | None:
    own, scores = left[at, at], projected[:, at]
    if column.variant.effect.name == CURVE:
        return _test_of_curve(column, at, scores, own) if bool((own.diagonal() > 0).any()) else None
    if not bool((before[at] > 0).all()) or not bool((own.diagonal() > MIN_SHARE_OF_INFORMATION * before[at]).all()):
        return None
    steps = torch.linalg.solve(own, scores.T).T
    statistics = (scores * steps).sum(-1).numpy()
    return _Found(
        column=column,
        at=at,
        statistic=float(statistics[0]),
        p_values=stats.chi2.sf(statistics, column.size),
        coefficient=steps[0].numpy(),
        sd=torch.linalg.inv(own).diagonal().sqrt().numpy(),
        alone=own.diagonal().rsqrt().numpy(),
    )


def _test_of_curve(column: Column, at: slice, scores: Tensor, own: Tensor) -> _Found:
    """A score test against the prior (Liu, Lin and Ghosh 2007): a weighted sum of χ² of one degree of freedom, matched
    by a scaled χ² of the same mean and variance (Satterthwaite)."""
    covariance = column.variant.effect.prior.covariance_matrix.double()
    root = torch.linalg.cholesky(covariance)
    values, turn = torch.linalg.eigh(root.T @ own @ root)
    values = values.clamp(min=0)
    squares = (scores @ root @ turn).square() / (1 + values)
    weights = values / (1 + values)
    scale, freedom = float(weights.square().sum() / weights.sum()), float(weights.sum() ** 2 / weights.square().sum())
    statistics = squares.sum(-1).numpy()
    posterior = torch.linalg.inv(own + torch.linalg.inv(covariance))
    return _Found(
        column=column,
        at=at,
        statistic=float(statistics[0]),
        p_values=stats.chi2.sf(statistics / scale, freedom),
        coefficient=(posterior @ scores[0]).numpy(),
        sd=posterior.diagonal().sqrt().numpy(),
        alone=own.diagonal().rsqrt().numpy(),
        evidence=0.5 * float(statistics[0]) - 0.5 * float(torch.log1p(values).sum()),
    )


def _departed(departure: Departure, information: Tensor, scores: Tensor) -> tuple[Tested, np.ndarray]:
    """A Wald test of the fitted noise against the declared."""
    ridge = 1e-10 * float(information.diagonal().max()) * torch.eye(len(information)).double()
    step = torch.linalg.solve(information + ridge, departure.slope)  # a vanished noise has no information
    sd = float((departure.slope @ step).sqrt())
    z = torch.cat([torch.tensor([departure.away]).double(), scores[1:] @ step]).numpy() / sd
    p_values = 2 * stats.norm.sf(np.abs(z))
    sd *= math.sqrt(departure.share) * departure.factor
    tested = Tested(
        column=Column(departure.variant),
        statistic=float(z[0] ** 2),
        p_value=float(p_values[0]),
        coefficient=np.array([departure.factor - 1]),
        sd=np.array([sd]),
        detection_limit=np.array([sd]),
        alone=np.array([sd]),
        departure=True,
    )
    return tested, p_values


def _effective(smallest: np.ndarray) -> float:
    """How many independent tests the smallest of several p-values is like, from its median under the program."""
    median = float(np.clip(np.median(smallest), 1e-6, 0.5))
    return max(1.0, math.log(0.5) / math.log1p(-median))


def _groups(columns: Sequence[Column]) -> list[list[int]]:
    groups: dict[str, list[int]] = {}
    for index, column in enumerate(columns):
        effect = column.variant.effect.name
        groups.setdefault(CURVE if effect == CURVE else column.variant.name, []).append(index)
    return list(groups.values())


def _slice(columns: Sequence[Column], index: int) -> slice:
    first = sum(column.size for column in columns[:index])
    return slice(first, first + columns[index].size)


def _alike(left: Tensor, chosen: Sequence[slice]) -> Tensor:
    """Largest canonical correlations between the candidates' columns."""
    count = len(chosen)
    whitened = []
    for at in chosen:
        own = left[at, at]
        if bool((own.diagonal() > 0).all()):
            whitened.append(torch.linalg.inv(torch.linalg.cholesky(own + 1e-10 * torch.diag(own.diagonal()))))
        else:
            whitened.append(torch.zeros_like(own))
    alike = torch.eye(count, dtype=torch.float64)
    for i in range(count):
        for j in range(i):
            across = whitened[i] @ left[chosen[i], chosen[j]] @ whitened[j].T
            alike[i, j] = alike[j, i] = float(torch.linalg.matrix_norm(across, 2).clamp(max=1.0))
    return alike
