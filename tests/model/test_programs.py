"""Conformance of every shipped program, and their equations against independent ones in numpy."""

from __future__ import annotations

import ast
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyro
import pytest
import torch
from examples import MODELS, drives, example
from pyro.infer import Trace_ELBO
from scipy.integrate import solve_ivp
from small import HOVERCRAFT, TRUTH, only_start, simulated, steady, written

from steady_ppl import ExplicitEuler, Joint, SteadyError, TruthGuide, dense, for_program, load_program, simulate, stack
from steady_ppl.guides.base import true_paths
from steady_ppl.model.handlers import Recording, Replaying
from steady_ppl.model.program import names
from steady_ppl.model.substeps import acting_controls, sample_row
from steady_ppl.model.validate import probe

ABSTRACT = {"NeuralVehicle"}
PROGRAMS = [
    f"{file.name}:{node.name}"
    for file in sorted(MODELS.glob("*.py"))
    for node in ast.parse(file.read_text()).body
    if isinstance(node, ast.ClassDef) and node.name not in ABSTRACT
]
every_program = pytest.mark.parametrize("name", PROGRAMS)


def test_the_programs_are_those_of_the_paper_and_two_of_other_systems() -> None:
    expected = {
        "Hovercraft",
        "HovercraftTruth",
        "LinearGaussian",
        "NeuralHovercraft",
        "NeuralTruck",
        "PaperHovercraft",
        "PaperHovercraftTruth",
        "PaperNeuralHovercraft",
        "PaperNeuralTruck",
        "PaperTruck",
        "Pendulum",
        "Truck",
    }
    assert expected <= {name.partition(":")[2] for name in PROGRAMS}


# --- conformance ------------------------------------------------------------------------------------------------------


@every_program
def test_the_program_is_well_formed(name: str) -> None:
    program = load_program(MODELS / name)
    probe(program)
    assert set(program.angles) <= set(program.state_names)
    named = [component for group in program.error_groups.values() for component in group]
    assert sorted(named) == sorted(program.state_names) or not program.error_groups


@every_program
def test_simulated_drives_are_finite_and_have_the_declared_columns(name: str) -> None:
    program = example(name)
    program.duration = 2.0
    data = simulate(program, 5, seed=1)
    assert data.time.shape == (round(2.0 / program.step) + 1, 5) and data.observed.all()
    for values, columns, declared in (
        (data.states, data.state_names, program.states),
        (data.controls, data.control_names, program.controls),
        (data.measurements, data.measurement_names, program.measurements),
    ):
        assert torch.isfinite(values).all() and columns == names(declared)
        assert values.shape == (*data.time.shape, len(declared))
        assert len(values) == 0 or values.std() > 0 or not values.any()
    assert not torch.equal(data.states[0, 0], data.states[0, 1])  # the drives start apart


@every_program
def test_step_after_step_is_the_same_as_all_steps_at_once(name: str) -> None:
    """Given the channel noise, the sequential run and the one over all rows give equal states and densities."""
    program = stirred(example(name))
    data = drives(program, 3, 8, gaps=True)
    paths = true_paths(program, data)
    states = torch.where(data.rows[..., None], data.states, data.states[:1])
    noise = {site: value[0] for site, value in paths.noise.items()}
    controls = acting_controls(program, data)

    def move(rows: slice) -> tuple[torch.Tensor, torch.Tensor]:
        recording = Recording()
        with recording, Replaying({site: value[rows] for site, value in noise.items()}):
            after = sample_row(
                program, states[:-1][rows], controls[:-1][rows], data.elapsed[:-1][rows], data.steps[rows]
            )
        density = sum(recording.distributions[site].log_prob(value[rows]) for site, value in noise.items())
        return after, density

    together, density = move(slice(None))
    one_by_one = [move(slice(row, row + 1)) for row in range(len(data.steps))]
    close = {"rtol": 1e-12, "atol": 1e-12}  # double precision
    torch.testing.assert_close(torch.cat([after for after, _ in one_by_one]), together, **close)
    torch.testing.assert_close(torch.cat([part for _, part in one_by_one]), density, **close)
    torch.testing.assert_close(together[data.transitions], states[1:][data.transitions], rtol=1e-9, atol=1e-9)


def stirred(program):
    """The program with its parameters a little off: a network's heads no longer zero, so that all gradients show."""
    with torch.no_grad():
        for parameter in program.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return program


@every_program
def test_every_parameter_has_a_finite_gradient_that_is_not_zero(name: str) -> None:
    program = stirred(example(name))
    data = drives(program, 4, 12)
    guide = TruthGuide(program)
    guide.refresh(data, 0.0)
    elbo = Trace_ELBO(max_plate_nesting=2)
    with pyro.settings.context(module_local_params=True), pyro.validation_enabled(False):
        elbo.differentiable_loss(Joint(program), guide, data).backward()
    gradients = {parameter: value.grad for parameter, value in program.named_parameters()}
    for parameter, gradient in gradients.items():
        assert gradient is not None and torch.isfinite(gradient).all(), parameter
        assert gradient.abs().max() > 0, parameter


@every_program
def test_single_and_double_precision_agree(name: str) -> None:
    data, moved, drawn = drives(example(name), 2, 6), [], Recording()
    for dtype in (torch.float64, torch.float32):
        program = example(name, dtype)
        part = for_program(program, data)
        given = Replaying({site: value.to(dtype) for site, value in drawn.values.items()})
        with given, drawn:
            moved.append(program.transition(part.states[:-1], part.controls[:-1], part.elapsed[:-1], part.steps))
    assert [after.dtype for after in moved] == [torch.float64, torch.float32]
    torch.testing.assert_close(moved[1].double(), moved[0], rtol=1e-5, atol=1e-5)  # single precision


def test_to_swap_programs_is_to_name_another_file(tmp_path: Path) -> None:
    table = written(tmp_path / "t.csv")
    few = ("--steps", 1, "--particles", 10, "--draws", 2)
    swaps = (HOVERCRAFT, TRUTH, f"{MODELS / 'neural_vehicle.py'}:NeuralHovercraft")
    for number, program in enumerate(swaps):
        assert steady("fit", program, table, *few, "--out", tmp_path / str(number)) == 0


@pytest.mark.parametrize("name", ["linear_gaussian.py", "pendulum.py", "truck.py"])
def test_the_same_commands_serve_every_system(tmp_path: Path, name: str) -> None:
    program, table, run = MODELS / name, tmp_path / "t.csv", tmp_path / "run"
    like = written(tmp_path / "like.csv", simulated(name, trajectories=2, rows=12))
    assert steady("simulate", program, "--controls", like, "--seed", 1, "--out", table) == 0
    assert steady("fit", program, table, "--steps", 2, "--particles", 20, "--draws", 2, "--out", run) == 0
    assert steady("evaluate", run, table, "--particles", 50, "--rollouts", 3) == 0


# --- the hovercraft ---------------------------------------------------------------------------------------------------


def some_states(count: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """States, controls, accelerations and steps of no drive in particular."""
    random = np.random.default_rng(0)
    states = random.normal(size=(count, 6)) * [5, 5, 3, 1, 1, 1]
    return states, random.uniform(0, 1.5, (count, 2)), random.normal(size=(count, 3)), random.uniform(0.05, 0.2, count)


def by_hand(states: np.ndarray, acceleration: np.ndarray, step: np.ndarray) -> np.ndarray:
    """One step of second order: pushed along the heading in its middle, moved by the mean of old and new velocity."""
    place, heading, velocity, w = (
        states[:, 0] + 1j * states[:, 1],
        states[:, 2],
        states[:, 3] + 1j * states[:, 4],
        states.T[5],
    )
    forward, lateral, yaw = acceleration.T
    turn = w * step + yaw * step**2 / 2
    faster = velocity + np.exp(1j * (heading + turn / 2)) * (forward + 1j * lateral) * step / (1 + turn**2 / 24)
    there = place + (velocity + faster) / 2 * step
    return np.stack([there.real, there.imag, heading + turn, faster.real, faster.imag, w + yaw * step], -1)


def by_euler(states: np.ndarray, acceleration: np.ndarray, step: np.ndarray) -> np.ndarray:
    """One explicit Euler step of section 1 of the facts, with old values on the right."""
    x, y, heading, vx, vy, w = states.T
    forward, lateral, yaw = acceleration.T
    turned = np.exp(1j * heading) * (forward + 1j * lateral)
    moved = [x + vx * step, y + vy * step, heading + w * step, vx + turned.real * step, vy + turned.imag * step]
    return np.stack([*moved, w + yaw * step], -1)


def stepped(program):
    """The step that a program takes, by hand."""
    return by_euler if isinstance(program, ExplicitEuler) else by_hand


def run_once(program, states, controls, acceleration, step) -> tuple[np.ndarray, torch.distributions.Distribution]:
    recording = Recording()
    given = [torch.from_numpy(values) for values in (states, controls, step, step)]
    with recording, Replaying({"acceleration": torch.from_numpy(acceleration)}):
        after = program.transition(*given)
    return after.detach().numpy(), recording.distributions["acceleration"]


def in_continuous_time(states: np.ndarray, acceleration: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Where vehicles are after a row in which their acceleration is held in the body frame."""

    def motion(_, state, forward, lateral, yaw):
        pushed = np.exp(1j * state[2]) * (forward + 1j * lateral)
        return [*state[3:5], state[5], pushed.real, pushed.imag, yaw]

    rows = zip(states, acceleration, step, strict=True)
    ends = [solve_ivp(motion, (0, row), at, args=held, rtol=1e-12, atol=1e-12).y[:, -1] for at, held, row in rows]
    return np.stack(ends)


def test_a_vehicles_step_comes_near_continuous_time_by_its_third_power() -> None:
    states, controls, acceleration, step = some_states()
    vehicle, paper = example("hovercraft"), example("paper.py:PaperHovercraft")
    off = {}
    for name, program in (("vehicle", vehicle), ("paper", paper)):
        for part in (1, 2, 4):
            after, _ = run_once(program, states, controls, acceleration, step / part)
            off[name, part] = abs(after - in_continuous_time(states, acceleration, step / part))[:, :5].max()
    # halved, an error of the third power is an eighth: a step of second order; Euler's is a quarter
    assert 6 < off["vehicle", 1] / off["vehicle", 2] < 10 and 6 < off["vehicle", 2] / off["vehicle", 4] < 10
    assert 3 < off["paper", 1] / off["paper", 2] < 5
    assert off["vehicle", 1] < 0.05 * off["paper", 1]


def test_a_vehicle_that_does_not_turn_moves_exactly() -> None:
    states, controls, acceleration, step = some_states()
    states[:, 5] = acceleration[:, 2] = 0.0
    after, _ = run_once(example("hovercraft"), states, controls, acceleration, step)
    np.testing.assert_allclose(after, in_continuous_time(states, acceleration, step), rtol=1e-9, atol=1e-9)


def dragged(states: np.ndarray, controls: np.ndarray) -> np.ndarray:
    """Mean accelerations of the simulated hovercraft, from the velocities of these states."""
    body = np.exp(-1j * states[:, 2]) * (states[:, 3] + 1j * states[:, 4])
    left, right = controls.T
    mean = [
        (left + right - 0.015 * body.real * abs(body.real)) / 1.5,
        -0.03 * body.imag * abs(body.imag) / 1.5,
        (right - left - 0.07 * states[:, 5]) / 1.5,
    ]
    return np.stack(mean, -1)


SINGLE = {"rtol": 1e-6}  # the constants come from single precision


def test_the_simulated_hovercraft_moves_as_the_paper_says() -> None:
    states, controls, acceleration, step = some_states()
    after, noise = run_once(example("paper.py:PaperHovercraftTruth"), states, controls, acceleration, step)
    np.testing.assert_allclose(after, by_euler(states, acceleration, step), rtol=1e-12)
    np.testing.assert_allclose(noise.mean.detach(), dragged(states, controls), **SINGLE, atol=1e-7)
    np.testing.assert_allclose(noise.stddev.detach(), np.tile([0.08, 0.08, 0.05], (len(states), 1)), **SINGLE)


def test_the_hovercraft_with_drag_is_slowed_by_its_velocity_in_the_middle_of_a_step() -> None:
    states, controls, acceleration, step = some_states()
    after, noise = run_once(load_program(TRUTH).double(), states, controls, acceleration, step)
    np.testing.assert_allclose(after, by_hand(states, acceleration, step), rtol=1e-12)
    left, right = controls.T
    thrust = np.stack([(left + right) / 1.5, 0 * left, (right - left) / 1.5], -1)
    halfway = by_hand(states, thrust, step / 2)
    np.testing.assert_allclose(noise.mean.detach(), dragged(halfway, controls), **SINGLE, atol=1e-7)
    np.testing.assert_allclose(noise.stddev.detach(), np.tile([0.08, 0.08, 0.05], (len(states), 1)), **SINGLE)


@pytest.mark.parametrize("name", ["hovercraft", "paper.py:PaperHovercraft"])
def test_the_owners_hovercraft_is_the_same_without_drag(name: str) -> None:
    states, controls, acceleration, step = some_states()
    program = example(name)
    after, noise = run_once(program, states, controls, acceleration, step)
    np.testing.assert_allclose(after, stepped(program)(states, acceleration, step), rtol=1e-12)
    left, right = controls.T
    mean = np.stack([(left + right) / 1.5, 0 * left, (right - left) / 1.5], -1)
    np.testing.assert_allclose(noise.mean.detach(), mean, rtol=1e-6)
    np.testing.assert_allclose(noise.stddev.detach(), np.tile([0.2, 0.2, 0.1], (len(states), 1)), rtol=1e-6)


def test_the_hovercraft_sees_bearings_to_its_landmarks() -> None:
    program = load_program(TRUTH).double()
    states = some_states()[0]
    recording = Recording()
    with recording:
        program.observe(torch.from_numpy(states))
    seen = recording.distributions["bearing"]
    to = np.array([12 - 8j, -6 - 4j, -4 + 10j, 6 + 7j]) - (states[:, :1] + 1j * states[:, 1:2])
    np.testing.assert_allclose(np.exp(1j * seen.mean.detach().numpy()), np.exp(1j * (np.angle(to) - states[:, 2:3])))
    np.testing.assert_allclose(seen.stddev.detach(), np.full(to.shape, math.radians(5)))
    assert recording.values["bearing"].abs().max() <= math.pi


def test_a_vehicle_may_see_fewer_landmarks_and_worse() -> None:
    program = load_program(TRUTH).double()
    program.landmarks, program.bearing_sd = program.landmarks[:2], math.radians(20)
    recording = Recording()
    with recording:
        program.observe(torch.from_numpy(some_states()[0]))
    stddev = recording.distributions["bearing"].stddev.detach()
    np.testing.assert_allclose(stddev, np.full((len(stddev), 2), math.radians(20)))
    assert program.measurement_names == ("bearing_0", "bearing_1")


def test_the_hovercraft_starts_as_in_the_paper() -> None:
    program = load_program(TRUTH).double()
    recording = Recording()
    with recording:
        program.initial()
    start = recording.distributions["start"]
    mean = [0.5, 1.0, math.pi / 5, 0.25, 0.1, math.pi / 50]
    np.testing.assert_allclose(start.mean, mean, rtol=1e-6)
    np.testing.assert_allclose(start.stddev, [2, 2, math.pi, 0.3, 0.2, 0.1 * math.pi], rtol=1e-6)


AT = [0.0, 0.5, 2.0, 3.0, 5.0, 6.0, 9.0, 10.0, 12.0, 15.0]
LEFT = np.array([0, 1, 0, 0.7, 1.1, 0, 0.4, 0, 0, 0])
RIGHT = np.array([0, 0.4, 0, 0.5, 0.5, 0, 1, 0.5, 0, 0])
LEFT_SD = 0.5 * np.array([0, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0])
RIGHT_SD = 0.5 * np.array([0, 0.1, 0.1, 0.1, 0.1, 0.1, 0.2, 0.2, 0.1, 0])
DRIVES, SIGMAS = 20_000, 5


def thrusts(time: list[float]) -> np.ndarray:
    """Example controls of many drives, `(times, drives, 2)`."""
    torch.manual_seed(1)
    times = torch.tensor(time, dtype=torch.float64)[:, None].expand(-1, DRIVES)
    return example("hovercraft").example_controls(times).numpy()


def test_thrusts_go_through_the_papers_way_points_and_swap_in_three_drives_of_five() -> None:
    at = thrusts(AT)
    swapped = at[4, :, 0] < at[4, :, 1]  # 1.1 ± 0.1 against 0.5 ± 0.05: told apart without doubt
    assert abs(swapped.mean() - 0.6) < SIGMAS * math.sqrt(0.6 * 0.4 / DRIVES)
    at[:, swapped] = at[:, swapped, ::-1]
    for side, mean, sd in ((at[..., 0], LEFT, LEFT_SD), (at[..., 1], RIGHT, RIGHT_SD)):
        np.testing.assert_array_less(abs(side.mean(1) - mean), SIGMAS * sd / math.sqrt(DRIVES) + 1e-12)
        np.testing.assert_array_less(abs(side.std(1) - sd), SIGMAS * sd / math.sqrt(2 * DRIVES) + 1e-12)
    inner = at[1:-1].transpose(0, 2, 1).reshape(16, DRIVES)
    np.testing.assert_array_less(abs(np.corrcoef(inner) - np.eye(16)), SIGMAS / math.sqrt(DRIVES))


def test_thrusts_are_straight_between_way_points_and_zero_after_the_last() -> None:
    ends, middle = thrusts(AT), thrusts([(a + b) / 2 for a, b in pairwise(AT)])
    np.testing.assert_allclose(middle, (ends[:-1] + ends[1:]) / 2, atol=1e-12)
    assert not thrusts([15.0, 20.0]).any()


# --- the truck --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["truck", "paper.py:PaperTruck"])
def test_the_truck_reaches_its_command_as_far_as_the_limit_lets_it(name: str) -> None:
    """The paper's within one step and without the turn of its velocity, the other in .1 s and with it."""
    states, _, acceleration, step = some_states()
    commands = np.random.default_rng(1).normal(size=(len(states), 2))
    program = example(name)
    after, noise = run_once(program, states, commands, acceleration, step)
    np.testing.assert_allclose(after, stepped(program)(states, acceleration, step), rtol=1e-12)
    body = np.exp(-1j * states[:, 2]) * (states[:, 3] + 1j * states[:, 4])
    settling, carried = (0.1, 1j * states[:, 5] * body) if name == "truck" else (step, 0 * body)
    wanted = [
        (commands[:, 0] - body.real) / settling,
        -body.imag / settling + carried.imag,
        (0.5 * commands[:, 1] - states[:, 5]) / settling,
    ]
    mean = np.stack([np.clip(wanted[0], -6, 6) + carried.real, wanted[1], np.clip(wanted[2], -6, 6)], -1)
    assert 0 < (abs(wanted[0]) > 6).mean() < 1 and 0 < (abs(wanted[2]) > 6).mean() < 1
    np.testing.assert_allclose(noise.mean.detach(), mean, rtol=1e-6)
    np.testing.assert_allclose(noise.stddev.detach(), np.tile([5.0, 5.0, 2.0], (len(states), 1)))


def test_the_trucks_commands_are_held_and_turn_with_speed_times_curvature() -> None:
    torch.manual_seed(1)
    time = torch.arange(0, 10, 0.5, dtype=torch.float64)[:, None].expand(-1, 50)
    speed, turn = example("truck").example_controls(time).unbind(-1)
    held = speed.reshape(5, 4, 50)
    assert torch.equal(held, held[:, :1].expand_as(held)) and len(held[:, 0].unique()) == 250
    assert ((speed >= -0.7) & (speed <= 1.3)).all() and ((turn / speed).abs() <= 0.75 + 1e-9).all()


# --- other systems ----------------------------------------------------------------------------------------------------


def test_the_pendulum_swings_by_its_equation() -> None:
    random = np.random.default_rng(0)
    angle, rate, torque, acceleration = random.normal(size=(4, 30))
    step = random.uniform(0.01, 0.1, 30)
    after, noise = run_once(example("pendulum"), np.stack([angle, rate], -1), torque[:, None], acceleration, step)
    middle = angle + rate * step / 2
    np.testing.assert_allclose(
        noise.mean.detach(), -9.81 * np.sin(middle) - 0.2 * rate + 5 * torque, rtol=1e-5, atol=1e-6
    )
    faster = rate + acceleration * step
    np.testing.assert_allclose(after, np.stack([angle + (rate + faster) / 2 * step, faster], -1), rtol=1e-12)


def test_the_cart_rolls_by_its_equation() -> None:
    random = np.random.default_rng(0)
    position, velocity, push, acceleration = random.normal(size=(4, 30))
    step = random.uniform(0.01, 0.1, 30)
    states = np.stack([position, velocity], -1)
    after, noise = run_once(example("linear_gaussian"), states, push[:, None], acceleration, step)
    np.testing.assert_allclose(noise.mean.detach(), push - 0.8 * velocity, rtol=1e-6, atol=1e-7)
    there = position + velocity * step + acceleration * step**2 / 2
    np.testing.assert_allclose(after, np.stack([there, velocity + acceleration * step], -1))


# --- networks ---------------------------------------------------------------------------------------------------------

NETWORKS = [name for name in PROGRAMS if name.startswith(("neural_vehicle", "paper.py:PaperNeural"))]


def neural(name: str = "NeuralHovercraft", **options):
    return type(example(f"neural_vehicle.py:{name}"))(**options).double()


@pytest.mark.parametrize(
    ("options", "count"),
    [
        ({}, 5 * 3 + 3 + 5 * 64 + 64 + 64 * 3 + 3 + 5 * 3 + 3),
        ({"layers": 2, "absolute_heading": True}, 4915),  # as published
        ({"layers": 2}, 4915 - 2 * (3 + 64 + 3)),
    ],
    ids=["default", "the authors'", "two layers"],
)
def test_a_network_has_so_many_parameters(options, count: int) -> None:
    for name in ("NeuralHovercraft", "NeuralTruck"):
        assert sum(parameter.numel() for parameter in neural(name, **options).parameters()) == count


def test_a_network_refuses_options_that_it_does_not_know() -> None:
    for options in ({"layers": 3}, {"normalise": "smooth"}):
        with pytest.raises(ValueError, match=str(next(iter(options.values())))):
            neural(**options)


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_starts_at_constant_velocity_with_wide_noise(name: str) -> None:
    """All heads are zero: the mean acceleration is 0 and the deviation softplus(0) = ln 2 of its scale, anywhere."""
    program = example(name)
    states, controls, acceleration, step = some_states()
    after, noise = run_once(program, states, controls, acceleration, step)
    np.testing.assert_allclose(after, stepped(program)(states, acceleration, step), rtol=1e-12)
    assert not noise.mean.any()
    scale = np.tile(program.scale.numpy(), (len(states), 1))
    np.testing.assert_allclose(noise.stddev.detach(), math.log(2) * scale, rtol=1e-12)


@pytest.mark.parametrize("absolute_heading", [False, True])
def test_a_network_knows_no_place_and_only_if_asked_the_heading(absolute_heading: bool) -> None:
    """Turning the vehicle with its velocity, or moving it, leaves its body-frame accelerations alone."""
    program = stirred(neural(absolute_heading=absolute_heading, layers=2))
    states, controls, acceleration, step = some_states()
    velocity = (states[:, 3] + 1j * states[:, 4]) * np.exp(1j)
    turned = np.stack([*(states[:, :2].T + 7), states[:, 2] + 1, velocity.real, velocity.imag, states[:, 5]], -1)
    moved = np.concatenate([states[:, :2] + 7, states[:, 2:]], -1)
    mean, of_moved, of_turned = (
        run_once(program, some, controls, acceleration, step)[1].mean.detach() for some in (states, moved, turned)
    )
    torch.testing.assert_close(of_moved, mean, rtol=1e-12, atol=1e-12)
    assert torch.allclose(of_turned, mean, rtol=1e-9, atol=1e-12) == (not absolute_heading)


def body_moments(data) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and deviation of body velocities, yaw rate and controls over all rows of the drives."""
    states = data.states[data.rows].numpy()
    body = np.exp(-1j * states[:, 2]) * (states[:, 3] + 1j * states[:, 4])
    inputs = np.concatenate([np.stack([body.real, body.imag, states[:, 5]], -1), data.controls[data.rows].numpy()], -1)
    return torch.from_numpy(inputs.mean(0)), torch.from_numpy(inputs.std(0, ddof=1))


def test_normalised_by_the_truth_a_network_sees_unit_inputs() -> None:
    data = drives(load_program(TRUTH).double(), 4, 30, gaps=True)
    program = neural(normalise="truth")
    program.prepare(data, False)
    mean, sd = body_moments(data)
    torch.testing.assert_close(program.input_mean, mean)
    torch.testing.assert_close(program.input_sd, sd)


@pytest.mark.parametrize("known_start", [True, False])
def test_normalised_by_smoothing_a_network_never_looks_at_the_truth(known_start: bool) -> None:
    data = drives(load_program(TRUTH).double(), 4, 30)
    moments = []
    for given in (data, only_start(data), only_start(data) if known_start else data.without_truth()):
        program = neural()
        torch.manual_seed(1)
        program.prepare(given, known_start)
        moments.append(torch.stack([program.input_mean, program.input_sd]))
    assert torch.equal(moments[0], moments[1]) and torch.equal(moments[0], moments[2])
    assert torch.isfinite(moments[0]).all() and (moments[0][1] > 0).all()


def test_an_input_that_never_changes_is_not_blown_up() -> None:
    data = drives(load_program(TRUTH).double(), 2, 10)
    data = replace(data, controls=torch.zeros_like(data.controls))
    program = neural(normalise="truth")
    program.prepare(data, False)
    assert (program.input_sd[3:] == 1e-3).all()


@pytest.mark.parametrize("known", ["nothing", "the start"])
def test_normalising_by_a_truth_that_is_not_there_is_an_error(known: str) -> None:
    data = drives(load_program(TRUTH).double(), 2, 10)
    data = data.without_truth(keep_start=known == "the start")
    with pytest.raises(SteadyError, match="true state"):
        neural(normalise="truth").prepare(data, False)


@pytest.mark.parametrize("left", [(), (7,), (3, 1, 4)])
def test_dense_is_the_layer_whatever_the_layout(left):
    layer = torch.nn.Linear(5, 3).double()
    by_components = stack(*torch.randn(5, *left, dtype=torch.float64))
    for inputs in (by_components, by_components.contiguous()):
        torch.testing.assert_close(dense(layer, inputs), layer(inputs))


# --- the discovered truck ---------------------------------------------------------------------------------------------


def test_the_discovered_truck_is_what_its_docstring_says() -> None:
    """By numpy, at states and controls of its own drives."""
    found = example("discovered_truck.py")
    data = drives(found, 3, 20)
    found.slip, found.crab, found.bias = (torch.tensor(value, dtype=torch.float64) for value in (-0.05, -0.01, 0.3))
    state, control = data.states[:-1].numpy(), data.controls[:-1].numpy()
    learned = [name.removesuffix("_unconstrained") for name, _ in found.named_parameters()]
    value = {name: getattr(found, name).detach().numpy() for name in learned}
    _, _, heading, vx, vy, turning = np.moveaxis(state, -1, 0)
    v, w = np.cos(heading) * vx + np.sin(heading) * vy, np.cos(heading) * vy - np.sin(heading) * vx
    speed, turn = np.moveaxis(control, -1, 0)
    turned = (1 - value["share"]) * turn + value["share"] * turn * speed / (speed**2 + 0.05**2) * v
    limit = value["limit"]
    mean = np.stack(
        [
            np.clip((value["speed_gain"] * speed - v) / value["speed_time"], -limit, limit)
            + value["bias"]
            - w * turning,
            ((value["lever"] + value["slip"] * (v - 1.3)) * turning + value["crab"] * v - w) / value["grip_time"]
            + v * turning,
            np.clip((value["turn_gain"] * turned - turning) / value["turn_time"], -limit, limit)
            - value["caster"] * v * turning,
        ],
        -1,
    )
    erratic = np.stack([value["erratic"][0] * abs(mean[..., 0]), 0 * v, value["erratic"][1] * abs(turn - turning)], -1)
    found_mean, found_sd = found.accelerations(data.states[:-1], data.controls[:-1], data.steps)
    np.testing.assert_allclose(found_mean.detach().numpy(), mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found_sd.detach().numpy(), value["noise"] * (1 + erratic), rtol=1e-9, atol=1e-9)


def test_the_hybrid_truck_begins_as_the_discovered_one() -> None:
    found, hybrid = example("discovered_truck.py"), example("discovered_truck.py:HybridTruck")
    data = drives(found, 3, 20)
    given = data.states[:-1], data.controls[:-1], data.steps
    for one, other in zip(found.accelerations(*given), hybrid.accelerations(*given), strict=True):
        torch.testing.assert_close(one, other)
    assert {name for name, _ in hybrid.named_parameters()} > {name for name, _ in found.named_parameters()}
