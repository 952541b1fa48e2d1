"""Errors in measurement space: what was measured against what the filtered program predicted. No truth is needed."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.likelihood.evidence import in_parts
from steady_ppl.model.handlers import AtMean, Recording, as_vector, residual, running
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import acting_controls
from steady_ppl.smc.filter import particle_filter, roll_out
from steady_ppl.smc.resampling import systematic, take

OPEN_LOOP = {"open_loop_1s": 1.0, "open_loop_3s": 3.0}
OPEN_LOOP_DRAWS = 64


@torch.no_grad()
def measurement_errors(program: Program, data: Trajectories, *, particles: int, known_start: bool) -> dict[str, float]:
    """Root mean square of measured minus predicted over all measured cells, and the coverage of 90 % intervals.

    `one_step` and `coverage_90` judge the prediction of each row from the rows before it. `open_loop_1s` (and `_3s`)
    starts 64 filtered particles at each row and runs them without noise over the rows that make up that time.
    Measurement noise is part of every one of these errors.

    Args:
        program: the state-space model.
        data: as returned by `for_program`; all its rows are used.
        particles: N, for each trajectory.
        known_start: start at the true first state.

    Returns:
        `one_step`, `open_loop_1s`, `open_loop_3s` in the measurements' unit, and `coverage_90` between 0 and 1; an
        open loop shorter than a step or longer than every trajectory is left out.
    """
    totals: dict[str, list[float]] = {}
    rows = {name: data.rows_ahead(seconds) for name, seconds in OPEN_LOOP.items()}
    horizons = {name: count for name, count in rows.items() if 1 <= count < data.time.shape[0]}
    for part in in_parts(data, particles):
        for name, (total, count) in _totals(program, part, particles, known_start, horizons).items():
            have = totals.setdefault(name, [0.0, 0.0])
            have[0] += total
            have[1] += count
    means = {name: total / count for name, (total, count) in totals.items() if count}
    return {name: mean if name == "coverage_90" else math.sqrt(mean) for name, mean in means.items()}


def _totals(
    program: Program, data: Trajectories, particles: int, known_start: bool, horizons: dict[str, int]
) -> dict[str, tuple[float, float]]:
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

    particle_filter(program, data, particles=particles, known_start=known_start, keep_history=False, on_frame=on_frame)
    totals = {"one_step": (squares, count), "coverage_90": (covered, count)}
    return totals | _open_loop(program, data, torch.stack(draws, 1), horizons)


def _open_loop(
    program: Program, data: Trajectories, draws: Tensor, horizons: dict[str, int]
) -> dict[str, tuple[float, float]]:
    totals: dict[str, tuple[float, float]] = {}
    for name, horizon in horizons.items():
        starts = data.time.shape[0] - horizon

        def windows(values: Tensor, horizon: int = horizon, starts: int = starts) -> Tensor:
            return torch.stack([values[k : k + starts] for k in range(horizon)])

        *_, state = roll_out(
            program,
            draws[:, :starts],
            windows(acting_controls(program, data)),
            windows(data.elapsed),
            windows(data.steps),
            handler=AtMean(),
        )
        error, _ = _residuals(program, state, data.measurements[horizon:])
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
