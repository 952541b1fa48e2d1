"""What drives leave open of a program is said in words."""

from __future__ import annotations

import pytest
import torch
from examples import drives, example
from pyro.distributions import constraints
from pyro.nn import PyroParam

from steady_ppl import check
from steady_ppl.likelihood.maximize import maximise
from steady_ppl.likelihood.parameter_posterior import undetermined
from steady_ppl.model.problem import Problem
from steady_ppl.runs.fit import Fit

CART = type(example("linear_gaussian"))
PRODUCT = "these trajectories tell only the product of gain and torque, not each"


class Motor(CART):
    """The push is what a motor's torque and a gear's gain make of it."""

    def __init__(self):
        super().__init__()
        self.torque = PyroParam(torch.tensor(1.0), constraints.positive)

    def transition(self, state, control, time, step):
        return super().transition(state, self.torque * control, time, step)


class Quotient(Motor):
    def transition(self, state, control, time, step):
        return super().transition(state, control / self.torque**2, time, step)


class Sum(CART):
    """Two biases, one of which would do."""

    def __init__(self):
        super().__init__()
        self.wind, self.slope = (PyroParam(torch.tensor(0.0), constraints.real) for _ in range(2))

    def transition(self, state, control, time, step):
        return super().transition(state, control + (self.wind + self.slope), time, step)


class Idle(CART):
    """A number that does nothing."""

    def __init__(self):
        super().__init__()
        self.spare = PyroParam(torch.tensor(1.0), constraints.positive)


@pytest.mark.slow
@pytest.mark.parametrize("trajectories", [2, 12])
@pytest.mark.parametrize(
    ("program", "expected"),
    [
        (CART, []),
        (Motor, [PRODUCT]),
        (Quotient, ["these trajectories tell only the ratio of gain and torque, not each"]),
        (Sum, ["these trajectories tell wind and slope only together, not each"]),
        (Idle, ["these trajectories do not tell spare: many values are as likely"]),
    ],
)
def test_combinations_that_drives_do_not_tell_are_named(program, expected, trajectories):
    found = program().double()
    data = drives(found, trajectories, 120)
    maximum = maximise(Problem(found, data, True))
    assert undetermined(Problem(found, data, True), maximum.path) == expected


def test_check_says_it_on_other_drives():
    program = Motor()
    notes = check(Fit(program, "likelihood", {}, known_start=True), drives(program, 12, 60), simulations=20).notes
    assert PRODUCT in notes


def test_a_program_without_learnable_numbers_leaves_nothing_open():
    program = example("linear_gaussian")
    for parameter in program.parameters():
        parameter.requires_grad_(False)
    data = drives(program, 3, 30)
    assert undetermined(Problem(program, data, True), maximise(Problem(program, data, True)).path) == []
