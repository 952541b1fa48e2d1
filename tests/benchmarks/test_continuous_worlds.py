"""The continuous worlds solve their differential equations, and their benchmark counts right."""

import ast
import math
from dataclasses import replace
from pathlib import Path

import continuous_drives
import continuous_effects
import continuous_wheels
import continuous_worlds
import numpy as np
import pytest
import torch
from continuous import planted_jobs
from continuous_drives import integrate, simulate
from continuous_effects import PLANAR, Body, Planted, acting
from continuous_groups import GROUPS, user_program
from continuous_searches import sized
from continuous_tables import exact_interval, tables
from continuous_wheels import Car, TwoWheels
from continuous_worlds import Boat, Cart, Hovercraft, Pendulum, Unicycle, wrapped
from scipy.integrate import solve_ivp

from steady_ppl import for_program
from steady_ppl.effects import chosen_variant

WORLDS = (
    Hovercraft(),
    Hovercraft(driven="smooth", thrust=3.0),
    Boat(duration=4.0),
    Unicycle(),
    Car(),
    TwoWheels(),
    Cart(),
    Pendulum(),
)


def solved(rate, start, commands, step):
    """States at the rows by an adaptive solver, `(rows, D)`: one solution a row, its command held."""
    states = [np.asarray(start)]
    for told in commands[:-1]:
        found = solve_ivp(rate, (0, step), states[-1], args=tuple(told), rtol=1e-9, atol=1e-10)
        states.append(found.y[:, -1])
    return np.array(states)


def still(world):
    """The world without noise, three seconds long."""
    return replace(world, noise=(0.0,) * len(world.noise), duration=3.0)


# --- the equations are solved -----------------------------------------------------------------------------------------


def test_the_unicycle_agrees_with_an_adaptive_solver():
    def rate(time, state, speed, turn):
        _, _, heading, v, w = state
        return [v * math.cos(heading), v * math.sin(heading), w, (speed - v) / 0.3, (turn - w) / 0.2]

    drives = simulate(still(Unicycle()), 3, seed=1)
    for drive in range(3):
        first, commands = drives.states[0, drive].numpy(), drives.controls[:, drive].numpy()
        x, y, heading, v, w = solved(rate, [*first[:3], *commands[0]], commands, 0.1).T
        expected = np.stack([x, y, heading, v * np.cos(heading), v * np.sin(heading), w], -1)
        assert np.abs(drives.states[:, drive].numpy() - expected).max() < 1e-5


@pytest.mark.parametrize("driven", ["paper", "smooth"])
def test_the_hovercraft_agrees_with_an_adaptive_solver(driven):
    def rate(time, state, left, right):
        _, _, heading, vx, vy, yaw_rate = state
        push = (left + right) / 1.5
        return [vx, vy, yaw_rate, push * math.cos(heading), push * math.sin(heading), (right - left) / 1.5]

    drives = simulate(still(Hovercraft(driven=driven, thrust=2.0)), 3, seed=2)
    for drive in range(3):
        expected = solved(rate, drives.states[0, drive].numpy(), drives.controls[:, drive].numpy(), 0.1)
        assert np.abs(drives.states[:, drive].numpy() - expected).max() < 1e-5


def test_a_car_on_a_slope_agrees_with_an_adaptive_solver():
    def rate(time, state, speed, steering):
        _, _, heading, forward, yaw_rate = state
        told = forward * math.tan(steering + 0.1 * abs(steering)) / 2.8
        faster = (speed - forward) / 0.1 + 0.4 * math.cos(heading) - 0.3 * math.sin(heading)
        return [forward * math.cos(heading), forward * math.sin(heading), yaw_rate, faster, (told - yaw_rate) / 0.1]

    effects = (Planted("slope", (0.4, -0.3)), Planted("steering_asymmetry", (0.1,)))
    drives = simulate(replace(still(Car()), effects=effects), 2, seed=1)
    for drive in range(2):
        x, y, heading, vx, vy, yaw_rate = drives.states[0, drive].numpy()
        start = [x, y, heading, vx * math.cos(heading) + vy * math.sin(heading), yaw_rate]
        expected = solved(rate, start, drives.controls[:, drive].numpy(), 0.1)
        assert np.abs(drives.states[:, drive, :3].numpy() - expected[:, :3]).max() < 1e-4


def test_commands_of_wheels_and_steering_act_as_planted():
    wheels = np.array([[[1.0, 1.4]], [[-0.5, 0.5]]])
    for name, expected in (
        ("wheel_radius_difference", wheels * [0.9, 1.1]),
        ("track_width", [[[0.96, 1.44]], [[-0.6, 0.6]]]),
        ("gain_error:wheels", 1.2 * wheels),
    ):
        assert np.allclose(acting(wheels, 0.1, 0.1, (Planted(name, (0.2,)),)), expected), name
    steering = np.stack([np.ones(4), [0.2, 0.25, 0.5, 0.3]], -1)[:, None]
    dragged = acting(steering, 0.1, 0.1, (Planted("backlash", (0.1,)),))
    assert np.allclose(dragged[:, 0], np.stack([np.ones(4), [0.2, 0.2, 0.4, 0.4]], -1))


def test_drag_and_slip_of_the_boat_agree_with_an_adaptive_solver():
    def rate(time, state, left, right):
        _, _, heading, vx, vy, yaw_rate = state
        cos, sin = math.cos(heading), math.sin(heading)
        forward, lateral = cos * vx + sin * vy, cos * vy - sin * vx
        along = (left + right) / 20 - 0.15 * forward * abs(forward)
        across = -0.15 * lateral * abs(lateral) - 1.0 * (lateral - 0.2 * yaw_rate)
        turned = 0.05 * (right - left) - 0.6 * yaw_rate
        return [vx, vy, yaw_rate, cos * along - sin * across, sin * along + cos * across, turned]

    effects = (Planted("quadratic_drag", (0.15,)), Planted("side_slip", (1.0,), {"lead": 0.2}))
    world = replace(still(Boat()), effects=(*effects, Planted("yaw_linear_drag", (0.6,))))
    drives = simulate(world, 2, seed=3)
    for drive in range(2):
        expected = solved(rate, drives.states[0, drive].numpy(), drives.controls[:, drive].numpy(), 0.1)
        assert np.abs(drives.states[:, drive].numpy() - expected).max() < 1e-5


def test_a_cart_with_quadratic_drag_coasts_as_the_analytic_solution():
    drag, time = 0.4, 0.1 * np.arange(31)
    world = replace(still(Cart()), damping=0.0, effects=(Planted("quadratic_drag", (drag,)),))
    start = np.array([[0.5, -1.0], [2.0, 1.0]])
    path = integrate(world, start, np.zeros((31, 2, 1)), np.zeros((31, 1, 2)))[::100][:31]
    slower = 1 + drag * start[1] * time[:, None]
    assert np.allclose(path[:, 1], start[1] / slower, atol=1e-7)
    assert np.allclose(path[:, 0], start[0] + np.log(slower) / drag, atol=1e-7)


def test_a_cart_on_a_spring_swings_as_a_cosine():
    world = replace(still(Cart()), damping=0.0, effects=(Planted("stiffness", (4.0,)),))
    path = integrate(world, np.array([[1.0], [0.0]]), np.zeros((31, 1, 1)), np.zeros((31, 1, 1)))[::100][:31]
    assert np.allclose(path[:, 0, 0], np.cos(2 * 0.1 * np.arange(31)), atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS, ids=lambda world: type(world).__name__)
def test_half_the_integration_step_changes_little(world):
    world = replace(world, duration=3.0)
    one, other = (simulate(world, 2, seed=4, fine=fine) for fine in (0.001, 0.0005))
    assert torch.equal(one.controls, other.controls)
    assert float((one.states - other.states).abs().max()) < 1e-5
    assert float((one.measurements - other.measurements).abs().max()) < 1e-4


def test_a_row_is_a_whole_number_of_integration_steps():
    with pytest.raises(ValueError, match="whole number"):
        simulate(Cart(duration=1.0), 2, seed=1, fine=0.003)


def test_commands_and_noise_are_held_over_a_row():
    world = replace(Cart(), damping=0.0, duration=1.0)
    random = np.random.default_rng(0)
    noise = random.standard_normal((11, 1, 2))
    path = integrate(world, np.zeros((2, 2)), random.standard_normal((11, 2, 1)), noise)
    acceleration = np.diff(path[:, 1], axis=0).reshape(11, 100, 2)
    assert np.allclose(acceleration, acceleration[:, :1], atol=1e-12)
    assert np.abs(np.diff(acceleration[:, 0], axis=0)).min() > 1e-6


# --- actuators and clocks ---------------------------------------------------------------------------------------------


def test_a_delay_acts_inside_a_row():
    commands = np.array([1.0, 3.0, 3.0])[:, None, None]
    found = acting(commands, 0.1, 0.01, [Planted("actuator_delay", (0.125,))])[:, 0, 0]
    assert np.allclose(found[:22], 1.0) and np.allclose(found[23:], 3.0)
    assert found[22] == pytest.approx(2.0)  # it arrives in the middle of this step


def test_a_lag_builds_up_exponentially():
    commands = np.array([0.0, 1.0, 1.0, 1.0])[:, None, None]
    found = acting(commands, 0.1, 0.001, [Planted("actuator_lag", (0.07,))])[:, 0, 0]
    since = 0.001 * (np.arange(300) + 0.5)
    assert np.allclose(found[:100], 0.0)
    assert np.allclose(found[100:], 1 - np.exp(-since / 0.07), atol=1e-4)


@pytest.mark.parametrize("offset", [0.234, -0.234])
def test_a_clock_offset_shows_the_states_of_another_time(offset):
    world = Cart(duration=3.0, sd=0.0, step=0.001)  # logged at every integration step
    shown = simulate(replace(world, effects=(Planted("clock_offset", (offset,)),)), 2, seed=5)
    truth, rows = simulate(world, 2, seed=5), 234
    assert torch.equal(shown.states, truth.states)
    ahead, behind = slice(rows, None), slice(None, -rows)
    seen, true = (ahead, behind) if offset > 0 else (behind, ahead)
    assert torch.allclose(shown.measurements[seen], truth.states[true, :, :1], atol=1e-9)


def test_planted_effects_change_no_draw():
    world = Hovercraft(duration=2.0)
    one = simulate(world, 3, seed=6)
    other = simulate(replace(world, effects=(Planted("bearing_bias", (0.1,)), Planted("slope", (0.1, 0.0)))), 3, seed=6)
    assert torch.equal(one.controls, other.controls) and torch.equal(one.states[0], other.states[0])
    shift = wrapped((other.measurements[0] - one.measurements[0]).numpy())
    assert np.allclose(shift, 0.1)


def test_a_world_refuses_an_effect_that_it_has_not():
    with pytest.raises(ValueError, match="Cart has no magnus"):
        Cart(effects=(Planted("magnus", (0.1,)),))


# --- the worlds against the catalogue and the programs ----------------------------------------------------------------


def test_the_worlds_take_nothing_but_the_table_from_the_engine():
    modules = (continuous_drives, continuous_effects, continuous_wheels, continuous_worlds)
    for module in modules:
        allowed = ["Trajectories"] if module is continuous_drives else []
        tree = ast.parse(Path(module.__file__).read_text())
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        taken = [node for node in imports if "steady" in (node.module or "")]
        assert [alias.name for node in taken for alias in node.names] == allowed


@pytest.mark.parametrize("name", PLANAR)
def test_planar_forces_are_those_of_the_catalogue(name):
    program = user_program(GROUPS["hovercraft paper x1 known"])
    variant = chosen_variant(program, name)
    value = (0.7, -0.4)[: max(1, len(variant.effect.components))]
    state, control = torch.randn(5, 6), torch.randn(5, 2)
    body = Body(
        *(one.numpy() for one in program.body_velocity(state)),
        *(one.numpy() for one in (state[:, 2].cos(), state[:, 2].sin(), *control.unbind(-1))),
    )
    planted = Planted(name, value, dict(variant.profiled))
    ours = PLANAR[name](body, planted.size, planted.options)
    c = torch.tensor(value).squeeze()
    options = {key: one for key, one in variant.options.items() if key not in ("at", "scale")}
    theirs = variant.effect.function(program, state, control, 0.0, 0.1, c=c, **options)
    for channel, pushed in zip(("forward", "lateral", "yaw"), ours, strict=True):
        assert np.allclose(pushed, np.asarray(theirs.get(channel, 0.0)), atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", GROUPS)
def test_every_program_reads_the_drives_of_its_world(name):
    group = GROUPS[name]
    drives = simulate(replace(group.world, duration=1.0), 3, seed=7)
    assert drives.states.dtype == drives.measurements.dtype == torch.float64
    read = for_program(user_program(group), drives)
    assert read.measurements.shape == (round(1 / group.world.step) + 1, 3, len(group.world.measurements))
    assert read.known_start.shape == (3, len(group.world.states))
    assert drives.median_step == pytest.approx(user_program(group).step)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, group in GROUPS.items() if group.effects])
def test_every_effect_of_a_group_is_in_the_catalogue_and_in_the_world(name):
    group = GROUPS[name]
    for effect in group.effects:
        variant = chosen_variant(user_program(group, effect), effect)
        components = max(1, len(variant.effect.components))
        options = {"drag": 0.06} if effect == "wind" else {}
        planted = Planted(effect, (0.05,) * components, options)
        assert variant.name == effect
        seconds = 4.0 if effect == "backlash" else 1.0  # play is felt when a command turns back
        plain = simulate(replace(group.world, duration=seconds), 2, seed=8)
        moved = simulate(replace(group.world, duration=seconds, effects=(planted,)), 2, seed=8)
        assert not torch.equal(plain.measurements, moved.measurements)


# --- sizes and figures ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "total", "low", "high"),
    [(0, 20, 0, 0.16843), (1, 20, 0.00127, 0.24873), (5, 100, 0.01643, 0.11283), (10, 10, 0.69150, 1)],
)
def test_shares_have_the_exact_interval(count, total, low, high):
    assert exact_interval(count, total) == pytest.approx((low, high), abs=1e-5)


def test_sizes_are_multiples_of_the_limit():
    limit = {"limit": [0.02], "options": {"lead": 0.5}, "sign": 1, "most": 5.0}
    assert sized("side_slip", limit, 3.0, "a") == Planted("side_slip", (0.06,), {"lead": 0.5})
    assert sized("side_slip", {**limit, "most": 0.05}, 3.0, "a").value == (0.05,)
    signs = {math.copysign(1, sized("magnus", {**limit, "sign": 0}, 2.0, str(i)).value[0]) for i in range(20)}
    assert signs == {-1.0, 1.0}
    vector = sized("slope", {**limit, "limit": [0.02, 0.04], "sign": 0}, 2.0, "a")
    assert np.linalg.norm(np.array(vector.value) / [0.02, 0.04]) == pytest.approx(2.0, rel=1e-3)


def test_jobs_have_names_of_their_own_and_given_sizes():
    limit = {"limit": [0.02], "options": {}, "sign": 1, "most": 5.0}
    limits = {"boat": {"yaw_linear_drag": limit, "side_slip": limit}}
    jobs = planted_jobs([GROUPS["boat"]], 3, limits, {})
    assert len(jobs) == 2 * 2 * 3  # the quadratic drag has no limit
    (name, group, index, planted), *rest = planted_jobs([GROUPS["boat"]], 1, {}, {"side_slip": (1.0,)}).values()
    assert (name, group, index, planted.value) == ("boat side_slip =1 1", "boat", 1, (1.0,)) and not rest


def test_tables_count_alarms_truths_and_intervals():
    common = {"substeps": 1, "seconds": 3.0, "p_value": 0.4, "version": "v", "set": "s"}
    quiet = {**common, "group": "cart", "verdict": "none", "effect": None, "class": [], "found": []}
    loud = {**quiet, "verdict": "dynamics", "effect": "stiffness", "class": ["stiffness", "cubic_stiffness"]}
    found = {"effect": "stiffness", "interval_90": [[0.1, 0.3]]}
    right = {**loud, "found": [found], "planted": {"effect": "stiffness", "value": [0.2]}}
    second = {**loud, "found": [found], "planted": {"effect": "cubic_stiffness", "value": [0.2]}}
    text = tables([quiet, loud], [right, second])
    assert "| cart | 1 of 2: 50.0% [1.3%, 98.7%] | yes | stiffness 1 | 1 2 |" in text
    assert "| all | 2 of 2: 100.0% [15.8%, 100.0%] | 1 of 2: 50.0% [1.3%, 98.7%] | 1 of 1: 100.0%" in text
