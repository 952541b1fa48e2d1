"""Exact answers for `models/linear_gaussian.py`, written apart from the package, and the tolerances of random ones.

The Kalman filter runs all trajectories at once and is differentiable; `CartPosterior` solves one trajectory as a single
Gaussian over its start and channel noise, without any recursion. The two share no line.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from statistics import NormalDist

import pyro
import torch
from pyro import poutine
from pyro.infer import Trace_ELBO
from torch import Tensor

from steady_ppl import Joint, PathGuide, Paths, Program, Trajectories
from steady_ppl.model.handlers import Observing, Replaying
from steady_ppl.model.substeps import sample_row

START_MEAN = torch.tensor([0.0, 0.5], dtype=torch.float64)
START_SD = torch.tensor([0.5, 0.5], dtype=torch.float64)

Parameters = Mapping[str, Tensor]


def cart_parameters(program) -> dict[str, Tensor]:
    """gain, damping, noise and measurement_sd of the program, differentiable, in double precision."""
    return {name: getattr(program, name).double() for name in ("gain", "damping", "noise", "measurement_sd")}


def cart_evidence(program, data: Trajectories) -> Tensor:
    """log p(y) of all drives of the cart, differentiable."""
    return kalman(data, cart_parameters(program)).log_likelihood.sum()


def cart_maximum(program, data: Trajectories) -> float:
    """Bring gain and damping of the cart to their maximum of log p(y), which is returned."""

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = -cart_evidence(program, data)
        loss.backward()
        return loss

    free = [program.gain_unconstrained, program.damping_unconstrained]
    optimizer = torch.optim.LBFGS(free, max_iter=50, line_search_fn="strong_wolfe")
    optimizer.step(closure)
    return float(cart_evidence(program, data).detach())


@dataclass(frozen=True)
class Kalman:
    """`(rows, B, ...)` moments given the measurements up to a row (`predicted_`: before it), and log p(y), `(B,)`."""

    log_likelihood: Tensor
    means: Tensor
    covariances: Tensor
    predicted_means: Tensor
    predicted_covariances: Tensor


@dataclass(frozen=True)
class LinearSystem:
    """x' = matrix x + offset + N(0, noise), `(T, B, ...)`; the first state N(start_mean, start_covariance), `(B, ...)`;
    its first component measured with variance `measurement_variance`."""

    matrix: Tensor
    offset: Tensor
    noise: Tensor
    start_mean: Tensor
    start_covariance: Tensor
    measurement_variance: Tensor


def cart_system(data, parameters: Parameters, *, known_start: bool = False) -> LinearSystem:
    """The cart's matrices; every interval has its own step."""
    step, push = data.steps.double(), data.controls[:-1, :, 0].double()
    zero, one = torch.zeros_like(step), torch.ones_like(step)
    trajectories = step.shape[1]
    coasting = torch.stack([torch.stack([one, step], -1), torch.stack([zero, one], -1)], -2)
    by_acceleration = torch.stack([step.square() / 2, step], -1)
    braking = torch.stack([zero, -parameters["damping"] * one], -1)
    return LinearSystem(
        matrix=coasting + by_acceleration[..., :, None] * braking[..., None, :],
        offset=by_acceleration * (parameters["gain"] * push)[..., None],
        noise=by_acceleration[..., :, None] * by_acceleration[..., None, :] * parameters["noise"].square(),
        start_mean=data.states[0].double() if known_start else START_MEAN.expand(trajectories, 2),
        start_covariance=torch.diag(START_SD**2 * (not known_start)).expand(trajectories, 2, 2),
        measurement_variance=parameters["measurement_sd"].square(),
    )


def kalman(data, parameters: Parameters, *, known_start: bool = False, weight: float = 1.0) -> Kalman:
    """Kalman filter of the cart; `weight` tempers the density of the measurements.

    N(y; x, R)^w = N(y; x, R / w) · √(2πR / w) · (2πR)^(−w / 2)
    """
    return kalman_filter(cart_system(data, parameters, known_start=known_start), data, weight=weight)


def kalman_filter(system: LinearSystem, data, *, weight: float = 1.0) -> Kalman:
    """Kalman (1960), with the evidence; a row without measurement is predicted only."""
    mean, covariance = system.start_mean, system.start_covariance
    variance = system.measurement_variance / weight
    constant = 0.5 * (2 * math.pi * variance).log() - 0.5 * weight * (2 * math.pi * system.measurement_variance).log()
    total = mean.new_zeros(mean.shape[0])
    kept: dict[str, list[Tensor]] = {name: [] for name in ("means", "covariances", "predicted_m", "predicted_c")}
    for row in range(data.time.shape[0]):
        if row > 0:
            matrix = system.matrix[row - 1]
            mean = (matrix @ mean[..., None])[..., 0] + system.offset[row - 1]
            covariance = matrix @ covariance @ matrix.mT + system.noise[row - 1]
        kept["predicted_m"].append(mean)
        kept["predicted_c"].append(covariance)
        seen = data.observed[row, :, 0]
        innovation = data.measurements[row, :, 0].double() - mean[:, 0]
        spread = covariance[:, 0, 0] + variance
        density = -0.5 * innovation.square() / spread - 0.5 * (2 * math.pi * spread).log() + constant
        total = total + torch.where(seen, density, 0.0)
        gain = torch.where(seen[:, None], covariance[:, :, 0] / spread[:, None], 0.0)
        mean = mean + gain * innovation[:, None]
        covariance = covariance - gain[:, :, None] * covariance[:, None, 0, :]
        kept["means"].append(mean)
        kept["covariances"].append(covariance)
    return Kalman(total, *(torch.stack(kept[n]) for n in ("means", "covariances", "predicted_m", "predicted_c")))


class CartPosterior:
    """The exact posterior of one trajectory as one Gaussian.

    Start, accelerations and states are affine in standard normals w (two for the start, one a step), so that given the
    measurements w ~ N(mean, covariance) with covariance⁻¹ = I + HᵀH / R.

    Attributes:
        log_likelihood: log p(y).
        states_mean, states_covariance: `(rows, 2)` and `(rows, 2, rows, 2)`; lag-one covariances are in the latter.
        latent_mean, latent_covariance: of (start, accelerations), `(2 + T,)` and its square.
    """

    def __init__(self, data, trajectory: int, parameters: Parameters, *, known_start: bool = False) -> None:
        rows = int(data.lengths[trajectory])
        size = 2 + rows - 1
        gain, damping, noise, sd = (
            float(parameters[name].detach()) for name in ("gain", "damping", "noise", "measurement_sd")
        )
        unit = torch.eye(size, dtype=torch.float64)
        state = torch.zeros(2, size, dtype=torch.float64)
        if known_start:
            constant = data.states[0, trajectory].double()
        else:
            state, constant = START_SD[:, None] * unit[:2], START_MEAN
        maps, constants, accelerations, centres = [state], [constant], [], []
        for row in range(rows - 1):
            step = float(data.steps[row, trajectory])
            push = float(data.controls[row, trajectory, 0])
            accelerations.append(noise * unit[2 + row] - damping * state[1])
            centres.append(gain * push - damping * constant[1])
            state, constant = (
                torch.stack([x + step * v + step**2 / 2 * a, v + step * a])
                for (x, v), a in ((state, accelerations[-1]), (constant, centres[-1]))
            )
            maps.append(state)
            constants.append(constant)
        self._states, self._states_constant = torch.stack(maps), torch.stack(constants)
        self._latent = torch.cat([maps[0], torch.stack(accelerations)])
        self._latent_constant = torch.cat([constants[0], torch.stack(centres)])
        seen = data.observed[:rows, trajectory, 0]
        measured = self._states[seen, 0]
        residual = data.measurements[:rows, trajectory, 0].double()[seen] - self._states_constant[seen, 0]
        evidence = torch.distributions.MultivariateNormal(
            torch.zeros_like(residual), measured @ measured.T + sd**2 * torch.eye(len(residual), dtype=torch.float64)
        )
        self.log_likelihood = evidence.log_prob(residual)
        self._covariance = torch.linalg.inv(unit + measured.T @ measured / sd**2)
        self._mean = self._covariance @ measured.T @ residual / sd**2
        self.states_mean = self._states @ self._mean + self._states_constant
        self.states_covariance = torch.einsum("aim,mn,bjn->aibj", self._states, self._covariance, self._states)
        self.latent_mean = self._latent @ self._mean + self._latent_constant
        self.latent_covariance = self._latent @ self._covariance @ self._latent.T

    def draw(self, draws: int) -> tuple[Tensor, Tensor]:
        """Independent draws of the states, `(draws, rows, 2)`, and of their accelerations, `(draws, T)`."""
        w = self._mean + torch.randn(draws, len(self._mean), dtype=torch.float64) @ torch.linalg.cholesky(
            self._covariance, upper=True
        )
        states = torch.einsum("aim,sm->sai", self._states, w) + self._states_constant
        return states, (w @ self._latent.T + self._latent_constant)[:, 2:]

    def divergence(self, other: CartPosterior) -> Tensor:
        """KL(self ‖ other) of start and accelerations."""
        return torch.distributions.kl_divergence(
            torch.distributions.MultivariateNormal(self.latent_mean, self.latent_covariance),
            torch.distributions.MultivariateNormal(other.latent_mean, other.latent_covariance),
        )


def assert_mean(samples: Tensor, exact: Tensor | float, *, false_alarm: float = 1e-4) -> None:
    """The mean over dimension 0 of independent `samples` is `exact`, judged by its own standard error.

    The limit is 3.9 standard errors for one number, and for many numbers such that all hold together as often.
    """
    samples = samples.detach().double()
    error = (samples.std(0) / math.sqrt(len(samples))).clamp(min=1e-12)  # what is not random must be exact
    score = (samples.mean(0) - torch.as_tensor(exact, dtype=torch.float64).detach()) / error
    limit = NormalDist().inv_cdf(1 - false_alarm / (2 * score.numel()))
    worst = score.abs().max()
    assert worst < limit, f"{worst:.2f} standard errors off (limit {limit:.2f}): {score}"


def all_at_once(program: Program, data: Trajectories, paths: Paths, *, known_start: bool = False) -> Tensor:
    """log p(paths, measurements), summed over draws and trajectories, by `Joint`."""
    guide, joint = Stored(paths), Joint(program, known_start=known_start)
    with ExitStack() as stack:
        if guide.draws > 1:
            stack.enter_context(pyro.plate("draw", guide.draws, dim=-3))
        guided = poutine.trace(guide).get_trace(data)
        return poutine.trace(poutine.replay(joint, guided)).get_trace(data).log_prob_sum()


def step_by_step(program: Program, data: Trajectories, paths: Paths, *, known_start: bool = False) -> Tensor:
    """The same as `all_at_once`, with one call a row, on plain tensors and with the lengths counted by hand."""
    draws, rows, trajectories, _ = paths.states.shape

    def density(method, *handlers) -> tuple[Tensor, Tensor]:
        with ExitStack() as stack:
            for dim, size in enumerate((trajectories, 1, draws), start=1):
                stack.enter_context(pyro.plate(f"dim_{dim}", size, dim=-dim))
            for handler in handlers:
                stack.enter_context(handler)
            trace = poutine.trace(method).get_trace()
        trace.compute_log_prob()
        sites = [site for site in trace.nodes.values() if site["type"] == "sample" and "log_prob" in site]
        logs = [s["log_prob"] for s in sites if not isinstance(s["fn"], pyro.poutine.subsample_messenger._Subsample)]
        return sum(log.expand(draws, 1, trajectories) for log in logs), trace.nodes["_RETURN"]["value"]

    total = torch.zeros(draws, 1, trajectories, dtype=torch.float64)
    start, state = density(program.initial, Replaying(paths.start))
    if not known_start:
        total = total + start
    for row in range(rows):
        inside = row < data.lengths
        observing = Observing(data.measurements[row, None], data.observed[row, None])
        seen, _ = density(lambda: program.observe(state), observing)  # noqa: B023
        total = total + torch.where(inside, seen, 0.0)
        if row < rows - 1:
            noise = {site: value[:, row, None] for site, value in paths.noise.items()}
            at = data.controls[row, None], data.elapsed[row, None], data.steps[row, None]
            moved, state = density(lambda: sample_row(program, state, *at), Replaying(noise))  # noqa: B023
            state = state.detach()  # a path is given: in substeps a row's end would follow the parameters a little
            total = total + torch.where(row + 1 < data.lengths, moved, 0.0)
    return total.sum()


def joint_density(program, paths, data):
    elbo = Trace_ELBO(max_plate_nesting=3)
    with pyro.settings.context(module_local_params=True), pyro.validation_enabled(False):
        loss = elbo.differentiable_loss(Joint(program), Kept(paths), data)
        loss.backward()
    return loss.detach(), {name: value.grad.clone() for name, value in program.named_parameters()}


class Stored(PathGuide):
    """The guide of given paths."""

    def __init__(self, paths: Paths) -> None:
        super().__init__(len(paths.states))
        self.paths = paths


class Kept(PathGuide):
    """Paths that are given."""

    def __init__(self, paths) -> None:
        super().__init__(len(paths.states))
        self.paths = paths
