"""What a program has to beat: a vehicle that keeps its velocity, and a measurement that stays as it was."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor

from steady_ppl.data.trajectories import Trajectories
from steady_ppl.gaussian.kalman import Tracked, track
from steady_ppl.gaussian.predict import Prediction, on_a_circle, predict
from steady_ppl.model.handlers import Recording, Standardised, as_event, joined, normal_moments, running
from steady_ppl.model.interventions import Transforming
from steady_ppl.model.problem import Problem
from steady_ppl.model.program import Program
from steady_ppl.model.substeps import mean_step, row_inputs, sample_channels
from steady_ppl.utils.angles import wrap

NOISE_MULTIPLES = (0.5, 1.0, 2.0, 4.0, 8.0)  # of the channels' root mean squares, that are scanned
DEFINITION = (
    "the model with every channel's mean replaced by zero, so that it ignores the controls and keeps its velocity; "
    "its channel noise is the one of a scan under which these measurements are most likely"
)


class ConstantVelocity(Program):
    """Another program's start, kinematics and sensors, but no acceleration other than noise of these scales `(C,)`."""

    def __init__(self, program: Program, scales: Tensor) -> None:
        super().__init__()
        self.register_buffer("scales", scales)
        for name in ("states", "controls", "channels", "measurements", "substeps", "angles", "error_groups", "start"):
            setattr(self, name, getattr(program, name))
        self.kept_names = program.kept_names
        object.__setattr__(self, "of", program)  # not a part of this one: Pyro would rename it

    def initial(self) -> Tensor:
        return self.of.initial()

    def told(self, data: Trajectories) -> dict[str, tuple[Tensor, Tensor]]:
        return self.of.told(data)

    @property
    def derivatives(self) -> Mapping[str, str]:
        return self.of.derivatives

    def transition(self, state: Tensor, control: Tensor, time: Tensor, step: Tensor) -> Tensor:
        with Transforming(self._noise_alone):
            return self.of.transition(state, control, time, step)

    def _noise_alone(self, fn: Any, columns: slice) -> Any:
        """A channel's distribution with mean zero and the scale of its columns."""
        zero = torch.zeros_like(normal_moments(fn, "channel")[0])
        scale = as_event(self.scales[columns].to(zero), fn.event_dim)
        return dist.Normal(zero, scale.expand_as(zero)).to_event(fn.event_dim)

    def observe(self, state: Tensor) -> None:
        self.of.observe(state)

    def actuators(self, control: Tensor, time: Tensor) -> Tensor:
        return self.of.actuators(control, time)

    def between_rows(self, control: Tensor, time: Tensor) -> Tensor:
        return self.of.between_rows(control, time)


@dataclass(frozen=True)
class Reference:
    """Predictions of the vehicle that keeps its velocity."""

    program: ConstantVelocity
    log_likelihood: float  # log p(y) of all drives, linearised
    predictions: dict[int, Prediction]  # by how many rows ahead


@torch.no_grad()
def constant_velocity(problem: Problem, tracked: Tracked, horizons: Sequence[int]) -> Reference | str:
    """Scan the channel noise of `ConstantVelocity` by log p(y) and predict with the best; or why there is none.

    The scan begins where the program was tracked. The horizons count rows.
    """
    program, data = problem.program, problem.data
    path = tracked.path(data)
    inputs = row_inputs(program, data)
    left, seen = path.noise.shape[:-1], Recording()
    with running(*left), seen, Standardised(path.noise):
        sample_channels(program, path.states[:-1], *inputs)
    values = joined(seen.values, seen.distributions, left)
    spreads = {site: normal_moments(fn, site)[1] for site, fn in seen.distributions.items()}
    spread = joined(spreads, seen.distributions, left)
    sizes = (values.double().square() + spread.double().square())[data.transitions].mean(0).sqrt()
    if not bool((sizes > 0).all() and torch.isfinite(sizes).all()):
        return "a channel of the model never moves"
    moved = mean_step(program, path.states[:-1], *inputs)
    kind = type("ConstantVelocity", (ConstantVelocity,), {})  # kernels take the inner program's parameters as constants
    coasted = mean_step(kind(program, sizes), path.states[:-1], *inputs)
    if bool(((moved - coasted).abs() <= 1e-6 * moved.abs().amax((0, 1))).all()):
        return "the model's channels have no mean that could be taken away"
    best: tuple[float, ConstantVelocity, Tracked] | None = None
    for multiple in NOISE_MULTIPLES:
        coasting = kind(program, multiple * sizes)
        start = replace(path, noise=(values / (multiple * sizes)).to(values.dtype))
        found = track(replace(problem, program=coasting), start, passes=3)
        likely = float(found.log_likelihood.sum())
        if math.isfinite(likely) and (best is None or likely > best[0]):
            best = likely, coasting, found
    if best is None:
        return "it diverges on these trajectories"
    likely, coasting, found = best
    return Reference(coasting, likely, predict(coasting, data, found, horizons))


@torch.no_grad()
def last_measurement(problem: Problem, states: Tensor, horizons: Sequence[int]) -> dict[int, tuple[Tensor, Tensor]]:
    """Measured less the component's last value up to `horizon` rows before, and where both exist, `(·, B, K)`."""
    data = problem.data
    circle = on_a_circle(problem.program, data, states)
    rows = torch.arange(len(data.time), device=data.time.device)[:, None, None]
    last = torch.where(data.observed, rows, -1).cummax(0).values  # the row in which a component was last measured
    held, known = data.measurements.gather(0, last.clamp(min=0)), last >= 0
    found = {}
    for horizon in horizons:
        error = (data.measurements[horizon:] - held[: len(held) - horizon]).double()
        error = torch.where(circle, wrap(error), error)
        found[horizon] = error, data.observed[horizon:] & known[: len(known) - horizon]
    return found
