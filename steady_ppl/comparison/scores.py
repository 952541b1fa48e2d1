"""The lines of a proof: one program's figures on drives, as sums over each drive, and paired intervals."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import special
from torch import Tensor

from steady_ppl.comparison.evaluate import has_truth, squared_errors
from steady_ppl.criticism.baselines import constant_velocity, last_measurement
from steady_ppl.errors import FilterError
from steady_ppl.gaussian.information_filter import Lookahead
from steady_ppl.gaussian.kalman import Tracked, track
from steady_ppl.gaussian.linearize import ReferencePath, require_linear
from steady_ppl.gaussian.predict import Prediction, predict, simulate_again, states_ahead
from steady_ppl.gaussian.smoother import find_and_smooth, smooth
from steady_ppl.kernels.jit import unchanged
from steady_ppl.likelihood.evidence import neglected
from steady_ppl.likelihood.scores import measured, substep_spreads
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program, error_indices
from steady_ppl.utils.random import seeded

PROOF_HORIZONS, BANDED_HORIZONS = 3, 3  # times ahead besides one step; named horizons, one step among them, with bands
CURVE_HORIZONS = 12  # horizons of the picture
MAX_FLOOR_SETS, MAX_FLOOR_ROWS = 20, 100_000  # simulated sets for the noise floor, and rows of all their drives
MIN_SHARE_OF_ROWS = 0.9  # of all rows; a bearing's noise grows beside its landmark
RESAMPLES, COVERAGE = 2000, 0.95  # resamples of the drives, and of intervals over them
MIN_DRIVES = 5  # drives for such an interval
Scales = dict[str, dict[str, float | None]]  # "channels" and "measurements" → component → σ, None where there is none


class Key(NamedTuple):
    """Which figure."""

    kind: str  # log_likelihood, log_likelihood_by_particles, coverage_90, measurement, measured before or state
    of: str  # the unit of measurements, the error group of states
    horizon: int  # rows, 0 for log p(y)


BY_PARTICLES = Key("log_likelihood_by_particles", "", 0)
MEASURED_BEFORE = "measured before"  # errors of cells that a last measurement predicts as well
Held = Mapping[int, tuple[Tensor, Tensor]]  # horizon → what `last_measurement` gives


@dataclass(frozen=True)
class Sums:
    """A mean over cells, or the root of one, from what each drive adds to it."""

    total: np.ndarray  # (B,) sum over the drive's cells
    count: np.ndarray  # (B,) how many cells they are
    root: bool = False  # whether the figure is the root of the mean, as of squared errors

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


@dataclass(frozen=True)
class Change:
    """A difference with its 95 % interval; relative to the other's figure as well, unless that is zero."""

    difference: float  # the one program's figure less the other's
    interval: list[float]
    relative: float | None = None
    relative_interval: list[float] | None = None


def paired(ours: Sums, theirs: Sums, *, seed: int) -> Change | None:
    """The difference between two figures; None where fewer than 5 drives have them, or where it is not finite.

    The interval is between percentiles of the resampled differences, at levels that make it as wide as Student's for
    a mean of few drives (Hesterberg 2015, The American Statistician 69, section 5.3, the expanded percentile interval).
    """
    both = (ours.count > 0) & (theirs.count > 0)
    if both.sum() < MIN_DRIVES:
        return None
    ours, theirs = (replace(sums, total=sums.total[both], count=sums.count[both]) for sums in (ours, theirs))
    drives = int(both.sum())
    weights = _weights(drives, seed)
    one, other = ours.of(weights), theirs.of(weights)
    if not np.isfinite(one).all() or not np.isfinite(other).all():
        return None
    tail = special.ndtr(special.stdtrit(drives - 1, (1 - COVERAGE) / 2) * math.sqrt(drives / (drives - 1)))
    changes = [one - other]
    if (other > 0).all():
        changes.append(changes[0] / other)
    found: list[Any] = []
    for values in changes:
        found += [float(values[0]), np.quantile(values[1:], [tail, 1 - tail]).tolist()]
    return Change(*found)


@lru_cache(maxsize=2)
def _weights(drives: int, seed: int) -> np.ndarray:
    """How often each drive counts, `(1 + R, B)`: once, and in each resample."""
    drawn = np.random.default_rng([seed, drives]).multinomial(drives, np.full(drives, 1 / drives), RESAMPLES)
    weights = np.concatenate([np.ones((1, drives)), drawn])
    weights.flags.writeable = False
    return weights


@dataclass(frozen=True)
class ProgramScores:
    """A line of the table."""

    program: Program  # that was judged
    sums: dict[Key, Sums]  # every figure, drive by drive; of the noise floor's simulated drives
    scales: Scales
    neglected: Tensor | str | None = None  # see `Judged`


@dataclass(frozen=True)
class Judged:
    """What a row is summed from: a lookahead and a filter along the same path."""

    problem: Problem  # the drives as the program reads them, with the truth
    horizons: dict[str, int]  # name → rows ahead, one step first
    ahead: Lookahead
    tracked: Tracked
    predictions: dict[int, Prediction]  # horizon → measured less predicted
    states: dict[tuple[str, int], tuple[Tensor, Tensor]]
    """Error group and horizon → squared errors `(T + 1 − horizon, B)` and where the truth is known."""
    neglected: Tensor | str | None = None
    """log p(y) by a particle filter, if it ran, less the linearised one, `(B,)` nats; or why the filter broke down."""


def judge_program(
    name: str, problem: Problem, horizons: dict[str, int], seed: int, path: ReferencePath | None = None
) -> Judged:
    """Find the paths from the measurements alone, unless one is given; predict, and compare; errors as of `prove`."""
    program, known_start = problem.program, problem.known_start
    unseen = problem.without_truth()
    require_linear(unseen, f"{name}: prove needs models that can be linearised", " (`steady evaluate` takes any)")
    with unchanged(program):
        try:
            with seeded(seed, "prove"):
                ahead = find_and_smooth(unseen, path=path)
        except FilterError as error:
            raise FilterError(f"{name}: {error}", trajectory=error.trajectory, time=error.time) from error
        judged = compare_predictions(problem, ahead, horizons)
        try:
            with seeded(seed, "prove by particles"):
                return replace(judged, neglected=neglected(program, unseen.data, known_start=known_start, ahead=ahead))
        except FilterError as error:
            return replace(judged, neglected=str(error))


def compare_predictions(problem: Problem, ahead: Lookahead, named: dict[str, int]) -> Judged:
    """Track along a path that was found and compare what is predicted from every row with measurements and truth."""
    program, data, unseen = problem.program, problem.data, problem.without_truth()
    tracked = track(unseen, ahead.linearization.path)
    longest, states = max(named.values()), dict[tuple[str, int], tuple[Tensor, Tensor]]()
    horizons = {round(rows) for rows in np.geomspace(1, longest, CURVE_HORIZONS).tolist()} | set(named.values())
    bands = list(named.values())[:BANDED_HORIZONS]
    predictions = predict(program, unseen.data, tracked, sorted(horizons), bands=bands)
    if data.states is not None and has_truth(data):
        for horizon, state in states_ahead(program, unseen.data, tracked, longest):
            if horizon in horizons:
                truth = data.states[horizon:]
                for group, squares in squared_errors(program, state, truth).items():
                    known = torch.isfinite(truth[..., list(error_indices(program)[group])]).all(-1)
                    states[group, horizon] = squares, known
    return Judged(problem, named, ahead, tracked, predictions, states)


def judge_constant_velocity(before: Judged) -> Judged | str:
    """A program without any acceleration but noise, of the size under which the measurements are most likely."""
    unseen = before.problem.without_truth()
    found = constant_velocity(unseen, before.tracked, [1])
    if isinstance(found, str):
        return found
    path = before.tracked.path(unseen.data)
    ahead = smooth(replace(unseen, program=found.program), replace(path, noise=torch.zeros_like(path.noise)))
    if bool(ahead.is_broken.any()):
        return "it diverges on these trajectories"
    return compare_predictions(replace(before.problem, program=found.program), ahead, before.horizons)


def noise_floor(true: Judged, seed: int) -> Judged | str:
    """The program that made the drives on drives of its own: what noise alone leaves."""
    unseen = true.problem.without_truth()
    program, data = unseen.program, unseen.data
    sets = max(1, min(MAX_FLOOR_SETS, MAX_FLOOR_ROWS // data.time.numel()))
    with seeded(seed, "noise floor"):
        _, drawn, _ = true.ahead.draws(sets)
        starts = data.known_start.expand(sets, -1, -1) if unseen.known_start else drawn[:, 0]
        again, path = simulate_again(program, data, starts, true.tracked.noise.shape[-1])
    own = replace(unseen, data=again)
    ahead = smooth(own, path)
    if bool(ahead.is_broken.any()):
        return "the true model does not fit trajectories of its own"
    if true.states:
        own = replace(own, data=replace(again, states=torch.where(again.rows.unsqueeze(-1), path.states, torch.nan)))
    return compare_predictions(own, ahead, true.horizons)


def as_row(judged: Judged, counted: Mapping[int, Tensor], held: Held) -> ProgramScores:
    """Sum over each drive the cells that count, `(T + 1 − horizon, B, K)` for each horizon, and beside them those that
    were `held` before."""
    likely = judged.ahead.log_likelihood.numpy(force=True)
    sums = {Key("log_likelihood", "", 0): Sums(likely, np.ones_like(likely))}
    if isinstance(judged.neglected, Tensor):
        by_particles = likely + judged.neglected.numpy(force=True)
        sums[BY_PARTICLES] = Sums(by_particles, np.ones_like(likely))
    problem = judged.problem
    for horizon, ahead in judged.predictions.items():
        seen = counted[horizon]
        sums |= _of_measurements(problem.program, "measurement", horizon, ahead.error, seen)
        sums |= _of_measurements(problem.program, MEASURED_BEFORE, horizon, ahead.error, seen & held[horizon][1])
        if bool(torch.isfinite(ahead.variance[seen]).any()):
            sums[Key("coverage_90", "", horizon)] = _sums(ahead.covered(), seen)
    for (group, horizon), (squares, known) in judged.states.items():
        if bool(known.any()):
            sums[Key("state", group, horizon)] = _sums(squares.unsqueeze(-1), known.unsqueeze(-1), root=True)
    return ProgramScores(problem.program, sums, noise_scales(problem, judged.tracked), judged.neglected)


def held_measurements(judged: Judged) -> Held:
    """See `last_measurement`, at the horizons of what is judged."""
    return last_measurement(judged.problem.without_truth(), judged.tracked.smoothed, list(judged.predictions))


def row_of_last_measurement(judged: Judged, counted: Mapping[int, Tensor], held: Held) -> ProgramScores:
    """The errors of a measurement that stays as it was, of the cells that count and have been measured before."""
    program, sums = judged.problem.program, dict[Key, Sums]()
    for horizon, (error, both) in held.items():
        for kind in ("measurement", MEASURED_BEFORE):
            sums |= _of_measurements(program, kind, horizon, error, counted[horizon] & both)
    return ProgramScores(program, sums, {"channels": {}, "measurements": {}})


def _of_measurements(program: Program, kind: str, horizon: int, error: Tensor, seen: Tensor) -> dict[Key, Sums]:
    units, found = program.measurement_units, dict[Key, Sums]()
    for of in dict.fromkeys(units):
        chosen = [i for i, name in enumerate(units) if name == of]
        found[Key(kind, of, horizon)] = _sums(error[..., chosen].square(), seen[..., chosen], root=True)
    return found


def _sums(values: Tensor, there: Tensor, *, root: bool = False) -> Sums:
    total = torch.where(there, values.double(), 0.0).sum((0, 2))
    return Sums(total.numpy(force=True), there.double().sum((0, 2)).numpy(force=True), root)


def noise_scales(problem: Problem, tracked: Tracked) -> Scales:
    """Standard deviations (a Student t's scale) that nearly all rows of the drives share, as declared."""
    program, data = problem.program, problem.data
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
        found[label] = float(usual) if float(same) > MIN_SHARE_OF_ROWS else None
    return found
