"""A ship with a propeller and a rudder, which answers in tens of seconds; list your own sensors."""

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import PlanarVehicle, stack
from steady_ppl.sensors import Heading, Position, YawRate


class Ship(PlanarVehicle):
    """Nomoto's first-order steering at every speed, with surge and drift.

    a_forward = drag · (p|p| − v|v|)                                      p = pitch · propeller
    a_lateral = −(w + drift · L · yaw_rate) · s / (sway_time · L) + v · yaw_rate
    a_yaw     = (gain · v|v| / L · rudder − s · yaw_rate) / (turn_time · L)    s = √(v² + slow²)

    v is the forward and w the lateral velocity. L is the ship's `length`. `drift`, `gain` and `turn_time` are relative
    to it: K = gain · v / L and T = turn_time · L / v in Nomoto's terms. The rudder's force grows with the square of the
    speed; positive rudder turns the ship to the left. Drift in a turn slows the ship. Forces are those in the middle of
    a step.
    Source: Nomoto and others, On the steering qualities of ships, 1957; Fossen, Handbook of Marine Craft Hydrodynamics
    and Motion Control, 2011, 7.2.
    """

    controls = ("propeller [1/s]", "rudder [rad]")
    sensors = (Position(sd=2.0, name="gps"), Heading(sd=0.01, name="compass"), YawRate(sd=0.001, name="gyro"))
    guesses = ("noise",)
    substeps = 4
    step = 1.0  # s
    duration = 300.0
    simulated_step = 0.1
    length = 80.0  # m
    sway_time = 0.5  # lengths
    slow = 0.5  # m/s

    def __init__(self):
        super().__init__()
        self.pitch = PyroParam(tensor(4.0), constraints.positive)  # m
        self.drag = PyroParam(tensor(0.002), constraints.positive)  # 1/m
        self.gain = PyroParam(tensor(1.5), constraints.positive)
        self.turn_time = PyroParam(tensor(2.0), constraints.positive)
        self.drift = PyroParam(tensor(0.4), constraints.positive)
        self.noise = PyroParam(tensor([0.01, 0.01, 1e-4]), constraints.positive)  # m/s², m/s², rad/s²

    def initial(self):
        mean, sd = tensor([0.0, 0.0, 0.0, 4.0, 0.0, 0.0]), tensor([50.0, 50.0, 1.0, 2.0, 2.0, 0.01])
        return pyro.sample("start", dist.Normal(mean.to(self.noise), sd.to(self.noise)).to_event(1))

    def transition(self, state, control, time, step):
        early = self.response(state, control)
        mean = self.response(self.halfway(state, early, step), control)
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)

    def response(self, state, control):
        """Accelerations in the body frame, `(..., 3)`."""
        propeller, rudder = control.unbind(-1)
        v, w, yaw_rate = self.body_velocity(state)
        through = (v * v + self.slow**2).sqrt() / self.length  # lengths a second
        driven = self.pitch * propeller
        steered = self.gain * v * v.abs() / self.length**2 * rudder
        return stack(
            self.drag * (driven * driven.abs() - v * v.abs()),
            -(w + self.drift * self.length * yaw_rate) * through / self.sway_time + v * yaw_rate,
            (steered - through * yaw_rate) / self.turn_time,
        )

    def example_controls(self, time):
        """Propeller speeds and rudder angles held for a minute each."""
        held = (time / 60).long()
        values = torch.rand(2, int(held.max()) + 1, time.shape[1])
        propeller, rudder = (part.gather(0, held).to(time) for part in (1 + values[0], 0.6 * values[1] - 0.3))
        return torch.stack([propeller, rudder], -1)
