"""The particle filter: the Pyro program itself, forward in time, for many particles and trajectories.

Gordon, Salmond and Smith (1993); Chopin and Papaspiliopoulos (2020), algorithms 10.1 and 10.3 (adaptive resampling).
With a twist the noise is proposed with a view to the later measurements (Guarniero, Johansen and Lee 2017).
Densities live in the channels: a particle is a start and its channel noise, its states follow.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from functools import partial
from typing import Any

import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import FilterError, ProgramError
from steady_ppl.model.handlers import KnownStart, Recording, Standardised, broadcast_event, running
from steady_ppl.model.program import Program
from steady_ppl.model.stability import divergence
from steady_ppl.model.substeps import advance, channel_values
from steady_ppl.smc.backends import Stepping, stepping_for
from steady_ppl.smc.genealogy import Filtered
from steady_ppl.smc.resampling import effective_sample_size, normalise, systematic, take

STEPS_WORTH_COMPILING = 1_000_000  # steps of particles, which take the program's own lines a second
OnFrame = Callable[[int, Tensor, Tensor, Tensor], None]


@torch.no_grad()
def particle_filter(
    program: Program,
    data: Trajectories,
    *,
    particles: int,
    observation_weight: float | Tensor = 1.0,
    known_start: bool = False,
    resample_below: float = 0.5,
    proposal: Proposal | None = None,
    keep_history: bool = True,
    kernels: bool | None = None,
    on_frame: OnFrame | None = None,
) -> Filtered:
    """Run the program as a particle filter on every trajectory at once.

    Args:
        program: the state-space model.
        data: as returned by `for_program`.
        particles: N, for each trajectory.
        observation_weight: tempers the observations' log-density (w_obs in STEADY); `(B,)` for one a trajectory.
        known_start: start every particle at the true first state instead of drawing it from the prior.
        resample_below: resample a trajectory when its effective sample size falls below this share of N;
            checked at its observed rows (at all rows when looking ahead), never at the table's last one.
        proposal: where the noise of start and steps comes from; the program itself when None (the bootstrap filter).
        keep_history: keep what `Filtered.paths` needs.
        kernels: run compiled methods where they can serve; None: if there is enough to do, see `STEPS_WORTH_COMPILING`.
        on_frame: called at every row with (row, states `(N, B, D)`, log-weights before, log-weights after), `(N, B)`;
            not when looking ahead.

    Returns:
        The estimate of log p(y) and, with `keep_history`, the genealogy.

    Raises:
        FilterError: every weight is zero; names trajectory and time.
    """
    rows, trajectories = data.time.shape
    proposal = proposal or Proposal()
    if proposal.looks_ahead and on_frame is not None:
        raise ValueError("on_frame sees what is predicted: a filter that looks ahead has seen the later measurements")
    inside, last = data.rows, rows - 1
    ended = (~inside).any(1).tolist()  # rows past a trajectory's end
    observed_rows = data.observed.any(-1).any(-1).tolist()
    start = Recording()
    noise, log_ratio = (None, 0.0) if known_start else proposal.start(particles)
    drawing = KnownStart(data.known_start) if known_start else nullcontext() if noise is None else _given(noise)
    with running(particles, 1, trajectories), start, drawing:
        state = program.initial()
    left = torch.Size((particles, 1, trajectories))
    state = broadcast_event(state, left, 1).squeeze(1)
    if known_start and not bool((state == data.known_start).all()):
        raise ProgramError(
            "a known start needs initial() to return the sampled state as it is; it returns another", site="initial"
        )
    stepping, reason = Stepping(program, data, observation_weight), None
    if kernels is None:
        kernels = particles * data.time.numel() >= STEPS_WORTH_COMPILING
    if kernels and rows > 1:
        stepping, reason = stepping_for(program, data, state, observation_weight)
    log_weights = state.new_full((trajectories, particles), -math.log(particles), dtype=torch.float64).t()
    log_weights = log_weights + log_ratio
    log_likelihood = log_weights.new_zeros((rows, trajectories))
    effective_sizes = log_weights.new_full((rows, trajectories), float(particles))
    blown_up = torch.zeros_like(log_likelihood)
    unmoved = torch.arange(particles, device=state.device).expand(trajectories, -1).t()
    roots = unmoved
    history: list[Tensor] = []
    noises: dict[str, list[Tensor]] = {}
    all_ancestors: list[Tensor | None] = []

    future: Any = 0.0
    for row in range(rows):
        if keep_history:
            history.append(state)
        predicted, ancestors = log_weights, None
        if observed_rows[row]:
            log_weights = log_weights + stepping.log_density(row, state)
        if observed_rows[row] or proposal.looks_ahead:
            if proposal.looks_ahead:
                future = proposal.log_future(row, state)
                if ended[row]:
                    future = torch.where(inside[row], future, 0.0)
            expected = log_weights + future
            broken = expected.isnan()  # a particle that blew up explains no measurement
            log_weights = log_weights.masked_fill(broken, -math.inf)
            weights, log_likelihood[row] = normalise(expected.masked_fill_(broken, -math.inf))
            blown_up[row] = broken.sum(0)
            log_weights = log_weights - log_likelihood[row]
            effective_sizes[row] = effective_sample_size(weights)
            if row < last and resample_below > 0:
                exhausted = effective_sizes[row] < resample_below * particles
                if state.device.type != "cpu" or bool(exhausted.any()):
                    ancestors = torch.where(exhausted, systematic(weights, particles), unmoved)
        if on_frame is not None:
            on_frame(row, state, predicted, log_weights)
        if keep_history:
            all_ancestors.append(ancestors)
        if row == last:
            break
        if ancestors is not None:
            fresh = -math.log(particles) - (take(future, ancestors) if proposal.looks_ahead else 0.0)
            log_weights = torch.where(exhausted, fresh, log_weights)
            roots = take(roots, ancestors)
        if ancestors is not None and proposal.looks_ahead:
            state, ancestors = take(state, ancestors), None
        noise, log_ratio = proposal.step(row, state)
        if proposal.looks_ahead:
            log_weights = log_weights + (torch.where(inside[row + 1], log_ratio, 0.0) if ended[row + 1] else log_ratio)
        state, values = stepping.transition(row, state, ancestors, noise)
        if keep_history:
            for site, value in values.items():
                noises.setdefault(site, []).append(value)

    event_dims = {"states": 1} | {site: fn.event_dim for site, fn in start.distributions.items()} | stepping.event_dims
    _raise_if_broken(program, log_likelihood, blown_up, data)
    survivors = torch.zeros_like(log_weights).scatter_(0, roots, 1.0).sum(0)
    return Filtered(
        log_likelihood=log_likelihood.sum(0),
        log_weights=log_weights,
        effective_sizes=effective_sizes,
        roots=survivors,
        blown_up=blown_up.sum(0),
        states=history,
        start={site: broadcast_event(value, left, event_dims[site]).squeeze(1) for site, value in start.values.items()},
        noise=noises,
        ancestors=all_ancestors,
        event_dims=event_dims,
        in_plain_torch=reason,
        channels=None if program.substeps == 1 else partial(_channels, program, data),
    )


@torch.no_grad()
def _channels(program: Program, data: Trajectories, states: Tensor, noise: dict[str, Tensor]) -> dict[str, Tensor]:
    with running(*noise[next(iter(noise))].shape[:3]):
        return channel_values(program, data, states, noise)


def _given(noise: Tensor) -> Standardised:
    return Standardised(noise.unsqueeze(1))


def _raise_if_broken(program: Program, log_likelihood: Tensor, blown_up: Tensor, data: Trajectories) -> None:
    """Find the first row whose evidence is not finite."""
    broken = ~torch.isfinite(log_likelihood)
    if not bool(broken.any()):
        return
    row, trajectory = (int(i) for i in broken.nonzero()[0])
    label, time = data.labels[trajectory], float(data.elapsed[row, trajectory])
    impossible = bool(log_likelihood[row, trajectory] == -math.inf) and not bool(blown_up[: row + 1, trajectory].any())
    what = divergence(program, data.subset([trajectory]), row) or (
        "every particle's weight is zero: the measurement is impossible under the program"
        if impossible
        else "no particle is left that is a number: the program's parameters or states have blown up"
    )
    raise FilterError(f"trajectory {label} at {time:.3g} s: {what}", trajectory=label, time=time)


@torch.no_grad()
def roll_out(
    program: Program,
    state: Tensor,
    controls: Tensor,
    elapsed: Tensor,
    steps: Tensor,
    *,
    handler: Messenger | None = None,
) -> Iterator[Tensor]:
    """Run the program forward from given states; yields the state after each step.

    Args:
        state: `(draws, 1 or R, B, D)`; rows R are starts of a roll-out of their own.
        controls: `(H, 1 or R, B, U)`.
        elapsed, steps: `(H, 1 or R, B)` s.
        handler: acts on the channel noise, for example `AtMean()` for a roll-out without noise.
    """
    for control, time, step in zip(controls, elapsed, steps, strict=True):
        with running(*state.shape[:-1]), handler or nullcontext():
            state = advance(program, state, control, time, step)
        yield state


class Proposal:
    """The program's own noise: the bootstrap filter.

    Attributes:
        looks_ahead: whether weights know of later measurements, at measured rows and at others.
    """

    looks_ahead = False

    def start(self, particles: int) -> tuple[Tensor | None, Tensor | float]:
        """The standard normal noise of `initial`, `(N, B, C)`, and its log density less that of the proposal, `(N, B)`;
        None lets the program draw."""
        return None, 0.0

    def step(self, row: int, state: Tensor) -> tuple[Tensor | None, Tensor | float]:
        """The same for the `transition` after a row, from states `(N, B, D)`."""
        return None, 0.0

    def log_future(self, row: int, state: Tensor) -> Tensor:
        """What is thought of all measurements after a row, `(N, B)` in double precision."""
        return state.new_zeros(state.shape[:-1], dtype=torch.float64)
