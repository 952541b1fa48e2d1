"""The hovercraft moves, sees and is driven as the paper says: against equations in numpy."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from examples import example
from model_steps import by_euler, by_hand, run_once, some_states, stepped
from scipy.integrate import solve_ivp
from small import TRUTH

from steady_ppl import load_program
from steady_ppl.model.handlers import Recording


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
