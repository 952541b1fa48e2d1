"""The score of every effect of the catalogue at a program that has none of them."""

import copy
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.discovery.curves import CURVE, by_height, multiplier, over_reading, over_state, variables
from steady_ppl.effects import Variant, attach
from steady_ppl.errors import FilterError
from steady_ppl.gaussian.information_filter import Lookahead
from steady_ppl.gaussian.lanes import LANES
from steady_ppl.gaussian.predict import simulate_again
from steady_ppl.gaussian.smoother import smooth
from steady_ppl.likelihood.parameters import Element
from steady_ppl.likelihood.scores import (
    Arrivals,
    Smoothed,
    arrivals,
    channel_moments,
    component_major,
    measured,
    parameter_scores,
    smoothed,
    substep_spreads,
)
from steady_ppl.model.interventions import by_channel
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import acting_controls, noisy_step, row_controls, row_inputs
from steady_ppl.utils.cores import Output, run_in_parallel
from steady_ppl.utils.random import seeded
from steady_ppl.utils.text import reason_of

TRAJECTORIES_OF_JOB = 400  # that are scored at a time at most
NUMBERS_OF_JOB = 2**23  # in the slopes of its measurements at most, as far as lanes are filled
MIN_SHARE_OF_FINITE_SETS = 0.8  # share of the simulated sets that must not blow up


@dataclass(frozen=True)
class Column:
    """A candidate at one coefficient, whose scores are looked at."""

    variant: Variant  # the effect
    probe: float | None = None  # the finite coefficient that was tried, None for the derivative where it is absent

    @property
    def size(self) -> int:
        """How many numbers its coefficient has."""
        return self.variant.effect.size

    @property
    def is_curve(self) -> bool:
        """Whether it is no named effect."""
        return self.variant.effect.name == CURVE


def columns_of(variants: Sequence[Variant]) -> list[Column]:
    """One column a variant, or one for each of its probes."""
    return [Column(v, probe) for v in variants for probe in (v.probes or (None,))]


class Scoring:
    """Scores of columns along a program without them, smoothed on these drives."""

    def __init__(self, program: Program, data: Trajectories, at: Smoothed) -> None:
        self.program, self.data, self.at = program, data, at
        self.acting = acting_controls(program, data)
        self.controls = row_controls(program, self.acting)
        self.rows = (self.controls[:-1], data.elapsed[:-1], data.steps)  # of transitions
        self.means, spread = channel_moments(program, data, at.channels.points, self.acting)
        self.row_spread = spread[0]
        self.substep_spread = substep_spreads(program, data, at.channels.points[:1], self.acting)[0]
        self._around = cache(at.channels.around)
        self._means: dict[int, dict[str, Tensor]] = {}  # by channel; a cached method would keep all this in a cycle
        self._variables: dict[int, dict[str, Tensor]] = {}

    def __call__(self, column: Column) -> Tensor:
        """Scores of a column, `(B, size)`, in double precision."""
        if column.variant.effect.function is over_state:
            return self._curve_of_channel(column.variant)
        if column.variant.effect.function is over_reading:
            return self._curve_of_readings(column.variant)
        score = getattr(self, f"_{column.variant.effect.form}")
        return torch.stack([score(column.variant, c, width) for c, width in self._differences(column)], -1).double()

    def _differences(self, column: Column) -> Iterator[tuple[tuple[Tensor, Tensor], float]]:
        """For each number of the coefficient two coefficients and how far they are apart."""
        variant, like = column.variant, self.substep_spread
        absent, typical = variant.absent(like), variant.typical.to(like)
        if column.probe is not None:
            reach = 1.0 if not torch.isfinite(absent) else abs(column.probe - float(absent))
            yield (torch.as_tensor(column.probe).to(like), absent), reach
            return
        steps = 0.05 * torch.where(typical == 0, typical.abs().max(), typical.abs())
        for step, by in zip(steps.tolist(), torch.diag(steps), strict=True):
            by = by.reshape(absent.shape)
            yield (absent + by, absent - by), 2 * step

    def _push(self, variant: Variant, c: tuple[Tensor, Tensor], width: float) -> Tensor:
        values = [value for value in c if bool(torch.isfinite(value).all())]
        of_one_drive = [self._pushed(variant, value, 0, few=True) for value in values]
        first, second = of_one_drive[0], of_one_drive[-1]
        if len(values) == 2 and all(bool((first[name] == -second[name]).all()) for name in first):
            values, width = values[:1], width / 2  # the push only changes its sign with the coefficient
        total = self.at.states.new_zeros(len(self.data))
        for index, channel in enumerate(self.program.channel_names):
            if channel not in first:
                continue
            pushes = [self._pushed(variant, value, index)[channel] for value in values]
            change = pushes[0] if len(pushes) == 1 else pushes[0] - pushes[1]
            slope = (change / (width * self.substep_spread[..., index])).expand(3, *self.substep_spread.shape[:2])
            total = total + self.at.channels.of_component(index, slope).sum(0)
        return total

    def _curve_of_readings(self, variant: Variant) -> Tensor:
        """Scores of the heights at the knots of a curve that is added to some readings, `(B, K)`."""
        at, knots, circular = self.at.measurements, variant.options["knots"], variant.options["circular"]
        found = []
        rows, drives = at.mean.shape[:2]
        for index, name in enumerate(self.program.measurement_names):
            if name in variant.options["chosen"]:
                which = at.cells.of_component(index)
                values = self.reading[at.cells.points[:, which], 0, index]
                weights = at.weights(index) * at.at_cells(self.at.sharpness, which)
                by_row = values.new_zeros(2, 3, rows * drives)
                by_row[..., at.cells.row[which]] = torch.stack([values, weights])
                along, by = by_row.view(2, 3, rows, drives)
                found.append(by_height(along, by, knots, circular))
        return torch.stack(found).sum(0)

    def _curve_of_channel(self, variant: Variant) -> Tensor:
        """Scores of the heights at the knots of a curve that is added to a channel, `(B, K)`."""
        index = self.program.channel_names.index(variant.options["channel"])
        variable, knots = variant.options["variable"], variant.options["knots"]
        times = multiplier(self._means_around(index), variant.options["channel"], variant.options["times"])
        weights = self.at.channels.weights(index) / self.substep_spread[..., index] * times
        return by_height(self._variables_around(index)[variable], weights, knots, variable in self.program.angles)

    def _variables_around(self, index: int) -> dict[str, Tensor]:
        """What curves may depend on, at the points of one channel, each `(3, T, B)`."""
        if index not in self._variables:
            found = variables(self.program, self._around(index), *self.rows[:2], self._means_around(index))
            shape = (3, *self.substep_spread.shape[:2])
            self._variables[index] = {name: value.expand(shape) for name, value in found.items()}
        return self._variables[index]

    def _means_around(self, index: int) -> dict[str, Tensor]:
        """The channels' means at the points of one of them, each `(3, T, B)`."""
        if index not in self._means:
            at = self.at.channels.places(index)
            self._means[index] = {name: self.means[at, ..., k] for k, name in enumerate(self.program.channel_names)}
        return self._means[index]

    def _pushed(self, variant: Variant, value: Tensor, index: int, few: bool = False) -> dict[str, Tensor]:
        """At the points of one channel; of `few`, of the first drive only."""
        points, rows = self._around(index), self.rows
        means = self._means_around(index) if variant.needs_mean else {}
        if few:
            points, rows = points[:1, :, :1], (rows[0][:, :1], rows[1][:, :1], rows[2][:, :1])
            means = {name: mean[:1, :, :1] for name, mean in means.items()}
        return variant(self.program, points, *rows, c=value, mean=means)

    def _command(self, variant: Variant, c: tuple[Tensor, Tensor], width: float) -> Tensor:
        up, down = (variant(self.program, self.at.channels.points, *self.rows[:2], c=value) for value in c)
        slope = (self.by_control * (up - down).movedim(-1, 0).unsqueeze(-1)).sum(0)
        return self.at.channels.of_mean(slope / (width * self.row_spread))

    def _history(self, variant: Variant, c: tuple[Tensor, Tensor], width: float) -> Tensor:
        up, down = (variant(self.program, self.controls, self.data.elapsed, c=value)[:-1] for value in c)
        return ((up - down) * self.of_control).sum((0, -1)) / width

    def _between(self, variant: Variant, c: tuple[Tensor, Tensor], width: float) -> Tensor:
        """By where rows end: the course of controls within a row is in no mean of a row."""
        states, noise = self._arriving.states, self._arriving.noise
        changed = (attach(copy.deepcopy(self.program), variant, value) for value in c)
        up, down = (noisy_step(self.program, states, noise, *row_inputs(one, self.data)).double() for one in changed)
        return self._arriving.score(up - down) / width

    @cached_property
    def _arriving(self) -> Arrivals:
        return arrivals(self.at.ahead, self.data)

    @cached_property
    def of_control(self) -> Tensor:
        """Scores of the acting controls, row by row, `(T, B, U)`."""
        return torch.stack([self.at.channels.by_row(slope / self.row_spread) for slope in self.by_control], -1)

    @cached_property
    def by_control(self) -> Tensor:
        """Derivatives of the channels' means in the acting controls, `(U, P, T, B, C)`."""
        found, count = [], self.controls.shape[-1]
        for index in range(count):
            step = 0.02 * float(self.controls[..., index].abs().max()) or 0.02
            up, down = self.acting.clone(), self.acting.clone()
            up[..., index::count] += step
            down[..., index::count] -= step
            means = [channel_moments(self.program, self.data, self.at.channels.points, u)[0] for u in (up, down)]
            found.append((means[0] - means[1]) / (2 * step))
        return torch.stack(found)

    @cached_property
    def reading(self) -> Tensor:
        """What is measured on average at the measurements' points, `(N, 1, K)`."""
        return measured(self.program, self.at.measurements.points).reading

    def _measured(self, variant: Variant, c: tuple[Tensor, Tensor], width: float) -> Tensor:
        at, component = self.at.measurements, variant.options.get("component")
        if not isinstance(component, int):
            up, down = (variant(self.program, at.points, self.reading, c=value) for value in c)
            return at.of_mean(at.own(up - down) * at.at_cells(self.at.sharpness) / width)
        which = at.cells.of_component(component)
        own = (one.squeeze(1)[at.cells.points[:, which]] for one in (at.points, self.reading))
        points, reading = map(component_major, own)
        up, down = (variant(self.program, points, reading, c=value)[..., component] for value in c)
        return at.of_mean((up - down) * at.at_cells(self.at.sharpness, which) / width, which)

    def _viewpoint(self, variant: Variant, c: tuple[Tensor, Tensor], width: float) -> Tensor:
        at = self.at.measurements
        up, down = (measured(self.program, variant(self.program, at.points, c=value)) for value in c)
        return at.of_mean(at.own(down.shift(up)) * at.at_cells(self.at.sharpness) / width)

    def _spread(self, variant: Variant, c: tuple[Tensor, Tensor], width: float) -> Tensor:
        factors = (variant(self.program, self.at.states[:-1], *self.rows, c=value) for value in c)
        up, down = (by_channel(self.program, factor, 1.0, self.substep_spread) for factor in factors)
        return self.at.channels.of_spread((up / down).log() / width)

    def _blur(self, variant: Variant, c: tuple[Tensor, Tensor], width: float) -> Tensor:
        up, down = (variant(self.program, self.at.states, c=value) for value in c)
        return self.at.measurements.of_spread((up / down).log() / width)

    def _tails(self, variant: Variant, c: tuple[Tensor, Tensor], width: float) -> Tensor:
        """Of 1/ν at zero: (z⁴ − 2 z² − 1) / 4, its posterior mean."""
        at = self.at.measurements
        squares = at.mean.square()
        fourth = squares.square() + 6 * squares * at.variance + 3 * at.variance.square()
        slopes = torch.where(at.present, (fourth - 2 * (squares + at.variance) - 1) / 4, 0.0)
        return slopes[..., list(variant.options.get("columns") or range(slopes.shape[-1]))].sum((0, -1))

    def _colour(self, variant: Variant, c: tuple[Tensor, Tensor], width: float) -> Tensor:
        """Of the share of the last deviation that stays, at zero: E[ε(t) ε(t − 1)], in the spreads' ratio."""
        at = self.at.channels
        product = at.mean[1:] * at.mean[:-1] + self.at.lag[1:]
        ratio = self.substep_spread[:-1] / self.substep_spread[1:]
        chosen = [float(name in variant.options["channels"]) for name in self.program.channel_names]
        return torch.where(at.present[1:], product * ratio * ratio.new_tensor(chosen), 0.0).sum((0, -1))


def scores_along(
    problem: Problem, ahead: Lookahead, parts: Sequence[Element], columns: Sequence[Column]
) -> tuple[Tensor, list[Tensor | str]]:
    """Scores of the parameters, `(B, P)`, and of each column, `(B, size)`, or why it has none."""
    along = (problem.program, problem.data, smoothed(ahead, problem.data))
    scoring = Scoring(*along)

    def tried(column: Column) -> Tensor | str:
        try:
            scores = scoring(column)
        except Exception as error:  # also of the program's own code, on commands and states that nobody tried before
            return reason_of(error)
        return scores if bool(torch.isfinite(scores).all()) else "it is not finite along these trajectories"

    return parameter_scores(*along, list(parts)), [tried(column) for column in columns]


@torch.no_grad()
def simulate_scores(
    problem: Problem, starts: Tensor, parts: Sequence[Element], columns: Sequence[Column], *, seed: int
) -> Tensor:
    """Scores `(S, B, N)` of drives that a program makes from `starts` `(S, B, D)`, with the same controls and gaps.

    Sets that diverge are left out. Columns with which too many would are not finite.
    """
    program, data, sets = problem.program, problem.data, len(starts)
    with seeded(seed, "bootstrap"):
        drives, path = simulate_again(program, data, starts, len(program.channels))

    slopes = drives.measurements.numel() * len(program.states)

    def score(index: Tensor) -> Output:
        part = replace(problem, data=drives.subset(index))
        ahead = smooth(part, path.subset(index), passes=2)
        own, found = scores_along(part, ahead, parts, columns)
        each = [
            own.new_full((len(index), column.size), math.nan) if isinstance(one, str) else one
            for column, one in zip(columns, found, strict=True)
        ]
        return {"scores": torch.cat([own, *each], -1), "likely": ahead.log_likelihood}, {}

    count = max(LANES, min(TRAJECTORIES_OF_JOB, NUMBERS_OF_JOB * len(drives) // slopes // LANES * LANES))
    jobs = [partial(score, index) for index in torch.arange(len(drives)).split(count)]
    found = [tensors for tensors, _ in run_in_parallel(jobs)]
    scores, likely = (torch.cat([one[name] for one in found]) for name in ("scores", "likely"))
    scores = scores.unflatten(0, (sets, len(data)))
    finite = torch.isfinite(scores).all(1)
    able = torch.isfinite(likely.view(sets, len(data))).all(-1) & finite[:, : len(parts)].all(-1)
    ends = itertools.accumulate((column.size for column in columns), initial=len(parts))
    of_columns = torch.stack([able, *(finite[:, first:end].all(-1) for first, end in itertools.pairwise(ends))])
    breaks = (able & ~of_columns).sum(1)
    kept = sorted(range(len(breaks)), key=lambda index: int(breaks[index]))
    while len(kept) > 1 and int(of_columns[kept].all(0).sum()) < MIN_SHARE_OF_FINITE_SETS * sets:
        kept.pop()  # what breaks most of them
    whole = of_columns[kept].all(0)
    if int(whole.sum()) < MIN_SHARE_OF_FINITE_SETS * sets:
        raise FilterError(
            f"{int((~whole).sum())} of {sets} simulated sets blew up: the fitted model does not even explain "
            "trajectories of its own"
        )
    return scores[whole]
