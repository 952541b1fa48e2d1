"""The programs that a user would write for the continuous worlds: unicycle, robot on two wheels, cart and pendulum."""

from __future__ import annotations

import math

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import PlanarVehicle, Program, WrappedNormal, stack


class UnicycleProgram(PlanarVehicle):
    """A vehicle without slip that approaches its commanded speed and turn rate.

    a_forward = (speed − v) / speed_time − w · yaw_rate,   a_lateral = −w / step + v · yaw_rate
    a_yaw     = (turn − yaw_rate) / turn_time

    The lateral velocity w is taken back within a step; the velocity turns with the heading.
    """

    controls = ("speed [m/s]", "turn [rad/s]")
    measurements = ("x [m]", "y [m]", "heading [rad]")
    guesses = ("noise",)
    slips = False

    def __init__(self):
        super().__init__()
        self.speed_time = PyroParam(tensor(0.3), constraints.positive)
        self.turn_time = PyroParam(tensor(0.2), constraints.positive)
        self.noise = PyroParam(tensor([0.1, 0.1, 0.1]), constraints.positive)

    def initial(self):
        sd = tensor([0.5, 0.5, 3.0, 2.0, 2.0, 1.0])
        return pyro.sample("start", dist.Normal(torch.zeros_like(sd).to(self.noise), sd.to(self.noise)).to_event(1))

    def transition(self, state, control, time, step):
        speed, turn = control.unbind(-1)
        forward, lateral, yaw_rate = self.body_velocity(state)
        mean = stack(
            (speed - forward) / self.speed_time - lateral * yaw_rate,
            -lateral / step + forward * yaw_rate,
            (turn - yaw_rate) / self.turn_time,
        )
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)

    def observe(self, state):
        pyro.sample("position", dist.Normal(state[..., :2], 0.02).to_event(1))
        pyro.sample("heading", WrappedNormal(state[..., 2:3], 0.01).to_event(1))


class TwoWheelProgram(UnicycleProgram):
    """The same, told the speeds of two wheels: speed = (left + right) / 2, turn = (right − left) / track.

    A user calls its controls as the log has them, and says what they are.
    """

    controls = ("port [m/s]", "starboard [m/s]")
    roles = {"port": "left_wheel", "starboard": "right_wheel"}
    track = 0.5  # m

    def transition(self, state, control, time, step):
        left, right = control.unbind(-1)
        return super().transition(state, stack(0.5 * (left + right), (right - left) / self.track), time, step)


class CartProgram(Program):
    """a = force / mass − damping · v; the velocity first, then the position by the mean of old and new velocity."""

    states = ("position [m]", "velocity [m/s]")
    controls = ("force [N]",)
    measurements = ("position [m]",)
    channels = ("forward [m/s²]",)
    motion = {"forward": ("position", "velocity")}
    guesses = ("noise",)

    def __init__(self):
        super().__init__()
        self.mass = PyroParam(tensor(2.0), constraints.positive)
        self.damping = PyroParam(tensor(0.3), constraints.positive)
        self.noise = PyroParam(tensor(0.1), constraints.positive)

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(2).to(self.noise), 1.0).to_event(1))

    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        mean = control[..., 0] / self.mass - self.damping * velocity
        acceleration = pyro.sample("forward", dist.Normal(mean, self.noise))
        faster = velocity + acceleration * step
        return stack(position + 0.5 * (velocity + faster) * step, faster)

    def observe(self, state):
        pyro.sample("position", dist.Normal(state[..., :1], 0.05).to_event(1))


class PendulumProgram(Program):
    """a = −stiffness · sin(angle) − damping · rate + gain · torque; the rate first, then the angle by the mean rate."""

    states = ("angle [rad]", "rate [rad/s]")
    controls = ("torque [N m]",)
    measurements = ("angle [rad]",)
    channels = ("torque [rad/s²]",)
    angles = ("angle",)
    motion = {"torque": ("angle", "rate")}
    guesses = ("noise",)
    step = 0.05

    def __init__(self):
        super().__init__()
        self.stiffness = PyroParam(tensor(9.81), constraints.positive)
        self.damping = PyroParam(tensor(0.2), constraints.positive)
        self.gain = PyroParam(tensor(5.0), constraints.positive)
        self.noise = PyroParam(tensor(0.3), constraints.positive)

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(2).to(self.noise), 0.5).to_event(1))

    def transition(self, state, control, time, step):
        angle, rate = state.unbind(-1)
        mean = -self.stiffness * angle.sin() - self.damping * rate + self.gain * control[..., 0]
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise))
        faster = rate + acceleration * step
        return stack(angle + 0.5 * (rate + faster) * step, faster)

    def observe(self, state):
        pyro.sample("angle", WrappedNormal(state[..., :1], math.radians(3)).to_event(1))
