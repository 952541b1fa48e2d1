"""No vehicle: a motor joint, pushed by a torque, its position read by an encoder."""

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import Program, stack


class MotorJoint(Program):
    """An inertia with viscous friction; the rate is never measured. A linear axis has the same form, in m and N.

    a = (torque − friction · rate) / inertia
    rate' = rate + a · step,   position' = position + (rate + rate') / 2 · step

    The friction is that at the rate in the middle of the step (implicit midpoint rule), stable at any step.
    The encoder's standard deviation is its resolution over √12.
    Source: Gautier and others, Dynamic identification of robots with a dry friction model, 2013, without dry friction.
    """

    states = ("position [rad]", "rate [rad/s]")
    controls = ("torque [N m]",)
    measurements = ("encoder [rad]",)
    channels = ("joint [rad/s²]",)
    motion = {"joint": ("position", "rate")}
    guesses = ("noise",)
    step = 0.02
    duration = 6.0
    resolution = 0.01  # rad

    def __init__(self):
        super().__init__()
        self.inertia = PyroParam(tensor(0.05), constraints.positive)  # kg m²
        self.friction = PyroParam(tensor(0.2), constraints.positive)  # N m s/rad
        self.noise = PyroParam(tensor(1.0), constraints.positive)  # rad/s²

    def initial(self):
        sd = tensor([1.0, 1.0]).to(self.noise)
        return pyro.sample("start", dist.Normal(torch.zeros_like(sd), sd).to_event(1))

    def transition(self, state, control, time, step):
        position, rate = state.unbind(-1)
        mean = (control[..., 0] - self.friction * rate) / (self.inertia + 0.5 * step * self.friction)
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise))
        faster = rate + acceleration * step
        return stack(position + 0.5 * (rate + faster) * step, faster)

    def observe(self, state):
        pyro.sample("encoder", dist.Normal(state[..., :1], self.resolution / 12**0.5).to_event(1))

    def example_controls(self, time):
        """Torques held for half a second each."""
        held = (2 * time).long()
        return (2 * torch.rand(int(held.max()) + 1, time.shape[1]) - 1).gather(0, held).to(time).unsqueeze(-1)
