"""The program's first-order form against finite differences of the program, gaps, angles, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import drives, example
from pyro import poutine
from torch import Tensor

from steady_ppl import Program, ProgramError, seeded, stack
from steady_ppl.gaussian.linearize import Linearization, ReferencePath, linearize, why_not_linear
from steady_ppl.gaussian.smoother import smooth
from steady_ppl.model.handlers import Standardised, running
from steady_ppl.model.problem import Problem
from steady_ppl.model.substeps import advance

PROGRAMS = (
    "linear_gaussian",
    "hovercraft",
    "hovercraft:HovercraftTruth",
    "truck",
    "pendulum",
    "neural_vehicle:NeuralHovercraft",
)
Cart = type(example("linear_gaussian"))


def prepared(name: str) -> Program:
    """A program in double precision, a network with random weights."""
    program = example(name).requires_grad_(False)
    with seeded("weights"):
        for parameter in program.parameters():
            if name.startswith("neural"):
                parameter.normal_(0, 0.2)
    return program


def near_the_truth(program: Program, data) -> ReferencePath:
    """The true states and no noise, both shaken; finite also past a trajectory's end."""
    states = torch.where(data.rows[..., None], data.states, data.states[:1])
    with seeded("shaken"):
        noise = 0.5 * torch.randn(*data.steps.shape, len(program.channels), dtype=torch.float64)
        return ReferencePath(states + 0.1 * torch.randn_like(states), noise)


def arrived(program: Program, data, states: Tensor, noise: Tensor) -> Tensor:
    """Where the transitions lead from the rows but the last."""
    with running(*states.shape[:-1]), Standardised(noise):
        return advance(program, states, data.controls[:-1], data.elapsed[:-1], data.steps)


def began(program: Program, noise: Tensor) -> Tensor:
    with running(*noise.shape[:-1]), Standardised(noise):
        return program.initial()


def measured(program: Program, states: Tensor) -> tuple[Tensor, Tensor]:
    """Means and standard deviations of the measurements."""
    with running(*states.shape[:-1]):
        trace = poutine.trace(program.observe).get_trace(states)
    sites = [site["fn"] for site in trace.nodes.values() if site["type"] == "sample"]
    means, sds = ([getattr(fn, what) for fn in sites] for what in ("mean", "stddev"))
    shape = (*states.shape[:-1], -1)
    return torch.cat([m.reshape(shape) for m in means], -1), torch.cat([s.reshape(shape) for s in sds], -1)


def central_differences(function: Callable[[Tensor], Tensor], at: Tensor, width: float = 1e-5) -> Tensor:
    """`(..., D, ·)`; bearings are compared on the circle's covering, so they must not jump in between."""
    columns = []
    for component in range(at.shape[-1]):
        change = torch.zeros_like(at)
        change[..., component] = width
        columns.append((function(at + change) - function(at - change)) / (2 * width))
    return torch.stack(columns, -1)


def on_the_circle(angle: Tensor) -> Tensor:
    return torch.atan2(angle.sin(), angle.cos())


def assert_same(a: Linearization, b: Linearization, *besides: str) -> None:
    """Equal in everything but the fields `besides`."""
    for name in vars(a).keys() - {"path", "angles", *besides}:
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=1e-9, atol=1e-9, msg=name)


# --- against finite differences ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_transition_is_that_of_finite_differences(name):
    program = prepared(name)
    data = drives(program, 3, 12, gaps=True)
    path = near_the_truth(program, data)
    linear, inside = linearize(Problem(program, data), path), data.transitions
    before, noise = path.states[:-1], path.noise
    by_state = central_differences(lambda states: arrived(program, data, states, noise), before)
    by_noise = central_differences(lambda noise: arrived(program, data, before, noise), noise)
    # central differences of width 1e-5 are off by 1e-10 of the third derivative and by 1e-10 in rounding
    torch.testing.assert_close(linear.state[inside], by_state[inside], rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(linear.noise[inside], by_noise[inside], rtol=1e-6, atol=1e-7)
    kicks = (linear.noise @ noise.unsqueeze(-1)).squeeze(-1)
    without = arrived(program, data, before, noise) - kicks - path.states[1:]
    torch.testing.assert_close(linear.offset[inside], without[inside], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_measurement_is_that_of_finite_differences(name):
    program = prepared(name)
    data = drives(program, 3, 12, gaps=True)
    path = near_the_truth(program, data)
    linear, seen = linearize(Problem(program, data), path), data.observed
    mean, sd = measured(program, path.states)
    by_state = central_differences(lambda states: on_the_circle(measured(program, states)[0] - mean), path.states)
    torch.testing.assert_close(linear.measurement[seen], by_state[seen], rtol=1e-6, atol=1e-7)
    residual = data.measurements - mean if name == "linear_gaussian" else on_the_circle(data.measurements - mean)
    torch.testing.assert_close(linear.residual[seen], residual[seen], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(linear.precision[seen], sd[seen] ** -2)
    scale = torch.where(seen, -sd.log() - 0.5 * math.log(2 * math.pi), 0.0).sum(-1)
    torch.testing.assert_close(linear.log_scale, scale)


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_start_is_that_of_finite_differences(name):
    program = prepared(name)
    data = drives(program, 3, 12)
    path = near_the_truth(program, data)
    linear = linearize(Problem(program, data), path)
    nothing = torch.zeros(3, len(program.states), dtype=torch.float64)
    torch.testing.assert_close(linear.start_offset + linear.start_turn, began(program, nothing) - path.states[0])
    torch.testing.assert_close(
        linear.start_offset[:, linear.angles], on_the_circle(linear.start_offset[:, linear.angles])
    )
    by_noise = central_differences(lambda noise: began(program, noise), nothing)
    torch.testing.assert_close(linear.start_noise, by_noise, rtol=1e-6, atol=1e-7)
    assert (linear.start_noise.diagonal(dim1=-2, dim2=-1) > 0).all()


def test_noise_that_enters_by_its_square_is_linearised_around_the_paths():
    class Squared(Cart):
        def transition(self, state, control, time, step):
            position, velocity = state.unbind(-1)
            acceleration = pyro.sample("acceleration", dist.Normal(0 * velocity, self.noise))
            return stack(position + velocity * step, velocity + acceleration**2 * step)

    program = Squared().double().requires_grad_(False)
    data = drives(program, 2, 6)
    path = near_the_truth(program, data)
    linear, kick = linearize(Problem(program, data), path), program.noise**2 * data.steps
    torch.testing.assert_close(linear.noise[..., 1, 0], 2 * kick * path.noise[..., 0])
    # (2ε̄ε − ε̄²) is what is left of ε² to first order: −ε̄² at ε = 0
    expected = path.states[:-1, :, 1] - kick * path.noise[..., 0] ** 2 - path.states[1:, :, 1]
    torch.testing.assert_close(linear.offset[..., 1], expected)


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_known_start_is_certain(name):
    program = prepared(name)
    data = drives(program, 3, 12, gaps=True)
    path = near_the_truth(program, data)
    known, unknown = (linearize(Problem(program, data, known), path) for known in (True, False))
    torch.testing.assert_close(known.start_offset, data.states[0] - path.states[0])
    assert known.start_noise.shape[:2] == (3, len(program.states)) and not known.start_noise.any()
    assert_same(known, unknown, "start_offset", "start_turn", "start_noise")


# --- lengths, gaps, angles, weights -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PROGRAMS)
def test_nothing_moves_past_a_trajectorys_end_and_missing_cells_say_nothing(name):
    program = prepared(name)
    data = drives(program, 3, 12, gaps=True)
    linear = linearize(Problem(program, data), near_the_truth(program, data))
    assert data.lengths.tolist() == [12, 10, 12]
    for moving in (linear.offset, linear.state, linear.noise):
        assert not moving[10:, 1].any() and not moving[~data.transitions].any()
        assert moving[data.transitions].flatten(1).any(1).all()
    missing = ~data.observed
    assert missing[data.rows].any() and missing[10:, 1].all()
    for said in (linear.precision, linear.residual, linear.measurement):
        assert not said[missing].any()
    assert (linear.precision[data.observed] > 0).all()
    unseen = missing.all(-1)
    assert not linear.log_scale[unseen].any() and (linear.log_scale[~unseen] != 0).all()


def test_what_stands_in_padding_and_missing_cells_changes_nothing():
    program = prepared("hovercraft")
    data = drives(program, 3, 12, gaps=True)
    path = near_the_truth(program, data)
    rubbish = replace(
        data,
        measurements=torch.where(data.observed, data.measurements, 1e6),
        controls=torch.where(data.rows[..., None], data.controls, 1e3),
    )
    assert_same(linearize(Problem(program, data), path), linearize(Problem(program, rubbish), path))


@pytest.mark.parametrize("name", ["hovercraft", "pendulum"])
def test_whole_turns_of_an_angle_that_is_measured_change_nothing(name):
    program = prepared(name)
    data = drives(program, 3, 12, gaps=True)
    path = near_the_truth(program, data)
    turns = torch.tensor([1, -2, 3], dtype=torch.float64)[:, None]
    turned = replace(data, measurements=data.measurements + 2 * math.pi * turns)
    here, there = linearize(Problem(program, data), path), linearize(Problem(program, turned), path)
    assert here.residual.abs().max() <= math.pi
    assert_same(here, there)


def test_a_position_is_not_an_angle():
    program = prepared("linear_gaussian")
    data = drives(program, 3, 12, gaps=True)
    path = near_the_truth(program, data)
    further = replace(data, measurements=data.measurements + 2 * math.pi)
    here, there = linearize(Problem(program, data), path), linearize(Problem(program, further), path)
    torch.testing.assert_close(there.residual, here.residual + 2 * math.pi * data.observed)


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_observation_weight_scales_precision_and_log_scale(name):
    program = prepared(name)
    data = drives(program, 3, 12, gaps=True)
    path = near_the_truth(program, data)
    whole, tempered = (linearize(Problem(program, data), path, observation_weight=weight) for weight in (1.0, 0.3))
    torch.testing.assert_close(tempered.precision, 0.3 * whole.precision)
    torch.testing.assert_close(tempered.log_scale, 0.3 * whole.log_scale)
    assert_same(whole, tempered, "precision", "log_scale")


def test_a_bearing_to_where_one_stands_does_not_say_where():
    program = prepared("hovercraft")
    data = drives(program, 2, 6)
    path = near_the_truth(program, data)
    path.states[3, 1, :2] = torch.tensor(program.landmarks[2], dtype=torch.float64)
    linear = linearize(Problem(program, data), path)
    tensors = vars(linear).keys() - {"path", "angles", "in_plain_torch"}
    assert all(getattr(linear, name).isfinite().all() for name in tensors)
    assert not linear.measurement[3, 1, 2, :2].any()
    assert linear.measurement[..., :2].any(-1).sum() == data.observed.sum() - 1


def test_single_precision_gives_the_same_in_double():
    program, single = prepared("hovercraft"), example("hovercraft", torch.float32).requires_grad_(False)
    data = drives(program, 3, 12, gaps=True)
    path = near_the_truth(program, data)
    rough = linearize(Problem(single, data.to(torch.float32)), ReferencePath(path.states.float(), path.noise.float()))
    exact = linearize(Problem(program, data), path)
    for name in vars(exact).keys() - {"path", "angles", "in_plain_torch"}:
        found, wanted = getattr(rough, name), getattr(exact, name)
        assert found.dtype == torch.float64
        # 2⁻²⁴ of numbers up to some 10, once or twice through a difference
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5, msg=name)


# --- what is refused --------------------------------------------------------------------------------------------------


class HeavyTailed(Cart):
    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        acceleration = pyro.sample("kick", dist.StudentT(3.0, -self.damping * velocity, self.noise))
        return stack(position + velocity * step, velocity + acceleration * step)


class HeavyTailedSensor(Cart):
    def observe(self, state):
        pyro.sample("range", dist.StudentT(3.0, state[..., 0], self.measurement_sd))


class Saturating(Cart):
    def observe(self, state):
        pyro.sample("range", dist.Laplace(state[..., 0], self.measurement_sd))


class Correlated(Cart):
    measurements = ("position [m]", "velocity [m/s]")

    def observe(self, state):
        covariance = torch.tensor([[0.04, 0.01], [0.01, 0.04]]).to(state)
        pyro.sample("both", dist.MultivariateNormal(state, covariance))


class UncertainStart(Cart):
    def initial(self):
        return pyro.sample("start", dist.Laplace(torch.zeros(2).to(self.noise), 1.0).to_event(1))


@pytest.mark.parametrize(
    ("program", "site", "distribution"),
    [
        (HeavyTailed, "kick", "StudentT"),
        (Saturating, "range", "Laplace"),
        (Correlated, "both", "MultivariateNormal"),
        (UncertainStart, "start", "Laplace"),
    ],
)
def test_noise_that_is_not_normal_and_independent_is_refused_by_name(program, site, distribution):
    refused = program().double().requires_grad_(False)
    data = drives(refused, 2, 6)
    path = near_the_truth(refused, data)
    with pytest.raises(ProgramError, match=rf"site '{site}' is {distribution} .*--guide bootstrap") as error:
        linearize(Problem(refused, data), path)
    assert error.value.site == site
    assert why_not_linear(refused, data) == str(error.value)


def test_a_student_t_sensor_is_linearised_by_the_normal_that_touches_it():
    program = HeavyTailedSensor().double().requires_grad_(False)
    data = drives(program, 2, 6)
    linear = linearize(Problem(program, data), near_the_truth(program, data))
    sd = float(program.measurement_sd)
    exact = torch.distributions.StudentT(3.0, 0.0, sd)
    residuals = linear.residual.clone().requires_grad_()
    (slope,) = torch.autograd.grad(exact.log_prob(residuals).sum(), residuals)
    assert torch.allclose(-linear.precision * linear.residual, slope)
    touching = linear.log_scale - 0.5 * (linear.precision * linear.residual**2).sum(-1)
    assert torch.allclose(touching, exact.log_prob(linear.residual).sum(-1))
    elsewhere = linear.residual + torch.linspace(-3, 3, 31)[:, None, None, None]
    below = linear.log_scale[..., None] - 0.5 * linear.precision * elsewhere**2
    assert bool((below <= exact.log_prob(elsewhere) + 1e-6).all())


def test_a_student_t_is_touched_at_the_root_of_the_mean_square_of_a_path_that_was_smoothed():
    program = HeavyTailedSensor().double().requires_grad_(False)
    data = drives(program, 2, 6)
    problem = Problem(program, data)
    ahead = smooth(problem, near_the_truth(program, data), passes=50, tolerance=1e-9)
    linear, (states, *_) = ahead.linearization, ahead.covariances()
    squares = (linear.residual.square() + states[..., :1, 0]) / float(program.measurement_sd) ** 2
    precision = (3.0 + 1) / (3.0 + squares) / float(program.measurement_sd) ** 2
    torch.testing.assert_close(linear.precision, torch.where(data.observed, precision, 0.0))
    other = ReferencePath(*(values + 1 for values in vars(linear.path).values()))
    for name, values in vars(linear.path.with_subset([1], other.subset([1]))).items():
        assert torch.equal(values[:, 0], getattr(linear.path, name)[:, 0])
        assert torch.equal(values[:, 1], getattr(other, name)[:, 1])
    assert linear.path.for_sensors(example("linear_gaussian")).variance is None


def test_kernels_of_a_student_t_sensor_take_a_path_with_variances_and_one_without():
    """They have one argument more or less, and a kernel each."""
    program = example("linear_gaussian", torch.float32).with_effect("heavy_tails", 0.3).requires_grad_(False)
    data = drives(program, 40, 30)
    found = near_the_truth(program, data)
    sure = ReferencePath(found.states.float(), found.noise.float())
    path = sure.for_sensors(program)
    found = [linearize(Problem(program, data), one, kernels=True) for one in (sure, path, sure, sure, path)]
    assert all(one.in_plain_torch is None for one in found)
    for one in found[1:]:
        torch.testing.assert_close(one.precision, found[0].precision)


def test_a_known_start_needs_no_normal_prior():
    program = UncertainStart().double().requires_grad_(False)
    data = drives(program, 2, 6)
    linear = linearize(Problem(program, data, True), near_the_truth(program, data))
    assert not linear.start_noise.any()


@pytest.mark.parametrize("name", PROGRAMS)
def test_nothing_keeps_the_example_programs_from_being_linearised(name):
    program = prepared(name)
    assert why_not_linear(program, drives(program, 2, 6, gaps=True)) is None


def test_an_operation_without_a_derivative_is_refused():
    class Forward(torch.autograd.Function):
        @staticmethod
        def forward(ctx, value):
            return 2 * value

    class Custom(Cart):
        def transition(self, state, control, time, step):
            return super().transition(Forward.apply(state) / 2, control, time, step)

    program = Custom().double().requires_grad_(False)
    data = drives(program, 2, 6)
    with pytest.raises(ProgramError, match="cannot be linearised.*--guide bootstrap"):
        linearize(Problem(program, data), near_the_truth(program, data))
