"""The lines of a proof: one program's figures on drives, as sums over each drive, and paired intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from scipy import special
from torch import Tensor

from steady_ppl.comparison.metrics import squared_errors
from steady_ppl.criticism.baselines import ConstantVelocity, constant_velocity
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import FilterError, UsageError
from steady_ppl.gaussian.information_filter import Lookahead
from steady_ppl.gaussian.kalman import Tracked, track
from steady_ppl.gaussian.linearize import ReferencePath, why_not_linear
from steady_ppl.gaussian.predict import Prediction, named_horizons, predict, simulate_again, states_ahead
from steady_ppl.gaussian.smoother import find_and_smooth, smooth
from steady_ppl.likelihood.evidence import neglected
from steady_ppl.likelihood.scores import measured, substep_spreads
from steady_ppl.model.program import Program, error_groups, for_program
from steady_ppl.utils.random import seeded

SECONDS = (1.0, 3.0, 10.0)
BANDS = ("one step", "1 s", "3 s")
DRAWN = 12  # horizons of the picture
SETS, CELLS = 20, 100_000  # simulated sets for the noise floor, and rows of all their drives at most
SHARED = 0.9  # of all rows; a bearing's noise grows beside its landmark
Scales = dict[str, dict[str, float | None]]


class Key(NamedTuple):
    """Which figure: kind is "log_likelihood", "coverage_90", "measurement" (of a unit) or "state" (of an error group);
    horizon in rows, 0 for log p(y)."""

    kind: str
    of: str
    horizon: int


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Attributes:
        program: that was judged.
        sums: every figure, drive by drive; of the noise floor's simulated drives.
        scales: "channels" and "measurements" → component as declared → standard deviation (a Student t's scale) that
            nearly all rows of the drives share, None where there is none.
        neglected: see `Judged`.
    """

    program: Program
    sums: dict[Key, Sums]
    scales: Scales
    neglected: Tensor | str | None = None


@dataclass(frozen=True)
class Judged:
    """What a row is summed from.

    Attributes:
        program, data: the drives as the program reads them, with the truth.
        ahead, tracked: along the same path.
        predictions: horizon → measured less predicted.
        states: error group and horizon → squared errors `(T + 1 − horizon, B)` and where the truth is known.
        neglected: log p(y) by a particle filter less that of the linearised program, `(B,)` nats; why the filter broke
            down; None where it was not run.
    """

    program: Program
    data: Trajectories
    ahead: Lookahead
    tracked: Tracked
    predictions: dict[int, Prediction]
    states: dict[tuple[str, int], tuple[Tensor, Tensor]]
    neglected: Tensor | str | None = None


def judge_program(name: str, program: Program, data: Trajectories, known_start: bool, seed: int) -> Judged:
    """Find the paths from the measurements alone, predict, and compare.

    Raises:
        UsageError: the program cannot be linearised.
        FilterError: the linearised program broke down.
    """
    run = for_program(program, data)
    unseen = run.without_truth(keep_start=known_start)
    if known_start:
        _ = unseen.known_start
    why = why_not_linear(program, unseen, known_start=known_start)
    if why is not None:
        raise UsageError(
            f"{name}: prove needs programs that can be linearised: {why.split(': looking')[0]} "
            "(`steady evaluate` takes any)"
        )
    try:
        with seeded(seed, "prove"):
            ahead = find_and_smooth(program, unseen, known_start=known_start)
    except FilterError as error:
        raise FilterError(f"{name}: {error}", trajectory=error.trajectory, time=error.time) from error
    judged = judge(program, run, ahead, known_start)
    try:
        with seeded(seed, "prove by particles"):
            return replace(judged, neglected=neglected(program, unseen, known_start=known_start, ahead=ahead))
    except FilterError as error:
        return replace(judged, neglected=str(error))


def judge(
    program: Program, data: Trajectories, ahead: Lookahead, known_start: bool, kernels: bool | None = None
) -> Judged:
    """Track along a path that was found and compare what is predicted from every row with measurements and truth."""
    unseen = data.without_truth(keep_start=known_start)
    tracked = track(program, unseen, ahead.linearization.path, known_start=known_start, kernels=kernels)
    named = named_horizons(data, SECONDS)
    longest = max(named.values())
    horizons = {round(rows) for rows in np.geomspace(1, longest, DRAWN).tolist()} | set(named.values())
    bands = [named[name] for name in BANDS if name in named]
    predictions = predict(program, unseen, tracked, sorted(horizons), bands=bands)
    states: dict[tuple[str, int], tuple[Tensor, Tensor]] = {}
    if data.states is not None and bool(torch.isfinite(data.states[1:]).any()):
        for horizon, state in states_ahead(program, unseen, tracked, longest):
            if horizon in horizons:
                truth = data.states[horizon:]
                for group, squares in squared_errors(program, state, truth).items():
                    known = torch.isfinite(truth[..., list(error_groups(program)[group])]).all(-1)
                    states[group, horizon] = squares, known
    return Judged(program, data, ahead, tracked, predictions, states)


def keeping_velocity(before: Judged, known_start: bool) -> Judged | str:
    """A program without any acceleration but noise, of the size under which the measurements are most likely."""
    program, tracked = before.program, before.tracked
    run = before.data.without_truth(keep_start=known_start)
    found = constant_velocity(program, run, tracked, [1], known_start=known_start)
    if isinstance(found, str):
        return found
    coasting = ConstantVelocity(program, found.scales)
    coasting.error_groups = program.error_groups  # type: ignore[misc]
    path = tracked.path(run)
    still = ReferencePath(path.states, torch.zeros_like(path.noise))
    ahead = smooth(coasting, run, still, known_start=known_start, kernels=False)
    if not bool(torch.isfinite(ahead.log_likelihood).all()):
        return "it blows up on these drives"
    return judge(coasting, before.data, ahead, known_start, kernels=False)


def noise_floor(true: Judged, known_start: bool, seed: int) -> Judged | str:
    """The program that made the drives on drives of its own: what noise alone leaves."""
    run = true.data.without_truth(keep_start=known_start)
    sets = max(1, min(SETS, CELLS // run.time.numel()))
    with seeded(seed, "noise floor"):
        _, drawn, _ = true.ahead.draws(sets)
        starts = run.known_start.expand(sets, -1, -1) if known_start else drawn[:, 0]
        again, path = simulate_again(true.program, run, starts, true.tracked.noise.shape[-1])
    ahead = smooth(true.program, again, path, known_start=known_start)
    if not bool(torch.isfinite(ahead.log_likelihood).all()):
        return "the true program does not explain drives of its own"
    if true.states:
        again = replace(again, states=torch.where(again.rows.unsqueeze(-1), path.states, torch.nan))
    return judge(true.program, again, ahead, known_start)


def as_row(judged: Judged, counted: Mapping[int, Tensor]) -> Row:
    """Sum over each drive the cells that count, `(T + 1 − horizon, B, K)` for each horizon."""
    likely = judged.ahead.log_likelihood.numpy(force=True)
    sums = {Key("log_likelihood", "", 0): Sums(likely, np.ones_like(likely))}
    unit = judged.program.measurement_units
    for horizon, ahead in judged.predictions.items():
        seen = counted[horizon]
        for of in dict.fromkeys(unit):
            chosen = [i for i, name in enumerate(unit) if name == of]
            squares = ahead.error[..., chosen].square()
            sums[Key("measurement", of, horizon)] = _sums(squares, seen[..., chosen], root=True)
        if bool(torch.isfinite(ahead.variance[seen]).any()):
            sums[Key("coverage_90", "", horizon)] = _sums(ahead.covered(), seen)
    for (group, horizon), (squares, known) in judged.states.items():
        if bool(known.any()):
            sums[Key("state", group, horizon)] = _sums(squares.unsqueeze(-1), known.unsqueeze(-1), root=True)
    return Row(judged.program, sums, noise_scales(judged.program, judged.data, judged.tracked), judged.neglected)


def _sums(values: Tensor, there: Tensor, *, root: bool = False) -> Sums:
    total = torch.where(there, values.double(), 0.0).sum((0, 2))
    return Sums(total.numpy(force=True), there.double().sum((0, 2)).numpy(force=True), root)


def noise_scales(program: Program, data: Trajectories, tracked: Tracked) -> Scales:
    """What `Row.scales` is."""
    states = tracked.path(data).states
    channels = substep_spreads(program, data, states[:-1].unsqueeze(0))
    declared = program.channels
    if len(declared) != channels.shape[-1]:
        declared = [f"channel {i + 1}" for i in range(channels.shape[-1])]
    return {
        "channels": _constants(declared, channels[0], data.transitions),
        "measurements": _constants(program.measurements, measured(program, states).spread, data.rows),
    }


def _constants(labels: Sequence[str], spreads: Tensor, inside: Tensor) -> dict[str, float | None]:
    found: dict[str, float | None] = {}
    for label, spread in zip(labels, spreads.unbind(-1), strict=True):
        some = spread.expand(inside.shape)[inside]
        usual = some.median()
        same = torch.isclose(some, usual, rtol=1e-5, atol=0.0).double().mean()
        found[label] = float(usual) if float(same) > SHARED else None
    return found


RESAMPLES = 2000


COVERAGE = 0.95


MIN_DRIVES = 5  # drives


@dataclass(frozen=True)
class Sums:
    """A mean over cells, or the root of one, from what each drive adds to it.

    Attributes:
        total: `(B,)` sum over the drive's cells.
        count: `(B,)` how many cells they are.
        root: whether the figure is the root of the mean, as of squared errors.
    """

    total: np.ndarray
    count: np.ndarray
    root: bool = False

    @property
    def value(self) -> float | None:
        """The figure; None where there is no cell or it is not finite."""
        value = float(self.of(np.ones((1, len(self.total))))[0])
        return value if math.isfinite(value) else None

    def of(self, weights: np.ndarray) -> np.ndarray:
        """The figure where drives count several times or not at all, `(R,)` for weights `(R, B)`."""
        with np.errstate(all="ignore"):
            mean = (weights @ self.total) / (weights @ self.count)
        return np.sqrt(mean) if self.root else mean

    def among(self, drives: np.ndarray) -> Sums:
        """Of some drives."""
        return Sums(self.total[drives], self.count[drives], self.root)


@dataclass(frozen=True)
class Change:
    """A difference with its 95 % interval.

    Attributes:
        value: the one program's figure less the other's.
        interval: its ends.
        relative: the same divided by the other's figure, with `relative_interval`; None where that is zero.
    """

    value: float
    interval: tuple[float, float]
    relative: float | None = None
    relative_interval: tuple[float, float] | None = None

    @property
    def sign(self) -> int:
        """1 or −1 where the interval lies above or below zero, else 0."""
        low, high = self.interval
        return int(low > 0) - int(high < 0)


def paired(ours: Sums, theirs: Sums, *, seed: int) -> Change | None:
    """The difference between two figures of the same drives.

    The interval is between percentiles of the resampled differences, at levels that make it as wide as Student's for
    a mean of few drives (Hesterberg 2015, The American Statistician 69, section 5.3, the expanded percentile interval).

    Args:
        ours, theirs: of the same drives.
        seed: of the resampling.

    Returns:
        None where fewer than 5 drives have such a figure, or where it is not finite.
    """
    both = (ours.count > 0) & (theirs.count > 0)
    if both.sum() < MIN_DRIVES:
        return None
    ours, theirs = ours.among(both), theirs.among(both)
    drives = int(both.sum())
    drawn = np.random.default_rng([seed, drives]).multinomial(drives, np.full(drives, 1 / drives), RESAMPLES)
    weights = np.concatenate([np.ones((1, drives)), drawn])
    one, other = ours.of(weights), theirs.of(weights)
    if not np.isfinite(one).all() or not np.isfinite(other).all():
        return None
    difference = one - other
    change = Change(float(difference[0]), _interval(difference[1:], drives))
    if not (other > 0).all():
        return change
    ratio = difference / other
    return Change(change.value, change.interval, float(ratio[0]), _interval(ratio[1:], drives))


def _interval(values: np.ndarray, drives: int) -> tuple[float, float]:
    student = special.stdtrit(drives - 1, (1 - COVERAGE) / 2)
    tail = special.ndtr(student * math.sqrt(drives / (drives - 1)))
    low, high = np.quantile(values, [tail, 1 - tail])
    return float(low), float(high)
