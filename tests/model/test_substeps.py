"""Rows in several substeps, held against programs whose substeps are unrolled by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import drives, example
from oracles import cart_system, joint_density, kalman_filter
from pyro.nn import PyroParam
from small import HOVERCRAFT, simulated, steady, written

from steady_ppl import (
    Fit,
    PlanarVehicle,
    Program,
    ProgramError,
    UsageError,
    for_program,
    load_program,
    particle_filter,
    seeded,
    simulate,
    stack,
    with_substeps,
)
from steady_ppl.gaussian.linearize import linearize
from steady_ppl.gaussian.smoother import find_path, smooth
from steady_ppl.kernels.rows import on_all_rows
from steady_ppl.model.handlers import AtMean, Recording, Standardised, running
from steady_ppl.model.problem import Problem
from steady_ppl.model.substeps import (
    advance,
    channel_scales,
    channel_values,
    sample_channels,
)
from steady_ppl.model.validate import probe
from steady_ppl.runs.posterior import forecast
from steady_ppl.smc.compiled import CompiledFilter, compiled_filter, standard_normal
from steady_ppl.smc.proposal import Proposal
from steady_ppl.smc.resampling import systematic
from steady_ppl.smc.simulate import roll_out, simulated_in, simulated_substeps
from steady_ppl.smc.stepping import Stepping

K = 3


class Braked(type(example("hovercraft"))):
    """A hovercraft with drag at the beginning of a step and noise that grows with the command."""

    def moments(self, state, control):
        left, right = control.unbind(-1)
        forward, lateral, _ = self.body_velocity(state)
        mean = stack((left + right) / self.mass - 0.4 * forward, -0.5 * lateral, (right - left) / self.inertia)
        return mean, self.noise * (1 + 0.3 * left.abs() + 0.2 * forward.abs()).unsqueeze(-1)

    def transition(self, state, control, time, step):
        mean, sd = self.moments(state, control)
        return self.integrate(state, pyro.sample("acceleration", dist.Normal(mean, sd).to_event(1)), step)


class Unrolled(Braked):
    """The same with `K` substeps a row in its own transition."""

    def transition(self, state, control, time, step):
        mean, _ = self.row(state, control, step, torch.zeros(3, dtype=state.dtype))
        first, own = self.moments(state, control)
        reach = 1 + 1e-3 * (first / own).abs().detach()
        units = torch.eye(3, dtype=state.dtype)
        sd = stack(*((self.row(state, control, step, reach * unit)[0] - mean)[..., i] for i, unit in enumerate(units)))
        sd = sd / reach
        noise = (pyro.sample("acceleration", dist.Normal(mean, sd).to_event(1)) - mean) / sd
        return self.row(state, control, step, noise)[1]

    def row(self, state, control, step, noise):
        """The accelerations averaged over a row with held noise, and the state at its end."""
        accelerations = []
        for _ in range(K):
            mean, sd = self.moments(state, control)
            accelerations.append(mean + sd * noise)
            state = self.integrate(state, accelerations[-1], step / K)
        return sum(accelerations) / K, state


@pytest.fixture(scope="module")
def pair():
    """The program in substeps, the one unrolled by hand, and drives, in double precision."""
    cut, unrolled = with_substeps(Braked().double(), K), Unrolled().double()
    return cut, unrolled, for_program(unrolled, drives(unrolled, 4, 25))


def rows_of(data):
    return data.controls[:-1], data.elapsed[:-1], data.steps


def test_a_row_is_that_of_the_program_unrolled_by_hand(pair) -> None:
    cut, unrolled, data = pair
    noise = torch.randn(*data.steps.shape, 3, dtype=torch.float64)
    ends = []
    for program in (cut, unrolled):
        with running(*data.steps.shape), Standardised(noise):
            ends.append(advance(program, data.states[:-1], *rows_of(data)))
    torch.testing.assert_close(ends[0], ends[1], rtol=1e-12, atol=1e-12)


def test_channels_are_scored_as_by_hand(pair) -> None:
    cut, unrolled, data = pair
    logs = []
    for program in (cut, unrolled):
        seen = Recording()
        with seeded(1, "channels"), running(*data.steps.shape), seen:
            sample_channels(program, data.states[:-1], *rows_of(data))
        logs.append(
            (seen.values["acceleration"], seen.distributions["acceleration"].log_prob(seen.values["acceleration"]))
        )
    torch.testing.assert_close(logs[0], logs[1], rtol=1e-12, atol=1e-12)


def test_the_filters_paths_have_the_density_and_the_gradient_of_the_program_unrolled_by_hand(pair) -> None:
    cut, unrolled, data = pair
    with seeded(2, "filter"):
        paths = particle_filter(cut, data, particles=50).paths(6)
    for program in (cut, unrolled):
        program.zero_grad()
    (mine, my_slopes), (theirs, their_slopes) = (joint_density(program, paths, data) for program in (cut, unrolled))
    torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-9)
    torch.testing.assert_close(my_slopes, their_slopes, rtol=1e-10, atol=1e-10)


def test_the_filters_noise_leads_from_each_state_to_the_next(pair) -> None:
    cut, unrolled, data = pair
    with seeded(3, "filter"):
        paths = particle_filter(cut, data, particles=50).paths(4)
    seen = Recording()
    states = paths.states[:, :-1]
    with running(*states.shape[:-1]), seen:
        sample_channels(unrolled, states, *rows_of(data))
    fn = seen.distributions["acceleration"].base_dist
    noise = (paths.noise["acceleration"] - fn.loc) / fn.scale
    with running(*states.shape[:-1]), Standardised(noise):
        after = advance(unrolled, states, *rows_of(data))
    torch.testing.assert_close(after, paths.states[:, 1:], rtol=1e-9, atol=1e-9)
    along = channel_values(cut, data, paths.states, {"acceleration": noise})
    torch.testing.assert_close(along["acceleration"], paths.noise["acceleration"], rtol=1e-9, atol=1e-9)


def test_the_linearised_program_is_that_of_the_program_unrolled_by_hand(pair) -> None:
    cut, unrolled, data = pair
    with seeded(4, "path"):
        path = find_path(Problem(unrolled, data))
    mine, theirs = (linearize(Problem(program, data), path) for program in (cut, unrolled))
    for name in ("state", "noise", "offset", "measurement", "residual"):
        torch.testing.assert_close(getattr(mine, name), getattr(theirs, name), rtol=1e-10, atol=1e-10)


def test_kernels_compute_the_substeps() -> None:
    program = with_substeps(Braked(), K)
    data = for_program(program, drives(Braked(), 3, 12)).to(torch.float32)
    state = torch.randn(64, 3, 6)
    machine = compiled_filter(Stepping(program, data, 1.0), state, Proposal(), systematic)
    assert isinstance(machine, CompiledFilter), machine
    uniform = torch.rand(64, 3, 5)
    noise, _ = standard_normal(uniform, 3)
    moved, values, _ = machine.transition(4, state, uniform)
    plain, _ = Stepping(program, data, 1.0).transition(4, state, noise)
    torch.testing.assert_close(moved, plain, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(values, noise, rtol=1e-5, atol=1e-5)

    def step(state, noise, control, time, step):
        with running(*state.shape[:-1]), Standardised(noise):
            return advance(program, state, control, time, step)

    given = {"control": data.controls[:-1], "time": data.elapsed[:-1], "step": data.steps}
    arguments = {"state": torch.randn(11, 3, 6), "noise": torch.randn(11, 3, 3)} | given
    found = on_all_rows(program, "substeps", step, arguments, ("state", "noise"), kernels=True)
    assert found.in_plain_torch is None
    torch.testing.assert_close(found.values, step(*arguments.values()), rtol=1e-5, atol=1e-5)


def test_two_substeps_of_the_cart_have_its_exact_evidence() -> None:
    """Both substeps move by the same noise: x'' = A (A x + b u + g w) + b u + g w."""
    cart = example("linear_gaussian")
    data = drives(cart, 5, 30)
    parameters = {name: getattr(cart, name).detach() for name in ("gain", "damping", "noise", "measurement_sd")}
    half = cart_system(replace(data, time=data.time / 2), parameters)
    spread = torch.stack([half.noise[..., 0, 0], half.noise[..., 1, 1]], -1).sqrt()  # of one factor, both positive
    again = (half.matrix @ spread.unsqueeze(-1)).squeeze(-1) + spread
    system = replace(
        half,
        matrix=half.matrix @ half.matrix,
        offset=(half.matrix @ half.offset.unsqueeze(-1)).squeeze(-1) + half.offset,
        noise=again.unsqueeze(-1) * again.unsqueeze(-2),
    )
    exact = kalman_filter(system, data).log_likelihood
    program = with_substeps(cart, 2)
    with seeded(0, "path"):
        found = smooth(Problem(program, data), find_path(Problem(program, data))).log_likelihood
    torch.testing.assert_close(found, exact, rtol=1e-9, atol=1e-7)
    with seeded(0, "filter"):
        drawn = torch.stack([particle_filter(program, data, particles=4000).log_likelihood for _ in range(6)])
    error = drawn.std(0) / math.sqrt(6)
    assert ((drawn.mean(0) - exact).abs() < 5 * error + 0.5 * drawn.var(0)).all()


def test_a_forecast_is_that_of_the_program_unrolled_by_hand(pair) -> None:
    cut, unrolled, data = pair
    when = float(data.elapsed[12, 0])
    mine, theirs = (
        forecast(program, data, after=when, draws=3, particles=50, known_start=True, seed=4)
        for program in (cut, unrolled)
    )
    for group, names in (("posterior", cut.state_names), ("predictions", (*cut.state_names, "measured_bearing_0"))):
        for name in names:
            np.testing.assert_allclose(mine[group][name], theirs[group][name], rtol=0, atol=1e-12)


def test_one_substep_is_the_program_itself(pair) -> None:
    cut, _, data = pair
    program = with_substeps(cut, 1)
    ends = []
    for move in (lambda *given: advance(program, *given), program.transition):
        with seeded(5, "row"), running(*data.steps.shape):
            ends.append(move(data.states[:-1], *rows_of(data)))
    assert torch.equal(*ends)


def test_noise_with_memory_remembers_rows_not_substeps() -> None:
    program = example("hovercraft").with_effect("coloured_noise:translation", 0.7)
    cut = with_substeps(program, K)
    data = for_program(cut, simulate(cut, 3, seed=1, substeps=K))
    deviations = data.states[..., 6:8]
    given = (data.controls[:-1], data.elapsed[:-1], data.steps)
    seen = Recording()
    with running(*data.steps.shape), seen, AtMean():
        after = advance(cut, data.states[:-1], *given)
    torch.testing.assert_close(after[..., 6:8], 0.7 * deviations[:-1], rtol=1e-9, atol=1e-12)
    noise = program.noise.detach()[:2] * math.sqrt(1 - 0.7**2)
    drawn = (deviations[1:] - 0.7 * deviations[:-1]) / noise
    count = drawn.numel()
    assert abs(float(drawn.var()) - 1) < 5 * math.sqrt(2 / count)


def test_the_module_of_a_fit_takes_the_substeps() -> None:
    program = with_substeps(Braked().double(), K)
    dynamics = Fit(program, "hand").dynamics(step=0.1)
    state, plan = torch.randn(5, 6, dtype=torch.float64), torch.rand(4, 2, dtype=torch.float64)
    controls = plan[:, None, None, :].expand(4, 1, 5, 2)
    elapsed = (0.1 * torch.arange(4, dtype=torch.float64))[:, None, None].expand(4, 1, 5)
    rolled = list(
        roll_out(program, state[None, None], controls, elapsed, torch.full_like(elapsed, 0.1), handler=AtMean())
    )
    torch.testing.assert_close(dynamics(state, plan), torch.cat(rolled).squeeze(1))


@pytest.mark.parametrize("count", [0, -1, 1.5, True, "2", 1001, math.nan])
def test_substeps_are_a_whole_number(count) -> None:
    with pytest.raises(UsageError, match="substeps must be a whole number from 1 to 1000"):
        with_substeps(example("hovercraft"), count)

    class Odd(type(example("hovercraft"))):
        substeps = count

    with pytest.raises(ProgramError, match="substeps is .* expected a whole number"):
        probe(Odd())


@pytest.mark.slow
def test_simulated_drives_do_not_depend_on_how_fine_their_steps_are() -> None:
    program = example("hovercraft:HovercraftTruth")
    fine, finer = simulate(program, 3, seed=1), simulate(program, 3, seed=1, substeps=80)
    coarse = simulate(program, 3, seed=1, substeps=1)
    step = (fine.states - finer.states).abs().max()
    assert step < 1e-3
    assert step < 0.1 * (coarse.states - finer.states).abs().max()


@pytest.mark.slow
def test_a_run_remembers_its_substeps(tmp_path) -> None:
    table, run = written(tmp_path / "drives.csv"), tmp_path / "run"
    assert steady("fit", HOVERCRAFT, table, "--recipe", "likelihood", "--substeps", 3, "--out", run) == 0
    assert json.loads((run / "run.json").read_text())["substeps"] == 3
    assert Fit.load(run).program.substeps == 3


@pytest.mark.slow
def test_a_program_that_add_writes_keeps_the_substeps_of_its_run(tmp_path) -> None:
    table, run, model = written(tmp_path / "drives.csv"), tmp_path / "run", tmp_path / "hovercraft.py"
    model.write_text(HOVERCRAFT.read_text())
    assert steady("fit", model, table, "--recipe", "likelihood", "--substeps", 3, "--out", run) == 0
    assert steady("add", run, "linear_drag", "--out", tmp_path / "more.py") == 0
    assert load_program(tmp_path / "more.py").substeps == 3


def test_a_pause_in_a_log_does_not_make_every_row_fine(tmp_path) -> None:
    program = example("hovercraft")
    data = simulate(program, 2, seed=1)
    late = data.time.clone()
    late[50:] += 5.0
    paused = for_program(program, replace(data, time=late))
    assert simulated_substeps(program, paused) == simulated_substeps(program, for_program(program, data)) == 20
    said = "simulated in steps of 5 ms, 20 a row"
    assert simulated_in(program, data) == said
    assert simulated_in(program, replace(data, time=late)) == (
        f"{said}, but those of the longest row (5.1 s) of 255 ms"
    )


@pytest.mark.parametrize("given", ["0", "-2", "1.5", "two"])
def test_other_numbers_of_substeps_are_refused_by_the_command_line(given, tmp_path, capsys) -> None:
    table = written(tmp_path / "drives.csv", simulated(trajectories=1))
    assert steady("fit", HOVERCRAFT, table, "--substeps", given, "--out", tmp_path / "run") == 2
    assert not (tmp_path / "run").exists()
    assert len(capsys.readouterr().err.strip().splitlines()) <= 2


def test_simulate_says_its_steps(tmp_path, capsys) -> None:
    out = tmp_path / "drives.csv"
    assert steady("simulate", HOVERCRAFT, "--trajectories", 1, "--out", out) == 0
    assert "simulated in steps of 5 ms, 20 a row" in capsys.readouterr().err


def test_an_abstract_program_has_one_substep() -> None:
    assert Program.substeps == 1


# --- what a channel is on average over a row --------------------------------------------------------------------------


class TwoSites(PlanarVehicle):
    """A vehicle with drag whose yaw has a site of its own, with the tails of a Student t."""

    controls = ("push", "turn")
    measurements = ("x", "y", "heading")

    def __init__(self):
        super().__init__()
        self.drag = PyroParam(torch.tensor(2.0))

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(6).to(self.drag), 0.1).to_event(1))

    def transition(self, state, control, time, step):
        push, turn = control.unbind(-1)
        forward, lateral, yaw_rate = self.body_velocity(state)
        yaw = pyro.sample("yaw", dist.StudentT(5.0, turn - 3.0 * yaw_rate, 0.2))
        mean = stack(push - self.drag * forward, -self.drag * lateral)
        moved = pyro.sample("moved", dist.Normal(mean, torch.tensor([0.3, 0.1]).to(mean)).to_event(1))
        return self.integrate(state, stack(moved[..., 0], moved[..., 1], yaw), step)

    def observe(self, state):
        pyro.sample("pose", dist.Normal(state[..., :3], 0.05).to_event(1))


def sampled(program, state, given):
    seen = Recording()
    with running(*state.shape[:-1]), seen:
        sample_channels(program, state, *given)
    return seen.distributions


def test_a_row_keeps_as_much_of_each_sites_noise_as_is_left_at_its_end() -> None:
    """A rate λ in K parts of a row of T leaves (1 − (1 − λ T / K)^K) / (λ T) of noise that is held."""
    program = with_substeps(TwoSites().double(), 4)
    state, step = torch.zeros(3, 5, 6).double(), torch.tensor(0.3).double().expand(5)
    given = torch.zeros(5, 2).double(), torch.zeros(5).double(), step
    found = sampled(program, state, given)
    assert list(found) == ["yaw", "moved"] and isinstance(found["yaw"], dist.StudentT)

    def left(rate):
        return (1 - (1 - rate * 0.3 / 4) ** 4) / (rate * 0.3)

    torch.testing.assert_close(found["yaw"].scale, torch.full((3, 5), 0.2 * left(3.0)).double())
    expected = torch.tensor([0.3, 0.1]).double() * left(2.0)
    torch.testing.assert_close(found["moved"].base_dist.scale, expected.expand(3, 5, 2))
    own = channel_scales(program, state, *given)
    torch.testing.assert_close(own, torch.tensor([0.2, 0.3, 0.1]).double().expand(3, 5, 3))


@pytest.mark.parametrize("noise", [0.1, 1e-3, 1e-6, 2e-7])
def test_a_rows_noise_is_seen_in_single_precision_however_small_it_is(noise) -> None:
    cart = example("linear_gaussian", torch.float32)
    cart.noise, cart.damping = torch.tensor(noise), torch.tensor(2.0)
    cart = with_substeps(cart, 4)
    given = torch.full((1, 1), 20.0), torch.zeros(1), torch.full((1,), 0.1)
    (fn,) = sampled(cart, torch.zeros(1, 2), given).values()
    share = (1 - (1 - 0.2 / 4) ** 4) / 0.2
    assert float(fn.stddev.detach()) == pytest.approx(noise * share, rel=1e-3)


def test_noise_that_is_turned_round_within_a_row_counts_as_a_tenth() -> None:
    class Spring(type(example("linear_gaussian"))):
        def transition(self, state, control, time, step):
            position, velocity = state.unbind(-1)
            mean = self.gain * control[..., 0] - 35.0**2 * position
            velocity = velocity + pyro.sample("acceleration", dist.Normal(mean, self.noise)) * step
            return stack(position + velocity * step, velocity)

    cart = with_substeps(Spring().double(), 32)
    given = torch.zeros(1, 1).double(), torch.zeros(1).double(), torch.full((1,), 0.1).double()
    (fn,) = sampled(cart, torch.zeros(1, 2).double(), given).values()
    torch.testing.assert_close(fn.stddev, 0.1 * cart.noise.expand(1).detach())
