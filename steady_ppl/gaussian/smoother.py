"""The iterated smoother: linearise, look ahead, move the path to the posterior mean, again.

This is Gauss–Newton on the start and the standard normal noise of the program (Bell 1994). It finds the path along
which the lookahead filter is steered; its draws are an E step of their own (Briegel and Tresp 1998; Ghahramani and
Roweis 1999).
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import FilterError
from steady_ppl.gaussian.information_filter import Lookahead, look_ahead
from steady_ppl.gaussian.linearize import Linearization, ReferencePath, angles_on_a_circle, linearize
from steady_ppl.kernels.jit import unchanged
from steady_ppl.kernels.rows import on_all_rows
from steady_ppl.model.handlers import KnownStart, Recording, Standardised, joined, normal_moments, parted, running
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.model.stability import divergence
from steady_ppl.model.starts import first_state
from steady_ppl.model.substeps import all_rows, sample_channels
from steady_ppl.smc.filter import particle_filter
from steady_ppl.smc.genealogy import Paths, event_dims
from steady_ppl.utils.angles import wrap_angles

MAX_INCREASE = 10.0
"""Nats by which a step may leave a path worse off, see `_merit`: some such steps lead out of a bad place."""
MAX_RETURN = 0.5  # share of a whole step that the next may undo: where it undoes more, a path swings about its mode
MIN_SHARE = 0.05  # of a step, to which it is shortened at most
MAX_POORER, MORE_PARTICLES = 5.0, 8  # nats a reading that a drive is less likely than most; times as many then
REST_TOLERANCE = 0.05  # a trajectory is at rest where no noise moves by more, in standard deviations of its channel


@torch.no_grad()
def smooth(
    problem: Problem,
    path: ReferencePath,
    *,
    observation_weight: float = 1.0,
    passes: int = 10,
    tolerance: float = 0.01,
    kernels: bool | None = None,
    angles: tuple[int, ...] | None = None,
) -> Lookahead:
    """Move a path to the mode of the posterior and look ahead along it.

    Gauss and Newton's method. A step is halved while its end is worse by more than `MAX_INCREASE` nats, see `_merit`,
    and shortened where the next would undo it, see `MAX_RETURN`.

    Args:
        problem, observation_weight, kernels, angles: of `linearize`.
        path: where to begin; the better, the fewer passes.
        passes: linearisations at most.
        tolerance: stop when no noise moves by more, in standard deviations of its channel.

    Returns:
        The lookahead along the last path that was accepted, so that its linearization and its means agree.
    """
    data = problem.data
    with unchanged(problem.program):
        path = path.for_sensors(problem.program)
        if angles is None:
            angles = angles_on_a_circle(problem.program, data, path.states[0, :1])
        along = partial(linearize, problem, observation_weight=observation_weight, kernels=kernels, angles=angles)
        if passes == 1:
            return look_ahead(along(path))
        accepted = path = replace(path, noise=torch.where(data.transitions[..., None], path.noise, 0.0))
        penalty = torch.zeros_like(path.states, dtype=torch.float64)
        most = torch.full((len(data),), torch.inf, dtype=torch.float64, device=path.states.device)
        last, share = most.new_zeros(()), torch.ones_like(most)
        for index in range(passes):
            ahead = look_ahead(along(path))
            density, defect = _merit(ahead)
            worse = torch.isfinite(most) & ~(_cost(density, defect, penalty) <= most)  # or not a number
            any_worse = bool(worse.any())
            accepted = _either(worse, accepted, path) if any_worse else path
            if index == passes - 1:
                break
            moved = ahead.path(data)
            if any_worse:
                moved = _either(worse, _between(accepted, path, 0.5), moved)
            change = torch.nan_to_num((moved.noise - path.noise).abs(), nan=0.0).max()  # of what has not blown up
            if not bool(change > tolerance):
                break
            penalty = torch.where(worse[:, None], penalty, _penalty(ahead, moved))
            step = _step(ahead, moved)
            share = torch.where(worse, 1.0, _share_of_step(step, last, share))  # what is halved begins anew
            if bool((share < 1).any()):
                moved = _between(path, moved, share)
            last = torch.where(worse[:, None], 0.0, share[:, None] * step)
            most = torch.where(worse, most, _cost(density, defect, penalty) + MAX_INCREASE)
            path = moved
        return look_ahead(along(accepted)) if any_worse else ahead


def _merit(ahead: Lookahead) -> tuple[Tensor, Tensor]:
    """What paths are compared by: less a path's log-density given its own noise, less the linearised log p(y), `(B,)`,
    and how far its states are from where its noise leads, `(T + 1, B, D)`.

    The path's own negative log-density alone would lead through a beacon, where nothing is linear and what is drawn
    from the linearised program is useless. The linearised log p(y) alone may be high far from the measurements. So the
    merit is the one less the other: small where a path is likely and its surroundings are linear.
    """
    linear = ahead.linearization
    noise = linear.path.noise.double()
    start = _start_noise(linear, linear.start_offset)
    begins = linear.start_offset - (linear.start_noise @ start).squeeze(-1)
    rows = linear.offset + (linear.noise @ noise.unsqueeze(-1)).squeeze(-1)
    seen = 0.5 * (linear.precision * linear.residual.square()).sum((0, 2)) - linear.log_scale.sum(0)
    drawn = 0.5 * (noise.square().sum((0, 2)) + start.square().sum((1, 2)))
    defect = wrap_angles(torch.cat([begins.unsqueeze(0), rows]), linear.angles).abs()
    return seen + drawn - ahead.log_likelihood, defect


def _start_noise(linear: Linearization, offset: Tensor) -> Tensor:
    """The standard normal noise of the start that moves it by an offset `(B, D)`, `(B, ·, 1)`; none of a known one."""
    gram = linear.start_noise.mT @ linear.start_noise
    ridge = 1e-12 * gram.diagonal(dim1=-2, dim2=-1) + 1e-24  # a known start has no noise
    start, _ = torch.linalg.solve_ex(gram + torch.diag_embed(ridge), linear.start_noise.mT @ offset.unsqueeze(-1))
    return start


def _step(ahead: Lookahead, moved: ReferencePath) -> Tensor:
    """How far a path is moved, in standard normal noise of its start and of its rows, `(B, ·)`."""
    linear = ahead.linearization
    start = _start_noise(linear, (moved.states[0] - linear.path.states[0]).double())
    rows = (moved.noise - linear.path.noise).double()
    return torch.cat([start.flatten(1), rows.transpose(0, 1).flatten(1)], -1)


def _cost(density: Tensor, defect: Tensor, penalty: Tensor) -> Tensor:
    """Nats, `(B,)`, a unit of each defect counting its penalty (an l₁ penalty: Nocedal and Wright 2006, chapter 17)."""
    return density + (penalty * defect).sum((0, 2))


def _penalty(ahead: Lookahead, moved: ReferencePath) -> Tensor:
    """Twice the pull of a row's measurements and of the later ones at its state after a step, `(T + 1, B, D)`: what a
    unit of a defect must cost for none to be worth it."""
    linear = ahead.linearization
    away = (moved.states - linear.path.states).double().unsqueeze(-1)
    pull, seen = ahead.information.unsqueeze(-1) - ahead.precision @ away, (linear.precision > 0).any(-1)
    by_state = linear.measurement[seen]
    apart = linear.residual[seen].unsqueeze(-1) - by_state @ away[seen]
    pull[seen] += by_state.mT @ (linear.precision[seen].unsqueeze(-1) * apart)
    return 2 * pull.squeeze(-1).abs()


def _share_of_step(step: Tensor, last: Tensor, share: Tensor) -> Tensor:
    """The share of a step to go, `(B,)`, after the last one, of which a `share` was gone.

    Where whole steps would undo more than `MAX_RETURN` of each other, it is the share that leaves nothing to undo, by
    the secant of the two (Barzilai and Borwein 1988); else it is one.
    """
    bend = 1 / share - (step * last).sum(-1) / last.square().sum(-1).clamp(min=1e-30)
    return torch.where(bend > 1 + MAX_RETURN, (1 / bend).clamp(min=MIN_SHARE), 1.0)


def _between(one: ReferencePath, other: ReferencePath, share: Tensor | float) -> ReferencePath:
    """A share, one or `(B,)`, of the way from one path to another, with the variances of the other."""
    share = torch.as_tensor(share).to(one.states)[..., None]
    states, noise = torch.lerp(one.states, other.states, share), torch.lerp(one.noise, other.noise, share)
    return ReferencePath(states, noise, other.variance)


def _either(which: Tensor, one: ReferencePath, other: ReferencePath) -> ReferencePath:
    """Some trajectories of one path and the rest of another."""
    chosen = which[:, None]
    states, noise = torch.where(chosen, one.states, other.states), torch.where(chosen, one.noise, other.noise)
    variance = None
    if one.variance is not None and other.variance is not None:
        variance = torch.where(chosen, one.variance, other.variance)
    return ReferencePath(states, noise, variance)


def find_and_smooth(
    problem: Problem, *, observation_weight: float = 1.0, may_fail: bool = False, path: ReferencePath | None = None
) -> Lookahead:
    """Find paths from the measurements alone, unless some are given, and look ahead along them; a `FilterError` says
    that the bootstrap filter of the search broke down, or the linearised program unless it `may_fail`."""
    near = path or find_path(problem, observation_weight=observation_weight)
    ahead = smooth(problem, near, observation_weight=observation_weight)
    if not may_fail:
        require_found(ahead, problem)
    return ahead


def require_found(ahead: Lookahead, problem: Problem) -> None:
    """Raise a `FilterError` where the linearised program's log p(y) is not finite, or larger than it can be."""
    for (drive,) in ahead.is_broken.nonzero()[:1].tolist():
        label = problem.data.labels[drive]
        likely = float(ahead.log_likelihood[drive])
        why = divergence(problem.program, problem.data.subset([drive])) or (
            f"the linearised model's log p(y), {likely:.4g} nats, is larger than its sensors allow: the filter has "
            "broken down numerically"
            if math.isfinite(likely)
            else "the linearised model's log p(y) is not finite: its parameters or states have blown up, or it "
            "cannot be linearised there (--recipe steady --guide bootstrap does not)"
        )
        raise FilterError(f"trajectory {label}: {why}", trajectory=label)


def resting_path(ahead: Lookahead, data: Trajectories) -> ReferencePath:
    """The posterior mean after several passes, to go on from. What has not come to rest stays where it was linearised:
    how good a path is a step further is not known there. After a single pass it would never move."""
    means, path = ahead.path(data), ahead.linearization.path
    far = ~((means.noise - path.noise).abs().amax((0, 2)) <= REST_TOLERANCE)
    return _either(far, path, means)


@torch.no_grad()
def find_path(
    problem: Problem,
    *,
    observation_weight: float = 1.0,
    particles: int = 250,
    tempering: Sequence[float] = (1.0, 0.1, 0.01, 0.001),
    passes: int = 3,
) -> ReferencePath:
    """A path near the posterior's best mode, from the measurements alone.

    Smooths from a path each of several bootstrap filters, whose start comes from the program's prior and the first
    measurements, and takes the one under which the measurements are most likely. The filters trust the measurements
    less and less: from a broad prior sharp measurements leave a single root, often metres off, and all draws with it.
    Drives that are much less likely than the others, reading by reading, are searched again with more particles.

    Args:
        particles: of each filter, for each trajectory.
        tempering: of each filter's observations, times `observation_weight`.

    Raises:
        FilterError: a bootstrap filter broke down.
    """
    search = partial(_most_likely_path, observation_weight=observation_weight, tempering=tempering, passes=passes)
    path, likely = search(problem, particles=particles)
    a_reading = likely / problem.data.observed.sum((0, 2)).clamp(min=1)
    poor = a_reading < a_reading.median() - observation_weight * MAX_POORER
    if bool(poor.any()):
        index = poor.nonzero().flatten()
        again, found = search(problem.subset(index), particles=MORE_PARTICLES * particles)
        better = torch.zeros_like(poor).index_put((index,), found > likely[index])
        path = _either(better, again.subset(poor.cumsum(0).clamp(min=1) - 1), path)
    return path


def _most_likely_path(
    problem: Problem, *, observation_weight: float, particles: int, tempering: Sequence[float], passes: int
) -> tuple[ReferencePath, Tensor]:
    """A path of each drive, of those that the filters lead to, and log p(y) along it, `(B,)`."""
    program, data, known_start = problem.program, problem.data, problem.known_start
    copies = problem.subset(torch.arange(len(data)).repeat(len(tempering)))
    weights = observation_weight * data.controls.new_tensor(tempering).repeat_interleave(len(data))
    given: Any = {"known_start": known_start, "particles": particles, "observation_weight": weights}
    found = particle_filter(program, copies.data, **given).paths(1).within(copies.data)
    path = ReferencePath(found.states[0], standard_noise(program, copies.data, found)[0])
    ahead = smooth(copies, path, observation_weight=observation_weight, passes=passes)
    likely = torch.nan_to_num(ahead.log_likelihood, nan=-torch.inf).view(len(tempering), len(data))
    chosen = likely.argmax(0) * len(data) + torch.arange(len(data), device=likely.device)
    # their likelihood is known; a step further may be too far
    return ahead.linearization.path.subset(chosen), likely.amax(0)


@torch.no_grad()
def standard_noise(program: Program, data: Trajectories, paths: Paths) -> Tensor:
    """The channel noise of paths in its standard deviations, `(M, T, B, C)`."""
    channels = paths.channels(program, data)
    moments = {site: normal_moments(fn, site) for site, fn in channels.items()}
    scaled = {site: (paths.noise[site] - mean) / sd for site, (mean, sd) in moments.items()}
    return joined(scaled, channels, paths.states[:, 1:].shape[:-1])


@torch.no_grad()
def smoother_paths(problem: Problem, ahead: Lookahead, draws: int, *, kernels: bool | None = None) -> Paths:
    """Draws of the linearised posterior as paths of the program.

    The channel noise is what the program makes of the standard normal noise at the drawn states, so that a curved mean
    does not inflate the noise; the states agree with it to first order.
    """
    program, data = problem.program, problem.data
    start_noise, states, noise = (values.to(data.controls.dtype) for values in ahead.draws(draws))
    trajectories = len(data)
    certain = KnownStart(data.known_start) if problem.known_start else Standardised(start_noise.unsqueeze(1))
    with running(draws, 1, trajectories), Recording() as start, certain:
        first_state(program, data)
    few = slice(0, 1)  # one transition says which sites there are
    with running(1, 1, trajectories), Recording() as moving, Standardised(noise[few, few]):
        sample_channels(program, states[few, few], data.controls[few], data.elapsed[few], data.steps[few])
    dims = event_dims(start, moving)

    def drawn(state: Tensor, noise: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
        with running(*state.shape[:-1]), Recording() as seen, Standardised(noise):
            sample_channels(program, state, control, time, step)
        return joined(seen.values, seen.distributions, state.shape[:-1])

    by_row = all_rows(program, data, state=states[:, :-1], noise=noise)
    found = on_all_rows(program, "drawn", drawn, by_row, kernels=kernels)
    return Paths(
        states=states,
        start=start.expanded((draws, 1, trajectories)),
        noise=parted(found.values.unflatten(0, (draws, -1)), moving.distributions),
        event_dims=dims | {"states": 1},
        in_plain_torch=found.in_plain_torch,
    )
