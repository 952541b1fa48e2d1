"""Regressions of accelerations on the catalogue's columns, as others do them: as if all rows were independent."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from rival_columns import Evidence, candidates, evidence
from rival_poses import POSE, Motion, Poses, moving
from torch import Tensor

from steady_ppl import Program, Trajectories

Array = np.ndarray
THRESHOLDS = np.geomspace(1e-3, 1.0, 31)  # of coefficients that belong to columns and targets of unit size
ENTERS = 20.0  # F at which a regressor enters and stays: Klein and Morelli's choice for real flight data
LEVEL = 0.05
VELOCITY = slice(POSE, 2 * POSE)


@dataclass(frozen=True)
class Rows:
    """A regression problem.

    Attributes:
        names: of the columns' effects.
        labels: with place, knee and probe.
        columns: `(R, N)`.
        own: of the program's own parameters, `(R, P)`.
        target: `(R,)`.
    """

    names: tuple[str, ...]
    labels: tuple[str, ...]
    columns: Array
    own: Array
    target: Array

    def and_also(self, other: Rows) -> Rows:
        """The rows of both."""
        pairs = ((self.columns, other.columns), (self.own, other.own), (self.target, other.target))
        return Rows(self.names, self.labels, *(np.concatenate(pair) for pair in pairs))

    def without_own(self) -> Rows:
        """What the program's own parameters do not explain."""
        basis = np.linalg.qr(self.own)[0]
        columns, target = (part - basis @ (basis.T @ part) for part in (self.columns, self.target))
        return replace(self, columns=columns, target=target)


def rows_of(found: Evidence, target: Tensor, variance: Tensor | None = None) -> Rows:
    """One row a time, drive and channel, weighted by its target's variance if that is known."""
    weight = target.new_ones(target.shape) if variance is None else variance.rsqrt()
    columns, own = ((part * weight[..., None]).flatten(0, -2).numpy() for part in (found.columns, found.own))
    return Rows(found.names, found.labels, columns, own, (target * weight).flatten().double().numpy())


def strong(
    program: Program, drives: Sequence[Trajectories], found: Sequence[Poses], window: int, withheld: Sequence[str]
) -> list[Rows]:
    """Accelerations less what the program explains, in standard deviations of its noise, for each table.

    Args:
        program: as it stands.
        drives: tables, the first one decides about places and knees.
        found: their poses.
        window: rows.
        withheld: effects that are left out.
    """
    rows = []
    for data, motion, known in _described(program, drives, found, window, withheld):
        by_channel = torch.linalg.pinv(known.entry)
        gained = motion.states[:-1] + data.steps[..., None] * motion.rates[:-1] - known.drift
        uncertain = data.steps[..., None] ** 2 * motion.variance[:-1]
        variance = 1 + by_channel[..., VELOCITY].square() @ uncertain[..., None]
        rows.append(rows_of(known, (by_channel @ gained[..., None])[..., 0], variance[..., 0]))
    return rows


def weak(
    program: Program, drives: Sequence[Trajectories], found: Sequence[Poses], window: int, withheld: Sequence[str]
) -> list[Rows]:
    """The same integrated against bumps (1 - s²)⁴ of `window` rows, by parts, so that only poses are needed."""
    rows = []
    for seen, (data, motion, known) in zip(found, _described(program, drives, found, window, withheld), strict=True):
        bumps = _bumps(len(data.steps), window)
        curved = _second_differences(bumps) / float(data.steps[0, 0])
        explained = known.drift[..., VELOCITY] - motion.states[:-1, ..., VELOCITY]
        target = _integrated(curved, seen.values) - _integrated(bumps, explained)
        entry = known.entry[..., VELOCITY, :]
        columns, own = (torch.einsum("wt,tbic,tbcn->wbin", bumps, entry, part) for part in (known.columns, known.own))
        variance = _integrated(curved**2, seen.variance) + _integrated(bumps**2, entry.square().sum(-1))
        rows.append(rows_of(replace(known, columns=columns, own=own), target, variance))
    return rows


def _described(
    program: Program, drives: Sequence[Trajectories], found: Sequence[Poses], window: int, withheld: Sequence[str]
) -> Iterator[tuple[Trajectories, Motion, Evidence]]:
    variants = None
    for data, seen in zip(drives, found, strict=True):
        motion = moving(seen, float(data.steps[0, 0]), window)
        if variants is None:
            variants = candidates(program, replace(data, states=motion.states), withheld)
        yield data, motion, evidence(program, data, motion.states.to(data.controls), variants)


def _integrated(bumps: Tensor, values: Tensor) -> Tensor:
    """`(W, rows)` and `(rows, B, I)` to `(W, B, I)`."""
    return torch.einsum("wt,tbi->wbi", bumps, values)


def _bumps(rows: int, window: int) -> Tensor:
    """Test functions on `rows` rows that vanish at their ends, a quarter of a window apart, `(W, rows)`."""
    shape = (1 - torch.linspace(-1, 1, window + 2)[1:-1].double() ** 2) ** 4
    starts = range(1, rows - window - 1, max(1, window // 4))
    bumps = torch.zeros(len(starts), rows, dtype=torch.double)
    for bump, start in zip(bumps, starts, strict=True):
        bump[start : start + window] = shape / shape.sum()
    return bumps


def _second_differences(bumps: Tensor) -> Tensor:
    """Σ φ(t) [p(t + 2) - 2 p(t + 1) + p(t)] as weights of p, `(W, rows + 1)`."""
    wide = torch.nn.functional.pad(bumps, (2, 1))
    return wide[:, :-2] - 2 * wide[:, 1:-1] + wide[:, 2:]


def sparse(train: Rows, valid: Rows) -> tuple[list[str], bool]:
    """Effects by the threshold up to which PySINDy's optimiser keeps them, and whether the best threshold keeps any.

    The threshold is the one with the least squared error on the validation drives.
    """
    from pysindy import STLSQ

    fit, judge = train.without_own(), valid.without_own()
    size = np.sqrt((fit.columns**2).mean(0))
    size[size <= 1e-6 * np.sqrt((train.columns**2).mean(0))] = np.inf  # the program has it, or nothing excites it
    unit = np.sqrt((fit.target**2).mean())
    lasting, kept, best = dict.fromkeys(fit.names, (0.0, 0.0)), False, np.inf
    for threshold in THRESHOLDS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that nothing is left
            optimiser = STLSQ(threshold=threshold, alpha=1e-3 * len(fit.target))
            coefficients = optimiser.fit(fit.columns / size, fit.target[:, None] / unit).coef_[0]
        error = float(((judge.target / unit - judge.columns / size @ coefficients) ** 2).mean())
        if error <= best:
            best, kept = error, bool(coefficients.any())
        for name, value in zip(fit.names, np.abs(coefficients), strict=True):
            if value > 0:
                lasting[name] = max(lasting[name], (float(threshold), float(value)))
    return sorted(lasting, key=lambda name: lasting[name], reverse=True), kept


def by_f_ratios(train: Rows, valid: Rows) -> tuple[list[str], bool]:
    """Effects in the order in which they enter, and whether any stays.

    One enters if its F ratio is the largest, above `ENTERS`, and the predicted squared error falls with it; one whose
    ratio has fallen below leaves. The others follow by their last ratio.
    """
    problem = Least(train.and_also(valid))
    chosen: list[str] = []
    ratios: dict[str, float] = {}
    for _ in range(10):
        taken = {problem.names[label] for label in chosen}
        ratios = {label: problem.ratio(label, chosen) for label, name in problem.names.items() if name not in taken}
        best = max(ratios, key=lambda label: ratios[label])
        if ratios[best] < ENTERS or problem.predicted_error([*chosen, best]) >= problem.predicted_error(chosen):
            break
        chosen.append(best)
        chosen = [one for one in chosen if problem.ratio(one, [label for label in chosen if label != one]) >= ENTERS]
    rest = sorted(ratios, key=lambda label: -ratios[label])
    return list(dict.fromkeys(problem.names[label] for label in [*chosen, *rest])), bool(chosen)


def one_by_one(rows: Rows) -> tuple[list[str], bool]:
    """Effects by the p-value of each one's own F test, and whether the least survives Bonferroni's correction."""
    from scipy import stats

    problem = Least(rows)
    tests = {}
    for label in problem.names:
        ratio, size = problem.ratio(label, []), problem.size([label])
        tests[label] = (stats.f.logsf(ratio, size, problem.free - size), -ratio)
    order = sorted(tests, key=lambda label: tests[label])
    detected = bool(tests[order[0]][0] < np.log(LEVEL / len(order)))
    return list(dict.fromkeys(problem.names[label] for label in order)), detected


class Least:
    """Least squares of a target on the columns of some labels and on the program's own parameters.

    Args:
        rows: of the regression.
    """

    def __init__(self, rows: Rows) -> None:
        own, rows = rows.own.shape[1], rows.without_own()
        self.free = len(rows.target) - own
        self.square, self.across = rows.columns.T @ rows.columns, rows.columns.T @ rows.target
        self.total = float(rows.target @ rows.target)
        self.names = dict(zip(rows.labels, rows.names, strict=True))
        self.members = {label: [i for i, other in enumerate(rows.labels) if other == label] for label in self.names}

    def left(self, labels: Sequence[str]) -> float:
        """The sum of squares that some labels leave."""
        at = [i for label in labels for i in self.members[label]]
        solved = np.linalg.lstsq(self.square[np.ix_(at, at)], self.across[at], rcond=1e-10)[0]
        return self.total - float(self.across[at] @ solved)

    def size(self, labels: Sequence[str]) -> int:
        """How many columns some labels have."""
        return sum(len(self.members[label]) for label in labels)

    def ratio(self, label: str, among: Sequence[str]) -> float:
        """The F ratio of one label beside others."""
        without, whole = self.left(among), self.left([*among, label])
        return (without - whole) / self.size([label]) / (whole / (self.free - self.size([*among, label])))

    def predicted_error(self, labels: Sequence[str]) -> float:
        """Mean square of what is left, and what the labels may have fitted of the noise (Barron 1984)."""
        return (self.left(labels) + self.total / self.free * self.size(labels)) / self.free
