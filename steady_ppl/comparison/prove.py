"""Prove an improvement: programs before and after on drives that neither was fitted on, with paired intervals.

Everything goes by the linearised program: log p(y) by its smoother, predictions by its filter, as in `check`. A
particle filter says how far its log p(y) is from the program's own. Readings that every program finds wrong, as a
position fix that jumps, are left out: one of them would decide a mean of squares.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import reduce

import numpy as np
import torch
from torch import Tensor

from steady_ppl.comparison.result import CONSTANT_VELOCITY, LAST_MEASUREMENT, NOISE_FLOOR, Proof
from steady_ppl.comparison.scores import (
    MIN_DRIVES,
    PROOF_HORIZONS,
    Judged,
    ProgramScores,
    as_row,
    held_measurements,
    judge_constant_velocity,
    judge_program,
    noise_floor,
    row_of_last_measurement,
)
from steady_ppl.data.table import refuse_long
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import DataError, UsageError
from steady_ppl.gaussian.linearize import ReferencePath, has_heavy_tails
from steady_ppl.gaussian.predict import suited_horizons
from steady_ppl.likelihood.outliers import Outliers, find_outliers
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program, for_program
from steady_ppl.model.starts import centre_of_start
from steady_ppl.runs.diagnostics import diagnose_units
from steady_ppl.runs.fit import Fit
from steady_ppl.utils.cores import one_thread
from steady_ppl.utils.progress import stages

MAX_NEGLECTED = 2.0  # nats of a drive's log p(y) between a particle filter and the linearised program


@one_thread()
@torch.no_grad()
def prove(
    rows: Mapping[str, Program | Fit],
    data: Trajectories,
    *,
    known_start: bool | None = None,
    reference: str | None = None,
    truth: str | None = None,
    with_constant_velocity: bool = True,
    paths: Mapping[str, ReferencePath] | None = None,
    horizons: Sequence[float] = (),
    seed: int = 0,
) -> Proof:
    """Compare programs on trajectories: log p(y), open-loop errors, coverage, noise scales.

    log p(y) is that of the linearised program, per trajectory; what a particle filter adds to it is near zero where it
    can be trusted. Errors are root mean squares of measured less predicted, some times ahead of every row's filtered
    state, without noise and with the recorded controls, over the components that share a unit; and of the program's
    error groups where the x. columns are known. Only measurements that every row predicts count.

    Args:
        rows: name → program, best the one before first and the one after second; further ones such as the oracle's
            structure refitted and the true parameters. Their noise is normal, their measurements' normal or Student t.
        data: trajectories on which none of them was fitted.
        known_start: the first row's x. columns are the exact start; None: if every `Fit` among the rows was so fitted.
        reference: the row that the others are compared with, the first when not given.
        truth: the row whose program made the trajectories; its own simulated trajectories give the noise floor.
        with_constant_velocity: add a row of the reference without any acceleration but noise.
        paths: name → path near the posterior means of the trajectories, where one is known; others are searched for.
        horizons: seconds ahead; those that suit the trajectories where none is given, see `data.horizons`.
        seed: of the search for paths, the simulation and the resampling.

    Raises:
        UsageError: a row's program cannot be linearised, or the rows measure different things.
        DataError: fewer than 5 trajectories or one that is too long, nothing to compare, or no known start.
        FilterError: a linearised program broke down.

    Example:
        >>> import steady_ppl as st  # doctest: +SKIP
        >>> runs = {name: st.Fit.load(f"runs/{name}") for name in ("before", "after")}  # doctest: +SKIP
        >>> print(st.prove(runs, st.read_table("test.csv")))  # doctest: +SKIP
    """
    programs = {name: row.program if isinstance(row, Fit) else row for name, row in rows.items()}
    notes: list[str] = []
    if known_start is None:
        fitted = [row.known_start for row in rows.values() if isinstance(row, Fit)]
        known_start = bool(fitted) and all(fitted)
        if any(fitted) and not known_start:
            notes.append("some rows were fitted with a known start and some without: all are judged without")
    reference = next(iter(programs), "") if reference is None else reference
    _require(programs, reference, truth, data)
    first = programs[reference]
    ahead = suited_horizons(first, for_program(first, data), PROOF_HORIZONS, horizons)

    def judge(data: Trajectories, paths: Mapping[str, ReferencePath]) -> dict[str, Judged]:
        judged = dict[str, Judged]()
        with stages(*((f"judging {name}", 1) for name in programs)) as begin:
            for name, program in programs.items():
                begin()
                same = next((other for other in judged if programs[other] is program), None)
                problem = Problem(program, for_program(program, data), known_start)
                judged[name] = judged[same] if same else judge_program(name, problem, ahead, seed, paths.get(name))
        return judged

    shares = ("", len(programs)), ("without wrong readings", len(programs)), ("judging the constant velocity", 0.5)
    with stages(*shares) as begin:
        begin()
        judged = judge(data, paths or {})
        begin()
        outliers = _wrong_by_all(list(judged.values()))
        if outliers.found:
            data = outliers.without(data)
            judged = judge(data, {name: one.ahead.linearization.path for name, one in judged.items()})
        begin()
        before, true = judged[reference], judged.get(truth or "")
        coasting = judge_constant_velocity(before) if with_constant_velocity else None
    if isinstance(coasting, Judged):
        judged[CONSTANT_VELOCITY] = coasting
    floor = noise_floor(true, seed) if true else None
    absent = {CONSTANT_VELOCITY: coasting, NOISE_FLOOR: floor}
    notes += [f"no row {name!r}: {why}" for name, why in absent.items() if isinstance(why, str)]
    counted, held = _counted(judged.values()), held_measurements(before)
    found = {name: as_row(row, counted, held) for name, row in judged.items()}
    found[LAST_MEASUREMENT] = row_of_last_measurement(before, counted, held)
    if isinstance(floor, Judged):
        found[NOISE_FLOOR] = as_row(floor, _counted([floor]), held_measurements(floor))
    drives = before.problem.data
    notes += drives.uneven_steps + diagnose_units(before.problem.program, drives)
    notes += _different_starts(judged)
    notes += _few_rows(drives, ahead, known_start) + unconverged(rows) + _blown_up(found) + doubtful(found, data)
    return Proof(found, reference, ahead, drives.median_step, len(data), known_start, seed, outliers, notes)


def _wrong_by_all(judged: Sequence[Judged]) -> Outliers:
    """The readings that every program finds wrong; none where one of them has tails that may explain them."""
    data, each = judged[0].problem.data, list[Outliers]()
    for one in {id(one.problem.program): one for one in judged}.values():
        path = one.ahead.linearization.path
        if has_heavy_tails(one.problem.program, path.states[:1, :1]):
            return Outliers(data, [], torch.zeros_like(data.observed))
        each.append(find_outliers(one.problem.without_truth(), path, against_tails=False))
    return reduce(Outliers.shared_with, each)


def _counted(judged: Iterable[Judged]) -> dict[int, Tensor]:
    """Horizon → the cells that every row predicts, `(T + 1 − horizon, B, K)`."""
    rows = [row.predictions for row in judged]
    return {horizon: torch.stack([row[horizon].observed for row in rows]).all(0) for horizon in rows[0]}


def unconverged(rows: Mapping[str, Program | Fit]) -> list[str]:
    """Which rows are fits that had not converged, so that a difference may be one of training."""
    return [
        f"{name} had not converged when its fit ended: part of what it differs by may be training"
        for name, row in rows.items()
        if isinstance(row, Fit) and row.trained is not None and row.trained.still_rising is not None
    ]


def _require(programs: Mapping[str, Program], reference: str, truth: str | None, data: Trajectories) -> None:
    if len(programs) < 2:
        raise UsageError(f"got {len(programs)} model: a proof needs one before and one after")
    for name in (reference, truth):
        if name is not None and name not in programs:
            raise UsageError(f"there is no row {name!r}; the rows are {', '.join(programs)}")
    for taken in {NOISE_FLOOR, CONSTANT_VELOCITY, LAST_MEASUREMENT} & programs.keys():
        raise UsageError(f"a row cannot be called {taken!r}: that is the name of a row of its own")
    ours = programs[reference].measurement_names
    for name, program in programs.items():
        if program.measurement_names != ours:
            raise UsageError(
                f"{reference} measures {', '.join(ours)} and {name} measures {', '.join(program.measurement_names)}: "
                "log p(y) of different measurements cannot be compared"
            )
    if len(data) < MIN_DRIVES:
        raise DataError(
            f"got {len(data)} trajectories: intervals over trajectories need at least {MIN_DRIVES}, and 16 are better"
        )
    if data.time.shape[0] < 2 or not bool(data.observed[1:].any()):
        raise DataError("nothing to compare: no trajectory has a measurement after its first row")
    refuse_long(data)


def _different_starts(judged: Mapping[str, Judged]) -> list[str]:
    """Say where the first measurements give the programs different priors of the start."""
    centres = {name: _centre(one.problem) for name, one in judged.items()}
    first, *others = centres
    return [
        f"{name} and {first} have different priors of the start: a part of their log p(y) is that"
        for name in others
        if not torch.equal(centres[name], centres[first])
    ]


def _centre(problem: Problem) -> Tensor:
    """Where the first measurements centre the prior of the start, and how far they widen it; empty if they do not."""
    if problem.known_start or not problem.program.start:
        return torch.empty(0)
    return torch.cat(centre_of_start(problem.program, problem.data)).nan_to_num(torch.inf)


def _few_rows(data: Trajectories, horizons: Mapping[str, int], known_start: bool) -> list[str]:
    """Say where an error goes by the first rows only."""
    notes, length = [], data.time.shape[0]
    for name, horizon in horizons.items():
        if length - horizon <= 5 < length - 1:
            rows = "row" if length - horizon == 1 else "rows"
            said = f"{name} ahead is judged from the first {rows} of a trajectory only"
            notes.append(said if known_start else said + ", where the state is least known")
    return notes


def _blown_up(rows: Mapping[str, ProgramScores]) -> list[str]:
    notes = []
    for name, row in rows.items():
        if horizons := [key.horizon for key, sums in row.sums.items() if not np.isfinite(sums.total).all()]:
            notes.append(f"{name} diverges {min(horizons)} rows ahead")
    return notes


def doubtful(rows: Mapping[str, ProgramScores], data: Trajectories) -> list[str]:
    """Drives on which the linearised program's log p(y) is not to be trusted, the worst of each row."""
    notes = []
    for name, row in rows.items():
        if isinstance(row.neglected, str):
            notes.append(f"{name}: no particle filter says how far its log p(y) can be trusted: {row.neglected}")
        if not isinstance(row.neglected, Tensor):
            continue
        size = row.neglected.abs().nan_to_num(torch.inf)
        worst, count = int(size.argmax()), int((size > MAX_NEGLECTED).sum())
        if not count:
            continue
        by = float(row.neglected[worst])
        said = f"{abs(by):.1f} nats {'above' if by > 0 else 'below'}" if math.isfinite(by) else "not comparable with"
        others = f" ({count - 1} other{'s' if count > 2 else ''} likewise)" if count > 1 else ""
        notes.append(
            f"{name}: on trajectory {data.labels[worst]} a particle filter's log p(y) is {said} the linearised "
            f"model's{others}: look at it before you trust the table"
        )
    return notes
