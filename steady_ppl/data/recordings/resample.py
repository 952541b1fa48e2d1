"""From what came at any time to rows at even times; a sensor's own stamps on the recorder's clock.

Times are whole nanoseconds throughout, so that a command at the very time of a row is known there.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from steady_ppl.data.recordings.mapping import Column
from steady_ppl.errors import DataError

MAX_PIECE_ROWS = 10_000_000  # of one trajectory
Spans = Sequence[tuple[int, int]]  # from when to when, ns
MAX_PAUSE_RATIO = 20  # times the usual time between commands or the step, the longer, from which a pause is reported


@dataclass(frozen=True)
class Series:
    """What the messages of a topic say in one field."""

    column: Column  # what it becomes
    times: np.ndarray  # (messages,) int64 ns, not decreasing
    values: np.ndarray  # (messages,) finite, as they were read: `scale` and `offset` come last


@dataclass(frozen=True)
class EvenRows:
    """The rows of one trajectory, its columns by their names."""

    start: int  # ns, the time of the first row
    cells: dict[str, np.ndarray]  # (rows,) each, NaN where there is no value
    rivals: dict[str, int]  # how many values of a measurement were left out, another being nearer to their row
    placed: dict[str, int]  # how many are in a row, or were left out for another

    @property
    def rows(self) -> int:
        """How many rows; none where there is no measurement."""
        return len(next(iter(self.cells.values())))


def in_rows(series: Sequence[Series], step: float, name: str = "bag", within: Spans | None = None) -> list[EvenRows]:
    """The pieces between pauses, each with rows from where all controls are known to its last measurement.

    No series of a control may be empty. More rows than `MAX_PIECE_ROWS` are a DataError that names the recording.
    `within` are the spans beyond which there are no rows; they do not overlap.
    """
    measured = [one.times for one in series if one.column.kind == "y" and len(one.times)]
    if not measured:
        return []
    controls = [one for one in series if one.column.kind == "u"]
    last = max(times[-1] for times in measured)
    everything = min(times[:1] for times in measured), np.array([last])
    known = [_stretches(control, last) for control in controls] or [everything]
    starts = np.unique(np.concatenate([first for first, _ in known]))
    starts = starts[starts >= max(first[0] for first, _ in known)]
    ends = np.min([end[np.searchsorted(first, starts, side="right") - 1] for first, end in known], 0).clip(max=last)
    spans = list(zip(starts.tolist(), ends.tolist(), strict=True))
    if within is not None:
        spans = [(max(a, c), b if b <= d else _last_row(max(a, c), d, step)) for a, b in spans for c, d in within]
    return [_piece(series, start, end, step, name) for start, end in spans if start <= end]


def _last_row(start: int, end: int, step: float) -> int:
    """The time of the last row that is not after an end."""
    return start + round((end - start) // (step * 1e9) * step * 1e9)


def _stretches(control: Series, last: int) -> tuple[np.ndarray, np.ndarray]:
    """From when to when a control is known: without a pause longer than is allowed; else to the last measurement."""
    times, longest = control.times, math.inf if control.column.longest is None else control.column.longest * 1e9
    pauses = np.flatnonzero(np.diff(times) > longest)
    first, end = times[np.append(0, pauses + 1)], times[np.append(pauses, len(times) - 1)]
    if last - end[-1] <= longest:
        end[-1] = max(end[-1], last)
    return first, end


def long_holds(series: Sequence[Series], step: float) -> Iterator[str]:
    """What is to be said of controls that are held, or interpolated, for far longer than commands usually last."""
    measured = [one.times[-1] for one in series if one.column.kind == "y" and len(one.times)]
    for control in series:
        if control.column.kind != "u" or control.column.longest is not None or not measured:
            continue
        gaps = np.diff(np.append(control.times, max(control.times[-1], *measured)))
        usual = max(float(np.median(gaps)), step * 1e9)
        longest = int(gaps.argmax())
        if gaps[longest] > MAX_PAUSE_RATIO * usual:
            after = (control.times[longest] - control.times[0]) / 1e9
            pause = f"no {control.column.topic} for {gaps[longest] / 1e9:.3g} s, {after:.3g} s after its first"
            what = "interpolated over it" if control.column.between == "interpolate" else "held as if it still acted"
            how = f"`longest = {10 * usual / 1e9:.2g}` would end the trajectory there"
            yield f"{pause}: {control.column.name} is {what}; {how}"


def _piece(series: Sequence[Series], start: int, end: int, step: float, name: str) -> EvenRows:
    spacing = step * 1e9
    last = int(np.floor((end - start) / spacing + 0.5))
    if last >= MAX_PIECE_ROWS:
        what = f"{(end - start) / 1e9:.6g} s in steps of {step} s are {last + 1} rows, more than {MAX_PIECE_ROWS}"
        raise DataError(f"{name}: {what}; take a larger step, or the same clock for controls and measurements")
    nearest = {one.column.name: _nearest(one, start, spacing, last) for one in series if one.column.kind == "y"}
    rows = 1 + max((int(at[-1]) for at, _, _ in nearest.values() if len(at)), default=-1)
    time, cells = _times(np.arange(rows), start, spacing), {}
    for one in series:
        column = one.column
        if column.kind == "y":
            at, found, _ = nearest[column.name]
            values = np.full(rows, np.nan)
            values[at] = found
        elif column.kind == "u" and column.between != "interpolate":
            values = one.values[np.searchsorted(one.times, time, side="right") - 1]
        else:
            values = _interpolated(one, time, None if column.kind == "u" else 2 * spacing)
        cells[column.name] = column.scale * values + column.offset
    rivals = {name: count - len(at) for name, (at, _, count) in nearest.items()}
    return EvenRows(start, cells, rivals, {name: count for name, (_, _, count) in nearest.items()})


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
    angle = one.column.is_angle
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


@dataclass(frozen=True)
class Alignment:
    """A sensor's own stamps moved onto the recorder's clock."""

    times: np.ndarray  # (messages,) int64 ns, the moved stamps, in the order of the messages
    offset: float  # s that are added to a stamp at the mean of the stamps; the smallest delay is in it
    drift: float  # how much that grows with every second of the stamps' clock; 1e-6 is one ppm

    def on(self, recorder: str) -> str:
        """What is said of it."""
        behind = "behind" if self.offset >= 0 else "ahead of"
        drift = f"{'lost' if self.drift >= 0 else 'gained'} {abs(self.drift) * 1e6:.2f} ppm"
        off = f"{abs(self.offset) * 1e3:.3f} ms {behind} the {recorder}'s halfway"
        return f"its clock was {off}, the smallest delay included, and {drift}"


def align(stamps: np.ndarray, received: np.ndarray) -> Alignment:
    """Move a sensor's stamps onto the clock on which they were received, `(messages,)` int64 ns each, at least one.

    A sensor's clock is off by an offset and drifts, and a message is on its way for a delay that is never negative. Of
    all lines offset + drift · stamp below the points (stamp, received − stamp), the nearest to them, summed over the
    points, is the edge of their lower convex hull over the mean of the stamps. Stamps moved by that line are when
    messages were made, all late by the smallest delay that occurs. Stamps that are all alike have no drift.

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
