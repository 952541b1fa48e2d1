"""The program along a path, to first order: the derivatives of its methods as they are written.

With standard normal noise ε for every latent site the program is a function, x₀ = g(ε) and x' = f(x, ε), with a
residual r(x) for every measurement. Around a path of states x̄ and noise ε̄, with δ = x − x̄,

    δ₀ = offset₀ + G₀ ε,    δ' = F δ + offset + G ε,    r = r̄ − H δ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.errors import ProgramError, UsageError
from steady_ppl.gaussian.lanes import Array, array
from steady_ppl.kernels.codegen import SIMD_LANES
from steady_ppl.kernels.rows import ROWS_WORTH_COMPILING, derivatives, on_all_rows
from steady_ppl.model.handlers import (
    NEEDS_NORMAL,
    AtMean,
    Observing,
    Recording,
    Standardised,
    draw_starts,
    is_heavy_tailed,
    joined,
    parted,
    residual,
    running,
    tangent_normal,
)
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.model.starts import first_state
from steady_ppl.model.substeps import mean_step, noisy_step, row_chain, row_inputs
from steady_ppl.model.validate import noise_size, start_size
from steady_ppl.utils.angles import wrap


@dataclass(frozen=True)
class ReferencePath:
    """States and the standard normal noise that goes with them."""

    states: Tensor  # (T + 1, B, D)
    noise: Tensor  # (T, B, C), in standard deviations of the channels
    variance: Tensor | None = None
    """Of what each measurement sees, given all measurements, (T + 1, B, K); None of models without Student t."""

    @classmethod
    def of_means(
        cls, states: Tensor, noise: Tensor, data: Trajectories, variance: Tensor | None = None
    ) -> ReferencePath:
        """Posterior means as a path to linearise along, the padding filled with the first row."""
        kind = data.controls.dtype
        return cls(
            states=torch.where(data.rows[..., None], states, states[:1]).to(kind),
            noise=torch.where(data.transitions[..., None], noise, 0.0).to(kind),
            variance=None if variance is None else variance.to(kind),
        )

    def subset(self, index: Tensor | Sequence[int]) -> ReferencePath:
        """Of some trajectories."""
        variance = None if self.variance is None else self.variance[:, index]
        return ReferencePath(self.states[:, index], self.noise[:, index], variance)

    def with_subset(self, index: Tensor | Sequence[int], other: ReferencePath) -> ReferencePath:
        """With some trajectories of another path, `other` being those alone."""

        def replaced(values: Tensor, others: Tensor) -> Tensor:
            values = values.clone()
            values[:, index] = others.to(values)
            return values

        variance = None
        if self.variance is not None and other.variance is not None:
            variance = replaced(self.variance, other.variance)
        return ReferencePath(replaced(self.states, other.states), replaced(self.noise, other.noise), variance)

    def for_sensors(self, program: Program) -> ReferencePath:
        """With variances, zero if unknown, for a program with Student t, and without for any other."""
        if not has_heavy_tails(program, self.states[:1, :1]):
            return replace(self, variance=None)
        if self.variance is not None:
            return self
        zero = self.states.new_zeros((*self.states.shape[:2], len(program.measurements)))
        return replace(self, variance=zero)


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """What is measured, to first order around states, in double precision; zero where it is missing."""

    residual: Tensor  # r̄ (T + 1, B, K), on the circle where the measurement is an angle
    measurement: Tensor  # H (T + 1, B, K, D)
    precision: Tensor  # (T + 1, B, K), observation weight over variance
    log_scale: Tensor  # (T + 1, B), the measurements' log-density at residual zero, times the observation weight
    in_plain_torch: str | None = None  # why no kernels served; None where they did or were not worth it


class LinearArrays(NamedTuple):
    """What the recursions read of a `Linearization`, see there."""

    start_offset: Array
    start_noise: Array
    offset: Array
    state: Array
    noise: Array
    residual: Array
    measurement: Array
    precision: Array


@dataclass(frozen=True, kw_only=True)
class Linearization(Sensors):
    """The whole program to first order along a path; nothing moves past a trajectory's end."""

    path: ReferencePath  # what it was taken along
    angles: tuple[int, ...]  # the state's components on a circle: the declared ones that a whole turn does not change
    start_offset: Tensor  # (B, D), the mean start less the path's, angles on the circle
    start_turn: Tensor  # (B, D), the whole turns that this leaves out
    start_noise: Tensor  # G₀ (B, D, C₀); zero where the start is known
    offset: Tensor  # (T, B, D), where the program arrives without noise less the path's next, angles on the circle
    state: Tensor  # F (T, B, D, D)
    noise: Tensor  # G (T, B, D, C)

    @property
    def circular(self) -> Tensor:
        """Which of the state's components are `angles`, `(D,)`."""
        return torch.tensor([i in self.angles for i in range(self.state.shape[-1])], device=self.state.device)

    def arrays(self) -> LinearArrays:
        return LinearArrays(*(array(getattr(self, name)) for name in LinearArrays._fields))


@torch.no_grad()
def linearize(
    problem: Problem,
    path: ReferencePath,
    *,
    observation_weight: float = 1.0,
    kernels: bool | None = None,
    angles: tuple[int, ...] | None = None,
) -> Linearization:
    """Differentiate the program along a path, all trajectories and times at once.

    Args:
        problem: its channel noise normal, its measurements normal or Student t, wrapped or not, components independent.
        observation_weight: tempers the observations.
        kernels: differentiate by kernels where they can serve; None: if there are rows enough, see `on_all_rows`.
        angles: `Linearization.angles`, where they are known.

    Raises:
        ProgramError: a site has another distribution, or an operation has no derivative.
    """
    program, data, states, noise = problem.program, problem.data, path.states, path.noise
    moving = data.transitions
    if angles is None:
        angles = angles_on_a_circle(program, data, states[0, :1])
    given = {"state": states[:-1], "noise": noise} | row_inputs(program, data)._asdict()
    step, along = partial(noisy_step, program), ("state", "noise")
    chain = partial(row_chain, program, **given) if program.substeps > 1 else None
    moved, (by_state, by_noise), in_plain_torch = on_all_rows(program, "step", step, given, along, kernels, chain=chain)
    offset = (moved - (by_noise @ noise.unsqueeze(-1)).squeeze(-1) - states[1:]).double()
    offset[..., angles] = wrap(offset[..., angles])  # a program may keep its angles on the circle, and so may a path
    start_offset, start_noise = (part.double() for part in _start(problem, states[0]))
    start_turn = torch.zeros_like(start_offset)
    start_turn[:, angles] = (start_offset - wrap(start_offset))[:, angles]
    seen = linearize_sensors(
        program, data, states, path.variance, observation_weight=observation_weight, kernels=kernels
    )
    both = vars(seen) | {"in_plain_torch": in_plain_torch or seen.in_plain_torch}
    return Linearization(
        path=path,
        angles=angles,
        start_offset=start_offset - start_turn,
        start_turn=start_turn,
        start_noise=start_noise,
        offset=_where(moving[..., None], offset),
        state=_where(moving[..., None, None], by_state).double(),
        noise=_where(moving[..., None, None], by_noise).double(),
        **both,
    )


@torch.no_grad()
def linearize_sensors(
    program: Program,
    data: Trajectories,
    states: Tensor,
    variance: Tensor | None = None,
    *,
    observation_weight: float = 1.0,
    kernels: bool | None = None,
) -> Sensors:
    """The part of `linearize` that is about what is measured, around states `(T + 1, B, D)`; see
    `ReferencePath.variance`.

    Rows without a measurement are left out, unless hardly any has one.
    """
    given = {"state": states, "measurement": data.measurements, "observed": data.observed}
    name = "measure"
    if variance is not None:
        given["variance"], name = variance, "measure at mean squares"
    measure, count = partial(_residuals, program), data.measurements.shape[-1]
    if kernels is None:
        kernels = states[..., 0].numel() >= ROWS_WORTH_COMPILING
    seen = data.observed.any(-1).flatten()
    looks_everywhere = bool(seen.all()) or int(seen.sum()) < SIMD_LANES
    if not looks_everywhere:
        given = {name: values.flatten(0, 1)[seen].unsqueeze(1) for name, values in given.items()}
    measured, (by,), in_plain_torch = on_all_rows(program, name, measure, given, ("state",), kernels, count)
    residuals, log_sd, log_density = measured.chunk(3, -1)
    by_measured = -by[..., :count, :]
    observed = given["observed"] & torch.isfinite(by_measured.sum(-1))  # where one stands a bearing has no derivative

    def of_all_rows(values: Tensor) -> Tensor:
        if looks_everywhere:
            return values
        found = values.new_zeros(len(seen), *values.shape[2:])
        found[seen] = values.squeeze(1)
        return found.unflatten(0, states.shape[:2])

    return Sensors(
        residual=of_all_rows(_where(observed, residuals).double()),
        measurement=of_all_rows(_where(observed[..., None], by_measured).double()),
        precision=of_all_rows(observation_weight * _where(observed, (-2 * log_sd).exp()).double()),
        log_scale=of_all_rows(observation_weight * _where(observed, log_density).double().sum(-1)),
        in_plain_torch=in_plain_torch,
    )


def _where(there: Tensor, values: Tensor) -> Tensor:
    """The values, contiguous, and zero where nothing is there."""
    return values.contiguous() if bool(there.all()) else torch.where(there, values, 0.0)


@torch.no_grad()
def why_not_linear(program: Program, data: Trajectories, *, known_start: bool = False) -> str | None:
    """What keeps a program from being linearised, None if nothing does; tried on the first two rows of the first
    trajectory of `data`, as returned by `for_program`, where its first state is certain if `known_start`."""
    rows, first = min(2, data.time.shape[0]), data.subset([0])
    data = replace(first.with_rows(lambda values: values[:rows]), lengths=first.lengths.clamp(max=rows))
    state = draw_starts(program, rows - 1, 1)
    path = ReferencePath(state[:1].expand(rows, -1, -1), state.new_zeros((rows - 1, 1, noise_size(program))))
    try:
        linearize(Problem(program, data, known_start), path)
    except ProgramError as error:
        return str(error)
    return None


def require_linear(problem: Problem, what: str, advice: str = "") -> None:
    """Raise the UsageError that `what` needs a program that can be linearised, why this one cannot, and the advice."""
    if why := why_not_linear(problem.program, problem.data, known_start=problem.known_start):
        raise UsageError(f"{what}: {why.removesuffix(NEEDS_NORMAL)}{advice}")


@torch.no_grad()
def has_heavy_tails(program: Program, state: Tensor) -> bool:
    """Whether some measurement is a Student t; looked at from states `(..., D)`."""
    with running(*state.shape[:-1]), Recording() as seen, AtMean():
        program.observe(state)
    return any(is_heavy_tailed(fn) for fn in seen.distributions.values())


def _residuals(
    program: Program, state: Tensor, measurement: Tensor, observed: Tensor, variance: Tensor | None = None
) -> Tensor:
    """Residuals and, beside them, log standard deviations and log-densities at residual zero, `(..., 3 K)`; where the
    noise is not normal, of the normal that touches it."""
    residuals, log_sds, heights = {}, {}, {}
    with running(*state.shape[:-1]):
        with Recording() as seen, Observing(measurement, observed):
            program.observe(state)
        known = {} if variance is None else parted(variance, seen.distributions)
        for site, fn in seen.distributions.items():
            residuals[site] = residual(fn, seen.observed[site])
            sd, heights[site] = tangent_normal(fn, residuals[site], site, known.get(site))
            log_sds[site] = sd.log()
    parts = (joined(values, seen.distributions, state.shape[:-1]) for values in (residuals, log_sds, heights))
    return torch.cat(list(parts), -1)


def _start(problem: Problem, first: Tensor) -> tuple[Tensor, Tensor]:
    def start(noise: Tensor) -> Tensor:
        left = noise.shape[:-1]
        with running(*left), Standardised(noise):
            return first_state(problem.program, problem.data).expand(*left, -1)

    if problem.known_start:
        return problem.data.known_start - first, first.new_zeros((*first.shape, 1))
    began, (start_noise,) = derivatives(start, first.new_zeros((first.shape[0], start_size(problem.program))))
    return began - first, start_noise


def angles_on_a_circle(program: Program, data: Trajectories, state: Tensor) -> tuple[int, ...]:
    """The declared angles of which a whole turn changes neither what is measured nor where the program goes; an angle
    that a plain normal measures counts its turns. Looked at from one state, `(1, D)`, beside what a
    sixth of a turn changes."""
    angles = list(program.angle_indices)
    count = len(angles)
    turns = state.new_zeros((2 * count + 1, state.shape[-1]))
    turns[range(1, count + 1), angles] = 2 * math.pi
    turns[range(count + 1, len(turns)), angles] = math.pi / 3
    states = (state + turns).unsqueeze(1)
    first = slice(0, 1)
    measurement = data.measurements[first, first].new_zeros((len(turns), 1, data.measurements.shape[-1]))
    everywhere = torch.ones_like(measurement, dtype=torch.bool)
    residuals, log_sd, _ = _residuals(program, states, measurement, everywhere).chunk(3, -1)
    squares = (residuals / log_sd.exp()).square()  # of no sign: a bearing straight behind is on both ends of its scale
    same = ((squares - squares[first]).abs() <= 0.01 * (1 + squares)).flatten(1).all(1)[: count + 1]
    if len(data.steps):
        given = (part[first, first] for part in (data.controls, data.elapsed, data.steps))
        change = mean_step(program, states, *given) - states
        apart = change - change[first]
        apart[..., angles] = wrap(apart[..., angles])
        by_part = torch.cat([apart[first], apart[count + 1 :]]).abs()
        apart, change, states = (part[: count + 1] for part in (apart, change, states))
        same &= (apart.abs() <= 0.01 * (change.abs() + by_part) + 1e-6 * states.abs()).flatten(1).all(1)
    return tuple(angle for angle, periodic in zip(angles, same[1:].tolist(), strict=True) if periodic)
