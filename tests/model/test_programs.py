"""Conformance of every shipped program, and the equations of trucks, pendulum and cart against ones in numpy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyro
import pytest
import torch
from examples import MODELS, drives, example
from model_steps import PROGRAMS, run_once, some_states, stepped, stirred
from pyro.infer import Trace_ELBO
from small import HOVERCRAFT, TRUTH, simulated, steady, written

from steady_ppl import Joint, TruthGuide, for_program, load_program, simulate
from steady_ppl.guides.path_guides import true_paths
from steady_ppl.model.handlers import Recording, Replaying
from steady_ppl.model.program import names
from steady_ppl.model.substeps import acting_controls, sample_row
from steady_ppl.model.validate import probe

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


@pytest.mark.slow
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
        assert values.numel() == 0 or values.std() > 0 or not values.any()
    assert not torch.equal(data.states[0, 0], data.states[0, 1])  # the drives start apart


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_to_swap_programs_is_to_name_another_file(tmp_path: Path) -> None:
    table = written(tmp_path / "t.csv")
    few = ("--steps", 1, "--particles", 10, "--draws", 2)
    swaps = (HOVERCRAFT, TRUTH, f"{MODELS / 'neural_vehicle.py'}:NeuralHovercraft")
    for number, program in enumerate(swaps):
        assert steady("fit", program, table, *few, "--out", tmp_path / str(number)) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["linear_gaussian.py", "pendulum.py", "truck.py"])
def test_the_same_commands_serve_every_system(tmp_path: Path, name: str) -> None:
    program, table, run = MODELS / name, tmp_path / "t.csv", tmp_path / "run"
    like = written(tmp_path / "like.csv", simulated(name, trajectories=2, rows=12))
    assert steady("simulate", program, "--controls", like, "--seed", 1, "--out", table) == 0
    assert steady("fit", program, table, "--steps", 2, "--particles", 20, "--draws", 2, "--out", run) == 0
    assert steady("evaluate", run, table, "--particles", 50, "--rollouts", 3) == 0


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
