"""What a program makes of the controls of some drives, many times over: what the drives are compared with.

Sets are simulated, smoothed and judged a block at a time, so that memory does not grow with their number times the
drives': three hundred drives and a hundred sets at once would take fourteen gigabytes.
"""

import copy
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from steady_ppl.criticism.perturbations import Direction, directions
from steady_ppl.criticism.residual_maps import Residuals
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import FilterError
from steady_ppl.gaussian.kalman import Tracked, track
from steady_ppl.gaussian.linearize import ReferencePath
from steady_ppl.gaussian.predict import Prediction, predict, simulate_each
from steady_ppl.gaussian.smoother import REST_TOLERANCE, smooth
from steady_ppl.likelihood.parameters import elements, set_values
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.utils.angles import wrap_angles
from steady_ppl.utils.cores import Output, run_in_parallel
from steady_ppl.utils.random import seeded

MIN_BAND_SETS = 20  # simulated sets for bands
MAX_ROWS_OF_BLOCK = 100_000  # of all drives of a block: the memory of larger arrays takes longer to get than to fill
ROUNDING = 1e-5  # of a state, in single precision
MAX_LINEARISATIONS = 4  # of drives that need them: beside a landmark the truth is far from the mode


@dataclass(frozen=True)
class SimulatedSets:
    """`M` sets of the same `B` drives."""

    sets: int  # M, those that blew up left out
    floor: dict[int, np.ndarray]  # horizon → RMSE of each component in each set, (M, K)
    residuals: Residuals
    directions: list[Direction]  # with the scores of all M · B drives


@torch.no_grad()
def simulate_sets(
    problem: Problem, starts: Tensor, channels: int, horizons: Sequence[int], values: Tensor | None = None
) -> SimulatedSets:
    """Simulate, and track and predict with the program as it is.

    Args:
        problem: a program and `B` drives.
        starts: `(M, B, D)`, where each drive of each set begins.
        channels: C, how many numbers a step's noise has.
        horizons: rows ahead, one row among them.
        values: `(M, P)`, the learnable numbers under which each set is simulated; None: as they are.

    Raises:
        FilterError: too many sets blew up.
    """
    at_once, seed = max(1, MAX_ROWS_OF_BLOCK // problem.data.time.numel()), int(torch.randint(2**31, ()))

    def simulate(number: int, block: Tensor, under: Tensor | None) -> Output:
        with seeded(seed + number, "block"):
            return _block(problem, block, under, channels, horizons)

    blocks_of_starts = starts.split(at_once)
    under = [None] * len(blocks_of_starts) if values is None else values.split(at_once)
    jobs = [partial(simulate, *job) for job in zip(itertools.count(), blocks_of_starts, under)]
    blocks = [(tensors, said) for tensors, said in run_in_parallel(jobs) if tensors]
    sets = sum(len(tensors["values"]) for tensors, _ in blocks)
    if sets < MIN_BAND_SETS:
        what = f"{len(starts) - sets} of {len(starts)} simulated sets blew up"
        raise FilterError(f"{what}: the fitted model does not even explain trajectories of its own")

    def of_blocks(name: str) -> Tensor:
        return torch.cat([tensors[name] for tensors, _ in blocks])

    _, said = blocks[0]
    variables = {name: of_blocks(f"variable {name}").numpy() for name in said["variables"]}
    in_all = [one for one in said["directions"] if all(f"scores {one[1]}" in tensors for tensors, _ in blocks)]
    return SimulatedSets(
        sets,
        {horizon: of_blocks(f"floor {horizon}").numpy() for horizon in said["horizons"]},
        Residuals(said["names"], of_blocks("values").numpy(), of_blocks("there").numpy(), variables),
        [Direction(kind, name, of_blocks(f"scores {name}")) for kind, name in in_all],
    )


def _block(problem: Problem, starts: Tensor, values: Tensor | None, channels: int, horizons: Sequence[int]) -> Output:
    """What `SimulatedSets` has of some sets, each tensor with the sets or their drives in front, and the names in it;
    nothing where every set blew up."""
    program, sets = problem.program, len(starts)
    programs: Iterable[Program] = [program]
    begins: Sequence[Tensor] = [starts]
    if values is not None:
        values, counts = values.unique_consecutive(dim=0, return_counts=True)
        programs, begins = _moved(program, values), starts.split(counts.tolist())
    again, truth = simulate_each(programs, problem.data, begins, channels)
    copies = replace(problem, data=again)
    near, tracked = _tracked(copies, truth)
    whole = torch.isfinite(tracked.log_likelihood).view(sets, -1).all(1)
    if not bool(whole.all()):
        if not bool(whole.any()):
            return {}, {}
        kept = whole.repeat_interleave(len(problem.data)).nonzero().flatten()
        copies, sets = copies.subset(kept), int(whole.sum())
        tracked = track(copies, near.subset(kept), passes=1)
    again = copies.data
    simulated = predict(program, again, tracked, horizons, bands=[1])
    errors, scores = residuals(program, again, tracked, simulated[1], sets), directions(program, again, tracked)
    arrays = {"values": errors.values, "there": errors.there}
    arrays |= {f"variable {name}": value for name, value in errors.variables.items()}
    arrays |= {f"floor {horizon}": _rmse_of_sets(ahead, sets) for horizon, ahead in simulated.items()}
    tensors = {name: torch.from_numpy(value) for name, value in arrays.items()}
    said = {"names": errors.names, "variables": list(errors.variables), "horizons": list(simulated)}
    said["directions"] = [[one.kind, one.name] for one in scores]
    return tensors | {f"scores {one.name}": one.scores for one in scores}, said


def _moved(program: Program, values: Tensor) -> Iterator[Program]:
    """A copy of a program with some numbers `(M, P)` after the others, each until the next is asked for."""
    program = copy.deepcopy(program)
    parts = elements(program)
    for each in values:
        set_values(parts, each)
        yield program


def _tracked(problem: Problem, truth: ReferencePath) -> tuple[ReferencePath, Tracked]:
    """Paths near the posterior's modes, and the drives along them. Drives whose path is still on its way after a single
    step from the truth take more."""
    near = smooth(problem, truth, passes=1).path(problem.data)
    tracked = track(problem, near, passes=1)
    far = ~((tracked.noise - near.noise).abs().amax((0, 2)) <= REST_TOLERANCE) | _starts_elsewhere(tracked, near)
    if bool(far.any()):
        index = far.nonzero().flatten()
        path = smooth(problem.subset(index), truth.subset(index), passes=MAX_LINEARISATIONS).linearization.path
        near = near.with_subset(index, path)
        tracked = track(problem, near, passes=1)
    return near, tracked


def _starts_elsewhere(tracked: Tracked, near: ReferencePath) -> Tensor:
    """Whether drives' first states are others than the path's, in standard deviations, `(B,)`."""
    begin = near.states[0].double()
    away = wrap_angles(tracked.smoothed[0] - begin, tracked.linearization.angles).abs()
    sd = tracked.covariances[0].diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    return ~(away <= REST_TOLERANCE * sd + ROUNDING * begin.abs().amax(0)).all(-1)


def residuals(program: Program, data: Trajectories, tracked: Tracked, ahead: Prediction, sets: int) -> Residuals:
    """The standardised one-step errors of the measurements and the scores of the channels, with what they are sorted
    by: state components, velocities in the channels' own frame and positions."""
    there = torch.cat([ahead.observed, data.transitions.unsqueeze(-1).expand_as(tracked.noise)], -1)
    states = tracked.path(data).states[:-1]
    variables = {name: states[..., i] for i, name in enumerate(program.state_names)}
    for angle in program.angles:
        variables[angle] = torch.remainder(variables[angle] + torch.pi, 2 * torch.pi) - torch.pi
    for name, velocity in program.velocities(states).items():
        if not any(torch.equal(velocity, value) for value in variables.values()):
            variables[f"{name} velocity"] = velocity
    channels, count = program.channel_names, tracked.noise.shape[-1]
    if len(channels) != count:
        channels = tuple(f"channel {i + 1}" for i in range(count))
    return Residuals(
        names=[*program.measurement_names, *channels],
        values=_by_set(torch.where(there, torch.cat([ahead.standardised, tracked.noise], -1), 0.0), sets),
        there=_by_set(there, sets),
        variables={name: _by_set(value, sets) for name, value in variables.items()},
    )


def _rmse_of_sets(prediction: Prediction, sets: int) -> np.ndarray:
    """Root mean square of each component's error in each set, `(M, K)`."""
    error, there = (values.unflatten(1, (sets, -1)) for values in (prediction.error, prediction.observed))
    squares = torch.where(there, error, 0.0).square().sum((0, 2))
    return (squares / there.sum((0, 2)).clamp(min=1)).sqrt().numpy(force=True)


def _by_set(values: Tensor, sets: int) -> np.ndarray:
    """`(T, M · B, ...)` to `(M, T, B, ...)`."""
    return values.unflatten(1, (sets, -1)).transpose(0, 1).contiguous().numpy(force=True)
