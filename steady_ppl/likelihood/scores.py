"""How log p(y) changes with a parameter, exactly for the linearised program, by Fisher's identity.

The derivative of log p(y) is the posterior mean of the derivative of the joint log-density (Fisher; Louis 1982). The
joint is a product of normals, of the channels and of the measurements. With z a standardised deviation, ψ the
derivative of its mean in standard deviations and χ that of the log standard deviation it is the sum of

    E[z ψ(x) + (z² − 1) χ(x)],    E[z ψ(x)] ≈ E[z] ψ(x̂) + ½ [ψ(x̂ + v) − ψ(x̂ − v)],    v = Cov(x, z).

A regression of smoothed residuals on ψ leaves out v and divides by Σψ² instead of the information: it finds 5 to 20 %
of a missing drag. Scores keep the posterior's dependence, and are divided by what they vary by under the program.

With several substeps a parameter also changes the noise's way through a row, which no moment of the channels holds.
There the joint is that of the noise alone, and a row's end x' moves with the parameter. With β(x') the likelihood of
the measurements from x' on, the score is the sum of E[∇ log β(x') · ∂x'/∂θ], the noise held. Effects' columns in a
search do not go so far: they are pushes on the channels, whose scores simulated sets calibrate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.information_filter import Lookahead
from steady_ppl.gaussian.linearize import has_heavy_tails
from steady_ppl.gaussian.posterior_moments import Cells, posterior_moments
from steady_ppl.kernels.rows import Slopes, slopes_on_all_rows
from steady_ppl.likelihood.parameters import Element, moved, on_both_sides
from steady_ppl.model.handlers import (
    AtMean,
    Recording,
    as_vector,
    is_heavy_tailed,
    location,
    normal_moments,
    residual,
    running,
    unwrapped,
)
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import (
    acting_controls,
    all_rows,
    channel_scales,
    noisy_step,
    row_chain,
    row_inputs,
    sample_channels,
)
from steady_ppl.utils.angles import wrap_angles


@dataclass(frozen=True)
class Deviations:
    """The posterior of standardised deviations from their means."""

    mean: Tensor  # (rows, B, C), zero where there is none
    variance: Tensor  # likewise
    points: Tensor  # of the state, where slopes of the means are wanted, (..., D)
    present: Tensor  # (rows, B, C) bool

    def of_spread(self, slope: Tensor) -> Tensor:
        """Score of a change of the log standard deviations by `slope`, `(rows, B, C)`; `(B,)`."""
        return torch.where(self.present, self.excess * slope, 0.0).sum((0, -1))

    @cached_property
    def excess(self) -> Tensor:
        """By how much mean squares are larger than under the program, `(rows, B, C)`."""
        return self.mean.square() + self.variance - 1


@dataclass(frozen=True)
class ChannelDeviations(Deviations):
    """Of channels; `points` are x̂, x̂ + v and x̂ − v for each component, `(1 + 2 C, rows, B, D)`."""

    def of_mean(self, slope: Tensor) -> Tensor:
        """Score of a change of the means by `slope` deviations at `points`, `(1 + 2 C, rows, B, C)`; `(B,)`."""
        return self.by_row(slope).sum(0)

    def by_row(self, slope: Tensor) -> Tensor:
        """`of_mean` row by row, `(rows, B)`."""
        count = self.mean.shape[-1]
        return sum(self.of_component(i, slope[self.places(i), ..., i]) for i in range(count))  # type: ignore[return-value]

    def of_component(self, index: int, slope: Tensor) -> Tensor:
        """Row by row, of a change of one component's mean at x̂, x̂ + v and x̂ − v of that component, `(3, rows, B)`."""
        return torch.where(self.present[..., index], self.mean[..., index] * slope[0] + (slope[1] - slope[2]) / 2, 0.0)

    def weights(self, index: int) -> Tensor:
        """What `of_component` multiplies the slopes with, `(3, rows, B)`."""
        half = torch.full_like(self.mean[..., index], 0.5)
        return torch.where(self.present[..., index], torch.stack([self.mean[..., index], half, -half]), 0.0)

    def around(self, index: int) -> Tensor:
        """The points of one component, `(3, rows, B, D)`."""
        return component_major(self.points[self.places(index)])

    def places(self, index: int) -> list[int]:
        """Which `points` are those of one component."""
        return [0, 1 + index, 1 + self.mean.shape[-1] + index]

    def of_slopes(self, slopes: Slopes, sharpness: Tensor) -> Tensor:
        """Scores of learnable numbers, `(B, P)`, from the slopes of the means and, after them, of the log standard
        deviations, at `points` row by row; `sharpness` is 1 / the standard deviations, `(rows, B, C)`."""
        count, rows = self.mean.shape[-1], self.mean.shape[0]
        of_means = slopes.components < count
        at, values = slopes.components[of_means], slopes.values[of_means].unflatten(1, (-1, rows))
        here, up, down = (values[range(len(at)), point] for point in (0 * at, 1 + at, 1 + count + at))
        mean, sharp, present = (part.movedim(-1, 0) for part in (self.mean, sharpness, self.present))
        by_mean = torch.where(present[at], (mean[at] * here + (up - down) / 2) * sharp[at], 0.0)
        at = slopes.components[~of_means] - count
        by_spread = torch.where(present[at], self.excess.movedim(-1, 0)[at] * slopes.values[~of_means, :rows], 0.0)
        return (
            by_mean.sum(1).double().t() @ slopes.by_number[of_means]
            + by_spread.sum(1).double().t() @ slopes.by_number[~of_means]
        )


@dataclass(frozen=True)
class ReadingDeviations(Deviations):
    """Of measurements; `points` are those of the `cells`, `(N, 1, D)` in their order."""

    cells: Cells

    def of_mean(self, slope: Tensor, which: slice = slice(None)) -> Tensor:
        """Score of a change of the means by `slope` deviations at the three points of cells, `(3, M)`; `(B,)`."""
        rows, drives = self.mean.shape[:2]
        by_cell = self.at_cells(self.mean, which) * slope[0] + (slope[1] - slope[2]) / 2
        by_row = by_cell.new_zeros(rows * drives).index_add(0, self.cells.row[which], by_cell)
        return by_row.view(rows, drives).sum(0)

    def weights(self, index: int) -> Tensor:
        """What `of_mean` multiplies the slopes with, of the cells of one component, `(3, M)`."""
        mean = self.at_cells(self.mean, self.cells.of_component(index))
        half = torch.full_like(mean, 0.5)
        return torch.stack([mean, half, -half])

    def of_slopes(self, slopes: Slopes, sharpness: Tensor, of_tails: Tensor) -> Tensor:
        """Scores of learnable numbers, `(B, P)`, from the slopes of the means, after them of the log standard
        deviations and then of the tails, at `points`; `sharpness` is 1 / the standard deviations, `(rows, B, K)`, and
        `of_tails` what a change of the tails is worth."""
        _, drives, count = self.mean.shape
        place, cell = self.cells.of_components(slopes.components % count)
        here, up, down = slopes.values.squeeze(-1)[place, self.cells.points[:, cell]]
        mean, sharp, excess, tails = (self.at_cells(one)[cell] for one in (self.mean, sharpness, self.excess, of_tails))
        kind = (slopes.components // count)[place]
        own = torch.where(kind == 1, excess, tails) * here
        own = torch.where(kind == 0, (mean * here + (up - down) / 2) * sharp, own)
        by_drive = own.new_zeros(len(slopes.values) * drives, dtype=torch.float64)
        by_drive.index_add_(0, place * drives + self.cells.row[cell] % drives, own.double())
        return by_drive.view(-1, drives).t() @ slopes.by_number

    def own(self, values: Tensor) -> Tensor:
        """What values at `points`, `(N, 1, K)`, are of each cell's own component at its three points, `(3, M)`."""
        return values.squeeze(1)[self.cells.points, self.cells.component]

    def at_cells(self, values: Tensor, which: slice = slice(None)) -> Tensor:
        """What values `(rows, B, K)` are at cells, `(M,)`."""
        return values.movedim(-1, 0).flatten(1)[self.cells.component[which], self.cells.row[which]]


@dataclass(frozen=True)
class Smoothed:
    """What scores need of a smoothed program."""

    states: Tensor  # posterior means, (T + 1, B, D)
    channels: ChannelDeviations  # of (T, B, C) channels
    lag: Tensor  # posterior covariance of each channel's deviation with its last one, (T, B, C), zero at the first
    measurements: ReadingDeviations  # of (T + 1, B, K) measurements
    sharpness: Tensor  # 1 / their standard deviations, (T + 1, B, K); those of the normal that touches a Student t
    ahead: Lookahead  # of which these are the moments


@dataclass(frozen=True)
class Arrivals:
    """The posterior of ∇ log β(x'), of the measurements from the end of each row on.

    `states` and `noise` are posterior means, and these ± their covariance with each component of ∇ log β(x') in
    standard deviations.
    """

    mean: Tensor  # (T, B, D), in standard deviations
    scale: Tensor  # their size, (T, B, D)
    states: Tensor  # (1 + 2 D, T, B, D)
    noise: Tensor  # (1 + 2 D, T, B, C)
    angles: tuple[int, ...]  # components of the state that are angles
    present: Tensor  # (T, B) bool

    def score(self, change: Tensor) -> Tensor:
        """Of a change of where rows end, `(1 + 2 D, T, B, D)`; `(B,)`."""
        count = self.mean.shape[-1]
        change = wrap_angles(change, self.angles)
        apart = (change[1 : 1 + count] - change[1 + count :]).diagonal(dim1=0, dim2=-1) / 2
        return torch.where(self.present, (self.scale * (self.mean * change[0] + apart)).sum(-1), 0.0).sum(0)

    def of_slopes(self, slopes: Slopes) -> Tensor:
        """Scores of learnable numbers from the slopes of where rows end, row by row; `(B, P)`."""
        count, rows, at = self.mean.shape[-1], self.mean.shape[0], slopes.components
        values = slopes.values.unflatten(1, (-1, rows))
        here, up, down = (values[range(len(at)), point].double() for point in (0 * at, 1 + at, 1 + count + at))
        mean, scale = self.mean.movedim(-1, 0)[at], self.scale.movedim(-1, 0)[at]
        by_row = torch.where(self.present, scale * (mean * here + (up - down) / 2), 0.0)
        return by_row.sum(1).t() @ slopes.by_number


def arrivals(ahead: Lookahead, data: Trajectories) -> Arrivals:
    """What a push on the end of each row is worth."""
    linear = ahead.linearization
    states, noise = ahead.means()
    covariance, every, sway = ahead.covariances()
    weighted = linear.measurement * linear.precision.unsqueeze(-1)
    precision = (ahead.precision + weighted.mT @ linear.measurement)[1:]
    information = (ahead.information + (weighted.mT @ linear.residual.unsqueeze(-1)).squeeze(-1))[1:]
    away = (states - linear.path.states)[1:].unsqueeze(-1)
    with_state = linear.state @ covariance[:-1] + linear.noise @ sway.mT  # covariances of the end of a row
    with_noise = linear.state @ sway + linear.noise @ every
    of_end = linear.state @ with_state.mT + linear.noise @ with_noise.mT
    scale = (precision @ of_end @ precision).diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    per = torch.where(scale > 0, 1 / scale, 0.0)
    by_state, by_noise = (-(per.unsqueeze(-1) * (precision @ part)).movedim(-2, 0) for part in (with_state, with_noise))
    kind = data.controls.dtype
    begin = torch.where(data.rows.unsqueeze(-1), states, states[:1])[:-1]
    return Arrivals(
        mean=per * (information - (precision @ away).squeeze(-1)),
        scale=scale,
        states=component_major(torch.cat([begin.unsqueeze(0), begin + by_state, begin - by_state]).to(kind)),
        noise=component_major(torch.cat([noise.unsqueeze(0), noise + by_noise, noise - by_noise]).to(kind)),
        angles=linear.angles,
        present=data.transitions,
    )


def smoothed(ahead: Lookahead, data: Trajectories) -> Smoothed:
    """Posterior moments of a linearised program, whose path is its posterior mean or near it."""
    precision, kind = ahead.linearization.precision, data.controls.dtype
    found = posterior_moments(ahead, data)
    lag = torch.from_numpy(found.lag).movedim(0, -1).to(precision.device)
    inside = data.transitions.unsqueeze(-1).expand_as(lag)
    seen = found.measurements.tensors(precision.device)
    seen["points"] = seen["points"].unsqueeze(1)
    return Smoothed(
        states=component_major(found.states.to(kind)),
        channels=ChannelDeviations(**found.channels.tensors(precision.device), present=inside),
        lag=torch.where(inside, lag, 0.0),
        measurements=ReadingDeviations(**seen, present=precision > 0, cells=found.cells),
        sharpness=component_major(precision.sqrt().to(kind)),
        ahead=ahead,
    )


def component_major(values: Tensor) -> Tensor:
    """The same values `(..., C)`, laid out component by component, as the programs take them apart."""
    return values.movedim(-1, 0).contiguous().movedim(0, -1)


@torch.no_grad()
def channel_moments(
    program: Program, data: Trajectories, states: Tensor, controls: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Means and standard deviations of rows' channels at states `(P, T, B, D)`, each `(P, T, B, C)`; `controls` are the
    acting ones, `(T + 1, B, U)` or `(P, T + 1, B, U)`, or as `acting` gives them."""
    controls = acting_controls(program, data) if controls is None else controls
    return _moments_of_channels(program, states, controls[..., :-1, :, :], data.elapsed[:-1], data.steps)


def _moments_of_channels(
    program: Program, states: Tensor, control: Tensor, time: Tensor, step: Tensor
) -> tuple[Tensor, Tensor]:
    with running(*states.shape[:-1]), Recording() as seen, AtMean():
        sample_channels(program, states, control, time, step)
    sites = (
        [as_vector(part, fn.event_dim).expand(*states.shape[:-1], -1) for part in normal_moments(fn, site)]
        for site, fn in seen.distributions.items()
    )
    mean, spread = (torch.cat(parts, -1) for parts in zip(*sites, strict=True))
    return mean, spread


@torch.no_grad()
def substep_spreads(program: Program, data: Trajectories, states: Tensor, controls: Tensor | None = None) -> Tensor:
    """What the channels' distributions have as standard deviations at states `(P, T, B, D)`, `(P, T, B, C)`.

    With one substep they are those of `channel_moments`, which with more are of a row's average. `controls` as there.
    """
    if program.substeps == 1:
        return channel_moments(program, data, states, controls)[1]
    controls = acting_controls(program, data) if controls is None else controls
    with running(*states.shape[:-1]):
        return channel_scales(program, states, controls[..., :-1, :, :], data.elapsed[:-1], data.steps)


def widens(program: Program, parts: Sequence[Element], data: Trajectories) -> list[bool]:
    """Whether learnable numbers are each the logarithm of the standard deviation of some channel."""
    states = data.controls.new_ones((1, *data.steps.shape, len(program.states)))
    here, found = substep_spreads(program, data, states), []
    for part in parts:
        with moved(part, 0.1):
            there = substep_spreads(program, data, states)
        change = (there / here).log().nan_to_num(0.0, 0.0, 0.0)[:, data.transitions]
        still_or_moved = (change.abs() < 1e-6) | ((change - 0.1).abs() < 1e-3)
        found.append(bool(still_or_moved.all()) and bool((change > 0.05).any()))
    return found


@dataclass(frozen=True)
class Measured:
    """What is measured at some states: the sites' distributions."""

    distributions: dict[str, Any]

    def _of_sites(self, value: Callable[[str, Any], Tensor]) -> Tensor:
        """What is computed of each site and its distribution, as one vector, `(..., K)`."""
        return torch.cat([as_vector(value(site, fn), fn.event_dim) for site, fn in self.distributions.items()], -1)

    def shift(self, other: Measured) -> Tensor:
        """How much more `other` measures on average, on the circle where a measurement lives there, `(..., K)`."""
        return self._of_sites(lambda site, fn: residual(fn, location(other.distributions[site])))

    @property
    def reading(self) -> Tensor:
        """What is measured on average, `(..., K)`, on the circle where a measurement lives there."""
        return self._of_sites(lambda _, fn: -residual(fn, torch.zeros_like(location(fn))))

    @property
    def spread(self) -> Tensor:
        """Scales, `(..., K)`."""
        return self._of_sites(lambda _, fn: unwrapped(fn).scale)

    @property
    def tails(self) -> Tensor:
        """One over the degrees of freedom, `(..., K)`, zero where the noise is normal."""

        def of_site(_: str, fn: Any) -> Tensor:
            base = unwrapped(fn)
            tails = 1 / base.df if is_heavy_tailed(base) else torch.zeros_like(base.scale)
            return tails.expand(base.scale.shape)

        return self._of_sites(of_site)

    @property
    def heavy_tailed(self) -> bool:
        """Whether some site is a Student t."""
        return any(map(is_heavy_tailed, self.distributions.values()))


@torch.no_grad()
def measured(program: Program, states: Tensor) -> Measured:
    """What is measured at states `(..., D)`."""
    with running(*states.shape[:-1]), Recording() as seen, AtMean():
        program.observe(states)
    return Measured(seen.distributions)


def typical_spreads(program: Program, data: Trajectories, at: Smoothed) -> tuple[Tensor, Tensor]:
    """Root mean square standard deviations of the channels, `(C,)`, and of the measurements, `(K,)`."""
    spread = substep_spreads(program, data, at.channels.points[:1])
    sharp = measured(program, at.states).spread
    return spread[0][data.transitions].square().mean(0).sqrt(), sharp[data.rows].square().mean(0).sqrt()


@torch.no_grad()
def parameter_scores(program: Program, data: Trajectories, at: Smoothed, parts: list[Element]) -> Tensor:
    """Scores of a program's own parameters, `(B, P)`."""
    if not parts:
        return at.states.new_zeros((len(data), 0)).double()
    moving = _of_channels if program.substeps == 1 else _of_ends
    return moving(program, data, at, parts) + _of_measurements(program, at, parts)


def _of_channels(program: Program, data: Trajectories, at: Smoothed, parts: list[Element]) -> Tensor:
    """The parameters' part in the channels' moments, `(B, P)`."""
    points = at.channels.points

    def moments(state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
        mean, sd = _moments_of_channels(program, state, control, time, step)
        return torch.cat([mean, sd.log()], -1)

    slopes = slopes_on_all_rows(program, "moments", moments, all_rows(program, data, state=points), parts)
    scores, left = at.states.new_zeros((len(data), len(parts))).double(), list(range(len(parts)))
    if isinstance(slopes, Slopes):
        rows, count = at.channels.mean.shape[0], at.channels.mean.shape[-1]
        scores = at.channels.of_slopes(slopes, (-slopes.function[:rows, :, count:]).exp())
        left = of_actuators(program, data, parts)
    if left:
        _, spread = channel_moments(program, data, points[:1])
    for index in left:
        width = 2 * parts[index].step
        up, down = on_both_sides(parts[index], lambda: channel_moments(program, data, points))
        of_mean = at.channels.of_mean((up[0] - down[0]) / (width * spread))
        scores[:, index] = of_mean + at.channels.of_spread((up[1][0] / down[1][0]).log() / width)
    return scores


def _of_ends(program: Program, data: Trajectories, at: Smoothed, parts: list[Element]) -> Tensor:
    """The parameters' part in where rows end, `(B, P)`."""
    arriving = arrivals(at.ahead, data)
    given = all_rows(program, data, state=arriving.states, noise=arriving.noise)
    chain = partial(row_chain, program, **given)
    slopes = slopes_on_all_rows(program, "ends", partial(noisy_step, program), given, parts, chain)
    scores, left = at.states.new_zeros((len(data), len(parts))).double(), list(range(len(parts)))
    if isinstance(slopes, Slopes):
        scores, left = arriving.of_slopes(slopes), of_actuators(program, data, parts)
    along = (program, arriving.states, arriving.noise)
    for index in left:
        up, down = on_both_sides(parts[index], lambda: noisy_step(*along, *row_inputs(program, data)).double())
        scores[:, index] = arriving.score(up - down) / (2 * parts[index].step)
    return scores


def of_actuators(program: Program, data: Trajectories, parts: Sequence[Element]) -> list[int]:
    """Which learnable numbers change the acting controls: a kernel is given these and knows no slopes of theirs."""
    if not program.acts_on_commands:
        return []
    sides = (on_both_sides(part, lambda: acting_controls(program, data)) for part in parts)
    return [index for index, (up, down) in enumerate(sides) if not torch.equal(up, down)]


def _of_measurements(program: Program, at: Smoothed, parts: list[Element]) -> Tensor:
    """The parameters' part in what is measured, `(B, P)`."""
    points, found, of_tails = at.measurements.points, at.measurements, torch.zeros_like(at.measurements.mean)
    if has_heavy_tails(program, at.states[:1, :1]):
        of_tails = _of_tails(program, at)

    def readings(state: Tensor) -> Tensor:
        there = measured(program, state)
        reading = there.reading
        kinds = [reading, there.spread.log().expand(reading.shape)]
        return torch.cat([*kinds, there.tails.expand(reading.shape)] if there.heavy_tailed else kinds, -1)

    slopes = slopes_on_all_rows(program, "readings", readings, {"state": points}, parts)
    if isinstance(slopes, Slopes):
        return found.of_slopes(slopes, at.sharpness, of_tails)
    scores = at.states.new_zeros((at.states.shape[1], len(parts))).double()
    at_points, sharpness = measured(program, points), found.at_cells(at.sharpness)
    for index, part in enumerate(parts):
        up, down = on_both_sides(part, lambda: measured(program, at.states))
        alike = (up.spread == down.spread) & (up.tails == down.tails)
        if bool((up.shift(down) == 0).all()) and bool(alike.all()):
            continue
        width = 2 * part.step
        of_noise = found.of_spread((up.spread / down.spread).log() / width)
        of_noise = of_noise + (of_tails * (up.tails - down.tails) / width).sum((0, -1))
        up, down = on_both_sides(part, lambda: measured(program, points))
        of_mean = found.of_mean(found.own(at_points.shift(up) - at_points.shift(down)) * sharpness / width)
        scores[:, index] = of_mean + of_noise
    return scores


def _of_tails(program: Program, at: Smoothed) -> Tensor:
    """What a change of one over the degrees of freedom ν of a Student t is worth, `(T + 1, B, K)`: the slope of its
    log-density at the root of the mean square, where a normal touches it; zero where the noise is normal."""
    found, seen = at.measurements, at.measurements.present.any(-1)
    here, there = measured(program, at.states[seen].unsqueeze(1)), found.present[seen]
    tails, spread = (values.squeeze(-2).expand(there.shape) for values in (here.tails, here.spread))
    own = torch.zeros_like(found.present).masked_scatter(
        seen.unsqueeze(-1).expand_as(found.present), there & (tails > 0)
    )
    freedom = 1 / tails[own[seen]].double()
    size = (spread[own[seen]] * at.sharpness[own]).clamp(min=1e-12)
    squares = ((found.mean[own].square() + found.variance[own].clamp(min=0)) / size.square()).double()
    constant = torch.special.digamma((freedom + 1) / 2) - torch.special.digamma(freedom / 2) - 1 / freedom
    varying = (freedom + 1) * squares / (freedom + squares) / freedom - torch.log1p(squares / freedom)
    slopes = (-freedom.square() * (constant + varying) / 2).to(found.mean)
    return torch.zeros_like(found.mean).masked_scatter(own, slopes)
