"""What an effect does to a program's sites: move their means, widen them, give them tails.

with pushed(self, {"forward": -c * velocity}):
    return super().transition(state, control, time, step)
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pyro.distributions as dist
import torch
from pyro import poutine
from torch import Tensor

from steady_ppl.model.distributions import WrappedNormal, WrappedStudentT
from steady_ppl.model.handlers import (
    AtMean,
    ByColumn,
    Recording,
    as_event,
    as_vector,
    broadcast_shapes,
    mean_reading,
    normal_moments,
    unwrapped,
    with_moments,
)
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import row_ends


@dataclass(eq=False)
class Transforming(ByColumn):
    """Replace the distribution of each site that a method of a program samples."""

    change: Callable[[Any, slice], Any]  # of a distribution and the columns of the channels or measurements that it has

    def _pyro_sample(self, message: Any) -> None:
        message["fn"] = self.change(message["fn"], self.take(message["fn"]))


def pushed(program: Program, pushes: Mapping[str, Tensor]) -> Transforming:
    """Add to the means of a program's channels while its `transition` runs: channel → `(...)` in the channel's unit."""
    return _by_channel(program, pushes, 0.0, lambda fn, push: with_moments(fn, loc=unwrapped(fn).loc + push))


def widened(program: Program, factors: Mapping[str, Tensor]) -> Transforming:
    """Multiply the spreads of a program's channels, channel → factor `(...)`, while its `transition` runs."""
    return _by_channel(program, factors, 1.0, lambda fn, factor: with_moments(fn, scale=unwrapped(fn).scale * factor))


def _by_channel(
    program: Program, values: Mapping[str, Tensor], missing: float, alter: Callable[[Any, Tensor], Any]
) -> Transforming:
    """Alter each channel's distribution by its own value."""

    def change(fn: Any, columns: slice) -> Any:
        mean, _ = normal_moments(fn, "channel")
        return alter(fn, as_event(_side_by_side(values, program.channel_names[columns], missing, mean), fn.event_dim))

    return Transforming(change)


def misread(program: Program, change: Callable[[Tensor], Tensor]) -> Transforming:
    """Change the mean measurement, `(..., K)` and angles on the circle, while a program's `observe` runs."""

    def at_site(fn: Any, columns: slice) -> Any:
        reading = as_vector(mean_reading(fn), fn.event_dim)
        whole = reading.new_zeros((*reading.shape[:-1], len(program.measurements)))
        whole = torch.cat([whole[..., : columns.start], reading, whole[..., columns.stop :]], -1)
        return with_moments(fn, loc=as_event(change(whole)[..., columns], fn.event_dim))

    return Transforming(at_site)


def blurred(factors: Tensor) -> Transforming:
    """Multiply the measurements' standard deviations by factors `(..., K)` while a program's `observe` runs."""

    def change(fn: Any, columns: slice) -> Any:
        return with_moments(fn, scale=unwrapped(fn).scale * as_event(factors[..., columns], fn.event_dim))

    return Transforming(change)


def heavy_tailed(share: Tensor, columns: Sequence[int] = ()) -> Transforming:
    """Give the measurements' noise the tails of a Student t of 1/`share` degrees of freedom, its scale the normal's; of
    sites with some `columns` only, where these are named."""
    chosen = set(columns)

    def change(fn: Any, columns: slice) -> Any:
        if chosen and not chosen & set(range(columns.start, columns.stop)):
            return fn
        base = unwrapped(fn)
        kind = WrappedStudentT if isinstance(base, WrappedNormal | WrappedStudentT) else dist.StudentT
        return kind((1 / share).expand(base.loc.shape), base.loc, base.scale).to_event(fn.event_dim)

    return Transforming(change)


class Coloured(Transforming):
    """Let a share (channel → share) of each channel's last deviation stay; both deviations are `(..., C)`."""

    def __init__(self, program: Program, shares: Mapping[str, Tensor], last: Tensor) -> None:
        share = _side_by_side(shares, program.channel_names, 0.0, last)
        super().__init__(self._change)
        self.last, self.pushes, self.factors = last, share * last, (1 - share.square()).sqrt()
        self.deviations: list[Tensor] = []

    def _change(self, fn: Any, columns: slice) -> Any:
        pushes, factors = (as_event(values[..., columns], fn.event_dim) for values in (self.pushes, self.factors))
        return with_moments(fn, unwrapped(fn).loc + pushes, unwrapped(fn).scale * factors)

    def beside(self, state: Tensor) -> Tensor:
        """A state and the deviations side by side, `(..., D + C)`: the new ones where the row ends, else the last."""
        deviations = torch.cat(self.deviations, -1) if row_ends() else self.last
        left = broadcast_shapes(state.shape[:-1], deviations.shape[:-1])
        return torch.cat([state.expand(*left, -1), deviations.expand(*left, -1)], -1)

    def _pyro_post_sample(self, message: Any) -> None:
        fn = message["fn"]
        width = fn.event_shape.numel()
        mean, _ = normal_moments(fn, message["name"])
        value = as_vector(message["value"] - mean, fn.event_dim)
        self.deviations.append(value + self.pushes[..., self.column - width : self.column])


def channel_means(program: Program, transition: Callable[..., Tensor], *arguments: Tensor) -> dict[str, Tensor]:
    """The means of the channels that a transition of some arguments samples, by name, each `(...)`."""
    with poutine.block(), Recording() as seen, AtMean():
        transition(*arguments)
    parts = [as_vector(value, seen.distributions[site].event_dim) for site, value in seen.values.items()]
    return dict(zip(program.channel_names, torch.cat(parts, -1).unbind(-1), strict=True))


def by_channel(program: Program, values: Mapping[str, Tensor], missing: float, like: Tensor) -> Tensor:
    """Values by channel side by side, `(..., C)` as `like`."""
    return _side_by_side(values, program.channel_names, missing, like).expand_as(like)


def _side_by_side(values: Mapping[str, Tensor], channels: tuple[str, ...], missing: float, like: Tensor) -> Tensor:
    """Channels' values as columns, `(..., C)`."""
    found = [values.get(name, like.new_tensor(missing)) for name in channels]
    return torch.stack(torch.broadcast_tensors(*found), -1)
