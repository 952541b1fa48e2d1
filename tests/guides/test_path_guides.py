"""The E step: exact scores, the improvement inequality, tempering, and the true paths of supervised learning."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import drives, example
from oracles import CartPosterior, assert_mean, cart_parameters, kalman
from pyro.infer import Trace_ELBO
from torch import Tensor

from steady_ppl import (
    Constant,
    DataError,
    FilterError,
    Joint,
    LinearRamp,
    PathGuide,
    Paths,
    Program,
    ProgramError,
    SMCGuide,
    TruthGuide,
    for_program,
    seeded,
    simulate,
    stack,
)
from steady_ppl.guides.path_guides import true_paths
from steady_ppl.model.handlers import Replaying, running
from steady_ppl.model.substeps import sample_row


def negative_q(program, guide: PathGuide, data, *, known_start: bool = False) -> Tensor:
    """−Q of the guide's paths: the loss of the M step, summed over trajectories."""
    elbo = Trace_ELBO(num_particles=guide.draws, vectorize_particles=guide.draws > 1, max_plate_nesting=2)
    return elbo.differentiable_loss(Joint(program, known_start=known_start), guide, data)


def gradient(program, value: Tensor) -> Tensor:
    """With respect to the logarithms of gain, damping, noise and measurement_sd, `(4,)`."""
    return torch.stack(torch.autograd.grad(value, list(program.parameters())))


class ExactGuide(PathGuide):
    """Draws of the cart's exact posterior, for complete trajectories."""

    def refresh(self, data, progress: float) -> dict[str, float]:
        raise NotImplementedError

    def draw(self, posteriors: list[CartPosterior]) -> ExactGuide:
        states, accelerations = zip(*(posterior.draw(self.draws) for posterior in posteriors), strict=True)
        path = torch.stack(states, 2)
        noise = {"acceleration": torch.stack(accelerations, 2)}
        self.paths = Paths(path, {"start": path[:, :1]}, noise, {"states": 1, "start": 1, "acceleration": 0})
        return self


# --- the M step's gradient --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("known_start", [False, True])
@pytest.mark.parametrize("case", ["even", "uneven"])
def test_the_m_steps_gradient_is_the_exact_score(case, known_start):
    program = example("linear_gaussian")
    data = drives(program, 3, 12, gaps=case == "uneven")
    with torch.no_grad():
        for parameter in program.parameters():
            parameter += 0.2  # away from the truth, where the score is large
    evidence = kalman(data, cart_parameters(program), known_start=known_start).log_likelihood.sum()
    score = gradient(program, evidence)
    guide = SMCGuide(program, particles=2000, draws=200, tempering=Constant(), known_start=known_start)
    found = []
    for run in range(40):
        with seeded("score", run):
            guide.refresh(data, 0.0)
        found.append(-gradient(program, negative_q(program, guide, data, known_start=known_start)))
    assert_mean(torch.stack(found), score)


def test_the_gradient_of_exact_draws_is_the_exact_score():
    program = example("linear_gaussian")
    data = drives(program, 2, 12)
    score = gradient(program, kalman(data, cart_parameters(program)).log_likelihood.sum())
    posteriors = [CartPosterior(data, trajectory, cart_parameters(program)) for trajectory in range(2)]
    found = [-gradient(program, negative_q(program, ExactGuide(50).draw(posteriors), data)) for _ in range(40)]
    assert_mean(torch.stack(found), score)


# --- the improvement inequality ---------------------------------------------------------------------------------------


def improvement(make_guide: Callable) -> tuple[Tensor, Tensor, Tensor]:
    """M-step by M-step: samples of ΔQ by fresh draws, Δ log p(y), and the exact KL divergence that lies between."""
    program = example("linear_gaussian")
    data = drives(program, 2, 12)
    with torch.no_grad():
        for name in ("damping", "noise", "measurement_sd"):
            getattr(program, f"{name}_unconstrained").add_(1.0)

    def posteriors() -> list[CartPosterior]:
        return [CartPosterior(data, trajectory, cart_parameters(program)) for trajectory in range(2)]

    gained, improved, apart = [], [], []
    for _ in range(3):
        old = {name: value.clone() for name, value in program.state_dict().items()}
        before, evidence = posteriors(), kalman(data, cart_parameters(program)).log_likelihood.sum().detach()
        guides = [make_guide(program, data, before) for _ in range(30)]
        optimizer = torch.optim.Adam(program.parameters(), lr=0.03)
        for _ in range(8):
            optimizer.zero_grad()
            negative_q(program, guides[0], data).backward()
            optimizer.step()
        new = {name: value.clone() for name, value in program.state_dict().items()}
        with torch.no_grad():
            after = torch.stack([-negative_q(program, guide, data) for guide in guides[1:]])
            program.load_state_dict(old)
            gained.append(after - torch.stack([-negative_q(program, guide, data) for guide in guides[1:]]))
            program.load_state_dict(new)
            improved.append(kalman(data, cart_parameters(program)).log_likelihood.sum() - evidence)
        apart.append(sum(a.divergence(b) for a, b in zip(before, posteriors(), strict=True)))
    return torch.stack(gained, 1), torch.stack(improved), torch.stack(apart)


def exact_guide(program, data, posteriors):
    return ExactGuide(100).draw(posteriors)


def smc_guide(program, data, posteriors):
    guide = SMCGuide(program, particles=2000, draws=100, tempering=Constant())
    guide.refresh(data, 0.0)
    return guide


@pytest.mark.slow
@pytest.mark.parametrize("make_guide", [exact_guide, smc_guide])
def test_an_m_step_improves_log_p_y_by_at_least_what_q_gains(make_guide):
    gained, improved, apart = improvement(make_guide)
    assert (gained.mean(0) > 0.1).all()  # each M step did something
    assert (improved >= gained.mean(0) - 4 * gained.std(0) / math.sqrt(len(gained))).all()
    assert_mean(gained, improved - apart)  # Δ log p(y) = ΔQ + KL(old posterior ‖ new posterior)


# --- tempering --------------------------------------------------------------------------------------------------------


def test_the_linear_ramp_goes_from_its_first_weight_to_one():
    ramp = LinearRamp(0.001, share=0.5)
    assert [ramp(p) for p in (0.0, 0.25, 0.5, 0.75, 1.0)] == pytest.approx([0.001, 0.5005, 1.0, 1.0, 1.0])
    assert LinearRamp(0.001, share=0.0)(0.0) == 1.0
    assert LinearRamp()(0.0) == 0.001 and LinearRamp()(0.5) == pytest.approx(0.5005) and LinearRamp()(1.0) == 1.0


def test_a_constant_weight_stays():
    assert [Constant(0.3)(p) for p in (0.0, 0.5, 1.0)] == [0.3, 0.3, 0.3]
    assert Constant()(0.0) == 1.0


def test_the_schedule_sets_the_weight_of_the_observations():
    program = example("linear_gaussian").requires_grad_(False)
    data = drives(program, 3, 12, gaps=True)
    guide = SMCGuide(program, particles=400, draws=10, tempering=lambda progress: progress)
    figures = [guide.refresh(data, progress) for progress in (0.0, 0.1, 1.0)]
    assert [f["observation_weight"] for f in figures] == [0.0, 0.1, 1.0]
    assert figures[0]["ess"] == pytest.approx(400) and figures[0]["roots"] == 400  # nothing seen, nothing resampled
    assert figures[0]["roots"] > figures[1]["roots"] > figures[2]["roots"]


def test_a_tempered_guide_draws_from_the_power_posterior():
    program = example("linear_gaussian").requires_grad_(False)
    data = drives(program, 1, 12)
    # a weight of 1/4 on normal measurements is twice the measurement's standard deviation
    wide = cart_parameters(program) | {"measurement_sd": 2 * program.measurement_sd}
    guide = SMCGuide(program, particles=2000, draws=500, tempering=Constant(0.25))
    means = []
    for run in range(40):
        with seeded("power", run):
            guide.refresh(data, 0.0)
        means.append(guide.paths.states[:, :, 0].mean(0))
    assert_mean(torch.stack(means), CartPosterior(data, 0, wide).states_mean)


def test_a_guide_before_its_first_refresh_is_an_error():
    program = example("linear_gaussian")
    with pytest.raises(RuntimeError, match="refresh"):
        SMCGuide(program)(drives(program, 1, 4))


@pytest.mark.parametrize("measured", [3, 1])
def test_a_path_that_blows_up_after_the_last_measurement_is_an_error(measured):
    program = example("linear_gaussian").requires_grad_(False)
    data = drives(program, 2, 6)
    data.controls[3, 1] = math.inf  # the velocity of row 4
    data = replace(data, observed=data.observed & (torch.arange(6) < measured)[:, None, None])
    with pytest.raises(FilterError, match=r"trajectory 2 at 0.4 s: a state is not finite") as error:
        SMCGuide(program, particles=20).refresh(data, 1.0)
    assert error.value.trajectory == "2" and error.value.time == pytest.approx(0.4)


def test_a_path_that_blows_up_in_its_padding_is_none():
    program = example("linear_gaussian").requires_grad_(False)
    data = drives(program, 2, 6, gaps=True)
    assert data.lengths.tolist() == [6, 4]
    data.controls[3, 1] = math.inf
    guide = SMCGuide(program, particles=20)
    guide.refresh(data, 1.0)
    finite = guide.paths.states.isfinite()
    assert finite.all()
    assert torch.equal(guide.paths.states[:, 4:, 1], guide.paths.states[:, :1, 1].expand(-1, 2, -1))


# --- the true paths ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    ["linear_gaussian", "hovercraft", "hovercraft:HovercraftTruth", "truck", "pendulum", "neural_vehicle:NeuralTruck"],
)
def test_the_truth_guides_noise_leads_from_each_true_state_to_the_next(name):
    program = example(name).requires_grad_(False)
    data = drives(program, 3, 12, gaps=True)
    paths = true_paths(program, data)
    replaying = Replaying({site: value[0] for site, value in paths.noise.items()})
    with pyro.plate("interval", 11, dim=-2), pyro.plate("trajectory", 3, dim=-1), replaying:
        after = sample_row(program, paths.states[0, :-1], data.controls[:-1], data.elapsed[:-1], data.steps)
    inside = data.transitions
    torch.testing.assert_close(after[inside], data.states[1:][inside], rtol=1e-9, atol=1e-9)
    assert torch.equal(paths.start["start"][0, 0], data.states[0])


def test_the_truth_guides_noise_is_the_true_acceleration():
    program = example("hovercraft:HovercraftTruth").requires_grad_(False)
    data = drives(program, 3, 12, gaps=True)
    heading, turn = data.states[:-1, :, 2], data.states[1:, :, 2] - data.states[:-1, :, 2]
    change = (data.states[1:, :, 3:] - data.states[:-1, :, 3:]) / data.steps[..., None]
    vx, vy, yaw = change.unbind(-1)
    halfway = heading + turn / 2  # a push along the body, which turns, acts along the heading in the middle
    cos, sin, held = halfway.cos(), halfway.sin(), 1 / (1 + turn**2 / 24)
    expected = torch.stack([(cos * vx + sin * vy) / held, (cos * vy - sin * vx) / held, yaw], -1)
    inside = data.transitions
    torch.testing.assert_close(true_paths(program, data).noise["acceleration"][0][inside], expected[inside])


def test_the_truth_guides_noise_is_what_the_simulation_drew():
    drawn = []

    class Recorded(type(example("linear_gaussian"))):
        def transition(self, state, control, time, step):
            after = super().transition(state, control, time, step)
            drawn.append((after[..., 1] - state[..., 1]) / step)
            return after

    program = Recorded().double().requires_grad_(False)
    data = drives(program, 3, 12)
    noise = true_paths(example("linear_gaussian"), data).noise["acceleration"][0]
    torch.testing.assert_close(noise, torch.cat(drawn), rtol=1e-9, atol=1e-9)


def test_the_noise_of_several_sites_is_told_apart():
    class TwoSites(Program):
        states, controls, measurements = ("x", "v", "w"), (), ("x",)

        def initial(self):
            return pyro.sample("start", dist.Normal(torch.zeros(3).double(), 1.0).to_event(1))

        def transition(self, state, control, time, step):
            a = pyro.sample("a", dist.Normal(torch.zeros_like(state[..., :2]), 1.0).to_event(1))
            b = pyro.sample("b", dist.Normal(state[..., 2], 1.0))
            x, v, w = state.unbind(-1)
            return torch.stack([x + step * a[..., 0], v + step * (a[..., 1] + b), w + 2 * step * b], -1)

        def observe(self, state):
            pyro.sample("x", dist.Normal(state[..., 0], 1.0))

    program = TwoSites()
    data = drives(program.double(), 2, 6)
    data = replace(data, **{n: getattr(data, n).double() for n in ("time", "controls", "measurements", "states")})
    noise = true_paths(program, data).noise
    x, v, w = ((data.states[1:] - data.states[:-1]) / data.steps[..., None]).unbind(-1)
    torch.testing.assert_close(noise["b"][0], w / 2)
    torch.testing.assert_close(noise["a"][0], torch.stack([x, v - w / 2], -1))


def test_the_supervised_m_step_on_linear_data_is_least_squares():
    program = example("linear_gaussian")
    data = drives(program, 3, 30, gaps=True)
    guide = TruthGuide(program)
    guide.refresh(data, 0.0)
    inside = data.transitions
    velocity = data.states[:-1, :, 1]
    acceleration = ((data.states[1:, :, 1] - velocity) / data.steps)[inside]
    regressors = torch.stack([data.controls[:-1, :, 0], -velocity], -1)[inside]
    coefficients = torch.linalg.lstsq(regressors, acceleration[:, None]).solution[:, 0]
    residual = acceleration - regressors @ coefficients
    error = (data.measurements - data.states[..., :1])[data.observed]
    with torch.no_grad():
        assert gradient_size(program, guide, data) > 1
        program.gain, program.damping = coefficients
        program.noise, program.measurement_sd = residual.square().mean().sqrt(), error.square().mean().sqrt()
    assert gradient_size(program, guide, data) < 1e-8


def gradient_size(program, guide, data) -> float:
    with torch.enable_grad():
        return float(gradient(program, negative_q(program, guide, data)).abs().max())


def test_true_paths_need_every_state():
    program = example("linear_gaussian")
    data = drives(program, 2, 6, gaps=True)
    TruthGuide(program).refresh(data, 0.0)  # padding may be unknown
    data.states[3, 1, 1] = math.nan
    for incomplete in (data, data.without_truth()):
        with pytest.raises(DataError, match="true state of every row"):
            TruthGuide(program).refresh(incomplete, 0.0)


def test_noise_that_bends_the_next_state_too_much_is_refused():
    class Squared(type(example("linear_gaussian"))):
        def transition(self, state, control, time, step):
            position, velocity = state.unbind(-1)
            acceleration = pyro.sample("acceleration", pyro.distributions.Normal(0 * velocity, self.noise))
            return stack(position + velocity * step, velocity + acceleration**2 * step)

    program = Squared().double().requires_grad_(False)
    with pytest.raises(ProgramError, match="no channel noise was found that leads from one true state to the next"):
        true_paths(program, drives(program, 2, 12))


@pytest.mark.slow
def test_noise_is_told_from_states_that_no_vehicle_has():
    """What total variation makes of poor fixes, in single precision: hundreds of m/s, thousands of m/s²."""
    program = example("neural_vehicle:NeuralHovercraft", torch.float32).requires_grad_(False)
    data = for_program(program, simulate(example("hovercraft:HovercraftTruth", torch.float32), 4, seed=1))
    torch.manual_seed(0)
    wild = replace(
        data, states=data.states + 200 * torch.randn(data.states.shape) * torch.tensor([0, 0, 0, 1, 1, 0.01])
    )
    paths = true_paths(program, wild)
    with running(1, *wild.states[:-1].shape[:-1]), Replaying(paths.noise):
        after = program.transition(wild.states[None, :-1], wild.controls[:-1], wild.elapsed[:-1], wild.steps)
    apart = (after - wild.states[1:])[0]
    assert float(apart[..., 5].abs().max()) < 0.5
    # a push moves the place by half a step of the velocity it makes: least squares leaves over as much of both
    pulled = -0.5 * wild.steps[..., None] * apart[..., :2]
    assert float(pulled.abs().max()) > 0.5
    torch.testing.assert_close(apart[..., 3:5], pulled, rtol=0, atol=5e-3)
