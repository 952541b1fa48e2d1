"""Measurements predicted from the rows before them, some rows ahead, and drives simulated to compare with."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from steady_ppl.data.horizons import named_horizons
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.kalman import Tracked
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.kernels.rows import function_of_rows, on_all_rows
from steady_ppl.model.handlers import Observing, Recording, draw_starts, joined, residual, running
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import RowInputs, mean_step, noisy_step, row_inputs
from steady_ppl.smc.simulate import measure
from steady_ppl.utils.random import seeded

HALF_WIDTH = 1.6448536269514729  # of a normal's 90 % interval, in standard deviations


@dataclass(frozen=True)
class Prediction:
    """Measured less predicted, of rows `horizon`, `horizon` + 1, … from what was measured up to `horizon` rows before;
    each is `(T + 1 − horizon, B, K)`."""

    error: Tensor  # on the circle where the measurement is an angle
    variance: Tensor  # of the linearised program, measurement noise included; NaN where missing
    observed: Tensor  # where there is something to compare

    @property
    def standardised(self) -> Tensor:
        """Errors in standard deviations of the prediction, zero where missing."""
        return torch.where(self.observed, self.error / self.variance.sqrt(), 0.0)

    def covered(self) -> Tensor:
        """Whether the 90 % band holds the measurement."""
        return (self.standardised.abs() < HALF_WIDTH) & self.observed


@torch.no_grad()
def predict(
    program: Program, data: Trajectories, tracked: Tracked, horizons: Sequence[int], bands: Sequence[int] | None = None
) -> dict[int, Prediction]:
    """Run the program without noise from the filtered state of every row, with the recorded controls.

    Gives a prediction for each horizon, in rows ahead, that is shorter than the longest drive; `bands` are the horizons
    whose variances are wanted, the others' are NaN; None: all.
    """
    found = {}
    for horizon, state in states_ahead(program, data, tracked, max(horizons)):
        if horizon in horizons:
            seen = tracked.linearization.precision[horizon:] > 0
            wanted = bands is None or horizon in bands
            variance = tracked.variances_ahead(horizon) if wanted else torch.full(seen.shape, torch.nan).double()
            observed = data.observed[horizon:] & seen
            error = row_errors(program, state, data.measurements[horizon:], observed).double()
            found[horizon] = Prediction(torch.where(observed, error, 0.0), variance, observed)
    return found


def states_ahead(program: Program, data: Trajectories, tracked: Tracked, most: int) -> Iterator[tuple[int, Tensor]]:
    """From every row on, without noise: how many rows ahead, and the states there, `(T + 1 − ahead, B, D)`."""
    state = tracked.states.to(data.controls.dtype)
    inputs = row_inputs(program, data)
    for ahead in range(1, min(most, len(data.steps)) + 1):
        state = mean_steps(program, state[:-1], RowInputs(*(values[ahead - 1 :] for values in inputs)))
        yield ahead, state


def mean_steps(program: Program, states: Tensor, inputs: RowInputs) -> Tensor:
    """Where rows end without noise, `(rows, B, D)`, by a kernel where there is one."""
    given = {"state": states} | inputs._asdict()
    return on_all_rows(program, "mean step", partial(mean_step, program), given).values


def errors(program: Program, states: Tensor, measurements: Tensor, observed: Tensor) -> Tensor:
    """Measured less what the program measures in these states, `(..., K)`, on the circle for angles."""
    with running(*states.shape[:-1]), Recording() as seen, Observing(measurements, observed):
        program.observe(states)
    apart = {site: residual(fn, seen.observed[site]) for site, fn in seen.distributions.items()}
    return joined(apart, seen.distributions, states.shape[:-1])


def row_errors(program: Program, states: Tensor, measurements: Tensor, observed: Tensor) -> Tensor:
    """`errors` of states `(rows, B, D)`, by a kernel where there is one."""
    given = {"state": states, "measurement": measurements, "observed": observed}
    return on_all_rows(program, "errors", partial(errors, program), given).values


def simulate_again(
    program: Program, data: Trajectories, starts: Tensor, channels: int
) -> tuple[Trajectories, ReferencePath]:
    """`M · B` drives that the program makes of the same controls from starts `(M, B, D)` with C noise channels, with
    the same gaps in the measurements, all of the first set first; and their true paths."""
    return simulate_each([program], data, [starts], channels)


@torch.no_grad()
def simulate_each(
    programs: Iterable[Program], data: Trajectories, starts: Sequence[Tensor], channels: int
) -> tuple[Trajectories, ReferencePath]:
    """Some sets of each program, one after the other, see `simulate_again`; `starts` are `(·, B, D)` for each."""
    sets, drives = sum(map(len, starts)), len(data)
    parts = [
        _rolled_out(program, begin, data, channels, by_kernels=len(starts) > 1)
        for program, begin in zip(programs, starts, strict=True)
    ]
    path, noise, drawn = (torch.cat(one, 1) for one in zip(*parts, strict=True))
    again = data.subset(torch.arange(drives).repeat(sets))
    again = replace(again, measurements=torch.where(again.observed, drawn, 0.0), states=path)
    return again.without_truth(keep_start=True), ReferencePath(path, noise)


def _rolled_out(
    program: Program, starts: Tensor, data: Trajectories, channels: int, *, by_kernels: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """States, noise and measurements of some sets of drives, sets and drives in one dimension."""
    sets, drives, _ = starts.shape
    state, inputs = starts.to(data.controls.dtype), row_inputs(program, data)._asdict()
    states, noises = [state], list[Tensor]()
    step: Callable[..., Tensor] = partial(noisy_step, program)
    for row in range(len(data.steps)):
        noise = torch.randn(sets, drives, channels).to(state)
        at_row = {name: values[row].expand(sets, *values[row].shape) for name, values in inputs.items()}
        given = {"state": state, "noise": noise} | at_row
        if by_kernels and row == 0:
            step = function_of_rows(program, "end of a row", step, given)
        inside = data.transitions[row, :, None]
        state = torch.where(inside, step(*given.values()), states[0])
        states.append(state)
        noises.append(torch.where(inside, noise, 0.0))
    path = torch.stack(states).flatten(1, 2)
    return path, torch.stack(noises).flatten(1, 2), measure(program, path)


@torch.no_grad()
def on_a_circle(program: Program, data: Trajectories, states: Tensor) -> Tensor:
    """Which measurement components do not notice a whole turn, `(K,)`; looked at from the first of `states`."""
    one, every = states[:1, :1].to(data.controls.dtype), torch.ones_like(data.observed[:1, :1])
    measured = torch.full_like(data.measurements[:1, :1], 0.3)
    change = errors(program, one, measured + 2 * math.pi, every) - errors(program, one, measured, every)
    return (change.abs() < 1e-3).flatten()


def suited_horizons(program: Program, data: Trajectories, count: int, seconds: Sequence[float]) -> dict[str, int]:
    """See `named_horizons`; the program knows which measurements do not notice a whole turn."""
    with seeded(0, "horizons"):
        start = draw_starts(program, 1, 1)
    return named_horizons(data, count, seconds, on_a_circle(program, data, start))
