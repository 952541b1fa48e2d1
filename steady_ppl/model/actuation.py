"""What comes of a command on its way: lag, delay, rate limit and play of controls that are held from row to row."""

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

Array = np.ndarray[Any, Any]


def lagged(control: Tensor, time: Tensor, constant: Tensor) -> Tensor:
    """A first-order lag, averaged over each interval, exact for held controls; the first was held for ever before.

    Args:
        control: `(rows, trajectories, U)`.
        time: `(rows, trajectories)` s.
        constant: the time constant, s; none if it is not positive.
    """
    if len(time) < 2:
        return control
    constant = torch.as_tensor(constant, dtype=control.dtype, device=control.device).clamp(min=0.0)
    steps = row_spans(time).unsqueeze(-1)
    stays = (-steps / torch.maximum(constant, 1e-5 * steps)).exp()
    share = constant / steps * (1 - stays)
    given = (control, *torch.broadcast_tensors(share, stays))
    if _is_plain(*given):
        return torch.from_numpy(_followed(*(part.detach().contiguous().numpy() for part in given)))
    at, means = control[0], []
    for row in range(len(control)):
        means.append(control[row] + (at - control[row]) * share[row])
        at = control[row] + (at - control[row]) * stays[row]
    return torch.stack(means)


def _is_plain(*given: Tensor) -> bool:
    """Whether all are numbers of one precision in the host's memory, and none is learned by gradients."""
    is_learned = torch.is_grad_enabled() and any(part.requires_grad for part in given)
    kinds = {(part.dtype, part.device.type) for part in given}
    return not is_learned and kinds in ({(torch.float32, "cpu")}, {(torch.float64, "cpu")})


@njit(cache=True, error_model="numpy")
def _followed(control: Array, share: Array, stays: Array) -> Array:
    """The loop of `lagged`, compiled: a search looks at some hundred lags, a row of which takes torch 50 µs."""
    rows, drives, count = control.shape
    means = np.empty_like(control)
    for b in range(drives):
        for u in range(count):
            at, which = control[0, b, u], min(u, share.shape[2] - 1)
            for row in range(rows):
                now = control[row, b, u]
                means[row, b, u] = now + (at - now) * share[row, b, which]
                at = now + (at - now) * stays[row, b, which]
    return means


def delayed(control: Tensor, time: Tensor, delay: Tensor) -> Tensor:
    """A delay, averaged over each interval, exact for held controls; the first was held for ever before.

    Args:
        control: `(rows, trajectories, U)`.
        time: `(rows, trajectories)` s.
        delay: s; none if it is not positive.
    """
    if len(time) < 2:
        return control
    delay = torch.as_tensor(delay, dtype=control.dtype, device=control.device).clamp(min=0.0)
    edges = torch.cat([time, time[-1:] + row_spans(time)[-1:]])
    held = (edges[1:] - edges[:-1]).unsqueeze(-1) * control
    total = torch.cat([torch.zeros_like(held[:1]), held.cumsum(0)])  # the control's integral from the first row
    if delay.numel() == 1 and _is_plain(control, edges, delay):
        given = (control, edges, total, delay.reshape(1))
        return torch.from_numpy(_held_ago(*(part.detach().contiguous().numpy() for part in given)))
    ago = (edges - delay).contiguous()
    row = torch.searchsorted(edges.t().contiguous(), ago.t().contiguous()).t() - 1  # the one before, on an edge
    row = row.clamp(0, len(control) - 1)
    wide = row.unsqueeze(-1).expand(*row.shape, control.shape[-1])
    since = (ago - edges.gather(0, row)).unsqueeze(-1)  # negative before the first row, whose control was held
    integral = total.gather(0, wide) + since * control.gather(0, wide)
    return (integral[1:] - integral[:-1]) / (edges[1:] - edges[:-1]).unsqueeze(-1)


@njit(cache=True, error_model="numpy")
def _held_ago(control: Array, edges: Array, total: Array, delay: Array) -> Array:
    """What `delayed` computes from the control's integral `total` at the `edges` of rows, compiled."""
    rows, drives, count = control.shape
    means, integral = np.empty_like(control), np.empty_like(total)
    for b in range(drives):
        row = 0
        for edge in range(rows + 1):
            ago = edges[edge, b] - delay[0]
            while row + 1 < rows and edges[row + 1, b] < ago:
                row += 1
            since = ago - edges[row, b]
            for u in range(count):
                integral[edge, b, u] = total[row, b, u] + since * control[row, b, u]
        for row in range(rows):
            for u in range(count):
                means[row, b, u] = (integral[row + 1, b, u] - integral[row, b, u]) / (edges[row + 1, b] - edges[row, b])
    return means


def rate_limited(control: Tensor, time: Tensor, rate: Tensor) -> Tensor:
    """Follow commands at a rate's speed at most, averaged over each interval, exact for held controls; the first was
    held for ever before.

    Args:
        control: `(rows, trajectories, U)`.
        time: `(rows, trajectories)` s.
        rate: the fastest change, in the control's unit a second, one number or `(U,)`; nothing moves if it is not
            positive.
    """
    if len(time) < 2:
        return control
    rate = torch.as_tensor(rate, dtype=control.dtype, device=control.device)
    reach = (rate * row_spans(time).unsqueeze(-1)).clamp(min=torch.finfo(control.dtype).tiny)  # within an interval
    at, means = control[0], []
    for command, most in zip(control, reach, strict=True):
        away = command - at
        share = (away / most).clamp(-1, 1)
        means.append(command - share * (away.abs() - 0.5 * share.abs() * most))
        at = at + share * most
    return torch.stack(means)


def with_play(control: Tensor, gap: Tensor) -> Tensor:
    """What follows a control through a gap: it stays within `gap` of it, and moves no further than that takes.

    Args:
        control: `(rows, trajectories, U)`; the first is in the middle of the gap.
        gap: half the play, in the control's unit; none if it is not positive.
    """
    gap = torch.as_tensor(gap, dtype=control.dtype, device=control.device).clamp(min=0.0)
    low, high = control - gap, control + gap
    if _is_plain(low, high):
        return torch.from_numpy(_dragged(*(part.detach().contiguous().numpy() for part in (control, low, high))))
    at, found = control[0], [control[0]]
    for row in range(1, len(control)):
        at = torch.maximum(low[row], torch.minimum(high[row], at))
        found.append(at)
    return torch.stack(found)


@njit(cache=True, error_model="numpy")
def _dragged(control: Array, low: Array, high: Array) -> Array:
    """The loop of `with_play`, compiled."""
    found = np.empty_like(control)
    found[0] = control[0]
    for row in range(1, len(control)):
        found[row] = np.maximum(low[row], np.minimum(high[row], found[row - 1]))
    return found


def row_spans(time: Tensor) -> Tensor:
    """Seconds from each row to the next, of the last row as of the one before it; shaped as the `time` of rows."""
    return torch.cat([time[1:] - time[:-1], time[-1:] - time[-2:-1]])
