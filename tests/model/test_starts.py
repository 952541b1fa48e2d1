"""A start that sees the trajectory: its centre and width, the same prior in all ways of running, kilometres apart."""

from __future__ import annotations

import math
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import MODELS
from pyro import poutine
from pyro.distributions import constraints
from pyro.nn import PyroParam

import steady_ppl as st
from steady_ppl.criticism.baselines import ConstantVelocity
from steady_ppl.errors import ProgramError
from steady_ppl.gaussian.smoother import find_and_smooth
from steady_ppl.model.handlers import Recording
from steady_ppl.model.problem import Joint, Problem
from steady_ppl.model.starts import centre_of_start, draw_first_states
from steady_ppl.model.validate import probe
from steady_ppl.sensors import Heading, Position, Ranges, YawRate
from steady_ppl.smc.filter import particle_filter

Car = type(st.load_program(MODELS / "car.py"))
SENSORS = (Position(sd=0.3, name="gps", offset="antenna"), Heading(sd=0.05, name="compass", from_north=True))


class Seeing(Car):
    start = "first measurements"
    sensors = (*SENSORS, YawRate(sd=0.02, name="gyro"))


class Cart(st.Program):
    """A cart that rolls; its place is measured by a line of its own."""

    states = ("place [m]", "velocity [m/s]")
    controls = ("push [m/s²]",)
    measurements = ("laser_place [m]",)
    channels = ("forward [m/s²]",)
    motion = {"forward": ("place", "velocity")}
    start = "first measurements"
    mean, sd = (0.0, 0.0), (1.0, 0.5)

    def __init__(self):
        super().__init__()
        self.noise = PyroParam(torch.tensor(0.2), constraints.positive)

    def initial(self):
        mean, sd = (self.noise.new_tensor(one) for one in (self.mean, self.sd))
        return pyro.sample("start", dist.Normal(mean, sd).to_event(1))

    def transition(self, state, control, time, step):
        place, velocity = state.unbind(-1)
        push = pyro.sample("forward", dist.Normal(control[..., 0], self.noise))
        faster = velocity + step * push
        return st.stack(place + step * (velocity + faster) / 2, faster)

    def observe(self, state):
        pyro.sample("laser", dist.Normal(state[..., :1], 0.1).to_event(1))


def moved(drives: st.Trajectories, by: torch.Tensor) -> st.Trajectories:
    """The same drives elsewhere, by `(B, 2)` m."""
    shift = torch.zeros_like(drives.measurements)
    shift[..., :2] = by
    return replace(drives, measurements=drives.measurements + torch.where(drives.observed, shift, 0.0))


def same(one: torch.Tensor, other: torch.Tensor) -> bool:
    return torch.equal(one.nan_to_num(math.inf), other.nan_to_num(math.inf))


@pytest.fixture(scope="module")
def drives() -> st.Trajectories:
    program = Seeing()
    program.duration = 6.0
    return st.simulate(program, 4, seed=1)


def test_it_is_where_the_first_fixes_are_though_one_is_wrong(drives: st.Trajectories) -> None:
    measurements = drives.measurements.clone()
    measurements[1, 0, 0] += 50.0
    spoiled = replace(drives, measurements=measurements)
    program, true = Seeing().double(), drives.states[0]
    centre, wider = centre_of_start(program, st.for_program(program, spoiled))
    assert bool(((centre[:, :2] - true[:, :2]).norm(dim=-1) < 1.0 + 1.5).all())  # the antenna is 1 m ahead
    assert torch.allclose((centre[:, 2] - true[:, 2]).cos(), torch.ones(4).double(), atol=0.02)
    assert bool(centre[:, 3:5].isnan().all()) and torch.equal(centre[:, 5], centre[:, 5].nan_to_num())
    assert bool((wider[:, :2] < 3.0).all()) and float(wider[:, 3:5].max()) > 0.5  # some cars drive
    assert torch.equal(wider[:, 5] < 0.2, torch.ones(4, dtype=torch.bool))


def test_a_late_first_fix_makes_it_wider_and_none_leaves_it_as_declared(drives: st.Trajectories) -> None:
    program = Seeing().double()
    cells = torch.zeros_like(drives.observed)
    cells[:20, 0] = True
    cells[:, 1] = True
    before = centre_of_start(program, st.for_program(program, drives))[1]
    centre, wider = centre_of_start(program, st.for_program(program, drives.without(cells)))
    assert bool(centre[1].isnan().all()) and not bool(wider[1].any())
    assert float(wider[0, :2].norm()) > float(before[0, :2].norm()) + 1.0
    part, _ = centre_of_start(program, st.for_program(program, drives.subset([2, 3])))
    assert same(centre[2:], part)


def test_every_way_of_running_has_the_prior_of_a_program_that_declares_it() -> None:
    declared, program = Cart().double(), Cart().double()
    declared.start = ""
    declared.mean = (40.0, 0.0)
    data = st.for_program(program, st.simulate(declared, 1, seed=2)).without_truth()
    centre, wider = centre_of_start(program, data)
    assert abs(float(centre[0, 0]) - 40) < 4 and bool(centre[0, 1].isnan())
    declared.mean = (float(centre[0, 0]), 0.0)
    declared.sd = tuple(math.hypot(sd, float(more)) for sd, more in zip(Cart.sd, wider[0], strict=True))

    def densities(one: Cart) -> list[float]:
        found = [float(find_and_smooth(Problem(one, data)).log_likelihood.sum())]
        with st.seeded(0):
            found.append(float(particle_filter(one, data, particles=64).log_likelihood.sum()))
        states = torch.zeros(*data.time.shape, 2).double()
        known = {"states": states, "start": states[:1], "forward": states[:-1, :, 0]}
        trace = poutine.trace(poutine.condition(Joint(one), known)).get_trace(data)
        return [*found, float(trace.log_prob_sum().detach())]

    assert densities(program) == pytest.approx(densities(declared), rel=1e-9)
    coasting = ConstantVelocity(program, torch.ones(1).double())
    of_coasting = centre_of_start(coasting, data)
    assert same(of_coasting[0], centre) and same(of_coasting[1], wider)


def test_drives_kilometres_apart_are_as_likely_as_where_they_began(drives: st.Trajectories) -> None:
    by = 1e4 * torch.tensor([[1.0, -1.0], [0.3, 0.7], [-2.0, 0.0], [0.0, 0.0]]).double()
    found = {}
    for name, table in {"here": drives, "there": moved(drives, by)}.items():
        program = Seeing().double()
        with st.seeded(0):
            found[name] = find_and_smooth(Problem.of_table(program, table, False)).log_likelihood
    assert torch.allclose(found["here"], found["there"], atol=1e-4)


def test_without_drives_it_is_as_declared_and_like_drives_it_is_where_they_are(drives: st.Trajectories) -> None:
    program = Seeing()
    far = moved(drives, torch.tensor([5000.0, 0.0]).double())
    assert float(st.simulate(program, 8, seed=0).states[0, :, 0].abs().max()) < 15
    assert float((st.simulate(program, seed=0, like=far).states[0, :, 0] - 5000).abs().max()) < 30
    assert draw_first_states(program, None, 3, 2).shape == (3, 2, 6)


def test_ranges_tell_the_nearest_landmark() -> None:
    class Ranging(Car):
        start = "first measurements"
        landmarks = ((0.0, 0.0), (300.0, 0.0))
        sensors = (Ranges(sd=0.1),)

    program = Ranging()
    program.duration = 2.0
    program.__class__.initial = lambda self: pyro.sample(
        "start", dist.Normal(torch.tensor([295.0, 0, 0, 0, 0, 0]), 0.1).to_event(1)
    )
    drives = st.for_program(program, st.simulate(program, 2, seed=0))
    centre, wider = centre_of_start(program, drives)
    assert centre[:, :2].tolist() == [[300.0, 0.0]] * 2 and bool(((wider[:, :2] - 5).abs() < 1.5).all())


def test_wrong_declarations_are_refused() -> None:
    program = Cart()
    program.start = "somewhere"
    with pytest.raises(ProgramError, match=r"start is 'somewhere'; expected \"first measurements\""):
        probe(program)

    class Uniform(Cart):
        def initial(self):
            return pyro.sample("start", dist.Uniform(torch.zeros(2), torch.ones(2)).to_event(1))

    with pytest.raises(ProgramError, match="site 'start' is Uniform"):
        probe(Uniform())


def test_the_prior_is_told_by_measurements_alone(drives: st.Trajectories) -> None:
    """So that it does not move while parameters are learned."""
    one, other = Seeing(), Seeing()
    other.antenna = torch.tensor([5.0, 1.0])
    data = st.for_program(one, drives)
    with Recording() as first, pyro.settings.context(module_local_params=True):
        draw_first_states(one, data, 1, 4)
    assert not first.values  # hidden from handlers outside
    for mine, its in zip(centre_of_start(one, data), centre_of_start(other, data), strict=True):
        assert same(mine, its)


def test_a_heading_whose_mount_is_learned_tells_nothing_by_its_name(drives: st.Trajectories) -> None:
    class Turned(Car):
        start = "first measurements"
        sensors = (Position(sd=0.3, name="gps"), Heading(sd=0.05, angle="twist"))
        twist = 1.5

    class Mounted(Turned):
        sensors = (Position(sd=0.3, name="gps"), Heading(sd=0.05, angle=0.5))

    turned, mounted = Turned(), Mounted()
    data = st.for_program(turned, st.simulate(turned, 3, seed=2))
    told, known = turned.told(data), mounted.told(data)
    assert "heading" not in told and {"x", "y"} <= told.keys()
    heading = data.measurements[..., data.measurement_names.index("heading")]
    torch.testing.assert_close(known["heading"][0], heading - 0.5)
