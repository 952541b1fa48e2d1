"""From what came at any time to rows at even times; header stamps on the bag's clock.

Times are whole nanoseconds throughout, so that a command at the very time of a row is known there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from steady_ppl.data.rosbag.mapping import BagColumn
from steady_ppl.errors import DataError

MOST_ROWS = 10_000_000
UNUSUAL = 20  # times the usual time between commands, or the step if that is longer, from which holding one is said


@dataclass(frozen=True)
class Series:
    """What the messages of a topic say in one field.

    Attributes:
        column: what it becomes.
        times: `(messages,)` int64 ns, not decreasing.
        values: `(messages,)` finite, as they were read: `scale` and `offset` come last.
    """

    column: BagColumn
    times: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Piece:
    """The rows of one trajectory.

    Attributes:
        start: ns, the time of the first row.
        cells: a column's name to its `(rows,)` values, NaN where there is none.
        rivals: a measurement's column to how many of its values were left out, another one being nearer to their row.
        placed: a measurement's column to how many of its values are in a row, or were left out for another.
    """

    start: int
    cells: dict[str, np.ndarray]
    rivals: dict[str, int]
    placed: dict[str, int]

    @property
    def rows(self) -> int:
        """How many rows; none where there is no measurement."""
        return len(next(iter(self.cells.values())))


def in_rows(series: Sequence[Series], step: float, name: str = "bag") -> list[Piece]:
    """The pieces between pauses, each with rows from where all controls are known to its last measurement.

    No measurement is in two pieces where a pause, longer than a control's `longest`, takes two steps or more.

    Args:
        series: of controls (none empty), measurements and states.
        step: s between rows.
        name: what an error message calls the bag.

    Raises:
        DataError: there would be more rows than anybody wants.
    """
    measured = [one.times for one in series if one.column.kind == "y" and len(one.times)]
    if not measured:
        return []
    first, last = (min(times[0] for times in measured), max(times[-1] for times in measured))
    controls = [one for one in series if one.column.kind == "u"]
    spans = [(min(one.times[0] for one in controls) if controls else first, last)]
    for control in controls:
        spans = _intersection(spans, _stretches(control, last))
    return [_piece(series, int(start), int(end), step, name) for start, end in spans]


def _stretches(control: Series, last: int) -> list[tuple[int, int]]:
    """From when to when a control is known: without a pause longer than is allowed; else to the last measurement."""
    times, longest = control.times, control.column.longest
    if longest is None:
        return [(times[0], max(times[-1], last))]
    pauses = np.flatnonzero(np.diff(times) > longest * 1e9)
    first, end = times[np.append(0, pauses + 1)], times[np.append(pauses, len(times) - 1)]
    if last - end[-1] <= longest * 1e9:
        end[-1] = max(end[-1], last)
    return list(zip(first.tolist(), end.tolist(), strict=True))


def held_pauses(series: Sequence[Series], step: float) -> Iterator[str]:
    """What is to be said of controls that are held, or interpolated, for far longer than commands usually last."""
    measured = [one.times[-1] for one in series if one.column.kind == "y" and len(one.times)]
    for control in series:
        if control.column.kind != "u" or control.column.longest is not None or not measured:
            continue
        gaps = np.diff(np.append(control.times, max(control.times[-1], *measured)))
        usual = max(float(np.median(gaps)), step * 1e9)
        longest = int(gaps.argmax())
        if gaps[longest] > UNUSUAL * usual:
            after = (control.times[longest] - control.times[0]) / 1e9
            what = "interpolated over it" if control.column.between == "interpolate" else "held as if it still acted"
            yield (
                f"no {control.column.topic} for {gaps[longest] / 1e9:.3g} s, {after:.3g} s after its first: "
                f"{control.column.name} is {what}; `longest = {10 * usual / 1e9:.2g}` would end the trajectory there"
            )


def _intersection(a: list[tuple[int, int]], b: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The stretches that lie in one of `a` and in one of `b`; both are sorted and do not overlap."""
    found, i, j = [], 0, 0
    while i < len(a) and j < len(b):
        start, end = max(a[i][0], b[j][0]), min(a[i][1], b[j][1])
        if start <= end:
            found.append((start, end))
        if a[i][1] <= b[j][1]:
            i += 1
        else:
            j += 1
    return found


def _piece(series: Sequence[Series], start: int, end: int, step: float, name: str) -> Piece:
    spacing = step * 1e9
    last = int(np.floor((end - start) / spacing + 0.5))
    if last >= MOST_ROWS:
        raise DataError(
            f"{name}: {(end - start) / 1e9:.6g} s in steps of {step} s are {last + 1} rows, more than {MOST_ROWS}; "
            "take a larger step, or the same clock for controls and measurements"
        )
    measured = [(one, *_nearest(one, start, spacing, last)) for one in series if one.column.kind == "y"]
    rows = 1 + max((int(at[-1]) for _, at, _, _ in measured if len(at)), default=-1)
    time = _times(np.arange(rows), start, spacing)
    cells, rivals, placed = {}, {}, {}
    for one, at, values, count in measured:
        cells[one.column.name] = np.full(rows, np.nan)
        cells[one.column.name][at] = _scaled(one.column, values)
        rivals[one.column.name], placed[one.column.name] = count - len(at), count
    for one in series:
        if one.column.kind == "u" and one.column.between != "interpolate":
            held = one.values[np.searchsorted(one.times, time, side="right") - 1]
            cells[one.column.name] = _scaled(one.column, held)
        elif one.column.kind != "y":
            most = None if one.column.kind == "u" else 2 * spacing
            cells[one.column.name] = _scaled(one.column, _interpolated(one, time, most))
    return Piece(start, {one.column.name: cells[one.column.name] for one in series}, rivals, placed)


def _nearest(one: Series, start: int, spacing: float, last: int) -> tuple[np.ndarray, np.ndarray, int]:
    """The rows that have a measurement, the one nearest to each (of two as near the earlier), and of how many."""
    row = np.floor((one.times - start) / spacing + 0.5).astype(np.int64)
    inside = (row >= 0) & (row <= last)
    row, values = row[inside], one.values[inside]
    distance = np.abs(one.times[inside] - _times(row, start, spacing))
    order = np.lexsort((distance, row))
    at, first = np.unique(row[order], return_index=True)
    return at, values[order][first], len(row)


def _times(rows: np.ndarray, start: int, spacing: float) -> np.ndarray:
    return start + np.rint(rows * spacing).astype(np.int64)


def _interpolated(one: Series, time: np.ndarray, most: float | None) -> np.ndarray:
    """On the line between the messages before and after; NaN where one is missing or they are over `most` ns apart.

    Without `most` the first and the last message go on for ever. Angles take the shorter way round and come back
    continuous, the first between −π and π.
    """
    kept = np.append(one.times[1:] > one.times[:-1], True)[: len(one.times)]  # of messages at one time the last
    times, values = one.times[kept], one.values[kept]
    if len(times) == 0 or len(time) == 0:
        return np.full(len(time), np.nan)
    angle = one.column.reading is not None
    if angle:
        values = values - 2 * np.pi * np.append(0.0, np.rint(np.diff(values) / (2 * np.pi)).cumsum())
    after = np.searchsorted(times, time).clip(max=len(times) - 1)
    before = np.where(times[after] > time, after - 1, after).clip(min=0)
    gap = times[after] - times[before]
    share = np.where(gap > 0, (time - times[before]) / np.maximum(gap, 1), 0.0)
    found = values[before] + share * (values[after] - values[before])
    if most is not None:
        found[(gap > most) | (time < times[0]) | (time > times[-1])] = np.nan
    known = found[~np.isnan(found)]
    if angle and len(known):
        found = found - 2 * np.pi * np.rint(known[0] / (2 * np.pi))
    return found


def _scaled(column: BagColumn, values: np.ndarray) -> np.ndarray:
    return column.scale * values + column.offset


@dataclass(frozen=True)
class Alignment:
    """Header stamps moved onto the bag's clock.

    Attributes:
        times: `(messages,)` int64 ns, the moved stamps, in the order of the messages.
        offset: s that are added to a stamp at the mean of the stamps; the smallest delay is in it.
        drift: how much that grows with every second of the stamps' clock (1e-6 is one ppm).
    """

    times: np.ndarray
    offset: float
    drift: float


def align(stamps: np.ndarray, received: np.ndarray) -> Alignment:
    """Move header stamps onto the clock on which they were received.

    Args:
        stamps: `(messages,)` int64 ns, at least one.
        received: `(messages,)` int64 ns, when the bag says that they arrived.

    Returns:
        No drift where all stamps are alike.

    A bag keeps when a message arrived at the recorder; its header may keep when it was made, on the clock of the
    machine that made it. That clock is off by an offset and drifts, and what arrives has been on its way for a delay
    that is never negative. Of all lines offset + drift · stamp below the points (stamp, received − stamp), the nearest
    to them, summed over the points, is the edge of their lower convex hull over the mean of the stamps. Stamps moved by
    that line are when messages were made, all late by the smallest delay that occurs.

    Sue B. Moon, Paul Skelly and Don Towsley. Estimation and removal of clock skew from network delay measurements.
    INFOCOM 1999.
    """
    delays = received - stamps
    origin, least = int(stamps.min()), int(delays.min())
    x, y = (stamps - origin) / 1e9, (delays - least) / 1e9  # s: differences keep what float64 would lose
    hull = _lower_hull(x, y)
    middle = float(x.mean())
    if len(hull) == 1:
        height, drift = float(y[hull[0]]), 0.0
    else:
        right = min(max(int(np.searchsorted(x[hull], middle)), 1), len(hull) - 1)
        a, b = hull[right - 1], hull[right]
        drift = float((y[b] - y[a]) / (x[b] - x[a]))
        height = float(y[a] + drift * (middle - x[a]))
    moved = stamps + least + np.rint((height + drift * (x - middle)) * 1e9).astype(np.int64)
    return Alignment(moved, least / 1e9 + height, drift)


def _lower_hull(x: np.ndarray, y: np.ndarray) -> list[int]:
    """The corners of the lower convex hull from left to right, as indices (Andrew's monotone chain)."""
    hull: list[int] = []
    for i in np.lexsort((y, x)).tolist():
        if hull and x[i] == x[hull[-1]]:
            continue  # the lowest of these came first
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (x[b] - x[a]) * (y[i] - y[a]) > (y[b] - y[a]) * (x[i] - x[a]):
                break
            hull.pop()
        hull.append(i)
    return hull
