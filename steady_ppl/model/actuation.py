"""What comes of a command on its way: lag and delay of controls that are held from row to row."""

import torch
from torch import Tensor


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
    at, means = control[0], []
    for row in range(len(control)):
        means.append(control[row] + (at - control[row]) * share[row])
        at = control[row] + (at - control[row]) * stays[row]
    return torch.stack(means)


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

    ago = (edges - delay).contiguous()
    row = torch.searchsorted(edges.t().contiguous(), ago.t().contiguous()).t() - 1  # the one before, on an edge
    row = row.clamp(0, len(control) - 1)
    wide = row.unsqueeze(-1).expand(*row.shape, control.shape[-1])
    since = (ago - edges.gather(0, row)).unsqueeze(-1)  # negative before the first row, whose control was held
    integral = total.gather(0, wide) + since * control.gather(0, wide)
    return (integral[1:] - integral[:-1]) / (edges[1:] - edges[:-1]).unsqueeze(-1)


def row_spans(time: Tensor) -> Tensor:
    """Seconds from each row to the next, of the last row as of the one before it; shaped as the `time` of rows."""
    return torch.cat([time[1:] - time[:-1], time[-1:] - time[-2:-1]])
