"""The errors of the paper, and errors in measurement space that need no truth.

Definitions: STEADY (IROS 2022), section V, as its authors' code computes them.
"""

from __future__ import annotations

import math
from collections import Counter

import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import UsageError
from steady_ppl.likelihood.evidence import in_parts, run_filter
from steady_ppl.likelihood.problem import Problem
from steady_ppl.model.handlers import AtMean, Recording, as_vector, residual, running
from steady_ppl.model.planar_vehicle import PlanarVehicle
from steady_ppl.model.program import Program, error_groups
from steady_ppl.model.substeps import acting_controls
from steady_ppl.smc.filter import particle_filter, roll_out
from steady_ppl.smc.resampling import systematic, take
from steady_ppl.utils.angles import wrap

Errors = dict[str, float]
OPEN_LOOP = {"open_loop_1s": 1.0, "open_loop_3s": 3.0}  # s ahead
OPEN_LOOP_DRAWS = 64


def has_truth(data: Trajectories) -> bool:
    """Whether the states are known beyond a first row."""
    return data.states is not None and bool(torch.isfinite(data.states[1:]).any())


def squared_errors(program: Program, states: Tensor, truth: Tensor) -> dict[str, Tensor]:
    """Squared errors `(...)` of each of the program's error groups, angles on the circle; NaN where unknown."""
    difference = states - truth
    order = program.state_names
    for name in program.angles:
        index = order.index(name)
        difference[..., index] = wrap(difference[..., index])
    return {group: difference[..., list(members)].square().sum(-1) for group, members in error_groups(program).items()}


@torch.no_grad()
def state_estimation(
    program: Program,
    data: Trajectories,
    *,
    particles: int,
    known_start: bool,
    every: int = 10,
    lineages: int = 1000,
    look_ahead: bool = False,
) -> Errors:
    """Errors of smoothed lineages, measured at every n-th row and judged at all rows.

    The squared error is averaged over lineages and rows; its root is averaged over trajectories. See `run_filter` for
    the filter's settings; `every` is n, `lineages` are the paths of each trajectory.

    Returns:
        Error group → error, groups without truth left out.
    """
    assert data.states is not None
    roots: dict[str, list[Tensor]] = {}
    for part in in_parts(data.observed_every(every), particles, look_ahead=look_ahead):
        assert part.states is not None
        filtered = run_filter(program, part, particles=particles, known_start=known_start, look_ahead=look_ahead)
        paths = filtered.paths(lineages)
        for group, squared in squared_errors(program, paths.states, part.states).items():
            mean = squared.mean(0)
            known = torch.isfinite(mean) & part.rows
            judged = known.any(0)
            total = torch.where(known, mean, 0.0).sum(0)[judged]
            roots.setdefault(group, []).append((total / known.sum(0)[judged]).sqrt())
    return {group: float(torch.cat(values).mean()) for group, values in roots.items() if any(map(len, values))}


@torch.no_grad()
def forward(
    program: Program, data: Trajectories, *, horizon: int = 10, rollouts: int = 1000, handler: Messenger | None = None
) -> Errors:
    """End-point errors of noisy roll-outs from every true state, with the recorded controls.

    One root of the squared error averaged over roll-outs, starts and trajectories: the process noise counts in it,
    unless a handler changes it.
    """
    assert data.states is not None
    if data.time.shape[0] <= horizon:
        return {}
    counted = data.rows[horizon:] & torch.isfinite(data.states[:-horizon]).all(-1)
    origin = torch.where(counted[..., None], data.states[:-horizon], 0.0)
    sums: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    at_once = max(1, 500_000 // counted.numel())
    for first in range(0, rollouts, at_once):
        draws = min(at_once, rollouts - first)
        end = _ends_of_roll_outs(program, data, origin.expand(draws, *origin.shape), horizon, handler)
        for group, squared in squared_errors(program, end, data.states[horizon:]).items():
            members = list(error_groups(program)[group])
            known = counted & torch.isfinite(data.states[horizon:, :, members]).all(-1)
            sums[group] += float(squared[:, known].double().sum())  # type: ignore[assignment]
            counts[group] += draws * int(known.sum())
    return {group: math.sqrt(total / counts[group]) for group, total in sums.items() if counts[group]}


def forward_mean(program: Program, data: Trajectories, *, horizon: int = 10) -> Errors:
    """The same for one roll-out without channel noise."""
    return forward(program, data, horizon=horizon, rollouts=1, handler=AtMean())


def _ends_of_roll_outs(
    program: Program, data: Trajectories, states: Tensor, horizon: int, handler: Messenger | None
) -> Tensor:
    """Where roll-outs end that begin at given states of all rows but the last `horizon`, with the recorded controls."""
    starts = data.time.shape[0] - horizon
    given = (
        torch.stack([values[k : k + starts] for k in range(horizon)])
        for values in (acting_controls(program, data), data.elapsed, data.steps)
    )
    for end in roll_out(program, states, *given, handler=handler):
        states = end
    return states


def map_errors(program: Program, surveyed: Program) -> Errors:
    """How far a program's landmarks are from those of another, m: `rms` and `most`.

    Raises:
        UsageError: one of them has no landmarks, or another number of them.
    """
    places = []
    for one in (program, surveyed):
        if not isinstance(one, PlanarVehicle):
            raise UsageError(f"program {type(one).__name__} has no landmarks: it is no PlanarVehicle")
        places.append(torch.as_tensor(one.landmarks).detach().double().cpu())
    if places[0].shape != places[1].shape:
        raise UsageError(f"{len(places[0])} landmarks cannot be compared with {len(places[1])}")
    squares = (places[0] - places[1]).square().sum(-1)
    return {"rms": float(squares.mean().sqrt()), "most": float(squares.max().sqrt())}


@torch.no_grad()
def measurement_errors(program: Program, data: Trajectories, *, particles: int, known_start: bool) -> Errors:
    """Root mean square of measured minus predicted over all measured cells, and the coverage of 90 % intervals.

    `one_step` and `coverage_90` judge the prediction of each row from the rows before it. `open_loop_1s` (and `_3s`)
    starts 64 filtered particles at each row and runs them without noise over the rows that make up that time.
    Measurement noise is part of every one of these errors.

    Returns:
        `one_step`, `open_loop_1s`, `open_loop_3s` in the measurements' unit, and `coverage_90` between 0 and 1; an
        open loop shorter than a step or longer than every trajectory is left out.
    """
    totals: dict[str, tuple[float, float]] = {}
    rows = {name: data.rows_ahead(seconds) for name, seconds in OPEN_LOOP.items()}
    horizons = {name: count for name, count in rows.items() if 1 <= count < data.time.shape[0]}
    for part in in_parts(data, particles):
        for name, (total, count) in _totals(Problem(program, part, known_start), particles, horizons).items():
            so_far = totals.get(name, (0.0, 0.0))
            totals[name] = so_far[0] + total, so_far[1] + count
    means = {name: total / count for name, (total, count) in totals.items() if count}
    return {name: mean if name == "coverage_90" else math.sqrt(mean) for name, mean in means.items()}


def _totals(problem: Problem, particles: int, horizons: dict[str, int]) -> dict[str, tuple[float, float]]:
    """Error → its sum over measured cells, and how many they are."""
    program, data = problem.program, problem.data
    squares, covered, count = 0.0, 0.0, 0.0
    draws: list[Tensor] = []

    def on_frame(row: int, states: Tensor, before: Tensor, after: Tensor) -> None:
        nonlocal squares, covered, count
        draws.append(take(states, systematic(after.exp(), OPEN_LOOP_DRAWS)))
        observed = data.observed[row]
        if row == 0 or not bool(observed.any()):
            return
        weights = before.exp().unsqueeze(-1)
        error, noise = _residuals(program, states.unsqueeze(1), data.measurements[row, None])
        mean = (weights * error.squeeze(1)).sum(0)
        below = (weights * (noise < error).squeeze(1)).sum(0)
        squares += float(mean[observed].square().sum())
        covered += float(((below > 0.05) & (below < 0.95))[observed].sum())
        count += float(observed.sum())

    particle_filter(
        program, data, particles=particles, known_start=problem.known_start, keep_history=False, on_frame=on_frame
    )
    totals = {"one_step": (squares, count), "coverage_90": (covered, count)}
    filtered = torch.stack(draws, 1)
    for name, horizon in horizons.items():
        end = _ends_of_roll_outs(program, data, filtered[:, :-horizon], horizon, AtMean())
        error, _ = _residuals(program, end, data.measurements[horizon:])
        observed = data.observed[horizon:]
        totals[name] = (float(error.mean(0)[observed].double().square().sum()), float(observed.sum()))
    return totals


def _residuals(program: Program, states: Tensor, measurements: Tensor) -> tuple[Tensor, Tensor]:
    """Measured minus predicted, and one draw of the measurement noise, both `(..., K)`."""
    recording = Recording()
    with running(*states.shape[:-1]), recording:
        program.observe(states)
    errors, noises, column = [], [], 0
    for site, fn in recording.distributions.items():
        drawn = recording.values[site]
        width = fn.event_shape.numel()
        measured = measurements[..., column : column + width]
        column += width
        errors.append(as_vector(residual(fn, measured if fn.event_dim else measured[..., 0]), fn.event_dim))
        noises.append(as_vector(residual(fn, drawn), fn.event_dim))
    return torch.cat(errors, -1), torch.cat(noises, -1)
