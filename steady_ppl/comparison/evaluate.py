"""Judge fitted programs on one table: the paper's errors where the truth is known, measurement space always.

The paper's errors are those of STEADY (IROS 2022), section V, as its authors' code computes them.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor

from steady_ppl.data.table import refuse_long
from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import UsageError, labelled
from steady_ppl.likelihood.evidence import choose_filter, evidence, in_parts, run_filter
from steady_ppl.model.handlers import AtMean, Recording, joined, parted, residual, running
from steady_ppl.model.planar_vehicle import PlanarVehicle, UnknownMap
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program, error_indices, for_program
from steady_ppl.model.substeps import acting_controls
from steady_ppl.runs.fit import Fit
from steady_ppl.smc.filter import particle_filter
from steady_ppl.smc.resampling import systematic, take
from steady_ppl.smc.simulate import roll_out
from steady_ppl.utils.angles import wrap_angles
from steady_ppl.utils.cores import one_thread
from steady_ppl.utils.progress import stages
from steady_ppl.utils.random import seeded
from steady_ppl.utils.text import aligned, figure

Errors = dict[str, float]
OPEN_LOOP = {"open_loop_1s": 1.0, "open_loop_3s": 3.0}  # s ahead
OPEN_LOOP_DRAWS = 64  # filtered particles of a row, each the start of an open loop
ERRORS_OF_STATES = {"forward": "forward", "mean": "forward_mean", "state": "state_estimation"}  # column → errors


@one_thread()
def evaluate(
    fit: Fit,
    table: Trajectories,
    *,
    particles: int | None = None,
    rollouts: int = 1000,
    look_ahead: bool | None = None,
    seed: int = 0,
    surveyed: Program | None = None,
) -> dict[str, Any]:
    """Errors of one fitted program; equal seeds give every program the same random numbers.

    Args:
        fit: what is judged; its `known_start` decides whether the filters start at the true first state.
        table: trajectories that were not used for the fit.
        particles: N of each filter (the paper: 100 000); 200 looking ahead and 5000 otherwise when not given.
        rollouts: noisy roll-outs from each true state.
        look_ahead: whether log p(y) and the states come from a filter that looks ahead; None where the program allows.
        seed: of the Monte-Carlo draws.
        surveyed: a program of the same vehicle with the true landmarks, if the map is to be judged.

    Returns:
        `known_start` and `measured` (what log p(y) is given and is of), `filter` ("lookahead", or "bootstrap" and why),
        `log_likelihood` (mean per trajectory at every tenth row), `scarce` (how many `particles` its filter had, and in
        which `trajectory` after the largest `share` of measured rows fewer than ten of them were in effect), `forward`,
        `forward_mean`, `state_estimation` (error groups; empty without true states), `measurement` and, if asked for,
        `map` (see `map_errors`; `learned`: whether the landmarks are elsewhere than declared).

    Raises:
        DataError: the table lacks a column or a known start, or a trajectory is too long (`refuse_long`).
        UsageError: the map is none, or another vehicle's.
        FilterError: the filter broke down.
    """
    problem, of_map = _checked(fit, table, surveyed)
    program, data, known_start = problem.program, problem.data, problem.known_start
    choice = choose_filter(program, data, known_start=known_start, particles=particles, look_ahead=look_ahead)
    settings: Any = {"look_ahead": choice.look_ahead, "known_start": known_start, "particles": choice.particles}
    result: dict[str, Any] = {"recipe": fit.recipe, "known_start": known_start}
    result |= {"measured": list(data.measurement_names), "filter": choice.name}
    with stages(("log p(y)", 1), ("states", 2), ("measurements", 2)) as begin:
        begin()
        with seeded(seed, "log_likelihood"):
            likely, shares = evidence(program, data, **settings)
        worst = int(shares.argmax())
        scarce = {"trajectory": data.labels[worst], "share": float(shares[worst]), "particles": choice.particles}
        result |= {"log_likelihood": float(likely.mean()), "scarce": scarce}
        result |= {"forward": {}, "forward_mean": {}, "state_estimation": {}}
        begin()
        if has_truth(data):
            with seeded(seed, "forward"):
                result["forward"] = forward(program, data, rollouts=rollouts)
            result["forward_mean"] = forward_mean(program, data)
            with seeded(seed, "state_estimation"):
                result["state_estimation"] = state_estimation(program, data, **settings)
        begin()
        with seeded(seed, "measurement"):
            result["measurement"] = measurement_errors(program, data, particles=2000, known_start=known_start)
    return result | ({} if of_map is None else {"map": of_map})


def evaluate_all(
    fits: Sequence[Fit], labels: Sequence[str], table: Trajectories, *, surveyed: Program | None = None, **settings: Any
) -> list[dict[str, Any]]:
    """`evaluate` of several fits, all checked before anything is computed.

    Raises:
        SteadyError: as `evaluate` does, the fit's label before the message.
    """
    for fit, label in zip(fits, labels, strict=True):
        with labelled(label):
            _checked(fit, table, surveyed)
    results = []
    with stages(*((f"evaluating {label}", 1) for label in labels)) as begin:
        for fit, label in zip(fits, labels, strict=True):
            begin()
            with labelled(label):
                results.append(evaluate(fit, table, surveyed=surveyed, **settings))
    return results


def _checked(fit: Fit, table: Trajectories, surveyed: Program | None) -> tuple[Problem, dict[str, Any] | None]:
    """The fit's program and the columns that it reads, and errors of its map, if table and map suit it."""
    data = for_program(fit.program, table)
    refuse_long(data)
    of_map = None if surveyed is None else _errors_of_map(fit.program, surveyed)
    return Problem(fit.program, data, fit.known_start), of_map


def _errors_of_map(program: Program, surveyed: Program) -> dict[str, Any]:
    for one in (program, surveyed):
        if not len(getattr(one, "landmarks", ())):
            raise UsageError(f"model {type(one).__name__} has no landmarks: judge it without a map")
    errors = map_errors(program, surveyed)

    def form(one: Program) -> tuple[tuple[str, ...], ...]:
        states = tuple(name for name in one.state_names if name not in one.resting_names)  # but those of added effects
        return states, one.control_names, one.measurement_names

    for what, own, other in zip(("states", "controls", "measurements"), form(program), form(surveyed), strict=True):
        if own != other:
            raise UsageError(
                f"the map is another vehicle's: {type(surveyed).__name__} has the {what} {', '.join(other)}, "
                f"{type(program).__name__} has {', '.join(own)}; name a model of the same vehicle"
            )
    learned = isinstance(program, UnknownMap) and not torch.equal(program.landmarks, program.declared)
    return {**errors, "learned": learned}


def incomparable(results: Sequence[Mapping[str, Any]], labels: Sequence[str]) -> list[str]:
    """Why log p(y) of one fit says nothing beside that of another, a line a reason."""
    columns = dict.fromkeys(name for result in results for name in result["measured"])
    lacks, known, drawn, reasons = list[str](), list[str](), list[str](), list[str]()
    for label, result in zip(labels, results, strict=True):
        (known if result["known_start"] else drawn).append(label)
        if unread := [f"y.{name}" for name in columns if name not in result["measured"]]:
            lacks.append(f"{label} does not read {', '.join(unread)}")
    if lacks:
        reasons.append(
            f"log p(y) is not comparable, nor are errors in measurement space: {'; '.join(lacks)}; compare runs that "
            "read the same"
        )
    if known and drawn:
        reasons.append(
            f"log p(y) is not comparable: the start is known to {', '.join(known)} and from the prior in "
            f"{', '.join(drawn)}; compare runs that were given the same"
        )
    return reasons


def table_of(results: Sequence[Mapping[str, Any]], labels: Sequence[str]) -> str:
    """The results as a table of text, a line a program: the start where it is known to some only, log p(y), errors of
    the first two groups of states, and errors in measurement space."""
    groups = list(next((r["forward"] for r in results if r["forward"]), {}))[:2]
    columns = {f"{name} {group}": (of, group) for name, of in ERRORS_OF_STATES.items() for group in groups}
    columns |= {name: ("measurement", name) for name in ("one_step", *OPEN_LOOP, "coverage_90")}
    lines = [["", "start", "log p(y)", *columns]]
    for label, result in zip(labels, results, strict=True):
        start = "known" if result["known_start"] else "prior"
        errors = [figure(result[of].get(name), ".4f") for of, name in columns.values()]
        lines.append([label, start, f"{result['log_likelihood']:.2f}", *errors])
    if len({result["known_start"] for result in results}) == 1:
        lines = [[label, *figures] for label, _, *figures in lines]
    return "\n".join(aligned(lines))


def has_truth(data: Trajectories) -> bool:
    """Whether the states are known beyond a first row."""
    return data.states is not None and bool(torch.isfinite(data.states[1:]).any())


def squared_errors(program: Program, states: Tensor, truth: Tensor) -> dict[str, Tensor]:
    """Squared errors `(...)` of each of the program's error groups, angles on the circle; NaN where unknown."""
    difference = wrap_angles(states - truth, program.angle_indices)
    return {group: difference[..., list(members)].square().sum(-1) for group, members in error_indices(program).items()}


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
    """Errors of smoothed lineages, measured at every n-th row and judged at all; groups without truth are left out.

    The squared error is averaged over lineages and rows; its root is averaged over trajectories. See `run_filter` for
    the filter's settings; `every` is n, `lineages` are the paths of each trajectory.
    """
    roots = defaultdict[str, list[Tensor]](list)
    for part in in_parts(data.observed_every(every), particles, look_ahead=look_ahead):
        assert part.states is not None
        filtered = run_filter(program, part, particles=particles, known_start=known_start, look_ahead=look_ahead)
        for group, squared in squared_errors(program, filtered.paths(lineages).states, part.states).items():
            mean = squared.mean(0)
            known = torch.isfinite(mean) & part.rows
            judged = known.any(0)
            roots[group].append((torch.where(known, mean, 0.0).sum(0)[judged] / known.sum(0)[judged]).sqrt())
    return {group: float(torch.cat(values).mean()) for group, values in roots.items() if any(map(len, values))}


@torch.no_grad()
def forward(
    program: Program, data: Trajectories, *, horizon: int = 10, rollouts: int = 1000, handler: Messenger | None = None
) -> Errors:
    """End-point errors of noisy roll-outs from every true state, with the recorded controls.

    One root of the squared error averaged over all: the process noise counts in it, unless a handler changes it.
    """
    assert data.states is not None
    if data.time.shape[0] <= horizon:
        return {}
    begins = [index for index, name in enumerate(program.state_names) if name not in program.kept_names]
    counted = data.rows[horizon:] & torch.isfinite(data.states[:-horizon, :, begins]).all(-1)
    origin = torch.where(counted[..., None], data.states[:-horizon], 0.0).nan_to_num()
    sums, counts = defaultdict[str, float](float), defaultdict[str, int](int)
    at_once = max(1, 500_000 // counted.numel())
    for first in range(0, rollouts, at_once):
        draws = min(at_once, rollouts - first)
        end = _ends_of_roll_outs(program, data, origin.expand(draws, *origin.shape), horizon, handler)
        for group, squared in squared_errors(program, end, data.states[horizon:]).items():
            members = list(error_indices(program)[group])
            known = counted & torch.isfinite(data.states[horizon:, :, members]).all(-1)
            sums[group] += float(squared[:, known].double().sum())
            counts[group] += draws * int(known.sum())
    return {group: math.sqrt(total / counts[group]) for group, total in sums.items() if counts[group]}


def forward_mean(program: Program, data: Trajectories, *, horizon: int = 10) -> Errors:
    """The same for one roll-out without channel noise."""
    return forward(program, data, horizon=horizon, rollouts=1, handler=AtMean())


def _ends_of_roll_outs(
    program: Program, data: Trajectories, states: Tensor, horizon: int, handler: Messenger | None
) -> Tensor:
    """Where roll-outs end that begin at given states of all rows but the last `horizon`, with the recorded controls."""
    given = (
        torch.stack([values[k : len(data.time) - horizon + k] for k in range(horizon)])
        for values in (acting_controls(program, data), data.elapsed, data.steps)
    )
    for end in roll_out(program, states, *given, handler=handler):
        states = end
    return states


def map_errors(program: Program, surveyed: Program) -> Errors:
    """How far a program's landmarks are from as many of another, m: `rms` and `most`; see `evaluate` for errors."""
    places = []
    for one in (program, surveyed):
        if not isinstance(one, PlanarVehicle):
            raise UsageError(f"model {type(one).__name__} has no landmarks: it is no PlanarVehicle")
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
    rows = {name: data.rows_ahead(seconds) for name, seconds in OPEN_LOOP.items()}
    horizons = {name: count for name, count in rows.items() if 1 <= count < data.time.shape[0]}
    sums, counts = defaultdict[str, float](float), defaultdict[str, float](float)
    for part in in_parts(data, particles):
        for name, (total, count) in _totals(Problem(program, part, known_start), particles, horizons).items():
            sums[name] += total
            counts[name] += count
    means = {name: sums[name] / count for name, count in counts.items() if count}
    return {name: mean if name == "coverage_90" else math.sqrt(mean) for name, mean in means.items()}


def _totals(problem: Problem, particles: int, horizons: dict[str, int]) -> dict[str, tuple[float, float]]:
    """Error → its sum over measured cells, and how many they are."""
    program, data, known_start = problem.program, problem.data, problem.known_start
    squares, covered, count, draws = 0.0, 0.0, 0.0, list[Tensor]()

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
    filtered = torch.stack(draws, 1)
    for name, horizon in horizons.items():
        end = _ends_of_roll_outs(program, data, filtered[:, :-horizon], horizon, AtMean())
        error, _ = _residuals(program, end, data.measurements[horizon:])
        observed = data.observed[horizon:]
        totals[name] = (float(error.mean(0)[observed].double().square().sum()), float(observed.sum()))
    return totals


def _residuals(program: Program, states: Tensor, measurements: Tensor) -> tuple[Tensor, Tensor]:
    """Measured minus predicted, and one draw of the measurement noise, both `(..., K)`."""
    left, seen = states.shape[:-1], Recording()
    with running(*left), seen:
        program.observe(states)
    kinds = seen.distributions

    def apart(values: Mapping[str, Tensor]) -> Tensor:
        return joined({site: residual(fn, values[site]) for site, fn in kinds.items()}, kinds, left)

    return apart(parted(measurements, kinds)), apart(seen.values)
