"""Where, when and in which regime residuals are not what the program makes of itself.

Residuals are averaged with their signs over cells: drives, strips of time, ranges of controls and of state variables,
and over products with the controls and with themselves some rows before. Every cell is compared with the same cell of
simulated drives, and false discoveries are controlled over all cells together (Benjamini and Hochberg 1995). The mean
square of a residual would be nearly blind to a missing effect; it serves to widen the bands where residuals scatter
more than the program says (the dispersion of quasi-likelihood, McCullagh and Nelder 1989), so that wrong noise is not
taken for a wrong mean.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy import special

from steady_ppl.errors import DataError
from steady_ppl.utils.cores import one_thread

MAX_TIME_STRIPS, REGIME_BINS, PAIR_BINS = 10, 5, 4  # of a drive, and ranges of a variable alone or of two each
MIN_RESIDUALS = 8  # residuals in a cell
LAGS = (0, 1, 2, 5, 10)  # rows
MIN_SHARE_OF_SETS_WITH_CELL = 0.5  # of the simulated sets that must have a cell, too
CHECK_LEVEL = 0.05  # of false discoveries among cells, and of all tests of `attribution` together

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Residuals:
    """`R` residuals of `M` sets of the same `B` drives, at each interval."""

    names: Sequence[str]
    values: Array  # (M, T, B, R), standardised, zero where there is none
    there: Array  # of the same shape, bool
    variables: dict[str, Array] = field(default_factory=dict)  # what the intervals are sorted by, (M, T, B) each
    raw: Array | None = None  # of the first set, those with a unit in it, (T, B, ·)

    @cached_property
    def present(self) -> list[tuple[Any, Array]]:
        """Where each residual is, counted through all sets, intervals and drives, and its values there."""
        found: list[tuple[Any, Array]] = []
        for residual in range(len(self.names)):
            there, values = self.there[..., residual], self.values[..., residual].ravel()
            at = slice(None) if there.all() else np.flatnonzero(there)
            found.append((at, values[at]))
        return found

    @cached_property
    def mean_squares(self) -> Array:
        """Of each residual in each set, `(M, R)`."""
        return (self.values**2).sum((1, 2)) / np.maximum(self.there.sum((1, 2)), 1)

    @staticmethod
    def concatenated(parts: Sequence[Residuals]) -> Residuals:
        """The sets of all parts, one part after another."""
        return replace(
            parts[0],
            values=np.concatenate([one.values for one in parts]),
            there=np.concatenate([one.there for one in parts]),
            variables={name: np.concatenate([one.variables[name] for one in parts]) for name in parts[0].variables},
        )


@dataclass(frozen=True)
class Cell:
    """What a statistic is an average over."""

    map: str  # "all", "drive", "time", "drive and time", "regime", "pair", "lag" or "memory"
    residual: int  # its number
    where: dict[str, Any]  # what tells the cell from others of its map, for example {"left": (0.2, 0.6)}
    count: int  # residuals in it
    mean: float | None = None  # of the residuals, in their unit; None where they have none


Averaged = Iterator[tuple[Cell, Array]]  # each with its statistic in each set, (1 + M,)


@dataclass(frozen=True)
class SignificantCell:
    """A cell whose average lies outside the simulated band."""

    cell: Cell
    z: float  # how far from the simulated mean, in simulated standard deviations
    p_value: float  # of this cell alone, two-sided


@dataclass(frozen=True)
class Misfit:
    """All cells, judged."""

    cells: list[Cell]
    z: Array  # one a cell
    significant: list[SignificantCell]  # at a false-discovery rate of 5 %, strongest first
    p_values: Array  # (1 + M,): of the hypothesis that a set has nothing, by Simes' test, calibrated on the simulated
    simulated: Array  # Simes' own p-value of each simulated set, (M,)
    dispersion: Array  # mean square of each residual over that of the simulated ones, (R,); NaN where there are none

    @property
    def p_value(self) -> float:
        """Of the real set."""
        return float(self.p_values[0])

    def of_map(self, name: str) -> list[tuple[Cell, float]]:
        """The cells of one map, each with its z."""
        return [(cell, float(z)) for cell, z in zip(self.cells, self.z, strict=True) if cell.map == name]


def misfit_of(
    both: Residuals, time: Array, controls: dict[str, Array], pairs: Sequence[tuple[str, str]], unexplained: Array
) -> Misfit:
    """Compare every cell of one real set with those of many simulated ones.

    Args:
        both: the real set first.
        time: s since each drive's first row, `(T, B)`.
        controls: `(T, B)` each; they sort the intervals and are correlated with the residuals.
        pairs: names of variables that make a map together.
        unexplained: dispersion of every set that no effect on the mean explains; no band is widened by more.

    Raises:
        DataError: too few residuals to average anywhere.
    """
    found = list(_all_cells(both, time, controls, pairs))
    if not (cells := [cell for cell, _ in found]):
        rows, drives = time.shape
        what = f"{drives} trajectories of at most {rows} intervals hold no place, time or regime"
        raise DataError(f"{what} with enough residuals to average: take more trajectories, or longer ones")
    average = np.stack([average for _, average in found], -1)  # (1 + M, cells)
    squares, typical = both.mean_squares, both.mean_squares[1:].mean(0)
    dispersion = np.divide(squares, typical, out=np.full_like(squares, np.nan), where=typical > 0)
    z, freedom = standardise(average)
    z /= np.sqrt(np.minimum(dispersion, unexplained[:, None]).clip(1.0))[:, [cell.residual for cell in cells]]
    p_values = 2 * special.stdtr(freedom, -np.abs(z))
    rates = np.stack([_adjusted(row) for row in p_values])
    simes = rates.min(1)
    level = min(CHECK_LEVEL, float(np.quantile(simes[1:], CHECK_LEVEL, method="lower")))  # t's tails are a model, too
    chosen = np.flatnonzero(rates[0] <= level)
    findings = [SignificantCell(cells[i], float(z[0, i]), float(p_values[0, i])) for i in chosen]
    return Misfit(
        cells=cells,
        z=z[0],
        significant=sorted(findings, key=lambda finding: -abs(finding.z)),
        p_values=np.maximum(simes, tail_p_values(-np.log(np.maximum(simes, 1e-300)))),
        simulated=simes[1:],
        dispersion=dispersion[0],
    )


def standardise(values: Array) -> tuple[Array, int]:
    """Each row of `(1 + M, ...)` against the simulated ones, all but the first, in standard deviations, and the degrees
    of freedom. A simulated row is compared with the others; NaN, where a set has no value, counts as nothing found."""
    simulated = values[1:]
    count = np.maximum(np.isfinite(simulated).sum(0), 3)
    mean, variance = np.nanmean(simulated, 0), np.nanvar(simulated, 0) * count / (count - 1)
    spread = np.sqrt(np.maximum(variance, 1e-300) * (1 + 1 / count))
    away = simulated - mean
    left_out = away * count / (count - 1)
    variance_left = np.maximum(((count - 1) * variance - away * left_out) / (count - 2), 1e-300)
    z = np.concatenate([((values[:1] - mean) / spread), left_out / np.sqrt(variance_left * (1 + 1 / (count - 1)))])
    return np.nan_to_num(z), len(simulated) - 1


def tail_p_values(values: Array) -> Array:
    """How often a maximum is as large as each value `(1 + M,)`: Gumbel's distribution with the moments of all but the
    first."""
    scale = max(float(values[1:].std(ddof=1)), 1e-12) * math.sqrt(6) / math.pi
    away = (values - values[1:].mean()) / scale
    return -np.expm1(-np.exp(np.minimum(-away - np.euler_gamma, 700.0)))


def _adjusted(p_values: Array) -> Array:
    """The false-discovery rates at which each is just found; those of `scipy.stats` take half a second to load."""
    order, count = np.argsort(p_values), len(p_values)
    rates = p_values[order] * count / np.arange(1, count + 1)
    return np.minimum.accumulate(rates[::-1])[::-1].clip(max=1.0)[np.argsort(order)]


def _all_cells(data: Residuals, time: Array, controls: dict[str, Array], pairs: Sequence[tuple[str, str]]) -> Averaged:
    """Every cell; its statistic is the sum over the root of the count."""
    inside = data.there[0].any(-1)
    drives = np.broadcast_to(np.arange(time.shape[1]), time.shape)
    edges = np.linspace(0, time[inside].max() * (1 + 1e-9) + 1e-9, min(MAX_TIME_STRIPS, max(1, len(time) // 5)) + 1)
    strip = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, len(edges) - 2)
    strips = [{"time": (float(a), float(b))} for a, b in itertools.pairwise(edges)]
    each = [{"drive": drive} for drive in range(time.shape[1])]
    yield from _sums(data, "all", np.zeros(time.shape, int), [{}])
    yield from _sums(data, "drive", drives, each)
    if len(strips) > 1:
        yield from _sums(data, "time", strip, strips)
        both = [drive | when for drive in each for when in strips]
        yield from _sums(data, "drive and time", drives * len(strips) + strip, both)
    sorted_by = {name: value[None] for name, value in controls.items()} | data.variables
    for name, values in sorted_by.items():
        labels, ranges = _binned(values, inside, REGIME_BINS)
        if ranges:
            yield from _sums(data, "regime", labels, [{name: between} for between in ranges])
    for first, second in pairs:
        (one, ranges), (other, across) = (_binned(sorted_by[name], inside, PAIR_BINS) for name in (first, second))
        if ranges and across:
            where = [{first: a, second: b} for a in ranges for b in across]
            yield from _sums(data, "pair", one * len(across) + other, where)
    yield from _correlations(data, inside, controls)


def _binned(values: Array, inside: Array, bins: int) -> tuple[Array, list[tuple[float, float]]]:
    """Numbers of the ranges that hold equally many of a set's values, `(1 + M, T, B)`, and the first set's ranges, none
    where its values are all the same.

    Every set has ranges of its own: a single drive dwells in the ranges that its own values make and would pass through
    those of another, so that averages in them would scatter less.
    """
    edges = np.quantile(values[:, inside], np.linspace(0, 1, bins + 1), axis=1).astype(values.dtype)
    labels = sum(values >= edge[:, None, None] for edge in edges[1:-1])
    ranges = [(float(a), float(b)) for a, b in itertools.pairwise(edges[:, 0])]
    return np.asarray(labels), ranges if edges[0, 0] < edges[-1, 0] else []


def _sums(data: Residuals, kind: str, labels: Array, where: list[dict[str, Any]]) -> Averaged:
    sets = len(data.values)
    index = np.broadcast_to(labels, data.there.shape[:-1]) + len(where) * np.arange(sets)[:, None, None]
    size, flat = sets * len(where), index.ravel()
    for residual in range(len(data.names)):
        there, (present, values) = data.there[..., residual], data.present[residual]
        at = flat[present]
        count = np.bincount(at, minlength=size).reshape(sets, -1)
        total = np.bincount(at, values, minlength=size).reshape(sets, -1)
        enough = count >= MIN_RESIDUALS
        average = np.where(enough, total / np.sqrt(np.maximum(count, 1)), np.nan)
        mean: list[float | None] = [None] * len(where)  # of the first set, in the residual's unit
        if data.raw is not None and residual < data.raw.shape[-1]:
            raw = np.bincount(index[0][there[0]], data.raw[..., residual][there[0]], minlength=len(where))
            mean = (raw / np.maximum(count[0], 1)).tolist()
        for cell, place in enumerate(where):
            if enough[0, cell] and enough[1:, cell].mean() > MIN_SHARE_OF_SETS_WITH_CELL:
                yield Cell(kind, residual, place, int(count[0, cell]), mean[cell]), average[:, cell]


def _correlations(data: Residuals, inside: Array, controls: dict[str, Array]) -> Averaged:
    """With the controls, with their changes and with the residual itself, some rows before."""
    regressors = {}
    for name, told in controls.items():
        values = told / (np.abs(told[inside]).max() or 1.0)
        regressors[name] = np.where(inside, values - values[inside].mean(), 0.0)
        regressors[f"change of {name}"] = np.where(inside, np.diff(values, axis=0, prepend=values[:1]), 0.0)
    given = np.array([*regressors.values()]).reshape(len(regressors), *inside.shape)  # none without controls
    for residual in range(len(data.names)):
        values, there = data.values[..., residual], data.there[..., residual]
        for lag in (lag for lag in LAGS if lag < len(inside) // 2):
            now, before = slice(lag, None), slice(0, len(inside) - lag)
            squares = _products(given[:, before] ** 2, there[:, now])
            products = _products(given[:, before], values[:, now]) / np.sqrt(np.maximum(squares, 1e-12))
            for name, square, product in zip(regressors, squares, products, strict=True):
                if square[0] > 1e-12:
                    yield Cell("lag", residual, {name: lag}, int(there[0, now].sum())), product
            both = there[:, now] & there[:, before]
            if lag and both[0].sum() >= MIN_RESIDUALS:
                product = (values[:, now] * values[:, before]).sum((1, 2)) / np.sqrt(np.maximum(both.sum((1, 2)), 1))
                yield Cell("memory", residual, {"lag": lag}, int(both[0].sum())), product


def _products(regressors: Array, values: Array) -> Array:
    """Sums over rows and drives of each regressor `(N, T, B)` times each set's values `(M, T, B)`, `(N, M)`."""
    cells = values[0].size
    one, other = (np.ascontiguousarray(part, np.float64).reshape(len(part), cells) for part in (regressors, values))
    with one_thread():
        return (torch.from_numpy(one) @ torch.from_numpy(other).T).numpy()
