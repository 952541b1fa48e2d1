"""The time step is the first suspect: a program beside itself at finer steps, on drives in continuous time."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyro
import pyro.distributions as dist
import pytest
import scipy.linalg
import torch
from continuous_drives import simulate as in_continuous_time
from continuous_programs import UnicycleProgram
from continuous_worlds import Hovercraft, Unicycle
from examples import MODELS, example
from pyro.distributions import constraints
from pyro.nn import PyroParam
from small import steady
from torch import tensor

from steady_ppl import (
    FilterError,
    Fit,
    Program,
    check,
    discover,
    fit_by_likelihood,
    for_program,
    load_program,
    read_table,
    seeded,
    simulate,
    stack,
    write_table,
)
from steady_ppl.criticism import step_size
from steady_ppl.criticism.step_size import check_step
from steady_ppl.gaussian.smoother import find_path
from steady_ppl.likelihood.maximize import Maximum
from steady_ppl.likelihood.parameters import elements
from steady_ppl.model.problem import Problem

CASE = Path(__file__).parents[3] / "shared" / "cases" / "exact_unicycle"


class Turning(UnicycleProgram):
    """A unicycle whose lateral velocity is taken back in each step, without the term that turns the velocity."""

    def transition(self, state, control, time, step):
        speed, turn = control.unbind(-1)
        forward, lateral, yaw_rate = self.body_velocity(state)
        mean = stack((speed - forward) / self.speed_time, -lateral / step, (turn - yaw_rate) / self.turn_time)
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)


@pytest.fixture(scope="module")
def turning():
    """Unicycles that move in steps of 1 ms."""
    return in_continuous_time(Unicycle(), 8, seed=3)


def checked(program, table, *, known_start=False):
    data = for_program(program, table).without_truth(keep_start=known_start)
    with seeded(0, "paths"):
        maximum = fit_by_likelihood(program, data, known_start=known_start)
        return check_step(program, data, maximum, known_start=known_start)


@pytest.fixture(scope="module")
def steps_of_turning(turning):
    return checked(Turning(), turning)


@pytest.mark.slow
def test_a_step_that_is_too_coarse_is_told_by_its_gain(steps_of_turning) -> None:
    found = steps_of_turning
    assert found.too_coarse and found.suited.substeps == 32 and found.gain > 20
    last = found.trials[-1].log_likelihood - found.trials[-2].log_likelihood
    assert last > 3 and not found.settled
    assert found.sentence == (
        f"the model's own time step is too coarse: 32 substeps a row instead of 1 gain {found.gain:.0f} nats, "
        f"the last doubling {last:.0f} of them: more substeps may gain more (fit with --substeps 32)"
    )
    for trial, finer in zip(found.trials[:-1], found.trials[1:], strict=True):
        assert finer.substeps == 2 * trial.substeps


class Motor(Program):
    """i' = (u - R i - k w) / L,  w' = (k i - b w) / J, in explicit steps"""

    states = ("current [A]", "speed [rad/s]")
    controls = ("voltage [V]",)
    measurements = ("current [A]", "speed [rad/s]")
    channels = ("current [A/s]", "speed [rad/s²]")
    guesses = ("noise",)

    def __init__(self):
        super().__init__()
        self.resistance = PyroParam(tensor(1.0), constraints.positive)
        self.inductance = PyroParam(tensor(0.02), constraints.positive)
        self.constant = PyroParam(tensor(0.5), constraints.positive)
        self.friction = PyroParam(tensor(0.1), constraints.positive)
        self.inertia = PyroParam(tensor(0.05), constraints.positive)
        self.noise = PyroParam(tensor([5.0, 2.0]), constraints.positive)

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(2), tensor([5.0, 10.0])).to_event(1))

    def transition(self, state, control, time, step):
        current, speed = state.unbind(-1)
        mean = stack(
            (control[..., 0] - self.resistance * current - self.constant * speed) / self.inductance,
            (self.constant * current - self.friction * speed) / self.inertia,
        )
        rate = pyro.sample("rate", dist.Normal(mean, self.noise).to_event(1))
        return state + step[..., None] * rate

    def observe(self, state):
        pyro.sample("seen", dist.Normal(state, tensor([0.05, 0.2])).to_event(1))


def motors(inductance: float, drives: int = 12, rows: int = 151, step: float = 0.01, seed: int = 1):
    """What a motor does, by matrix exponentials; its voltage is held for fifteen rows, its noise for one."""
    rng = np.random.default_rng(seed)
    rates = np.array([[-1.0 / inductance, -0.5 / inductance], [0.5 / 0.05, -0.1 / 0.05]])
    decay = scipy.linalg.expm(step * rates)
    pushed = np.linalg.solve(rates, decay - np.eye(2))
    frames = []
    for drive in range(drives):
        voltage, state, states = np.repeat(rng.uniform(-12, 12, rows // 15 + 1), 15)[:rows], np.zeros(2), []
        for one in voltage:
            states.append(state)
            push = np.array([one / inductance, 0.0]) + rng.normal(0, [5.0, 2.0])
            state = decay @ state + pushed @ push
        seen = np.array(states) + rng.normal(0, [0.05, 0.2], (rows, 2))
        columns = {"trajectory": drive, "time": np.arange(rows) * step, "u.voltage": voltage}
        frames.append(pd.DataFrame(columns | {"y.current": seen[:, 0], "y.speed": seen[:, 1]}))
    return pd.concat(frames)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("inductance", "within"), [(0.02, 64), (0.003, 128)])
def test_parameters_that_a_coarse_step_has_bent_do_not_acquit_it(inductance, within, tmp_path) -> None:
    """At one step a row log p(y) is 341 and 968 nats lower. With the parameters of that fit two steps a row are 4,300
    and 68,700 nats lower still, and scoring steps from there end without noise or without friction."""
    motors(inductance).to_csv(tmp_path / "motors.csv", index=False)
    program = Motor()
    data = for_program(program, read_table(tmp_path / "motors.csv"))
    with seeded(0, "paths"):
        maximum = fit_by_likelihood(program, data)
        found = check_step(program, data, maximum, finest=128)
    assert found.gain > 200 and 8 <= found.suited.substeps <= within
    assert float(found.suited.program.inductance.detach()) == pytest.approx(inductance, rel=0.05)
    assert found.sentence.startswith("the model's own time step is too coarse: ")


def stubbed(monkeypatch, levels, *, at=True, looks=5.0):
    """A check whose fits end at prescribed log p(y) and promise prescribed gains, by how often a step was fitted."""
    program = example("hovercraft", torch.float32)
    data = for_program(program, simulate(program, 3, seed=0))
    fits = []

    def maximise(problem, path, *, steps, **settings):
        changed = problem.program
        ends = levels[changed.substeps]
        if steps:
            fits.append(changed.substeps)
        earlier = fits.count(changed.substeps) - (changed.substeps > 1)
        level = ends[min(max(0, earlier), len(ends) - 1)]
        if isinstance(level, Exception):
            raise level
        value, promised = level if isinstance(level, tuple) else (level, 0.0)
        every = tuple(part.name for part in elements(changed))
        likely = torch.full((3,), value / 3, dtype=torch.float64)
        firm = torch.eye(len(every), dtype=torch.float64)
        return Maximum(likely, value, path, every, firm, steps, promised if steps else promised + looks, 0.0)

    monkeypatch.setattr(step_size, "maximise", maximise)
    path = find_path(Problem(program, data))
    own = replace(maximise(Problem(program, data), path, steps=0), decrement=0.0) if at else path
    return check_step(program, data, own), fits


@pytest.mark.slow
@pytest.mark.parametrize(
    ("levels", "substeps", "known"),
    [
        ({1: [-100], 2: [-200], 4: [-90], 8: [-89]}, 4, True),  # the first finer fit is a bad one
        ({1: [-100], 2: [-4000], 4: [-4000]}, 1, True),  # finer steps are worse: a world that takes the own step
        ({1: [-100], 2: [-150], 4: [-140], 8: [-130]}, 1, True),
        ({1: [-100], 2: [(-150, 30.0)], 4: [(-145, 200.0)]}, 1, False),  # fits that have not converged say nothing
        ({1: [-100], 2: [-4000], 4: [FilterError("broken")]}, 1, False),
        ({1: [-100], 2: [FilterError("broken")]}, 1, False),
        ({1: [-100], 2: [ZeroDivisionError()]}, 1, False),  # of the program's own code
        ({1: [-100, -50], 2: [-200, -50], 4: [-50]}, 1, True),  # several maxima of one program, no matter of its step
        # the finer step's parameters diverge at the coarse one
        ({1: [-100, FilterError("diverges")], 2: [-50], 4: [-50]}, 2, True),
        ({1: [-100, ZeroDivisionError()], 2: [-50], 4: [-50]}, 2, True),
    ],
)
def test_what_fits_at_finer_steps_say_and_do_not(monkeypatch, levels, substeps, known) -> None:
    found, _ = stubbed(monkeypatch, levels)
    assert (found.suited.substeps, found.settled) == (substeps, known)
    assert (found.uncompared is None) == known
    assert found.too_coarse == (substeps > 1)


@pytest.mark.slow
def test_a_coarser_step_is_fitted_again_where_the_next_one_has_risen_since(monkeypatch) -> None:
    """All three end at −50, the own one only from the parameters that two steps have got from four."""
    found, fits = stubbed(monkeypatch, {1: [-100, -100, -50], 2: [-95, -50], 4: [-50]})
    assert fits == [2, 1, 4, 2, 1]
    assert not found.too_coarse and [trial.log_likelihood for trial in found.trials] == pytest.approx([-50] * 3)


@pytest.mark.slow
def test_no_more_is_fitted_than_is_needed(monkeypatch) -> None:
    _, fits = stubbed(monkeypatch, {1: [-100], 2: [-150], 4: [-145], 8: [-140]})
    assert fits == [2, 4, 2]  # the last is two steps from the parameters of four
    found, fits = stubbed(monkeypatch, {1: [-100], 2: [-110]}, at=False, looks=0.5)  # a fit, one look
    assert fits == [1] and found.settled and not found.too_coarse


@pytest.mark.slow
def test_parameters_of_finer_steps_are_those_of_the_vehicle(steps_of_turning) -> None:
    """Response times of .3 and .2 s; one explicit step a row makes them longer."""
    own, finest = steps_of_turning.trials[0].program, steps_of_turning.trials[-1].program
    for name, truth in (("speed_time", 0.3), ("turn_time", 0.2)):
        off = [abs(getattr(program, name).item() - truth) for program in (own, finest)]
        assert off[1] < 0.5 * off[0]


@pytest.mark.slow
def test_the_second_order_step_is_fine_enough_for_the_hovercraft_and_explicit_euler_is_not() -> None:
    table = in_continuous_time(Hovercraft(thrust=2.0), 8, seed=1)
    assert not checked(example("hovercraft", torch.float32), table, known_start=True).too_coarse
    found = checked(example("paper:PaperHovercraft", torch.float32), table, known_start=True)
    assert found.settled and found.sentence == (
        f"the model's own time step is too coarse: {found.suited.substeps} substeps a row instead of 1 gain "
        f"{found.gain:.0f} nats (fit with --substeps {found.suited.substeps})"
    )


@pytest.mark.slow
def test_what_a_finer_step_has_gained_is_kept_where_the_next_one_fails(turning, monkeypatch) -> None:
    maximise = step_size.maximise

    def failing(problem, *arguments, **settings):
        if problem.program.substeps >= 4:
            raise FilterError("broken")
        return maximise(problem, *arguments, **settings)

    monkeypatch.setattr(step_size, "maximise", failing)
    found = checked(Turning(), turning)
    assert [trial.substeps for trial in found.trials] == [1, 2] and not found.settled
    assert found.gain > 3 and "(fit with --substeps 2)" in found.sentence


@pytest.mark.exhaustive
def test_check_says_the_step_first(turning) -> None:
    program = Turning()
    with seeded(0, "paths"):
        fit_by_likelihood(program, for_program(program, turning))
    found = check(Fit(program, "likelihood"), in_continuous_time(Unicycle(), 6, seed=4), simulations=40)
    assert str(found).startswith("The model's own time step is too coarse: ")
    assert found.figures["step"]["substeps"] == found.step.suited.substeps > 1


@pytest.mark.exhaustive
def test_discover_goes_on_at_the_step_that_suits_and_names_no_effect(turning, tmp_path) -> None:
    found = discover(Turning(), in_continuous_time(Unicycle(), 12, seed=5), in_continuous_time(Unicycle(), 12, seed=6))
    assert str(found).startswith("The model's own time step is too coarse: ")
    assert found.verdict == "none"
    assert found.after.program.substeps == found.search.step.suited.substeps >= 4
    assert found.figures["step"]["gain"] > 3
    found.after.save(tmp_path / "run")
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["substeps"] == found.after.program.substeps


@pytest.mark.exhaustive
@pytest.mark.parametrize(("count", "excluded"), [(6, 0.55), (16, 0.582)])
def test_sizes_are_those_of_the_step_at_which_they_rest(count: int, excluded: float) -> None:
    """A yaw drag of .6 1/s on a boat: one explicit step a row makes (1 − exp(−.06)) / .1 = .582 of it."""
    boat = example("gps_boat", torch.float32)
    truth = boat.with_effect("yaw_linear_drag", 0.6)
    drives = [simulate(truth, count, seed=seed).without_truth() for seed in (1, 2)]
    found = discover(boat, *drives)
    (effect,) = [one for one in found.findings if one.variant.name == "yaw_linear_drag"]
    ((low, high),) = effect.interval  # of 95 %, which misses in one data set of twenty: 3.3 standard deviations here
    assert low > excluded
    assert abs(0.6 - (low + high) / 2) < 3.3 / 1.96 * (high - low) / 2
    assert found.after.program.substeps > 1
    assert any("substeps a row instead of 1 move yaw_linear_drag" in note for note in found.notes)
    assert found.search.with_found.trials[-2] is found.search.with_found.suited  # nothing finer than the next is fitted


@pytest.mark.slow
@pytest.mark.skipif(not CASE.is_dir(), reason="the case exact_unicycle is not beside the checkout")
def test_the_exact_unicycle_lacks_nothing_but_a_finer_step(tmp_path, capsys) -> None:
    run = tmp_path / "run"
    train, valid = CASE / "train.csv", CASE / "valid.csv"
    assert steady("fit", CASE / "unicycle.py", train, "--valid", valid, "--recipe", "likelihood", "--out", run) == 0
    figures = tmp_path / "found.json"
    assert steady("discover", run, train, "--valid", valid, "--json", figures) == 0
    content = json.loads(figures.read_text())
    assert content["sentence"].startswith("The model's own time step is too coarse: ")
    assert content["verdict"] == "none"
    trials = {trial["substeps"]: trial["log_likelihood"] for trial in content["step"]["trials"]}
    assert trials[content["step"]["substeps"]] / 12 >= 785


@pytest.mark.slow
def test_an_unstable_step_is_told_by_every_command(tmp_path, capsys) -> None:
    model = tmp_path / "stiff.py"
    source = (MODELS / "linear_gaussian.py").read_text()
    source = source.replace("PyroParam(tensor(0.8)", "PyroParam(tensor(60.0)").replace("LinearGaussian", "Stiff")
    model.write_text(source)
    write_table(simulate(example("linear_gaussian"), 10, seed=1), tmp_path / "drives.csv")
    out = tmp_path / "run"
    for command in (("fit", "--recipe", "likelihood"), ("discover",)):
        assert steady(command[0], model, tmp_path / "drives.csv", *command[1:], "--out", out) != 0
        said = capsys.readouterr().err
        assert "the model itself diverges at this step: damping · step = 6" in said
        assert "impossible" not in said
    drives = read_table(tmp_path / "drives.csv")
    with pytest.raises(FilterError, match="the model itself diverges at this step: damping · step = 6"):
        check(Fit(load_program(model), "hand"), drives, simulations=20)


@pytest.mark.slow
@pytest.mark.parametrize("change", [{"information": torch.nan}, {"log_likelihood": 1e30}])
def test_parameters_that_diverge_are_no_trial(change, monkeypatch) -> None:
    """A measurement that never changes has a likelihood without a maximum: its noise shrinks without end."""
    cart = example("linear_gaussian")
    data = for_program(cart, simulate(cart, 4, seed=1)).without_truth()
    own, found = step_size.maximise, []

    def diverging(problem, path, **settings):
        maximum = own(problem, path, **settings)
        found.append(maximum)
        if len(found) < 3:
            return maximum
        return replace(maximum, **{name: torch.full_like(getattr(maximum, name), to) for name, to in change.items()})

    monkeypatch.setattr(step_size, "maximise", diverging)
    monkeypatch.setattr(step_size, "MAX_DECREMENT", -1.0)  # finer steps are always fitted
    said = check_step(cart, data)
    assert len(found) > 2 and "likelihood has no maximum on these trajectories" in said.uncompared


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_two_maxima_of_one_program_are_no_matter_of_its_step(seed) -> None:
    """From a bias of 30 m/s² the coarser fit ends at a lower maximum than the finer one, which begins where it ends."""
    cart = example("linear_gaussian", torch.float32)
    data = for_program(cart, simulate(cart, 10, seed=seed)).without_truth()
    with seeded(0, "paths"):
        found = check_step(cart.with_effect("acceleration_bias", 30.0).double(), data)
    assert len(found.trials) > 1  # one look did not do
    assert not found.too_coarse
    assert found.trials[0].log_likelihood == pytest.approx(found.trials[1].log_likelihood, abs=1.0)
