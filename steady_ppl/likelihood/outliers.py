"""Measurements that no noise of the sensor explains: runs of wrong cells, as a position fix that jumps for some rows.

A contamination model: a cell is read as the program says, or it is any number in the column's range. Runs of wrong
cells are dropped one by one, each the run that gains most, as long as that is more than the run costs by chance. A run
is judged as a whole, for the cells of a jump that lasts agree with each other (masking: Justel, Peña and Tsay 2001).
Every column has a robust standard deviation of its own in this, so that a noise that is declared too narrow makes no
outliers. A Student t is compared with it: tails that wrong readings of every size have are no outliers.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from scipy import optimize
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.information_filter import Lookahead, look_ahead
from steady_ppl.gaussian.linearize import Linearization, ReferencePath
from steady_ppl.gaussian.smoother import smooth
from steady_ppl.model.problem import Problem

MIN_SD_OF_PEAK = 5.0  # of a cell's residual given all others, in robust standard deviations: runs are tried around it
RUN_ROWS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89)  # lengths of runs that are tried
OTHER_PEAKS = 6  # rows of a column that are farthest off, at which a run may end as well
ROWS_OFF = (0, 1, 2, 3, 4, 8, 13, 21, 34)  # at either end of the best run, that may be taken off
MAX_LINES = 8  # of text
MAX_RUNS = 12  # of a trajectory
MAX_SHARE = 0.1  # of a column's cells: where more look wrong, the program is
WRITES_WITHOUT = "`steady check --mask` writes the table without them"
AS_TAILS = "readings are far off at all distances, as heavy tails have them: none is left out"
NORMAL_MEDIAN = 0.6745  # of |z| of a standard normal
PASSES_OF_SD = 3  # in which robust standard deviations are found
ROBUST_RANGE = (0.1, 10.0)  # of a column's robust standard deviation over the declared one
DEGREES_OF_FREEDOM = (2.0, 3.0, 4.0, 6.0, 10.0)  # of the Student t that is compared


@dataclass(frozen=True)
class Outlier:
    """A run of wrong cells."""

    drive: int
    label: str  # the trajectory's
    rows: tuple[int, int]  # the first and the last, from 0
    seconds: tuple[float, float]  # when these are, from the trajectory's first row
    columns: tuple[str, ...]  # as the table names them
    away: float  # the largest distance from what all other cells say, in the sensor's robust standard deviations
    gain: float  # nats that the rest is likelier by, less `cost`
    cost: float  # nats by which wrong readings are less likely than nothing: of their values, and of such a run

    def __str__(self) -> str:
        begin, end = self.seconds
        when = f"at {begin:.2f} s" if begin == end else f"between {begin:.2f} and {end:.2f} s"
        return f"trajectory {self.label} {when}: {', '.join(self.columns)} {self.away:.0f} sd away from all else"


@dataclass(frozen=True)
class Outliers:
    """What of some drives is wrong."""

    data: Trajectories  # the drives with all that was read
    found: list[Outlier]
    wrong: Tensor  # (T + 1, B, K) bool
    note: str = ""  # why nothing is called wrong although much looks so

    @property
    def cells(self) -> int:
        return int(self.wrong.sum())

    @property
    def left(self) -> Trajectories:
        """The drives without what is wrong."""
        return self.data.without(self.wrong)

    def without(self, table: Trajectories) -> Trajectories:
        """The table of these drives without what is wrong; it may have further columns."""
        places = [table.measurement_names.index(name) for name in self.data.measurement_names]
        cells = torch.zeros_like(table.observed)
        cells[..., places] = self.wrong
        return table.without(cells)

    def with_more(self, other: Outliers) -> Outliers:
        """These and those that were found in what they leave."""
        found = _in_order([*self.found, *other.found])
        return replace(self, found=found, wrong=self.wrong | other.wrong, note=self.note or other.note)

    def shared_with(self, other: Outliers) -> Outliers:
        """Those of these drives that another program finds wrong too."""
        wrong = self.wrong & other.wrong
        shared = (self._narrowed(one, wrong) for one in self.found)
        return replace(self, found=[one for one in shared if one is not None], wrong=wrong)

    def _narrowed(self, run: Outlier, wrong: Tensor) -> Outlier | None:
        """The rows and columns of a run in which cells are wrong."""
        places = [self.data.measurement_names.index(name.removeprefix("y.")) for name in run.columns]
        cells = wrong[run.rows[0] : run.rows[1] + 1, run.drive][:, places]
        if not bool(cells.any()):
            return None
        rows = [run.rows[0] + row for row in cells.any(1).nonzero().flatten().tolist()]
        columns = tuple(run.columns[at] for at in cells.any(0).nonzero().flatten().tolist())
        begin, end = self.data.elapsed[[rows[0], rows[-1]], run.drive].tolist()
        return replace(run, rows=(rows[0], rows[-1]), seconds=(begin, end), columns=columns)

    @property
    def cost(self) -> float:
        return sum(one.cost for one in self.found)

    def lines(self, drives: str = "", how: str = WRITES_WITHOUT) -> list[str]:
        """As text, the clearest first; empty where nothing is wrong. `drives` says which they are, `how` what to do."""
        if not self.found:
            return []
        clearest = sorted(self.found, key=lambda one: -one.gain)
        more = len(clearest) - MAX_LINES
        count = f"{self.cells} reading{'s' * (self.cells > 1)}"
        of_which = f" of the {drives} trajectories" if drives else ""
        lines = [f"{count}{of_which} left out as wrong ({how}):"]
        lines += [f"  {one}" for one in clearest[:MAX_LINES]]
        return lines + [f"  and {more} more"] * (more > 0)

    @property
    def figures(self) -> list[dict[str, Any]]:
        """Ready for JSON."""
        return [
            {"trajectory": one.label, "seconds": list(one.seconds), "columns": list(one.columns), "text": str(one)}
            for one in self.found
        ]


@torch.no_grad()
def find_outliers(problem: Problem, path: ReferencePath, *, against_tails: bool = True) -> Outliers:
    """Look for wrong cells of a fitted program's drives, from a path near their posterior means.

    `against_tails` keeps them all where a Student t, compared on residuals, explains them better.
    """
    data, none = problem.data, torch.zeros_like(problem.data.observed)
    own = _Robust.declared(smooth(problem, path)).with_median_sd()
    found, wrong, active = list[Outlier](), none.clone(), own.peaks.nonzero().flatten()
    log_range, units = _log_ranges(data), problem.program.measurement_units
    by_chance = math.log(max(1, int(data.observed.sum()))) + math.log(len(RUN_ROWS))
    for _ in range(MAX_RUNS):
        if not len(active):
            break
        part = Problem(problem.program, data.subset(active).without(wrong[:, active]), problem.known_start)
        robust = _Robust.declared(smooth(part, path.subset(active))).with_sd(own.sd)
        best = _best_runs(robust, part.data, log_range, units, by_chance)
        for place, run in best.items():
            drive = int(active[place])
            wrong[:, drive] |= run.cells
            found.append(_outlier(data, drive, run, float(robust.z[:, place][run.cells].abs().max())))
        active = active[sorted(best)]
    if against_tails and found and own.gain_of_tails() > sum(one.gain for one in found):
        return Outliers(data, [], none, AS_TAILS)
    if said := too_many(data, wrong):
        return Outliers(data, [], none, said)
    return Outliers(data, _in_order(found), wrong)


def _log_ranges(data: Trajectories) -> Tensor:
    """Logarithms of the columns' ranges, `(K,)`."""
    columns = zip(data.measurements.double().unbind(-1), data.observed.unbind(-1), strict=True)
    seen = [values[there] for values, there in columns]
    ranges = [float(values.max() - values.min()) if len(values) else 0.0 for values in seen]
    logs = [math.log(one) if one > 0 else 0.0 for one in ranges]
    return torch.tensor(logs, dtype=torch.float64, device=data.measurements.device)


def _outlier(data: Trajectories, drive: int, run: Run, away: float) -> Outlier:
    rows, columns = (run.cells.any(dim).nonzero().flatten().tolist() for dim in (1, 0))
    names = tuple(f"y.{data.measurement_names[column]}" for column in columns)
    seconds = (float(data.elapsed[rows[0], drive]), float(data.elapsed[rows[-1], drive]))
    return Outlier(drive, data.labels[drive], (rows[0], rows[-1]), seconds, names, away, run.gain, run.cost)


def _in_order(found: Sequence[Outlier]) -> list[Outlier]:
    """Runs by trajectory and row; those of the same columns that touch each other are one."""
    merged = list[Outlier]()
    for one in sorted(found, key=lambda one: (one.drive, one.columns, one.rows)):
        before = merged[-1] if merged else one
        alike = (before.drive, before.columns) == (one.drive, one.columns)
        if merged and alike and one.rows[0] <= before.rows[1] + 1:
            later = max(before, one, key=lambda run: run.rows[1])
            merged[-1] = replace(
                before,
                rows=(before.rows[0], later.rows[1]),
                seconds=(before.seconds[0], later.seconds[1]),
                away=max(before.away, one.away),
                gain=before.gain + one.gain,
                cost=before.cost + one.cost,
            )
        else:
            merged.append(one)
    return sorted(merged, key=lambda one: (one.drive, one.rows))


def too_many(data: Trajectories, wrong: Tensor) -> str:
    """Why so many cells cannot be wrong, `(T + 1, B, K)` bool; empty where they can."""
    share = wrong.sum((0, 1)) / data.observed.sum((0, 1)).clamp(min=1)
    if not bool((share > MAX_SHARE).any()):
        return ""
    column = data.measurement_names[int(share.argmax())]
    return f"{100 * float(share.max()):.0f} % of y.{column} look wrong: too many for outliers, so that all are kept"


class Run(NamedTuple):
    """A run of cells that may be wrong."""

    cells: Tensor  # (T + 1, K) bool
    gain: float  # see `Outlier`
    cost: float


@dataclass(frozen=True)
class _Robust:
    """Drives along a path, the sensors' standard deviations replaced by robust ones."""

    ahead: Lookahead  # with these
    sd: Tensor  # in declared ones, (K,)

    @classmethod
    def declared(cls, ahead: Lookahead) -> _Robust:
        """With the declared standard deviations."""
        return cls(ahead, ahead.linearization.precision.new_ones(ahead.linearization.precision.shape[-1]))

    @property
    def linear(self) -> Linearization:
        return self.ahead.linearization

    def with_sd(self, sd: Tensor) -> _Robust:
        return _Robust(look_ahead(_with_sd(self.linear, sd / self.sd)), sd)

    def with_median_sd(self) -> _Robust:
        """With those by which the median residual is that of a normal, found in some passes."""
        found = self
        for _ in range(PASSES_OF_SD):
            sizes, seen = found.z.abs(), found.linear.precision > 0
            known = seen.flatten(0, 1).any(0)
            medians = [float(sizes[..., k][seen[..., k]].median()) for k in known.nonzero().flatten().tolist()]
            sd = found.sd.clone()
            sd[known] = sd[known] * sd.new_tensor(medians) / NORMAL_MEDIAN
            found = found.with_sd(sd.clamp(*ROBUST_RANGE))
        return found

    @cached_property
    def z(self) -> Tensor:
        """Residuals given all other cells, in their own standard deviations, `(T + 1, B, K)`; zero where missing."""
        linear, (means, _) = self.linear, self.ahead.means()
        away = (means - linear.path.states).double()
        apart = linear.residual - (linear.measurement @ away.unsqueeze(-1)).squeeze(-1)
        left = (1 - linear.precision * self.ahead.sensed_variance).clamp(min=1e-9)
        return torch.where(linear.precision > 0, apart * (linear.precision / left).sqrt(), 0.0)

    @property
    def peaks(self) -> Tensor:
        """Trajectories with a cell that is far off, `(B,)`."""
        return (self.z.abs() > MIN_SD_OF_PEAK).any(-1).any(0)

    def alone(self, drive: int, copies: int) -> Linearization:
        """Copies of one trajectory, side by side."""
        index, linear = torch.full((copies,), drive), self.linear
        first = {name: getattr(linear, name)[index] for name in ("start_offset", "start_turn", "start_noise")}
        rows = ("residual", "measurement", "precision", "log_scale", "offset", "state", "noise")
        of_rows = {name: getattr(linear, name)[:, index] for name in rows}
        return replace(linear, path=linear.path.subset(index), **first, **of_rows)

    def gain_of_tails(self) -> float:
        """Nats by which a Student t is better than the robust normal on residuals given all other cells."""
        z, total = self.z, 0.0
        for k in range(z.shape[-1]):
            own = z[..., k][self.linear.precision[..., k] > 0]
            if len(own):
                normal = torch.distributions.Normal(0.0, 1.0).log_prob(own).sum()
                total += max(0.0, _best_student_t(own) - float(normal))
        return total


def _best_runs(
    robust: _Robust, data: Trajectories, log_range: Tensor, units: Sequence[str], by_chance: float
) -> dict[int, Run]:
    """For each trajectory with a cell that is far off: the run around it whose loss gains most, if it gains anything.

    `log_range` `(K,)` is the logarithm of each column's range, `units` are the columns', `by_chance` is what a run
    costs, nats.
    """
    found = dict[int, Run]()
    for drive in robust.peaks.nonzero().flatten().tolist():
        seen = data.observed[:, drive]

        def best(runs: Sequence[Tensor], drive: int = drive) -> Run:
            stacked = torch.stack(list(runs))
            left = look_ahead(_without(robust.alone(drive, len(stacked)), stacked.transpose(0, 1))).log_likelihood
            costs = (stacked * log_range).sum((1, 2)) + by_chance
            gains = (left - robust.ahead.log_likelihood[drive] - costs).nan_to_num(nan=-math.inf)
            index = int(gains.argmax())
            return Run(stacked[index], float(gains[index]), float(costs[index]))

        run = best(list(_runs(robust.z[:, drive], seen, units)))
        if run.gain > 0:
            found[drive] = best(list(_shortened(best(list(_shortened(run.cells))).cells)))
    return found


def _shortened(cells: Tensor) -> Iterator[Tensor]:
    """The run itself and with a few rows less at its ends."""
    rows = cells.any(1).nonzero().flatten().tolist()
    ends = [count for count in ROWS_OFF if count < len(rows)]
    for off, of_end in itertools.product(ends, ends):
        first, last = rows[off], rows[-1 - of_end]
        if first <= last:
            shorter = torch.zeros_like(cells)
            shorter[first : last + 1] = cells[first : last + 1]
            yield shorter


def _runs(z: Tensor, seen: Tensor, units: Sequence[str]) -> Iterator[Tensor]:
    """Cells `(T + 1, K)` of runs that begin, end or have their middle where `z` is largest, and of those that end at
    other peaks of its column, which the ends of a long jump are: of this column and of all columns in its unit."""
    row, column = divmod(int(z.abs().argmax()), z.shape[1])
    alike = torch.tensor([unit == units[column] for unit in units], device=seen.device)
    alone = torch.zeros_like(alike)
    alone[column] = True
    lengths = [length for length in RUN_ROWS if length <= len(z)]
    spans = [(first, first + n) for n in lengths for first in (row, row - n + 1, row - n // 2)]
    peaks = z[:, column].abs().topk(min(OTHER_PEAKS, len(z))).indices.tolist()
    for one in peaks:  # the peak itself may lie on either side of an end
        low, high = sorted((row, one))
        spans += [(low + first, high + last) for first in (0, 1) for last in (0, 1)]
    known = set[tuple[int, ...]]()
    for columns, (first, end) in itertools.product((alone, alike), spans):
        cells = torch.zeros_like(seen)
        cells[max(0, first) : max(0, end)] = columns
        cells &= seen
        key = tuple(cells.flatten().nonzero().flatten().tolist())
        if key and key not in known:
            known.add(key)
            yield cells


def _best_student_t(z: Tensor) -> float:
    """The largest log-likelihood of a Student t in its scale, of some degrees of freedom."""

    def loss(log_scale: float, freedom: float) -> float:
        return -float(torch.distributions.StudentT(freedom, 0.0, math.exp(log_scale)).log_prob(z).sum())

    found = [
        optimize.minimize_scalar(loss, bounds=(-2.0, 2.0), args=(one,), method="bounded") for one in DEGREES_OF_FREEDOM
    ]
    return -min(float(one.fun) for one in found)


def _with_sd(linear: Linearization, factor: Tensor) -> Linearization:
    """The linearised program, its sensors' standard deviations times `factor` `(K,)`."""
    there = linear.precision > 0
    lost = torch.where(there, factor.log().expand_as(linear.precision), 0.0).sum(-1)
    return replace(linear, precision=linear.precision / factor.square(), log_scale=linear.log_scale - lost)


def _without(linear: Linearization, cells: Tensor) -> Linearization:
    """The linearised program without some cells, `(T + 1, B, K)` bool."""
    heights = 0.5 * (linear.precision.clamp(min=1e-300) / (2 * math.pi)).log()
    lost = torch.where(cells & (linear.precision > 0), heights, 0.0).sum(-1)
    return replace(linear, precision=torch.where(cells, 0.0, linear.precision), log_scale=linear.log_scale - lost)
