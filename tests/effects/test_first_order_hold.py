"""Controls that change within a row, of whose course the table has the means."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import Fit, Program, UsageError, for_program, from_arrays, load_program, seeded, stack, with_substeps
from steady_ppl.discovery.effect_scores import Scoring, columns_of
from steady_ppl.effects import catalogue, chosen_variant, with_effect, write_program
from steady_ppl.gaussian.smoother import find_path, smooth
from steady_ppl.likelihood.maximize import fit_by_likelihood
from steady_ppl.likelihood.parameter_posterior import ridged_inverse
from steady_ppl.likelihood.scores import smoothed
from steady_ppl.model.problem import Problem
from steady_ppl.model.substeps import acting, mean_step, row_inputs
from steady_ppl.runs.export import Dynamics

MASS, ROW = 2.0, 0.2  # kg, s
OMEGA = (2.0, 8.0)  # rad/s of the force, at least and at most: a row is a quarter of the shortest period
READING_SD = 1e-4  # m


class Cart(Program):
    states = ("place [m]", "velocity [m/s]")
    controls = ("force [N]",)
    measurements = ("place [m]",)
    channels = ("forward [m/s²]",)
    motion = {"forward": ("place", "velocity")}
    guesses = ("noise",)
    step = ROW

    def __init__(self):
        super().__init__()
        self.mass = PyroParam(tensor(1.5), constraints.positive)
        self.noise = PyroParam(tensor(0.1), constraints.positive)

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(2), tensor([0.01, 0.01])).to_event(1))

    def transition(self, state, control, time, step):
        place, velocity = state.unbind(-1)
        forward = pyro.sample("forward", dist.Normal(control[..., 0] / self.mass, self.noise))
        return stack(place + step * velocity + step**2 * forward / 2, velocity + step * forward)

    def observe(self, state):
        pyro.sample("place", dist.Normal(state[..., :1], READING_SD).to_event(1))


def drives(trajectories: int = 6, rows: int = 40, seed: int = 0):
    """Of a cart under a force that swings: positions by the exact integral, forces as the means of rows."""
    random = np.random.default_rng(seed)
    time = ROW * np.arange(rows)
    found = []
    for omega, phase in zip(np.linspace(*OMEGA, trajectories), random.uniform(0, 2 * np.pi, trajectories), strict=True):
        place = (-np.sin(omega * time + phase) + np.sin(phase) + omega * time * np.cos(phase)) / omega**2 / MASS
        edges = np.append(time, time[-1] + ROW)
        force = -np.diff(np.cos(omega * edges + phase)) / omega / ROW
        found.append({"time": time, "u.force": force, "y.place": place + READING_SD * random.normal(size=rows)})
    return from_arrays(found)


def fitted(program: Program) -> tuple[float, float, float]:
    """The mass, its standard deviation and log p(y)."""
    with seeded(0, "paths"):
        found = fit_by_likelihood(program, for_program(program, drives()))
    share = ridged_inverse(found.information).diagonal()[found.names.index("mass")].sqrt()
    mass = float(program.mass.detach())
    return mass, mass * float(share), float(found.log_likelihood.sum())


def test_controls_rise_from_the_row_before_to_the_row_after_and_keep_their_mean() -> None:
    program = with_effect(with_substeps(Cart(), 4), "first_order_hold", 1.0)
    time = tensor([0.0, 0.2, 0.4, 0.8, 1.2]).unsqueeze(-1)  # the middles of rows lie at .1, .3, .6, 1 and 1.4 s
    force = tensor([0.0, 1.0, 3.0, 2.0, 5.0]).reshape(-1, 1, 1)
    acts = acting(program, force, time)[:, 0].detach()
    assert acts.shape == (5, 4)
    torch.testing.assert_close(acts.mean(-1), force[:, 0, 0])
    rises = [0.0, (3 - 0) / 0.5 * 0.2, (2 - 1) / 0.7 * 0.4, (5 - 3) / 0.8 * 0.4, 0.0]
    torch.testing.assert_close(acts[:, 3] - acts[:, 0], 0.75 * tensor(rises))


def test_a_force_that_grows_steadily_moves_the_cart_as_its_integral_says() -> None:
    rows = 12
    time = ROW * torch.arange(rows, dtype=torch.float64).unsqueeze(-1)
    force = (time + ROW / 2).unsqueeze(-1)  # of u = t
    data = from_arrays([{"time": time[:, 0], "u.force": force[:, 0, 0], "y.place": 0 * time[:, 0]}])
    ends = []
    for share in (0.0, 1.0):
        program = with_effect(with_substeps(Cart().double(), 50), "first_order_hold", share)
        state = torch.tensor([[0.0, 0.0]], dtype=torch.float64)
        for index in range(1, 7):  # rows that have neighbours
            given = (part[index] for part in row_inputs(program, for_program(program, data)))
            state = mean_step(program, state, *given)
        ends.append(float(state[0, 0].detach()))
    begin, end = ROW, 7 * ROW
    exact = ((end**3 - begin**3) / 6 - begin**2 / 2 * (end - begin)) / 1.5
    held, ramped = (abs(one - exact) for one in ends)
    assert ramped < 0.01 * held


def test_its_score_is_the_slope_of_the_evidence() -> None:
    program = with_substeps(Cart().double(), 8)
    program.mass, program.noise = (torch.tensor(value, dtype=torch.float64) for value in (1.8, 0.3))
    problem = Problem(program, for_program(program, drives()))

    def evidence(share: float) -> torch.Tensor:
        changed = replace(problem, program=with_effect(program, "first_order_hold", share))
        return smooth(changed, find_path(changed)).log_likelihood

    scoring = Scoring(program, problem.data, smoothed(smooth(problem, find_path(problem)), problem.data))
    (column,) = columns_of([chosen_variant(program, "first_order_hold")])
    with torch.no_grad():
        torch.testing.assert_close(
            scoring(column)[:, 0], (evidence(0.01) - evidence(-0.01)) / 0.02, rtol=1e-3, atol=1e-4
        )


@pytest.mark.slow
def test_the_mass_of_a_cart_under_swinging_forces_comes_near_with_it_alone() -> None:
    held, held_sd, before = fitted(with_substeps(Cart(), 8))
    ramped, _, after = fitted(with_effect(with_substeps(Cart(), 8), "first_order_hold", 0.5))
    assert after > before + 100
    assert abs(held - MASS) > 5 * held_sd and abs(ramped - MASS) < 0.2 * abs(held - MASS)


def test_of_a_row_in_one_step_nothing_is_known_of_its_course() -> None:
    assert "first_order_hold" not in {one.name for one in catalogue(Cart())}
    with pytest.raises(UsageError, match="takes a row in one step"):
        with_effect(Cart(), "first_order_hold")


def test_exported_dynamics_remember_the_command_before() -> None:
    program = with_substeps(Cart(), 4)
    assert not Dynamics(program, ROW).remembers
    assert Dynamics(with_effect(program, "first_order_hold", 1.0), ROW).remembers


def test_a_run_and_a_file_that_have_it_are_read_again(tmp_path) -> None:
    source = (Path(__file__).parents[2] / "models" / "pendulum.py").read_text()
    (tmp_path / "pendulum.py").write_text(source)
    program = with_substeps(load_program(tmp_path / "pendulum.py"), 4)
    program = with_effect(program, "first_order_hold", 0.75)
    Fit(program, "hand", known_start=False).save(tmp_path / "run")
    again = Fit.load(tmp_path / "run").program
    assert again.substeps == 4 and again.first_order_hold.item() == 0.75
    write_program(program, tmp_path / "held.py")
    assert load_program(tmp_path / "held.py").first_order_hold.item() == 0.75
