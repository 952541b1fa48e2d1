"""Stretches of a drive in which what was logged did not move or moved along a ruler: a sensor that hung, or a gap that
somebody filled by interpolation.

A real sensor scatters: no twelve rows of it lie on a line to one part in a million of what it sees on all drives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from steady_ppl.data import Trajectories

FEWEST = 12  # rows of a stretch
STRAIGHT = 1e-6  # of the column's range over all drives, by which a row may be beside the line


@dataclass(frozen=True)
class Stretch:
    """Rows of a drive in which some logged columns are on a line.

    Attributes:
        drive: its number.
        label: its name.
        rows: the first and the last row of the stretch, from 0.
        seconds: when these are, from the drive's first row.
        columns: which, as the table names them.
    """

    drive: int
    label: str
    rows: tuple[int, int]
    seconds: tuple[float, float]
    columns: tuple[str, ...]

    def __str__(self) -> str:
        begin, end = self.seconds
        return (
            f"drive {self.label} between {begin:.2f} and {end:.2f} s: {', '.join(self.columns)} on a straight line, "
            "as if a gap had been filled by interpolation or the sensor hung; nothing that is compared there was seen"
        )


def stuck(data: Trajectories) -> list[Stretch]:
    """Stretches in which a measurement or a known state is on a line though it scatters elsewhere.

    Known states are looked at because they were logged, too: where somebody's tracking lost the vehicle, whatever was
    made of its poses is made up.
    """
    runs: list[tuple[int, int, int, str]] = []
    for column, values, there in _columns(data):
        of_column = _runs(values, there)
        if sum(last - first for _, first, last in of_column) < 0.5 * float(there.sum()):
            runs += [(*run, column) for run in of_column]
    found: list[Stretch] = []
    for drive, first, last, column in sorted(runs, key=lambda run: run[:2]):
        before = found[-1] if found and found[-1].drive == drive and found[-1].rows[1] >= first else None
        rows = (before.rows[0], max(before.rows[1], last)) if before else (first, last)
        begin, end = (float(data.elapsed[row, drive]) for row in rows)
        columns = (*before.columns, column) if before else (column,)
        found[len(found) - bool(before) :] = [Stretch(drive, data.labels[drive], rows, (begin, end), columns)]
    return found


def masked(data: Trajectories, stretches: list[Stretch]) -> Trajectories:
    """The drives without the measurements of these stretches; true states there are forgotten, but for a first row."""
    observed = data.observed.clone()
    states = None if data.states is None else data.states.clone()
    for stretch in stretches:
        first, last = stretch.rows
        observed[first : last + 1, stretch.drive] = False
        if states is not None:
            states[max(first, 1) : last + 1, stretch.drive] = torch.nan
    return replace(data, observed=observed, measurements=torch.where(observed, data.measurements, 0.0), states=states)


def _columns(data: Trajectories) -> list[tuple[str, Tensor, Tensor]]:
    columns = [
        (f"y.{name}", data.measurements[..., i], data.observed[..., i]) for i, name in enumerate(data.measurement_names)
    ]
    if data.states is not None:
        for i, name in enumerate(data.state_names):
            values = data.states[..., i]
            columns.append((f"x.{name}", values.nan_to_num(), torch.isfinite(values) & data.rows))
    return columns


def _runs(values: Tensor, there: Tensor) -> list[tuple[int, int, int]]:
    """Drive, first and last row of every stretch on a line."""
    if len(values) < FEWEST or int(there.sum()) < FEWEST:
        return []
    seen = values[there]
    reach = STRAIGHT * float(seen.max() - seen.min())
    bend = (values[2:] - 2 * values[1:-1] + values[:-2]).abs()
    straight = (bend <= reach) & there[2:] & there[1:-1] & there[:-2]
    runs = []
    for drive in straight.any(0).nonzero().flatten().tolist():
        edges = torch.diff(straight[:, drive].int(), prepend=torch.zeros(1).int(), append=torch.zeros(1).int())
        begins, ends = (edges == 1).nonzero().flatten().tolist(), (edges == -1).nonzero().flatten().tolist()
        runs += [(drive, b, e + 1) for b, e in zip(begins, ends, strict=True) if e + 2 - b >= FEWEST]
    return runs
