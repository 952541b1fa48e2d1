"""No vehicle: a pendulum driven by a motor, its angle measured by a coarse encoder."""

import math

import pyro
import pyro.distributions as dist
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import Program, WrappedNormal, stack


class Pendulum(Program):
    """A point mass on a stiff rod; the rate is never measured.

    a = −stiffness · sin(angle) − damping · rate + gain · torque
    rate' = rate + a · step,   angle' = angle + (rate + rate') / 2 · step

    The acceleration is that at the angle half a step on (leapfrog).
    """

    states = ("angle [rad]", "rate [rad/s]")
    controls = ("torque [N m]",)
    measurements = ("angle [rad]",)
    channels = ("torque [rad/s²]",)
    angles = ("angle",)
    motion = {"torque": ("angle", "rate")}
    step = 0.05
    substeps = 2

    def __init__(self):
        super().__init__()
        self.stiffness = PyroParam(tensor(9.81), constraints.positive)
        self.damping = PyroParam(tensor(0.2), constraints.positive)
        self.gain = PyroParam(tensor(5.0), constraints.positive)
        self.noise = PyroParam(tensor(0.3), constraints.positive)

    def initial(self):
        mean, sd = tensor([0.0, 0.0]), tensor([0.5, 0.5])
        return pyro.sample("start", dist.Normal(mean.to(self.noise), sd.to(self.noise)).to_event(1))

    def transition(self, state, control, time, step):
        angle, rate = state.unbind(-1)
        middle = angle + 0.5 * rate * step
        mean = -self.stiffness * middle.sin() - self.damping * rate + self.gain * control[..., 0]
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise))
        faster = rate + acceleration * step
        return stack(middle + 0.5 * faster * step, faster)

    def observe(self, state):
        pyro.sample("angle", WrappedNormal(state[..., 0], math.radians(3)))

    def example_controls(self, time):
        """Swings of growing frequency."""
        return (0.5 * time + 0.15 * time**2).sin().unsqueeze(-1)
