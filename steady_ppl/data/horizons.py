"""How far ahead programs are judged: times that suit the pace at which what is measured moves.

The pace is that of the structure function, the mean square by which measurements some time apart differ (Kolmogorov
1941): zero at once but for the sensors' noise, twice the variance where nothing is left of what was.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import require

SHARE_MOVED = 0.3  # of what measurements far apart differ by, mean square, above the sensors' noise: the time scale
LAG_RATIO = 1.15  # of one lag that is looked at to the one before
MAX_SHARE_OF_DRIVE = 0.5  # that a lag may have: longer ones join few pairs of rows
MIN_PAIRS = 20  # of measurements a lag


def named_horizons(data: Trajectories, count: int, seconds: Sequence[float] = ()) -> dict[str, int]:
    """Name → rows ahead: one step, and those times that fit into the longest drive.

    Args:
        data: the drives.
        count: how many times there are at most, from the time scale on, in the series 1, 3, 10, 30, …
        seconds: times that are asked for instead.
    """
    for one in seconds:
        require(math.isfinite(one) and one > 0, "horizons", one, "seconds above zero")
    times = sorted(set(seconds))
    if not times:
        first = round(2 * math.log10(time_scale(data)))
        times = [_in_series(place) for place in range(first, first + count)]
    rows = {f"{one:g} s": data.rows_ahead(one) for one in times}
    return {"one step": 1} | {name: ahead for name, ahead in rows.items() if 1 < ahead < data.time.shape[0]}


def time_scale(data: Trajectories) -> float:
    """Seconds in which what is measured moves by much of its range, 1 or 3 times a power of ten.

    Never less than a row; where the drives are too short to tell, a tenth of the longest.
    """
    step, rows = data.median_step, data.time.shape[0]
    lags = [1]
    while (further := max(lags[-1] + 1, round(lags[-1] * LAG_RATIO))) <= MAX_SHARE_OF_DRIVE * rows:
        lags.append(further)
    moved = _share_moved(data, lags)
    known = moved.isfinite().nonzero().flatten()
    far = (moved - moved[known[:1]] >= SHARE_MOVED).nonzero().flatten() if len(known) else known
    seconds = step * (lags[int(far[0])] if len(far) else max(1.0, 0.1 * rows))
    return _in_series(round(2 * math.log10(seconds)))


def _in_series(place: int) -> float:
    """The series 1, 3, 10, 30, … from place 0 on."""
    return float(f"{'3' if place % 2 else '1'}e{place // 2}")


def _share_moved(data: Trajectories, lags: Sequence[int]) -> Tensor:
    """By what measurements so many rows apart differ, of that by which any two of a drive do, mean squares, the mean
    over the columns, `(lags,)`; NaN where too few pairs were measured."""
    seen, found = data.observed, []
    values = torch.where(seen, _on_a_circle(data.measurements.double(), seen), 0.0)
    count = seen.sum(0)
    apart = torch.where(seen, (values - values.sum(0) / count.clamp(min=1)).abs().square(), 0.0).sum((0, 1))
    variance = apart / (count - 1).clamp(min=0).sum(0).clamp(min=1)
    for lag in lags:
        both = seen[lag:] & seen[:-lag]
        squares = torch.where(both, (values[lag:] - values[:-lag]).abs().square(), 0.0).sum((0, 1))
        pairs = both.sum((0, 1))
        share = squares / pairs.clamp(min=1) / (2 * variance)
        found.append(torch.where((pairs >= MIN_PAIRS) & (variance > 0), share, torch.nan).nanmean())
    return torch.stack(found)


def _on_a_circle(values: Tensor, seen: Tensor) -> Tensor:
    """Measurements as complex numbers; those of a column within a turn, some of them across it from the row before,
    on the circle."""
    jumps = ((values[1:] - values[:-1]).abs() > math.pi) & seen[1:] & seen[:-1]
    within = (torch.where(seen, values, 0.0).abs() <= 2 * math.pi).all(0).all(0)
    turns = within & jumps.any(0).any(0)
    return torch.where(turns, torch.polar(torch.ones_like(values), values), values.to(torch.complex128))
