"""The lines of a proof: one program's figures on drives, as sums over each drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from steady_ppl.comparison.bootstrap import Sums
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
