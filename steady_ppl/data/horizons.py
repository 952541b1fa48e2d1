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
MAX_SHARE_OF_NOISE = 0.95  # of a column that tells: what is left is too little


def named_horizons(
    data: Trajectories, count: int, seconds: Sequence[float] = (), circle: Tensor | None = None
) -> dict[str, int]:
    """Name → rows ahead: one step, and those times that fit into the longest drive.

    Args:
        data: the drives.
        count: how many times there are at most, from the time scale on, in the series 1, 3, 10, 30, …
        seconds: times that are asked for instead.
        circle: which measurements do not notice a whole turn, `(K,)` bool.

    Raises:
        UsageError: a time that is asked for is less than two rows, longer than all drives, or the same rows as another.
    """
    if not seconds:
        first = round(2 * math.log10(time_scale(data, circle)))
        rows = {f"{one:g} s": data.rows_ahead(one) for one in map(_in_series, range(first, first + count))}
        return {"one step": 1} | {name: ahead for name, ahead in rows.items() if 1 < ahead < data.time.shape[0]}
    found = {"one step": 1}
    for one in sorted(set(seconds)):
        require(math.isfinite(one) and one > 0, "horizon", one, "seconds above zero")
        ahead, longest = data.rows_ahead(one), (data.time.shape[0] - 1) * data.median_step
        require(1 < ahead < data.time.shape[0], "horizon", one, f"{2 * data.median_step:.3g} to {longest:.3g} s")
        require(ahead not in found.values(), "horizon", one, "times that are not the same number of rows")
        found[f"{one:g} s"] = ahead
    return found


def time_scale(data: Trajectories, circle: Tensor | None = None) -> float:
    """Seconds in which what is measured moves by much of its range, 1 or 3 times a power of ten, no less than a row.

    The middle of the measurements; a tenth of the longest drive where none tells. `circle` is that of `named_horizons`.
    """
    step, values = data.median_step, data.measurements.to(torch.complex128)
    if circle is not None:
        values = torch.where(circle, torch.polar(torch.ones_like(values.real), values.real), values)
    found = [_rows_of_move(*column) for column in zip(values.unbind(-1), data.observed.unbind(-1), strict=True)]
    told = sorted(rows for rows in found if rows is not None)
    seconds = step * (told[(len(told) - 1) // 2] if told else max(1.0, 0.1 * data.time.shape[0]))
    place = round(2 * math.log10(seconds))
    return _in_series(place if _in_series(place) >= step * (1 - 1e-6) else place + 1)


def _in_series(place: int) -> float:
    """The series 1, 3, 10, 30, … from place 0 on."""
    return float(f"{'3' if place % 2 else '1'}e{place // 2}")


def _rows_of_move(values: Tensor, seen: Tensor) -> int | None:
    """Rows in which a column `(T + 1, B)` moves by `SHARE_MOVED`; None where it is noise alone or too few are there.

    The noise is what the first two lags extrapolate to, if they rise as what moves smoothly does.
    """
    count = seen.sum(0)
    mean = torch.where(seen, values, 0.0).sum(0) / count.clamp(min=1)
    apart = torch.where(seen, (values - mean).abs().square(), 0.0)
    variance = float(apart.sum()) / max(1, int((count - 1).clamp(min=0).sum()))
    most = int(MAX_SHARE_OF_DRIVE * len(values))
    first = next((lag for lag in range(1, most + 1) if int((seen[lag:] & seen[:-lag]).sum()) >= MIN_PAIRS), 0)
    if not first or not variance > 0:
        return None

    def share(lag: int) -> float:
        both = seen[lag:] & seen[:-lag]
        squares = torch.where(both, (values[lag:] - values[:-lag]).abs().square(), 0.0).sum()
        return float(squares) / max(1, int(both.sum())) / (2 * variance)

    multiples, lags = [1], [first]
    while (lag := first * max(multiples[-1] + 1, round(multiples[-1] * LAG_RATIO))) <= most:
        multiples.append(lag // first)
        lags.append(lag)
    shares = [share(lag) for lag in lags]
    rise = (shares[1] - shares[0]) / 3 if len(shares) > 1 else 0.0  # of squares of one and two lags
    noise = max(0.0, shares[0] - max(0.0, rise))
    if noise > MAX_SHARE_OF_NOISE:
        return None
    return next((lag for lag, one in zip(lags, shares, strict=True) if one - noise >= SHARE_MOVED * (1 - noise)), None)
