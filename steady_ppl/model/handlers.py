"""Effect handlers that run a program's sites: condition, temper, replay, record."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Self, cast

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from pyro import poutine
from pyro.poutine.mask_messenger import MaskMessenger
from pyro.poutine.messenger import Messenger
from torch import Tensor

from steady_ppl.errors import ProgramError
from steady_ppl.model.program import Program

EVENT_HINT = "(is .to_event(1) missing?)"
NEEDS_NORMAL = (  # ends the message of `normal_moments`
    ": looking ahead needs normal noise with independent components (a scalar or a vector); --recipe steady --guide "
    "bootstrap takes any"
)


class ByColumn(Messenger):
    """A handler whose sites take columns in the order in which they are met, from the first whenever it is entered."""

    column = 0

    def __enter__(self) -> Self:
        self.column = 0
        super().__enter__()
        return self

    def take(self, fn: Any) -> slice:
        """The columns of the site that has this distribution."""
        columns = slice(self.column, self.column + fn.event_shape.numel())
        self.column = columns.stop
        return columns


@dataclass(eq=False)
class Observing(ByColumn):
    """Condition the sites of `observe` on measurements and temper them. A missing cell contributes nothing."""

    measurements: Tensor  # (..., K), finite also where missing
    observed: Tensor  # (..., K) bool
    weight: float | Tensor = 1.0  # of the observations' log-density (w_obs in STEADY), (...) where it is a tensor

    def __exit__(self, *exception: Any) -> None:
        super().__exit__(*exception)
        if exception[0] is None and self.column != self.measurements.shape[-1]:
            declares = f"the model declares {self.measurements.shape[-1]}"
            raise ProgramError(f"observe sampled {self.column} measurement components, {declares}", site="observe")

    def _pyro_sample(self, message: Any) -> None:
        fn, name = message["fn"], message["name"]
        if message["is_observed"]:
            raise ProgramError(f"site {name!r} of observe has obs=: leave it out, the engine conditions", site=name)
        columns = self.take(fn)
        if fn.event_dim > 1 or self.column > self.measurements.shape[-1]:
            wanted = f"a scalar or a vector, and {self.measurements.shape[-1]} declared measurement components in all"
            what = f"has event shape {tuple(fn.event_shape)}; expected {wanted}"
            raise ProgramError(f"site {name!r} of observe {what}", site=name)
        value, observed = self.measurements[..., columns], self.observed[..., columns]
        if fn.event_dim == 0:
            value, observed = value[..., 0], observed[..., 0]
            try:
                fn = fn.mask(observed)
            except ValueError:
                what = f"which does not fit rows and trajectories {tuple(observed.shape)} {EVENT_HINT}"
                batch = f"site {name!r} of observe has batch shape {tuple(fn.batch_shape)}"
                raise ProgramError(f"{batch}, {what}", site=name) from None
        elif isinstance(fn, dist.Independent) and fn.base_dist.event_dim == 0:
            fn = fn.base_dist.mask(observed).to_event(1)
        else:
            whole = observed.all(-1)
            if bool((observed.any(-1) & ~whole).any()):
                some = f"correlated components ({type(fn).__name__}), of which some are missing"
                why = "independent components (to_event(1)) can be masked one by one, these cannot"
                raise ProgramError(f"site {name!r} has {some}: {why}", site=name)
            fn = fn.mask(whole)
        message["fn"], message["value"], message["is_observed"] = fn, value, True
        message["scale"] = message["scale"] * self.weight


@dataclass(eq=False)
class Broadcasting(Messenger):
    """Give every site the batch shape `left`, as plates would, without claiming any plate's dimension."""

    left: tuple[int, ...]

    def _pyro_sample(self, message: Any) -> None:
        fn = message["fn"]
        if fn.batch_shape == self.left:
            return
        try:
            message["fn"] = fn.expand(broadcast_shapes(fn.batch_shape, self.left))
        except RuntimeError:
            name, batch = message["name"], f"batch shape {tuple(fn.batch_shape)}"
            what = f"{batch} and event shape {tuple(fn.event_shape)} on states of batch shape {self.left} {EVENT_HINT}"
            raise ProgramError(f"site {name!r} has {what}", site=name) from None


@contextmanager
def running(*left: int) -> Iterator[None]:
    """Run the program's methods on states of batch shape `left`, hidden from any handler outside, without checks of
    the distributions' arguments (`probe` has made them)."""
    local = pyro.settings.context(module_local_params=True)
    with local, poutine.block(), pyro.validation_enabled(False), Broadcasting(left):
        yield


@dataclass(eq=False)
class KnownStart(Messenger):
    """Replace the prior of `initial` by certainty about the first state, `(B, D)`."""

    state: Tensor

    def _pyro_sample(self, message: Any) -> None:
        width = message["fn"].event_shape.numel()
        whole = message["fn"].event_dim == 1 and width <= self.state.shape[-1]
        if not whole or bool((self.state[..., width:] != 0).any()):
            name, has = message["name"], tuple(message["fn"].event_shape)
            wanted = f"to sample the whole state as one site of event shape ({self.state.shape[-1]},)"
            raise ProgramError(f"a known start needs initial() {wanted}; site {name!r} has {has}", site=name)
        message["fn"] = dist.Delta(self.state[..., :width], event_dim=1)  # what is left rests


@dataclass(eq=False)
class Replaying(Messenger):
    """Give latent sites the values that are already known, site name → value."""

    values: Mapping[str, Tensor]

    def _pyro_sample(self, message: Any) -> None:
        if message["name"] in self.values:
            message["value"] = self.values[message["name"]]


class AtMean(Messenger):
    """Give every latent site its mean: a roll-out without noise."""

    def _pyro_sample(self, message: Any) -> None:
        if not message["is_observed"]:
            message["value"] = location(message["fn"])


@dataclass(eq=False)
class Standardised(ByColumn):
    """Give latent sites `mean + sd · noise`, of standard normal noise `(..., C)`."""

    noise: Tensor

    def _pyro_sample(self, message: Any) -> None:
        if message["is_observed"]:
            return
        mean, sd = normal_moments(message["fn"], message["name"])
        noise = self.noise[..., self.take(message["fn"])]
        message["value"] = mean + sd * as_event(noise, message["fn"].event_dim)


@dataclass(eq=False)
class Substituting(ByColumn):
    """Give latent sites the columns of some values, `(..., C)`, in the order in which the sites are met."""

    values: Tensor

    def _pyro_sample(self, message: Any) -> None:
        message["value"] = as_event(self.values[..., self.take(message["fn"])], message["fn"].event_dim)


@dataclass(eq=False)
class Recording(Messenger):
    """Keep the values of latent sites, every site's distribution, and the observed sites' tempered log-densities."""

    values: dict[str, Tensor] = field(default_factory=dict)  # of latent sites
    observed: dict[str, Tensor] = field(default_factory=dict)  # values of observed sites
    distributions: dict[str, Any] = field(default_factory=dict)
    log_likelihood: list[Tensor] = field(default_factory=list)  # one `(...)` an observed site

    def total(self) -> Tensor:
        """The sum of the observed sites' log-densities, `(...)`."""
        return sum(self.log_likelihood[1:], self.log_likelihood[0])

    def expanded(self, left: Sequence[int]) -> dict[str, Tensor]:
        """Values of latent sites, by site, of batch shape `left`."""
        kinds = self.distributions
        return {site: broadcast_event(value, left, kinds[site].event_dim) for site, value in self.values.items()}

    def _pyro_post_sample(self, message: Any) -> None:
        name = message["name"]
        self.distributions[name] = message["fn"]
        if message["is_observed"]:
            self.observed[name] = message["value"]
            self.log_likelihood.append(message["scale"] * message["fn"].log_prob(message["value"]))
        else:
            self.values[name] = message["value"]


def masked(mask: Tensor) -> MaskMessenger:
    """Count only the sites' elements where `mask` holds."""
    return MaskMessenger(cast(torch.BoolTensor, mask))


def unwrapped(fn: Any) -> Any:
    """Return the distribution under `to_event`, `mask` and `expand`."""
    while isinstance(fn, dist.Independent | dist.MaskedDistribution | dist.ExpandedDistribution):
        fn = fn.base_dist
    return fn


def mean_reading(fn: Any) -> Tensor:
    """The mean of a measurement site, in its unit; on the circle where its distribution lives there."""
    base = unwrapped(fn)
    return -base.residual(torch.zeros_like(base.loc)) if hasattr(base, "residual") else base.loc


def residual(fn: Any, value: Tensor) -> Tensor:
    """`value − mean` of a measurement site, in its unit and as `value`, on the circle where its distribution lives
    there."""
    base = unwrapped(fn)
    if hasattr(base, "residual"):
        return base.residual(value)
    return value - location(fn)


def location(fn: Any) -> Tensor:
    """The mean of a site; of a Student t, which may have none, where it is centred."""
    base = unwrapped(fn)
    return base.loc.expand(fn.shape()) if isinstance(base, dist.StudentT) else fn.mean


def normal_moments(fn: Any, site: str) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation, `(...)` or `(..., C)`, of a site with independent normal components, or raise
    ProgramError."""
    base = unwrapped(fn)
    if not isinstance(base, dist.Normal) or fn.event_dim > 1:
        what = f"{type(base).__name__} with event shape {tuple(fn.event_shape)}"
        raise ProgramError(f"site {site!r} is {what}{NEEDS_NORMAL}", site=site)
    return base.loc, base.scale


def tangent_normal(fn: Any, residual: Tensor, site: str, variance: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return standard deviation and log-density at residual zero, each as `residual`, of the normal that touches a
    measurement site's log-density from below, with the same slope.

    A normal is its own; a Student t's is wider the farther out it is touched (Lange, Little and Taylor 1989). That is
    where the square is `residual`² + `variance`, there the bound of its mean is best. Any other site is a ProgramError.
    """
    base = unwrapped(fn)
    if not isinstance(base, dist.StudentT) or fn.event_dim > 1:
        _, sd = normal_moments(fn, site)
        return sd, -sd.log() - 0.5 * math.log(2 * math.pi)
    squares = residual.square() if variance is None else residual.square() + variance
    sd = ((base.df * base.scale.square() + squares) / (base.df + 1)).sqrt()
    density = dist.StudentT(base.df, torch.zeros_like(residual), base.scale).log_prob(squares.sqrt())
    return sd, density + 0.5 * squares / sd.square()


def is_heavy_tailed(fn: Any) -> bool:
    """Whether a site is a Student t."""
    return isinstance(unwrapped(fn), dist.StudentT)


def as_vector(value: Tensor, event_dim: int) -> Tensor:
    """A site's value `(..., *event)` as columns, `(..., C)`: a scalar, of event dimension 0, as a vector of one."""
    return value.unsqueeze(-1) if event_dim == 0 else value


def as_event(values: Tensor, event_dim: int) -> Tensor:
    """Columns `(..., C)` as a site's value, the one of a scalar site without its dimension; undoes `as_vector`."""
    return values if event_dim else values.squeeze(-1)


def joined(values: Mapping[str, Tensor], kinds: Mapping[str, Any], left: Sequence[int]) -> Tensor:
    """The sites' values side by side, `(*left, C)`."""
    parts = [as_vector(value, kinds[site].event_dim) for site, value in values.items()]
    return torch.cat([part.expand(*left, part.shape[-1]) for part in parts], -1)


def parted(values: Tensor, kinds: Mapping[str, Any]) -> dict[str, Tensor]:
    """What `joined` puts side by side, by site."""
    parts = values.split([fn.event_shape.numel() for fn in kinds.values()], -1)
    return {site: as_event(part, fn.event_dim) for (site, fn), part in zip(kinds.items(), parts, strict=True)}


def with_moments(fn: Any, loc: Tensor | None = None, scale: Tensor | None = None) -> Any:
    """A distribution of the kind of another one, with another location or scale."""
    base = unwrapped(fn)
    freedom = (base.df,) if isinstance(base, dist.StudentT) else ()
    moments = (base.loc if loc is None else loc, base.scale if scale is None else scale)
    return type(base)(*freedom, *moments).to_event(fn.event_dim)


def broadcast_event(value: Tensor, left: Sequence[int], event_dim: int) -> Tensor:
    """Expand a site's value `(..., *event)` to the batch shape `left`; `event_dim` is the event's dimensions."""
    return value.expand(*left, *value.shape[value.dim() - event_dim :])


def draw_starts(program: Program, *left: int) -> Tensor:
    """Draw states from a program's `initial`, `(*left, D)`."""
    with running(*left):
        return broadcast_event(program.initial(), left, 1)


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """Do as `torch.broadcast_shapes`, which loads sympy for half a second; RuntimeError where shapes do not fit.

    Example:
        >>> broadcast_shapes((3, 1), (2,))
        torch.Size([3, 2])
    """
    if not all(type(length) is int for shape in shapes for length in shape):  # what traces and exports pass on
        return torch.broadcast_shapes(*shapes)
    try:
        return torch.Size(np.broadcast_shapes(*map(tuple, shapes)))
    except ValueError as error:
        raise RuntimeError(str(error)) from None
