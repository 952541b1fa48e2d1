"""Sensors as parts: what they read, what they are called, and which effects follow from them."""

from __future__ import annotations

import math

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import MODELS, example
from pyro.nn import PyroParam
from torch import tensor
from torch.distributions import constraints

import steady_ppl as st
from steady_ppl.effects import catalogue, chosen_variant
from steady_ppl.model.handlers import Recording, running
from steady_ppl.model.validate import probe
from steady_ppl.runs.recipes import find_recipe
from steady_ppl.sensors import BodyVelocity, Heading, Position, Ranges, WheelSpeed, YawRate

Unicycle = type(st.load_program(MODELS / "unicycle.py"))
Car = type(st.load_program(MODELS / "car.py"))


class Carrying(Unicycle):
    """A robot with one of each."""

    sensors = (
        *Unicycle.sensors,
        Position(sd="gps_sd", name="gps", offset="antenna"),
        Position(sd=0.2, name="tag", offset=(0.1, 0.2)),
        Heading(sd=0.05, name="compass", from_north=True),
        BodyVelocity(sd=0.1, name="log"),
        WheelSpeed(sd=0.05, name="wheel", left=0.3, size=1.1),
    )

    def __init__(self):
        super().__init__()
        self.gps_sd = PyroParam(tensor(0.5), constraints.positive)
        self.antenna = PyroParam(tensor([0.5, -0.2]), constraints.real)


def states(count: int = 30) -> torch.Tensor:
    random = np.random.default_rng(1)
    return tensor(random.normal(size=(count, 6)) * [4, 4, 3, 1, 1, 1])


def read(program, state) -> torch.Tensor:
    with running(*state.shape[:-1]), Recording() as seen:
        program.observe(state)
    return torch.cat([fn.base_dist.loc for fn in seen.distributions.values()], -1)


def test_each_reads_what_geometry_says() -> None:
    program, state = Carrying().double(), states()
    x, y, heading, vx, vy, yaw_rate = state.numpy().T
    place, ahead = x + 1j * y, np.exp(1j * heading)
    towards = np.array([complex(*at) for at in program.landmarks])[:, None] - place
    antenna = place + ahead * (0.5 - 0.2j)
    tag = place + ahead * (0.1 + 0.2j)
    body = (vx + 1j * vy) / ahead
    expected = [
        *abs(towards),
        *np.angle(towards / ahead),
        yaw_rate,
        antenna.real,
        antenna.imag,
        tag.real,
        tag.imag,
        math.pi / 2 - heading,
        body.real,
        body.imag,
        (body.real - 0.3 * yaw_rate) / 1.1,
    ]
    found = read(program, state).detach().numpy().T
    on_circle = [name.startswith(("bearing", "compass")) for name in program.measurement_names]
    apart = found - np.stack(expected)
    apart[on_circle] = np.angle(np.exp(1j * apart[on_circle]))
    assert abs(apart).max() < 1e-8  # its settings are in single precision


def test_columns_are_called_after_the_sensor() -> None:
    program = Carrying()
    assert program.measurements[8:] == (
        "gyro [rad/s]",
        "gps_x [m]",
        "gps_y [m]",
        "tag_x [m]",
        "tag_y [m]",
        "compass [rad]",
        "log_forward [m/s]",
        "log_lateral [m/s]",
        "wheel [m/s]",
    )
    assert program.sensor_columns["bearing"] == (4, 5, 6, 7) and program.sensor_columns["wheel"] == (16,)
    probe(program)
    data = st.simulate(program, 3, seed=1)
    assert data.measurement_names == program.measurement_names
    assert st.why_not_linear(program, st.for_program(program, data)) is None


def test_a_vehicle_without_a_list_has_an_observe_of_its_own() -> None:
    hovercraft = example("hovercraft")
    assert hovercraft.sensor_columns == {} and hovercraft.sees_bearings

    class Blind(type(hovercraft)):
        observe = st.PlanarVehicle.observe

    with pytest.raises(st.ProgramError, match=r"lacks the method observe\(self, state\)"):
        probe(Blind())


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: YawRate(sd=0.0), "sensor yaw_rate: sd is a number above zero, got 0.0"),
        (lambda: YawRate(sd=math.inf), "sd is a number above zero, got inf"),
        (lambda: YawRate(sd=True), "sd is a number above zero, got True"),
        (lambda: Heading(sd=0.1, from_north="no"), "from_north is True or False, got 'no'"),
        (lambda: YawRate(sd=None), "sd is a number above zero, got None"),
        (lambda: YawRate(sd=0.1, name=3), "a sensor's name is one word, got 3"),
        (lambda: WheelSpeed(sd=0.1, size=0), "sensor wheel_speed: size is a number above zero, got 0"),
        (lambda: Position(sd=0.1, offset=1.0), "offset is two numbers, m ahead and to the left, got 1.0"),
        (lambda: YawRate(sd=0.1, name="two words"), "a sensor's name is one word, got 'two words'"),
    ],
)
def test_wrong_settings_are_refused(make, match: str) -> None:
    with pytest.raises(st.ProgramError, match=match):
        make()


def test_what_a_sensor_names_must_be_there_and_names_must_differ() -> None:
    class Nameless(Unicycle):
        sensors = (Position(sd="gps_sd"),)

    with pytest.raises(st.ProgramError, match="its sensor names 'gps_sd', which it does not have"):
        probe(Nameless())

    class Twice(Unicycle):
        sensors = (Position(sd=0.1), Position(sd=0.2))

    with pytest.raises(st.ProgramError, match="twice"):
        probe(Twice())


@pytest.mark.parametrize("listed", [Ranges(sd=0.1), (Ranges,), ("range",)])
def test_what_is_no_list_of_sensors_is_refused(listed) -> None:
    class Wrong(Unicycle):
        sensors = listed

    with pytest.raises(st.ProgramError, match=r"`sensors` is a list of sensors, as `\(Ranges\(sd=0.1\),\)`, got"):
        probe(Wrong())


def test_landmarks_are_needed_where_they_are_seen() -> None:
    class Lost(Unicycle):
        landmarks = ()

    with pytest.raises(st.ProgramError, match="its sensor range needs `landmarks`, and it has none"):
        probe(Lost())


class Diver(Unicycle):
    """Its depth is sampled first, the listed sensors after it."""

    @property
    def measurements(self):
        return ("depth [m]", *super().measurements)

    def observe(self, state):
        pyro.sample("depth", dist.Normal(0.0 * state[..., :1], 0.1).to_event(1))
        super().observe(state)


def test_lines_of_ones_own_stand_beside_the_list() -> None:
    program = Diver()
    probe(program)
    assert program.sensor_columns["range"] == (1, 2, 3, 4) and program.sensor_columns["gyro"] == (9,)
    scale = moved(program.double(), "sensor_scale", 0.02, at="range")
    assert not scale[:, [0, *range(5, 10)]].any() and bool((scale[:, 1:5] > 0).all())
    assert variants(program)["measurement_noise"][-1] == "measurement_noise:depth"


def test_sensors_that_an_own_observe_leaves_out_are_not_carried() -> None:
    class Own(Unicycle):
        measurements = ("depth [m]",)

        def observe(self, state):
            pyro.sample("depth", dist.Normal(0.0 * state[..., :1], 0.1).to_event(1))

    program = Own()
    probe(program)
    assert program.sensor_columns == {} and "sensor_delay" not in variants(program)
    assert variants(program)["sensor_bias"] == ["sensor_bias:depth"]
    with pytest.raises(st.UsageError, match="the model lists no `sensors`"):
        chosen_variant(program, "sensor_delay")


def variants(program) -> dict[str, list[str]]:
    return {effect.name: [one.name for one in effect.variants(program)] for effect in catalogue(program)}


def test_effects_follow_from_what_is_listed() -> None:
    found = variants(Carrying())
    assert found["bearing_bias"] == ["bearing_bias"]
    assert found["landmark_bias"] == [f"landmark_bias:bearing_{i}" for i in range(4)]
    assert found["sensor_bias"][0] == "sensor_bias:range_0" and found["sensor_bias"][-1] == "sensor_bias:range"
    assert "sensor_bias:compass" in found["sensor_bias"] and "sensor_bias:bearing_0" not in found["sensor_bias"]
    assert found["sensor_scale"] == [f"sensor_scale:{name}" for name in ("range", "bearing", "gyro", "log", "wheel")]
    assert found["range_dependent_noise"] == ["range_dependent_noise:range", "range_dependent_noise:bearing"]
    assert found["antenna_offset"] == ["antenna_offset"]  # of the tag: that of the GPS is learned
    assert found["sensor_delay"] == [f"sensor_delay:{name}" for name in ("range", "bearing", "gps", "tag", "compass")]
    names = ["range", "bearing", "gyro", "gps", "tag", "compass", "log", "wheel"]
    for effect in ("speed_dependent_noise", "measurement_noise"):
        assert found[effect] == [f"{effect}:{name}" for name in names]

    class Placed(Unicycle):
        sensors = (Position(sd=0.1), Heading(sd=0.1))

    with pytest.raises(st.UsageError, match="of positions and headings no size is measured"):
        chosen_variant(Placed(), "sensor_scale")
    assert "landmark_bias" not in variants(Placed()) and "antenna_offset" in variants(Placed())


def test_a_map_is_framed_by_a_position() -> None:
    class Mapping(st.UnknownMap, Carrying):
        pass

    class Blind(st.UnknownMap, Unicycle):
        pass

    data = st.simulate(Carrying(), 2, seed=1)
    Mapping().prepare(data, known_start=False)
    with pytest.raises(st.UsageError, match="list a sensor of the position"):
        Blind().prepare(data, known_start=False)


def test_a_vehicle_that_writes_its_own_lines_has_the_effects_of_landmarks_by_its_columns_names() -> None:
    class Own(Unicycle):
        sensors = ()
        measurements = (*(f"range_{i} [m]" for i in range(4)), *(f"bearing_{i} [rad]" for i in range(4)))

        def observe(self, state):
            pyro.sample("range", dist.Normal(self.ranges(state), 0.1).to_event(1))
            pyro.sample("bearing", st.bearings_to(self.landmarks, state, sd=0.05))

    program = Own()
    probe(program)
    found = variants(program)
    assert found["bearing_bias"] == ["bearing_bias"] and found["sensor_scale"][0] == "sensor_scale:bearing"
    places = [f"range_{i}" for i in range(4)] + [f"bearing_{i}" for i in range(4)] + ["range"]
    assert found["sensor_bias"] == [f"sensor_bias:{at}" for at in places] and "landmark_bias" not in found
    assert set(found["range_dependent_noise"]) == {"range_dependent_noise:range", "range_dependent_noise:bearing"}
    assert "sensor_delay" not in found


def moved(program, name: str, value, at: str = "") -> torch.Tensor:
    """By how much an effect changes what is read."""
    state = states()
    with_it = program.with_effect(chosen_variant(program, name, at), value)
    change = (read(with_it, state) - read(program, state)).detach()
    on_circle = [unit == "rad" for unit in program.measurement_units]
    change[:, on_circle] = torch.remainder(change[:, on_circle] + math.pi, 2 * math.pi) - math.pi
    return change.where(change.abs() > 1e-12, 0.0)


def test_an_effect_of_a_sensor_leaves_the_others_alone() -> None:
    program, state = Carrying().double(), states()
    columns = program.sensor_columns
    every = range(len(program.measurements))

    def only(change: torch.Tensor, sensor: str) -> torch.Tensor:
        others = [index for index in every if index not in columns[sensor]]
        assert not change[:, others].any()
        return change[:, list(columns[sensor])]

    bias = only(moved(program, "bearing_bias", 0.1), "bearing")
    assert torch.allclose(bias, tensor(0.1).double())
    scale = only(moved(program, "sensor_scale", 0.02, at="range"), "range")
    assert torch.allclose(scale, 0.02 * program.ranges(state))
    assert torch.allclose(only(moved(program, "sensor_bias", 0.3, at="range"), "range"), tensor(0.3).double())
    offset = only(moved(program, "antenna_offset", (1.0, 0.5)), "tag")
    ahead = torch.polar(torch.ones(len(state)).double(), state[:, 2]) * complex(1.0, 0.5)
    assert torch.allclose(offset, torch.stack([ahead.real, ahead.imag], -1))
    late = only(moved(program, "sensor_delay", 0.2, at="range"), "range")
    before = program.earlier(state, tensor(0.2))
    assert torch.allclose(late, program.ranges(before) - program.ranges(state))


@pytest.mark.parametrize(
    ("name", "at"),
    [("range_dependent_noise", "bearing"), ("speed_dependent_noise", "gps"), ("measurement_noise", "log")],
)
def test_noise_of_a_sensor_leaves_the_others_alone(name: str, at: str) -> None:
    program, state = Carrying().double(), states()
    spreads = []
    for one in (program, program.with_effect(chosen_variant(program, name, at), 1.5)):
        with running(*state.shape[:-1]), Recording() as seen:
            one.observe(state)
        kept = [fn.base_dist.scale.expand(fn.base_dist.loc.shape) for fn in seen.distributions.values()]
        spreads.append(torch.cat(kept, -1).detach())
    factors = spreads[1] / spreads[0]
    columns = list(program.sensor_columns[at])
    others = [index for index in range(factors.shape[-1]) if index not in columns]
    assert torch.allclose(factors[:, others], torch.ones(()).double())
    forward, lateral, _ = program.body_velocity(state)
    expected = {
        "range_dependent_noise": 1 + 1.5 * program.ranges(state),
        "speed_dependent_noise": (1 + 1.5 * torch.hypot(forward, lateral))[:, None],
        "measurement_noise": tensor(1.5).double(),
    }[name]
    assert torch.allclose(factors[:, columns], expected.expand(len(state), len(columns)), rtol=1e-6)


def test_a_steering_angle_has_the_effects_of_steering() -> None:
    car = Car()
    found = variants(car)
    assert {"steering_offset", "understeer", "reverse_steering", "response_time", "slip_angle"} <= set(found)
    assert "curvature_steering" not in found and "command_noise" not in found
    offset = car.with_effect("steering_offset", 0.02)
    state, control = torch.zeros(4, 6), tensor([[1.0, 0.1]]).expand(4, 2)
    with running(4), Recording() as seen:
        offset.transition(state + 1.0, control, torch.zeros(4), torch.full((4,), 0.1))
    with running(4), Recording() as known:
        car.transition(state + 1.0, control + tensor([0.0, 0.02]), torch.zeros(4), torch.full((4,), 0.1))
    mean, expected = (one.distributions["acceleration"].base_dist.loc for one in (seen, known))
    assert torch.allclose(mean, expected)
    assert chosen_variant(car, "steering_offset").unit == "rad"
    assert chosen_variant(Unicycle(), "steering_offset").unit == "rad/m"


@pytest.mark.slow
def test_an_antenna_that_is_learned_is_found() -> None:
    car = Car()
    car.antenna = tensor([3.6, -0.3])
    car.duration = 40.0
    data = st.simulate(car, 6, seed=3)
    fit = find_recipe("likelihood")(Car(), data, known_start=True, seed=0)
    found = fit.program.antenna.detach()
    sd = fit.information.matrix.inverse().diagonal().sqrt()
    index = [fit.information.names.index(name) for name in fit.information.names if name.startswith("antenna")]
    assert bool(((found - tensor([3.6, -0.3])).abs() < 4 * sd[index]).all()) and bool((sd[index] < 0.2).all())


def test_a_moment_ago_in_a_steady_curve_is_on_the_curve() -> None:
    speed, turn, ago = 3.0, 0.5, 0.2
    state = tensor([[speed / turn, 0.0, math.pi / 2, 0.0, speed, turn]]).double()
    before = Car().earlier(state, tensor(ago).double())
    forward, lateral, yaw_rate = Car().body_velocity(before)
    assert forward.item() == pytest.approx(speed) and abs(lateral.item()) < 1e-6 and yaw_rate.item() == turn
    angle = -turn * ago
    place = [speed / turn * math.cos(angle), speed / turn * math.sin(angle)]
    assert before[0, :2].tolist() == pytest.approx(place, abs=0.5 * speed * turn * ago**2 * 1.1)


def test_a_distance_has_a_slope_at_the_landmark() -> None:
    state = torch.zeros(1, 6, requires_grad=True)
    Unicycle().ranges(state).sum().backward()
    assert bool(torch.isfinite(state.grad).all())


def test_standard_deviations_are_as_many_as_columns() -> None:
    class Wrong(Unicycle):
        sensors = (Position(sd=(0.1, 0.2, 0.3)),)

    with pytest.raises(st.ProgramError, match="its sensor position has 3 standard deviations for 2 columns"):
        probe(Wrong())
