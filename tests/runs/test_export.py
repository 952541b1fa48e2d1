"""Learned dynamics as a torch module: the program's own transition, for any shape, and good enough to steer by."""

from __future__ import annotations

import pytest
import torch
from examples import drives, example
from oracles import assert_mean

import steady_ppl as st
from steady_ppl.model.handlers import AtMean, running
from steady_ppl.model.substeps import acting_controls


def dynamics(name: str = "hovercraft.py:HovercraftTruth", **effects: float):
    program = example(name)
    for effect, value in effects.items():
        program = program.with_effect(effect, value)
    return program, st.Fit(program, "hand").dynamics()


def by_hand(program, state, controls) -> torch.Tensor:
    """One transition after another, without noise."""
    states, step = [], torch.tensor(program.step, dtype=torch.float64)
    for row, control in enumerate(controls):
        with running(), AtMean():
            state = program.transition(state, control, row * step, step)
        states.append(state)
    return torch.stack(states)


STATE = torch.tensor([1.0, -2.0, 0.4, 0.5, -0.1, 0.2], dtype=torch.float64)
PLAN = torch.linspace(-1, 1, 10, dtype=torch.float64).reshape(5, 2)


def test_it_is_the_programs_transition() -> None:
    program, model = dynamics()
    assert torch.equal(model(STATE, PLAN), by_hand(program, STATE, PLAN))


def test_any_shape_stands_on_the_left() -> None:
    _, model = dynamics()
    plans = PLAN[:, None, None].expand(5, 4, 3, 2)
    assert torch.allclose(model(STATE, plans), model(STATE, PLAN)[:, None, None].expand(5, 4, 3, 6))
    assert torch.allclose(model(STATE.expand(3, 6), PLAN[:, None]), model(STATE, PLAN)[:, None].expand(5, 3, 6))


def test_gradients_reach_states_controls_and_parameters() -> None:
    _, model = dynamics()
    state, plan = STATE.clone().requires_grad_(), PLAN.clone().requires_grad_()
    model(state, plan)[-1, :2].sum().backward()
    assert state.grad.abs().sum() > 0 and plan.grad.abs().sum() > 0
    assert dict(model.named_parameters())["program.mass_unconstrained"].grad.abs() > 0


def test_it_is_a_copy_and_a_module_like_any() -> None:
    program, model = dynamics()
    states = model(STATE, PLAN)
    with torch.no_grad():
        program.mass = torch.tensor(9.0).double()
    assert torch.equal(model(STATE, PLAN), states)
    other = st.Fit(program, "hand").dynamics()
    other.load_state_dict(model.state_dict())
    assert torch.equal(other(STATE, PLAN), states)
    assert model.float()(STATE.float(), PLAN.float()).dtype == torch.float32


def test_noise_is_drawn_on_request() -> None:
    program, model = dynamics()
    with st.seeded(1):
        states = model(STATE, PLAN[:1, None].expand(1, 4000, 2), noisy=True)[0]
    quiet = model(STATE, PLAN[:1])[0]
    spread = (states[:, 5] - quiet[5]) / program.step
    assert_mean(spread, 0.0)
    assert_mean(spread.square(), program.noise[2].item() ** 2)


@pytest.mark.parametrize("effect", ["actuator_delay", "actuator_lag"])
def test_commands_that_act_later_are_remembered(effect: str) -> None:
    """A plan cut in two, the first half given as past, leads where the whole does; and where a table's drive goes."""
    program, model = dynamics(**{effect: 0.15})
    nothing = PLAN[:0]
    whole = model(STATE, PLAN, past=nothing)
    assert torch.allclose(model(whole[1], PLAN[2:], past=PLAN[:2]), whole[2:])
    with pytest.raises(st.UsageError, match="give those before as `past`"):
        model(STATE, PLAN)
    data = drives(program, 1, 6)
    acting = acting_controls(program, data)
    assert torch.allclose(
        model(STATE, data.controls[:-1, 0], past=nothing), by_hand(program, STATE, acting[:-1, 0]), atol=1e-6
    )


def test_time_counts_from_the_start_of_the_drive() -> None:
    program, model = dynamics(battery_sag=0.5)
    data = drives(program, 1, 6)
    given = acting_controls(model.program, data)[:-1, 0]
    assert not torch.allclose(given, data.controls[:-1, 0])
    acting = by_hand(program, STATE, given)
    assert torch.allclose(model(STATE, data.controls[:-1, 0]), acting, atol=1e-6)
    late, early = (model(STATE, PLAN, time=time)[-1] for time in (9.0, 0.0))
    assert not torch.allclose(late, early)


@pytest.mark.parametrize(
    ("effect", "size", "remembers"),
    [
        ("actuator_delay", 0.15, True),
        ("actuator_delay", 0.0, False),
        ("actuator_lag", 0.3, True),
        ("battery_sag", 0.5, False),
        ("thrust_asymmetry", 0.2, False),
        ("dead_zone", 0.2, False),
        ("thrust_saturation", 0.2, False),
    ],
)
def test_only_what_acts_later_is_remembered(effect: str, size: float, remembers: bool) -> None:
    _, model = dynamics(**{effect: size})
    assert model.remembers is remembers
    if not remembers:
        assert torch.equal(model(STATE, PLAN), model(STATE, PLAN, past=PLAN[:0]))


@pytest.mark.parametrize("count", [2, 3])
def test_one_past_is_that_of_every_plan(count: int) -> None:
    """Also where there are as many plans as past commands."""
    _, model = dynamics(actuator_delay=0.15)
    plans = PLAN[2:, None] * torch.linspace(1, 2, count).double()[:, None]
    many = model(STATE, plans, past=PLAN[:2])
    for index in range(count):
        assert torch.allclose(many[:, index], model(STATE, plans[:, index], past=PLAN[:2]))
    states = STATE + torch.arange(count)[:, None]
    assert torch.allclose(model(states, PLAN[2:], past=PLAN[:2])[:, 1], model(states[1], PLAN[2:], past=PLAN[:2]))
    assert model(states, PLAN[:0], past=PLAN[:2]).shape == (0, count, 6)


def test_what_is_measured_on_average() -> None:
    program, model = dynamics()
    landmarks = torch.tensor(program.landmarks, dtype=torch.float64)
    angle = torch.atan2(landmarks[:, 1] + 2.0, landmarks[:, 0] - 1.0) - 0.4
    assert torch.allclose(model.measure(STATE), torch.atan2(angle.sin(), angle.cos()))
    assert model.measure(STATE.expand(4, 3, 6)).shape == (4, 3, 4)
    single = STATE.float().expand(50, 40, 6).clone().requires_grad_()
    seen = dynamics()[1].float().measure(single)
    (slope,) = torch.autograd.grad(seen.sum(), single)
    assert torch.allclose(seen.double(), model.measure(STATE), atol=1e-5) and float(slope.abs().max()) > 0


@pytest.mark.parametrize(
    ("state", "plan", "past", "said"),
    [
        (STATE[:5], PLAN, PLAN, r"expected \(\.\.\., 6\) for x, y, heading"),
        (STATE, PLAN[:, :1], PLAN, r"shape \(5, 1\), expected \(rows, \.\.\., 2\) for left, right"),
        (STATE, PLAN[0], PLAN, r"shape \(2,\), expected \(rows, \.\.\., 2\)"),
        (STATE, PLAN, PLAN[0], r"shape \(2,\), expected \(rows, \.\.\., 2\)"),
        (STATE.expand(3, 6), PLAN[:, None].expand(5, 2, 2), PLAN, r"shapes \(3, 6\), \(5, 2, 2\), \(5, 2\) do not go"),
    ],
)
def test_wrong_sizes_are_named(state, plan, past, said: str) -> None:
    _, model = dynamics()
    with pytest.raises(st.UsageError, match=said):
        model(state, plan, past=past)


def test_a_step_goes_forward() -> None:
    with pytest.raises(st.UsageError, match="step must be positive"):
        st.Fit(example("hovercraft"), "hand").dynamics(step=0.0)


@pytest.mark.slow
@torch.no_grad()
def test_a_controller_plans_with_it() -> None:
    """Model-predictive path integral control (Williams et al. 2017) brings the hovercraft to a goal, and it stays."""
    _, model = dynamics()
    goal, state, plan = torch.tensor([2.0, 1.0]).double(), torch.zeros(6).double(), torch.zeros(30, 2).double()
    with st.seeded(0):
        for _ in range(80):
            plans = plan[:, None] + torch.randn(30, 256, 2)
            ahead = model(state, plans)
            cost = (ahead[..., :2] - goal).square().sum((0, 2)) + 0.1 * ahead[..., 3:].square().sum((0, 2))
            plan = ((-cost / 0.3).softmax(0)[:, None] * plans).sum(1)
            state = model(state, plan[:1])[0]
            plan = plan.roll(-1, 0)
    assert (state[:2] - goal).norm() < 0.2 and state[3:5].norm() < 0.5
