"""What each effect of the catalogue does to a program, against its equation by hand."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pyro
import pytest
import torch
from examples import MODELS, drives, each_effect_once_slow, example, short
from pyro.infer import Trace_ELBO
from torch import Tensor

from steady_ppl import Joint, TruthGuide, channel_means, for_program, load_program, simulate
from steady_ppl.effects import attached, catalogue, chosen_variant
from steady_ppl.effects.catalogue.forces import _limited
from steady_ppl.likelihood.evidence import log_likelihood
from steady_ppl.model.handlers import Recording
from steady_ppl.model.validate import probe

PROGRAMS = ("hovercraft", "truck", "pendulum")
BY_ROLE = {  # of other programs what these cannot have
    "car": ("backlash", "steering_asymmetry", "steering_offset", "slope"),
    "two_wheels": ("wheel_radius_difference", "track_width", "gain_error"),
}
EFFECTS = [(program, effect.name) for program in PROGRAMS for effect in catalogue(example(program))]
EFFECTS += [(program, effect) for program, names in BY_ROLE.items() for effect in names]
every_effect = pytest.mark.parametrize(("name", "effect"), EFFECTS, ids=["-".join(pair) for pair in EFFECTS])
slow_on_one_program = pytest.mark.parametrize(("name", "effect"), each_effect_once_slow(EFFECTS))


def variants(program, effect: str):
    return chosen_variant(program, effect).effect.variants(program)


# --- each effect ------------------------------------------------------------------------------------------------------


@slow_on_one_program
def test_without_its_coefficient_the_effect_is_not_there(name: str, effect: str) -> None:
    """The same seed gives the same drives; tails come near the normal's as far as their cap lets them."""
    program = short(name)
    plain = simulate(program, 3, seed=1)
    for variant in variants(program, effect):
        absent = variant.absent(torch.zeros((), dtype=torch.float64))
        with_it = simulate(program.with_effect(variant, absent), 3, seed=1)
        exact = {"rtol": 0.0, "atol": 1e-12 if effect != "heavy_tails" else 0.05}
        torch.testing.assert_close(with_it.states[..., : len(program.states)], plain.states, **exact)
        torch.testing.assert_close(with_it.measurements, plain.measurements, **exact)


@slow_on_one_program
def test_with_its_typical_coefficient_the_effect_is_felt_by_a_sound_program(name: str, effect: str) -> None:
    program = short(name, rows=40)
    for variant in variants(program, effect)[:1]:
        with_it = program.with_effect(variant)
        probe(with_it)
        felt = simulate(with_it, 3, seed=1)
        assert torch.isfinite(felt.states).all()
        assert not torch.equal(felt.measurements, undisturbed(name)) or is_idle(program, variant)


@cache
def undisturbed(name: str) -> Tensor:
    return simulate(short(name, rows=40), 3, seed=1).measurements


def is_idle(program, variant) -> bool:
    """Whether the example drives never get to the knee or to the limit."""
    return variant.effect.name in ("thrust_saturation", "acceleration_limit")


@every_effect
def test_the_coefficient_has_a_finite_gradient_where_the_effect_is_absent(name: str, effect: str) -> None:
    program = short(name)
    for variant in variants(program, effect)[:2]:
        start = None if math.isinf(variant.effect.null) else variant.absent(torch.zeros((), dtype=torch.float64))
        with_it = program.with_effect(variant, start)
        data = drives(with_it, 2, 9)
        guide = TruthGuide(with_it)
        guide.refresh(data, 0.0)
        elbo = Trace_ELBO(max_plate_nesting=2)
        with pyro.settings.context(module_local_params=True), pyro.validation_enabled(False):
            elbo.differentiable_loss(Joint(with_it), guide, data).backward()
        for parameter, value in with_it.named_parameters():
            assert value.grad is not None and torch.isfinite(value.grad).all(), (variant.label, parameter)


STATE = torch.tensor([1.0, -2.0, 0.7, 0.8, 0.5, 0.3], dtype=torch.float64)  # x, y, heading, vx, vy, yaw rate
COS, SIN = math.cos(0.7), math.sin(0.7)
FORWARD, LATERAL = 0.8 * COS + 0.5 * SIN, 0.5 * COS - 0.8 * SIN  # 0.93, −0.13 m/s
THRUSTS = torch.tensor([0.9, 0.4], dtype=torch.float64)
STEP = torch.tensor(0.1, dtype=torch.float64)


def means(program, state=STATE, control=THRUSTS, time=3.0) -> torch.Tensor:
    """Mean accelerations at one state, with the controls as they act when held for ever."""
    clock = torch.tensor([[time], [time + 0.1]], dtype=torch.float64)
    control = program.actuators(control.expand(2, 1, -1), clock)[0, 0]
    found = channel_means(program, program.transition, state, control, clock[0, 0], STEP)
    return torch.stack([found[channel] for channel in program.channel_names]).detach()


def limited(value: float, most: float) -> float:
    return value / (1 + (value / most) ** 4) ** 0.25


@pytest.mark.parametrize(
    ("effect", "value", "pushes"),
    [
        ("linear_drag", 0.2, (-0.2 * FORWARD, -0.2 * LATERAL, 0)),
        ("quadratic_drag", 0.2, (-0.2 * FORWARD**2, 0.2 * LATERAL**2, 0)),
        (
            "coulomb_friction",
            0.2,
            (-0.2 * FORWARD / math.hypot(FORWARD, 0.05), -0.2 * LATERAL / math.hypot(LATERAL, 0.05), 0),
        ),
        ("yaw_linear_drag", 0.2, (0, 0, -0.2 * 0.3)),
        ("yaw_quadratic_drag", 0.2, (0, 0, -0.2 * 0.3**2)),
        ("yaw_bias", 0.2, (0, 0, 0.2)),
        ("acceleration_bias", (0.2, 0.1), (0.2, 0.1, 0)),
        ("slope", (0.2, 0.0), (0.2 * COS, -0.2 * SIN, 0)),
        ("slope", (0.0, 0.2), (0.2 * SIN, 0.2 * COS, 0)),
        ("lateral_coupling", 0.2, (0, 0.2 * 0.5, 0)),
        ("weathervane", 0.2, (0, 0, -0.2 * FORWARD * LATERAL)),
        ("magnus", 0.2, (0, -0.2 * FORWARD * 0.3, 0)),
        ("added_mass", 0.2, (0.2 * LATERAL * 0.3, 0, 0)),
        ("cross_flow", 0.2, (0, 0.2 * LATERAL**2, 0)),  # it slides to the right
        ("caster", 0.2, (0, 0, -0.2 * FORWARD * 0.3)),
        ("lever_arm", 0.2, (0.2 * 0.3**2, 0.2 * 0.5 / 1.5, 0)),  # a_yaw = −0.5 / 1.5
        ("side_slip:lead=0.5", 0.2, (0, -0.2 * (LATERAL - 0.5 * 0.3), 0)),
        (
            "sticky_patch:x=1:y=-3:radius=2",
            0.2,
            (-0.2 * FORWARD * math.exp(-1 / 8), -0.2 * LATERAL * math.exp(-1 / 8), 0),
        ),
        ("acceleration_limit", 0.5, (limited(1.3 / 1.5, 0.5) - 1.3 / 1.5, 0, 0)),
        ("acceleration_limit:yaw", 0.2, (0, 0, 0.5 / 1.5 - limited(0.5 / 1.5, 0.2))),
        ("thrust_asymmetry", 0.2, (0.2 * 0.4 / 1.5, 0, 0.2 * 0.4 / 1.5)),  # the right one pulls to the left
        (
            "speed_dependent_gain",
            0.2,
            (-0.2 * math.hypot(0.8, 0.5) * 1.3 / 1.5, 0, 0.2 * math.hypot(0.8, 0.5) * 0.5 / 1.5),
        ),
        ("thrust_saturation:knee=0.5", 0.2, (-0.2 * 0.4 / 1.5, 0, 0.2 * 0.4 / 1.5)),
        ("dead_zone", 0.2, (-0.4 / 1.5, 0, 0)),
        ("dead_zone", 0.5, (-0.9 / 1.5, 0, 0.1 / 1.5)),  # the right one does nothing, the left one 0.4
        ("battery_sag", 0.2, (-0.2 * 0.3 * 1.3 / 1.5, 0, 0.2 * 0.3 * 0.5 / 1.5)),  # after 3 of 10 s
        ("actuator_lag", 0.2, (0, 0, 0)),
        ("actuator_delay", 0.2, (0, 0, 0)),
    ],
)
def test_a_hovercraft_is_pushed_as_the_equation_says(effect: str, value, pushes: tuple[float, ...]) -> None:
    program = example("hovercraft")
    got = means(program.with_effect(effect, value)) - means(program)
    torch.testing.assert_close(got, torch.tensor(pushes, dtype=torch.float64), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("most", [1e-20, 1e-9, 0.5, 1e9, math.inf])
def test_a_limit_is_never_passed_and_has_a_slope_on_both_sides(most: float, side: float) -> None:
    value = torch.tensor(side * 1.3, requires_grad=True)
    c = torch.tensor(most, requires_grad=True)
    limited_to = _limited(value, c)
    limited_to.backward()
    found = limited_to.item()
    assert abs(found) <= most and found * side > 0
    expected = most if most < 1e-3 else 1.3 if most > 1e3 else limited(1.3, most)
    assert found == pytest.approx(side * expected, rel=1e-6)
    slopes = (0.0, side) if most < 1e-3 else (1.0, 0.0)
    if most != 0.5:
        assert [float(value.grad), float(c.grad)] == pytest.approx(slopes, abs=1e-6)


def test_where_nothing_is_asked_for_a_limit_takes_nothing() -> None:
    value = torch.zeros((), requires_grad=True)
    _limited(value, torch.tensor(0.5)).backward()
    assert float(value.grad) == 1


def test_a_wind_carries_what_is_at_rest_and_stops_when_it_moves_along() -> None:
    program = example("hovercraft").with_effect("wind:drag=0.1", (2.0, 0.0))
    still = STATE * torch.tensor([1, 1, 0, 0, 0, 0])
    idle = torch.zeros(2, dtype=torch.float64)
    torch.testing.assert_close(means(program, still, idle), torch.tensor([0.4, 0, 0]).double(), atol=1e-7, rtol=1e-6)
    carried = still + torch.tensor(
        [0, 0, 0, 2.0, 0, 0]
    )  # no drag where there is no wind past it: 0.1 · 2² is given back
    torch.testing.assert_close(means(program, carried, idle), torch.tensor([0.4, 0, 0]).double(), atol=1e-7, rtol=1e-6)


@pytest.mark.parametrize(
    ("effect", "value", "pushes"),
    [
        ("gain_error:turn", 0.2, (0, 0, 0.2 * 0.5 * 0.4 / 0.1)),
        ("gain_error:speed", -0.2, (-0.2 * 0.95 / 0.1, 0, 0)),
        ("lever_arm", 0.2, (0, 0.2 * 0.5 * 0.4 / 0.1, 0)),  # v_y goes to c · yaw rate, which goes to what it is told
        ("curvature_steering", 0.5, (0, 0, 0.5 * 0.5 * 0.4 * (0.95 * FORWARD / (0.95**2 + 0.05**2) - 1) / 0.1)),
        ("response_time", 0.3, (-0.75 * (0.95 - FORWARD) / 0.1, 0, 0)),  # in 0.1 + 0.3 s
        ("response_time:yaw", 0.1, (0, 0, -0.5 * (0.5 * 0.4 - 0.3) / 0.1)),
        ("response_time:lateral", 0.1, (0, 0.5 * LATERAL / 0.1, 0)),
        ("steering_offset", 0.2, (0, 0, 0.5 * 0.2 * FORWARD / 0.1)),
        ("understeer", 0.2, (0, 0, -0.5 * 0.2 * FORWARD**2 * 0.4 / 0.1)),
        ("reverse_steering", 0.2, (0, 0, -0.5 * 0.2 * math.tanh(FORWARD / 0.1) * 0.4 / 0.1)),
        ("crab_angle", 0.2, (0, 0.2 * 0.95 / 0.1, 0)),  # likewise
        ("slip_angle", 0.2, (0, -0.2 * (FORWARD * 0.5 * 0.4 + (0.95 - FORWARD) * 0.3) / 0.1, 0)),
        ("caster", 0.2, (0, 0, -0.2 * FORWARD * 0.3)),
        ("slope", (0.2, 0.1), (0.2 * COS + 0.1 * SIN, 0, 0)),  # its wheels hold it sideways
        ("steering_asymmetry", 0.2, (0, 0, 0.2 * 0.5 * 0.4 / 0.1)),
    ],
)
def test_a_truck_is_pushed_as_the_equation_says(effect: str, value: float, pushes: tuple[float, ...]) -> None:
    program, control = example("truck"), torch.tensor([0.95, 0.4], dtype=torch.float64)
    got = means(program.with_effect(effect, value), control=control) - means(program, control=control)
    torch.testing.assert_close(got, torch.tensor(pushes, dtype=torch.float64), rtol=1e-6, atol=1e-6)


def acting(effect: str, value: float, commands: list[list[float]], name: str, roles=None) -> list[list[float]]:
    """What a program with an effect makes of commands, a row each."""
    program = example(name)
    if roles:
        program.controls, program.roles = ("engine [N]", "helm [rad]"), roles
    given = torch.tensor(commands, dtype=torch.float64).unsqueeze(1)
    clock = 0.1 * torch.arange(len(commands), dtype=torch.float64).unsqueeze(1)
    program = program.with_effect(effect, value)
    with torch.no_grad():
        plain = program.actuators(given, clock)
    learned = program.actuators(given, clock).detach()  # by gradients it is the same
    torch.testing.assert_close(learned, plain, rtol=1e-12, atol=1e-12)
    return plain.squeeze(1).tolist()


@pytest.mark.parametrize(("name", "roles"), [("car", None), ("car", {"helm": "rudder"})])
def test_what_steers_is_loose_or_bends_to_one_side(name: str, roles) -> None:
    steering = np.array([0.2, 0.25, 0.4, 0.35, 0.1, 0.0, 0.05, -0.3, 0.3])
    commands = [[3.0, one] for one in steering.tolist()]
    pin, dragged = steering[0], []
    for told in steering:  # a pin that is dragged along in a gap of .1 on either side
        if abs(told - pin) > 0.1:
            pin = told - math.copysign(0.1, told - pin)
        dragged.append(pin)
    assert np.allclose(acting("backlash", 0.1, commands, name, roles), np.stack([np.full(9, 3.0), dragged], -1))
    assert acting("backlash", 0.0, commands, name, roles) == commands
    bent = np.stack([np.full(9, 3.0), steering + 0.2 * np.abs(steering)], -1)
    assert np.allclose(acting("steering_asymmetry", 0.2, commands, name, roles), bent)


def test_two_wheels_are_unlike_too_large_or_too_far_apart() -> None:
    wheels = np.array([[1.0, 1.4], [-0.5, 0.5]])
    speed, turn = wheels.mean(-1), (wheels[:, 1] - wheels[:, 0]) / 0.5
    for effect, expected in (
        ("wheel_radius_difference", wheels * [0.9, 1.1]),
        ("track_width", np.stack([speed - 0.25 * 1.2 * turn, speed + 0.25 * 1.2 * turn], -1)),
        ("gain_error:wheels", 1.2 * wheels),
        ("gain_error:starboard", wheels * [1.0, 1.2]),
    ):
        assert np.allclose(acting(effect, 0.2, wheels.tolist(), "two_wheels"), expected, rtol=1e-6), effect


def test_a_rudder_and_front_wheels_hang_askew_each_alone() -> None:
    program = example("car")
    program.controls = ("speed [m/s]", "steering [rad]", "rudder [rad]")
    variants = chosen_variant(program, "steering_offset").effect.variants(program)
    assert [(one.at, one.unit) for one in variants] == [("steering", "rad"), ("rudder", "rad")]
    control = torch.ones(3, dtype=torch.float64)
    moved = variants[1](program, STATE, control, STEP, c=torch.tensor(0.2, dtype=torch.float64))
    assert moved.tolist() == pytest.approx([1.0, 1.0, 1.2])


def test_a_spring_pulls_a_pendulum_back() -> None:
    program, state = example("pendulum"), torch.tensor([0.5, 0.2], dtype=torch.float64)
    for effect, push in (("stiffness", -2 * 0.5), ("cubic_stiffness", -2 * 0.5**3)):
        got = means(program.with_effect(effect, 2.0), state, THRUSTS[:1]) - means(program, state, THRUSTS[:1])
        torch.testing.assert_close(got, torch.tensor([push], dtype=torch.float64))
    assert attached(program.with_effect("stiffness"))[0].parameter == "stiffness_effect"  # it has a `stiffness`


def seen(program, state=STATE) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and standard deviation of what is measured."""
    recording = Recording()
    with recording:
        program.observe(state)
    fn = recording.distributions["bearing"].base_dist
    return fn.loc.detach(), fn.scale.detach()


def test_sensors_read_as_the_equations_say() -> None:
    program = example("hovercraft")
    reading, sd = seen(program)
    third = torch.tensor([0, 0, 1.0, 0], dtype=torch.float64)
    moved = STATE - 0.2 * torch.cat([STATE[3:], torch.zeros(3)])
    for effect, value, expected in (
        ("bearing_bias", 0.1, reading + 0.1),
        ("landmark_bias:2", 0.1, reading + 0.1 * third),
        ("sensor_scale", 0.1, 1.1 * torch.atan2(reading.sin(), reading.cos())),
        ("clock_offset", 0.2, seen(program, moved)[0]),
    ):
        got = seen(program.with_effect(effect, value))[0]
        assert torch.allclose(torch.cos(got - expected), torch.ones(4).double(), atol=1e-12), effect
    ranges = (torch.tensor(program.landmarks).double() - STATE[:2]).square().sum(-1).sqrt()
    torch.testing.assert_close(seen(program.with_effect("range_dependent_noise", 0.1))[1], sd * (1 + 0.1 * ranges))


def test_noise_is_as_wide_as_the_equations_say() -> None:
    def widths(program, control=THRUSTS):
        recording = Recording()
        with recording:
            program.transition(STATE, control, torch.zeros(()), STEP)
        return recording.distributions["acceleration"].stddev.detach()

    program, truck = example("hovercraft"), example("truck")
    for effect, factor in (("translation", (3, 3, 1)), ("yaw", (1, 1, 3))):
        got = widths(program.with_effect(f"process_noise:{effect}", 3.0)) / widths(program)
        torch.testing.assert_close(got, torch.tensor(factor, dtype=torch.float64), rtol=1e-6, atol=0)
    got = widths(truck.with_effect("command_noise", 2.0)) / widths(truck)
    factors = (1 + 2 * abs(0.9 - FORWARD), 1, 1 + 2 * abs(0.4 - 0.3))
    torch.testing.assert_close(got, torch.tensor(factors, dtype=torch.float64), rtol=1e-6, atol=0)


# --- coloured noise ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_coloured_noise_has_the_spread_and_the_memory_that_it_claims() -> None:
    """Stationary sd σ and lag-1 correlation c; 5 standard errors, drives being independent."""
    program = load_program(f"{MODELS / 'hovercraft.py'}:Hovercraft").double()
    share, rows, count = 0.8, 40, 1500
    coloured = program.with_effect("coloured_noise:yaw", share)
    coloured.duration = (rows - 1) * program.step
    deviation = simulate(coloured, count, seed=0).states[..., -1]
    assert (deviation[0] == 0).all()  # at rest before
    last, after = deviation[-2], deviation[-1]
    sd, z = 0.1, 5 / math.sqrt(count)
    growth = math.sqrt(1 - share ** (2 * (rows - 1)))
    assert abs(after.std() / (sd * growth) - 1) < z / math.sqrt(2)
    assert abs((last * after).mean() / (last * last).mean() - share) < z * math.sqrt(1 - share**2)
    plain = simulate(coloured, count, seed=0).states[-1, :, -3:-1]
    assert abs(plain.std() / 0.2 - 1) < z / 2  # the other channels' noise stays white and as wide


def test_coloured_noise_of_two_axes_starts_where_a_drive_is_known_to() -> None:
    program = short("hovercraft").with_effect("coloured_noise:translation", 0.5).with_effect("coloured_noise:yaw", 0.5)
    probe(program)
    assert len(set(program.state_names)) == 6 + 2 * 3
    table = simulate(example("hovercraft"), 2, seed=0)
    data = for_program(program, table)
    assert (data.known_start[:, 6:] == 0).all()
    density = log_likelihood(program, data, particles=50, known_start=True)
    assert torch.isfinite(density).all()
