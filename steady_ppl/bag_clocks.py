"""When a message was made, on the clock of the bag.

A bag keeps when a message arrived at the recorder; its header may keep when it was made, on the clock of the machine
that made it. That clock is off by an offset and drifts, and what arrives has been on its way for a delay that changes
from message to message but is never negative. So of all lines offset + drift * stamp below the points
(stamp, received - stamp), the one that lies nearest to them, summed over the points, is the edge of their lower convex
hull over the mean of the stamps. Stamps moved by that line are when messages were made, all late by the smallest delay
that occurs: nothing in a bag tells that delay apart from the offset.

Sue B. Moon, Paul Skelly and Don Towsley. Estimation and removal of clock skew from network delay measurements.
INFOCOM 1999.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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
