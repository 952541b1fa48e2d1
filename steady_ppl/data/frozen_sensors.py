"""Stretches of a drive in which what was logged stood still or lay on a line: a sensor hung, or a gap was interpolated.

A real sensor scatters: no twelve rows of it lie on a line to one part in a million of what it sees on all drives. A
known state that keeps its value is left alone: the vehicle may have stood still.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories

MIN_STRETCH_ROWS = 12  # rows of a stretch
MAX_DEVIATION = 1e-6  # of the column's range over all drives, by which a row may be beside the line
RowRange = tuple[int, int, int, str]  # drive, first and last row, column


@dataclass(frozen=True)
class Stretch:
    """Rows of a drive in which some logged columns are on a line."""

    drive: int
    label: str
    rows: tuple[int, int]  # the first and the last, from 0
    seconds: tuple[float, float]  # when these are, from the drive's first row
    columns: tuple[str, ...]  # as the table names them

    def __str__(self) -> str:
        begin, end = self.seconds
        return (
            f"trajectory {self.label} between {begin:.2f} and {end:.2f} s: {', '.join(self.columns)} on a straight "
            "line, as if a gap had been filled by interpolation or the sensor hung; nothing that is compared there was "
            "seen"
        )


def frozen_stretches(data: Trajectories) -> list[Stretch]:
    """Stretches in which a measurement or a known state, which was logged too, is on a line over time though it
    scatters elsewhere."""
    runs, moving = list[RowRange](), set[RowRange]()
    names, logged, known = [f"y.{name}" for name in data.measurement_names], data.measurements, data.observed
    if data.states is not None:
        names += [f"x.{name}" for name in data.state_names]
        logged = torch.cat([logged, data.states.nan_to_num()], -1)
        known = torch.cat([known, torch.isfinite(data.states) & data.rows.unsqueeze(-1)], -1)
    for column, values, there in zip(names, logged.unbind(-1), known.unbind(-1), strict=True):
        of_column = _runs(data.time, values, there)
        if sum(last - first for _, first, last in of_column) < 0.5 * float(there.sum()):
            runs += [(*run, column) for run in of_column]
            moving |= {(*run, column) for run in of_column if values[run[1], run[0]] != values[run[2], run[0]]}
    runs = [run for run in runs if run in moving or run[3].startswith("y.") or _beside(run, moving)]
    found: list[Stretch] = []
    for drive, first, last, column in sorted(runs, key=lambda run: run[:2]):
        before = found[-1] if found and found[-1].drive == drive and found[-1].rows[1] >= first else None
        rows = (before.rows[0], max(before.rows[1], last)) if before else (first, last)
        begin, end = (float(data.elapsed[row, drive]) for row in rows)
        columns = (*before.columns, column) if before else (column,)
        found[len(found) - bool(before) :] = [Stretch(drive, data.labels[drive], rows, (begin, end), columns)]
    return found


def _beside(run: RowRange, moving: set[RowRange]) -> bool:
    """Whether another known state moves along a line meanwhile: then one that keeps its value is made up as well."""
    drive, first, last, _ = run
    return any(m[0] == drive and m[1] <= last and first <= m[2] and m[3].startswith("x.") for m in moving)


def without_stretches(data: Trajectories, stretches: list[Stretch]) -> Trajectories:
    """The drives without what nobody measured: a measurement that hung and, where known states are made up, everything
    that was logged with them but a first row's states."""
    observed = data.observed.clone()
    states = None if data.states is None else data.states.clone()
    for stretch in stretches:
        rows = slice(stretch.rows[0], stretch.rows[1] + 1)
        for name in (column.removeprefix("y.") for column in stretch.columns if column.startswith("y.")):
            observed[rows, stretch.drive, data.measurement_names.index(name)] = False
        if states is not None and any(column.startswith("x.") for column in stretch.columns):
            observed[rows, stretch.drive] = False
            states[max(rows.start, 1) : rows.stop, stretch.drive] = torch.nan
    return replace(data, observed=observed, measurements=torch.where(observed, data.measurements, 0.0), states=states)


def _runs(time: Tensor, values: Tensor, there: Tensor) -> list[tuple[int, int, int]]:
    """Drive, first and last row of every stretch on a line over time."""
    if len(values) < MIN_STRETCH_ROWS or int(there.sum()) < MIN_STRETCH_ROWS:
        return []
    seen = values[there]
    reach = MAX_DEVIATION * float(seen.max() - seen.min())
    share = ((time[1:-1] - time[:-2]) / (time[2:] - time[:-2])).to(values)
    whole = _turned(values[2:] - values[:-2])
    bend = _turned(values[1:-1] - values[:-2] - share * whole).abs()
    straight = (bend <= 0.5 * reach) & there[2:] & there[1:-1] & there[:-2]
    runs = []
    for drive in straight.any(0).nonzero().flatten().tolist():
        edges = torch.diff(straight[:, drive].int(), prepend=torch.zeros(1).int(), append=torch.zeros(1).int())
        begins, ends = (edges == 1).nonzero().flatten().tolist(), (edges == -1).nonzero().flatten().tolist()
        runs += [(drive, b, e + 1) for b, e in zip(begins, ends, strict=True) if e + 2 - b >= MIN_STRETCH_ROWS]
    return runs


def _turned(change: Tensor) -> Tensor:
    """A change of almost a whole turn is an angle that came round."""
    return torch.where(change.abs() > 2 * math.pi - 1, change - torch.sign(change) * 2 * math.pi, change)
