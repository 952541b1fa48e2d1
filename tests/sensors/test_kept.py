"""Sensors of the way that a row took: what a vehicle keeps of it, in every way of running a program."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import VEHICLES as VEHICLES_OF_MODELS, drives, example
from kernel_programs import assert_same, both
from oracles import all_at_once, step_by_step
from torch import tensor

import steady_ppl as st
from steady_ppl import sensors
from steady_ppl.comparison.evaluate import forward
from steady_ppl.effects import chosen_variant
from steady_ppl.gaussian.linearize import ReferencePath, linearize
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.gaussian.twisted_proposal import Twist
from steady_ppl.guides.path_guides import true_paths
from steady_ppl.kernels import rows as rows_by_kernels
from steady_ppl.model.handlers import Recording, running
from steady_ppl.model.problem import Problem
from steady_ppl.model.substeps import mean_step, noisy_step
from steady_ppl.model.validate import probe
from steady_ppl.sensors import (
    Accelerometer,
    Bearings,
    BodyVelocity,
    Encoder,
    Heading,
    Pose,
    Position,
    Ranges,
    RangesBearings,
    WheelSpeed,
    YawRate,
)
from steady_ppl.smc.simulate import simulated_substeps

SENSORS = (
    Accelerometer(sd=0.3, name="imu", offset=(0.5, -0.3), angle=0.2),
    Encoder(sd=0.02, name="left", left=0.4, size=1.1),
    Pose(sd=0.1, heading_sd=0.05, offset=(0.3, 0.1), angle=0.1),
    BodyVelocity(sd=0.2, angle=-0.1),
    Heading(sd=0.1, name="compass", angle=0.3, from_north=True),
)
OF_LANDMARKS = (RangesBearings(sd=0.2, bearing_sd=0.05), *SENSORS)
VEHICLES = {"unicycle": OF_LANDMARKS, "car": SENSORS, "hovercraft": OF_LANDMARKS}
EVERY_SENSOR = (
    *OF_LANDMARKS,
    Ranges(sd=0.2, name="radio"),
    Bearings(sd=0.05, name="camera"),
    Position(sd=0.5, name="gps", offset=(0.4, -0.2)),
    YawRate(sd=0.02, name="gyro"),
    WheelSpeed(sd=0.1, name="right", left=-0.4, size=0.9),
)
LANDMARKS = ((5.0, 1.0), (-4.0, 6.0), (0.0, -7.0))
PLANAR = (
    "hovercraft",
    "unicycle",
    *(name for name in VEHICLES_OF_MODELS if isinstance(example(name), st.PlanarVehicle)),
)
MARKS = {("car", 1): (), ("hovercraft", 3): pytest.mark.slow}  # of the others a share is run each day


def carrying(name: str, listed=None, dtype: torch.dtype = torch.float64, **more) -> st.Program:
    """A vehicle of `models/` with sensors of its kind, or with those that are given."""
    kind = type(example(name))
    about = {"sensors": VEHICLES[name] if listed is None else listed, "observe": st.PlanarVehicle.observe, **more}
    return type(f"Carrying{kind.__name__}", (kind,), about)().to(dtype)


def reading(program, state) -> torch.Tensor:
    with running(*state.shape[:-1]), Recording() as seen:
        program.observe(state)
    return torch.cat([fn.base_dist.loc for fn in seen.distributions.values()], -1).detach()


def with_every_sensor(name: str, dtype: torch.dtype = torch.float64) -> st.Program:
    return carrying(name, EVERY_SENSOR, dtype, landmarks=LANDMARKS)


def test_every_sensor_is_carried():
    every = {type(one) for one in EVERY_SENSOR}
    assert every == {getattr(sensors, name) for name in sensors.__all__} - {sensors.Sensor, sensors.Several}


@pytest.mark.parametrize(
    ("name", "substeps"),
    [pytest.param(*pair, marks=MARKS.get(pair, pytest.mark.exhaustive)) for pair in product(PLANAR, (1, 3))],
)
def test_a_program_is_the_same_in_turn_at_once_and_by_kernels(name, substeps, monkeypatch):
    program = st.with_substeps(with_every_sensor(name), substeps)
    probe(program)
    kept = ("mean_forward", "mean_lateral", "mean_yaw", "mean_squared_yaw_rate", "travelled", "turned")
    assert program.state_names[6:] == program.resting_names == kept
    data = drives(program, 3, 9, gaps=True)
    with st.seeded("paths"):
        paths = st.particle_filter(program, data, particles=20, kernels=False).paths(3)
    at_once, in_turn = (one(program, data, paths) for one in (all_at_once, step_by_step))
    torch.testing.assert_close(at_once, in_turn, rtol=1e-10, atol=0)

    problem = Problem(program, data)
    torch.manual_seed(1)
    path = ReferencePath(torch.randn(9, 3, 12).double(), torch.randn(8, 3, 3).double())
    plain = linearize(problem, path)
    given = (data.controls[:-1], data.elapsed[:-1], data.steps)
    for part, slopes in ((0, plain.state), (1, plain.noise)):
        for index in range(slopes.shape[-1]):
            ends = []
            for by in (1e-5, -1e-5):
                moved = [path.states[:-1].clone(), path.noise.clone()]
                moved[part][..., index] += by
                ends.append(noisy_step(program, *moved, *given))
            expected = torch.where(data.transitions[..., None], (ends[0] - ends[1]) / 2e-5, 0.0)
            torch.testing.assert_close(slopes[..., index], expected, rtol=1e-5, atol=1e-6)

    program = st.with_substeps(with_every_sensor(name, torch.float32), substeps)
    data = st.for_program(program, data)
    path = ReferencePath(path.states.float(), path.noise.float())
    monkeypatch.setattr(rows_by_kernels, "ROWS_WORTH_COMPILING", 1)
    by_kernel = linearize(Problem(program, data), path)
    assert by_kernel.in_plain_torch is None
    for part in ("offset", "state", "noise", "residual", "measurement", "precision", "log_scale"):
        torch.testing.assert_close(getattr(by_kernel, part), getattr(plain, part), rtol=1e-3, atol=2e-4)
    assert_same(*both(program, data))


@pytest.mark.slow
@pytest.mark.parametrize("name", VEHICLES)
def test_filters_agree_about_simulated_drives(name):
    program = carrying(name)
    program.duration = 3.0
    with torch.no_grad():
        program.noise.mul_(0.3)
    problem = Problem.of_table(program, st.simulate(program, 3, seed=2, substeps=program.substeps), True)
    ahead = find_and_smooth(problem)
    given = {"particles": 4000, "known_start": True}
    found = []
    for seed in range(4):
        with st.seeded(seed, "filter"):
            filtered = st.particle_filter(program, problem.data, proposal=Twist(ahead), **given)
        found.append(filtered.log_likelihood)
    mean, error = torch.stack(found).mean(0), torch.stack(found).std(0) / 2
    assert bool((error < 0.1).all())
    assert bool(((mean - ahead.log_likelihood).abs() < 4 * error + 0.3).all())


def driven(steps: int = 16, step: float = 0.1) -> tuple[np.ndarray, ...]:
    """A car of 2.8 m without slip that follows held commands in 0.1 s, by itself in steps of 1 ms: times, poses, speeds
    and turn rates, and the commands of each row."""
    random = np.random.default_rng(4)
    commands = np.stack([random.uniform(1, 4, steps), random.uniform(-0.4, 0.4, steps)], 1)
    fine, settling = round(step / 1e-3), 0.1

    def rate(state: np.ndarray, command: np.ndarray) -> np.ndarray:
        heading, speed, turn = state[2:]
        wanted = speed * math.tan(command[1]) / 2.8
        return np.array(
            [
                speed * math.cos(heading),
                speed * math.sin(heading),
                turn,
                (command[0] - speed) / settling,
                (wanted - turn) / settling,
            ]
        )

    states = [np.array([0.0, 0.0, 0.3, 2.0, 0.1])]
    for command in commands:
        for _ in range(fine):
            state, h = states[-1], 1e-3
            a = rate(state, command)
            b = rate(state + 0.5 * h * a, command)
            c = rate(state + 0.5 * h * b, command)
            d = rate(state + h * c, command)
            states.append(state + h / 6 * (a + 2 * b + 2 * c + d))
    return np.array(states), commands


@pytest.mark.parametrize(("substeps", "close"), [(1, 0.05), (4, 0.003), (16, 0.0006)])
def test_what_is_read_is_that_of_a_world_in_steps_of_a_millisecond(substeps, close):
    place, angle, left, size, step = (1.2, 0.4), 0.2, 0.7, 1.05, 0.1
    world, commands = driven()
    x, y, heading, speed, turn = world.T
    swung = (x + 1j * y) + np.exp(1j * heading) * complex(*place)
    forces = np.gradient(np.gradient(swung, 1e-3), 1e-3) * np.exp(-1j * (heading + angle))
    rows = len(commands)
    inside = forces[: rows * 100].reshape(rows, 100)[:, 3:-3]  # away from the jumps of commands, where it has a corner
    rolled = (speed - left * turn) / size
    ways = ((rolled[1:] + rolled[:-1]) * 0.5e-3).reshape(rows, 100).sum(1)

    listed = (
        Accelerometer(sd=0.1, name="imu", offset=place, angle=angle),
        Encoder(sd=0.1, name="odo", left=left, size=size),
        WheelSpeed(sd=0.1, name="wheel", left=left, size=size),
    )
    car = st.with_substeps(carrying("car", listed), substeps)
    start = [0.0, 0.0, 0.3, 2.0 * math.cos(0.3), 2.0 * math.sin(0.3), 0.1] + [0.0] * len(car.resting)
    state, found = tensor(start).double(), []
    for row, command in enumerate(commands):
        state = mean_step(car, state, tensor(command), tensor(row * step).double(), tensor(step).double())
        found.append(reading(car, state))
    forward, lateral, way, now = torch.stack(found).numpy().T
    force = inside.mean(1)
    scale = abs(force).max()
    assert scale > 5
    assert abs(forward + 1j * lateral - force).max() < close * scale
    assert abs(way - ways).max() < close * abs(ways).max()
    assert abs(now - rolled[100::100]).max() < close * abs(rolled).max()


def test_an_accelerometer_in_an_upright_plane_feels_what_holds_it_up_and_not_its_weight() -> None:
    listed = (Accelerometer(sd=0.1, gravity=(0.0, -9.81)),)
    quadrotor = st.with_substeps(carrying("planar_quadrotor", listed), 16)
    probe(quadrotor)
    state = torch.zeros(len(quadrotor.state_names)).double()
    state[:6] = tensor([0.0, 0.0, 0.4, 1.0, -0.5, 2.0])
    step, held = tensor(0.05).double(), tensor([2.5, 2.4]).double()
    with torch.no_grad():
        after = mean_step(quadrotor, state, held, tensor(0.0).double(), step)
        forward, lateral = reading(quadrotor, after)
        speeds = [float(quadrotor.body_velocity(one)[0]) for one in (state, after)]
    assert float(lateral) == pytest.approx(4.9 / 0.5, abs=0.02)  # thrust alone; across the bar nothing drags
    assert float(forward) == pytest.approx(-0.3 * sum(speeds) / 2, abs=0.02)


def test_whatever_pushes_is_felt_and_other_states_lie_beside() -> None:
    plain = st.with_substeps(carrying("hovercraft", (Accelerometer(sd=0.1),)), 2)
    coloured = plain.with_effect("coloured_noise:translation", 0.5).with_effect("acceleration_bias", (0.3, -0.2))
    probe(coloured)
    assert coloured.resting_names == (*plain.resting_names, "deviation_forward", "deviation_lateral", "deviation_yaw")
    step, control, time = tensor(0.1).double(), tensor([0.4, 0.4]).double(), tensor(0.0).double()
    rest, noise = torch.zeros(11).double(), tensor([2.0, -1.0, 0.0]).double()
    with torch.no_grad():
        state = noisy_step(coloured, rest, noise, control, time, step)
        sd = coloured.noise[:2] * math.sqrt(1 - 0.5**2)
        expected = tensor([0.8 / 1.5 + 0.3, -0.2]).double() + sd * noise[:2]
        torch.testing.assert_close(reading(coloured, state), expected, rtol=1e-6, atol=1e-6)
        assert state.shape == (11,)
        again = noisy_step(coloured, state, 0 * noise, 0 * control, time, step)
        stays = tensor([0.3, -0.2]).double() + 0.5 * coloured.noise[:2] * noise[:2] * math.sqrt(1 - 0.5**2)
        torch.testing.assert_close(reading(coloured, again), stays, rtol=1e-6, atol=1e-6)


def test_the_first_row_has_no_reading_and_its_cell_is_passed_over() -> None:
    program = carrying("car")
    program.duration = 1.0
    table = st.simulate(program, 2, seed=1)
    assert simulated_substeps(program, st.for_program(program, table)) == 20  # of 5 ms: what is kept is no step
    late = [program.measurement_names.index(name) for name in ("imu_forward", "imu_lateral", "left")]
    seen = table.observed[0].all(0)
    assert not seen[late].any() and int(seen.sum()) == len(seen) - 3 and table.observed[1:].all()
    filled = table.measurements.clone()
    filled[0] = filled[1]
    with_cells = st.Trajectories(**{**vars(table), "measurements": filled, "observed": torch.ones_like(table.observed)})
    assert torch.equal(st.for_program(program, with_cells).observed[0], table.observed[0])


def test_a_table_of_the_six_states_alone_is_enough() -> None:
    program = carrying("car")
    program.duration = 1.0
    table = st.simulate(program, 2, seed=1, substeps=program.substeps)
    bare = table.select(table.control_names, table.measurement_names, program.state_names[:6])
    problem = Problem.of_table(program, bare, True)
    assert not problem.data.known_start[:, 6:].any()
    assert bool(find_and_smooth(problem).log_likelihood.isfinite().all())
    whole = st.for_program(program, table)
    found = true_paths(program, st.for_program(program, bare))
    torch.testing.assert_close(found.states[0], whole.states, rtol=1e-4, atol=1e-4)
    assert forward(program, st.for_program(program, bare), horizon=3, rollouts=2).keys() == program.error_groups.keys()


class Own(type(example("unicycle"))):
    """Its own lines see the row's controls, its acceleration and the row before."""

    sensors = ()
    keeps = ("control", "acceleration", "before")
    measurements = ("current [A]", "felt [m/s²]", "jump [m]")

    def observe(self, state):
        speed = self.kept(state, "control")[..., :1]
        pyro.sample("current", dist.Normal(speed, 0.1).to_event(1))
        pyro.sample("felt", dist.Normal(self.kept(state, "acceleration")[..., :1], 0.1).to_event(1))
        jump = (state[..., :2] - self.kept(state, "before")[..., :2]).norm(dim=-1, keepdim=True)
        pyro.sample("jump", dist.Normal(jump, 0.1).to_event(1))


@pytest.mark.parametrize("substeps", [1, 3])
def test_own_lines_see_controls_accelerations_and_the_row_before(substeps: int) -> None:
    program = st.with_substeps(Own().double(), substeps)
    probe(program)
    assert "before_heading" in program.angles
    state = tensor([1.0, 2.0, 0.0, 0.5, 0.0, 0.0] + [7.0] * 10).double()
    step, time = tensor(0.1).double(), tensor(0.0).double()
    after = mean_step(program, state, tensor([2.0, 0.0]).double(), time, step).detach()
    current, felt, jump = reading(program, after).tolist()
    assert current == pytest.approx(2.0) and jump == pytest.approx(float(after[0]) - 1.0)
    assert felt == pytest.approx((float(after[3]) - 0.5) / 0.1)
    assert torch.equal(program.kept(after, "before"), state[:6])


def test_what_cannot_be_kept_is_said() -> None:
    class Typo(type(example("unicycle"))):
        keeps = ("aceleration",)

    with pytest.raises(st.ProgramError, match="keeps names 'aceleration'; a vehicle can keep acceleration, turning"):
        probe(Typo())

    class Text(type(example("unicycle"))):
        keeps = "control"

    with pytest.raises(st.ProgramError, match=r"keeps is 'control'; one quantity is \('acceleration',\)"):
        probe(Text())

    class Nothing(type(example("unicycle"))):
        since_row_before = ("gyr",)

    with pytest.raises(st.ProgramError, match="since_row_before names 'gyr', no measurement"):
        probe(Nothing())

    program = example("car")
    with pytest.raises(st.ProgramError, match="it does not keep 'control': name it in `keeps`"):
        program.kept(torch.zeros(6), "control")
    program.sensors = (Encoder(sd=0.1),)
    with pytest.raises(st.ProgramError, match="its sensor encoder keeps travelled: list `sensors` in the body of the"):
        probe(program)


@pytest.mark.parametrize("keeps", [None, "acceleration", 3])
def test_what_is_kept_is_a_list(keeps) -> None:
    with pytest.raises(st.ProgramError, match=r"keeps is .*; one quantity is \('acceleration',\)"):
        probe(carrying("unicycle", keeps=keeps))


def test_a_subclass_calls_the_methods_of_its_parent() -> None:
    """Each `initial` and `transition` on the way sees and returns the six states."""
    Parent = type(carrying("car"))

    class Child(Parent):
        def initial(self):
            start = super().initial()
            assert start.shape[-1] == 6
            return start + torch.ones(6).to(start)

        def transition(self, state, control, time, step):
            assert state.shape[-1] == 6
            moved = super().transition(state, control, time, step)
            assert moved.shape[-1] == 6
            return moved

    program = Child()
    probe(program)
    assert len(program.states) == 12
    probe(program.with_effect("linear_drag", 0.1).with_effect("coloured_noise:yaw", 0.1))


# --- effects ----------------------------------------------------------------------------------------------------------


def states(program, count: int = 20) -> torch.Tensor:
    random = np.random.default_rng(1)
    return tensor(0.5 * random.normal(size=(count, len(program.states))))


def test_a_mounting_angle_turns_what_one_sensor_reads() -> None:
    program = carrying("car")
    state, columns = states(program), [program.measurement_names.index(f"imu_{to}") for to in ("forward", "lateral")]
    turned, plain = (reading(one, state) for one in (program.with_effect("mounting_angle:imu", 0.3), program))
    expected = torch.view_as_complex(plain[:, columns].contiguous()) * np.exp(-0.3j)
    torch.testing.assert_close(torch.view_as_complex(turned[:, columns].contiguous()), expected, atol=1e-6, rtol=1e-6)
    rest = [index for index in range(plain.shape[-1]) if index not in columns]
    torch.testing.assert_close(turned[:, rest], plain[:, rest], atol=1e-12, rtol=0)
    assert [one.at for one in chosen_variant(program, "mounting_angle").effect.variants(program)] == ["imu", "velocity"]


def test_tails_of_one_sensor_leave_the_others_normal() -> None:
    program = carrying("car")
    found = [one.name for one in chosen_variant(program, "heavy_tails").effect.variants(program)]
    assert found[0] == "heavy_tails" and "heavy_tails:imu" in found and "heavy_tails:pose_heading" in found
    tailed = program.with_effect("heavy_tails:pose_heading", 0.3).with_effect("heavy_tails:imu", 0.2)
    with running(1), Recording() as seen:
        tailed.observe(states(program, 1))
    bases = {site: fn.base_dist for site, fn in seen.distributions.items()}
    freedom = {site: float(base.df.detach().max()) if hasattr(base, "df") else math.inf for site, base in bases.items()}
    assert freedom.pop("pose_heading") == pytest.approx(1 / 0.3) and freedom.pop("imu") == pytest.approx(5.0)
    assert set(freedom.values()) == {math.inf}


@pytest.mark.parametrize("late", ["sensor_delay:pose", "clock_offset"])
@pytest.mark.parametrize("first", [True, False])
def test_an_offset_and_a_delay_see_each_other(late: str, first: bool) -> None:
    program = carrying("car", (Pose(sd=0.1, heading_sd=0.1), Encoder(sd=0.1)))
    order = [(late, 0.4), ("antenna_offset", (2.0, 1.0))]
    both_of_them = program
    for name, value in order if first else order[::-1]:
        both_of_them = both_of_them.with_effect(name, value)
    state = states(program)
    before = program.earlier(state, tensor(0.4).double())
    swung = torch.view_as_complex(before[:, :2].contiguous()) + (2 + 1j) * torch.exp(1j * before[:, 2])
    found = reading(both_of_them, state)
    torch.testing.assert_close(torch.view_as_complex(found[:, :2].contiguous()), swung, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(found[:, 2], before[:, 2], atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: Accelerometer(sd=0.1, offset=3.0), "offset is two numbers, m ahead and to the left, got 3.0"),
        (lambda: Accelerometer(sd=0.1, gravity=9.81), "gravity is two numbers, m/s² along x and y, got 9.81"),
        (lambda: Accelerometer(sd=0.1, angle=(1.0, 2.0)), r"angle is a finite number, got \(1.0, 2.0\)"),
        (lambda: Encoder(sd=0.1, left=math.nan), "left is a finite number, got nan"),
        (lambda: Pose(sd=0.1, heading_sd=-1), "sensor pose: heading_sd is a number above zero, got -1"),
        (lambda: RangesBearings(sd=0.1, bearing_sd=0), "sensor range_and_bearing: bearing_sd is a number above zero"),
    ],
)
def test_wrong_settings_are_refused(make, match: str) -> None:
    with pytest.raises(st.ProgramError, match=match):
        make()
