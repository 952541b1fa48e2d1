"""The model that can be solved exactly: a damped cart on a rail, its position measured."""

import pyro
import pyro.distributions as dist
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import Program, stack


class LinearGaussian(Program):
    """A cart pushed along a rail; linear, with normal noise, so that a Kalman filter is exact.

    a = gain · push − damping · velocity
    velocity' = velocity + a · step,   position' = position + (velocity + velocity') / 2 · step
    """

    states = ("position [m]", "velocity [m/s]")
    controls = ("push [N]",)
    measurements = ("position [m]",)
    channels = ("push [m/s²]",)
    motion = {"push": ("position", "velocity")}

    def __init__(self):
        super().__init__()
        self.gain = PyroParam(tensor(1.0), constraints.positive)
        self.damping = PyroParam(tensor(0.8), constraints.positive)
        self.noise = PyroParam(tensor(0.6), constraints.positive)
        self.measurement_sd = PyroParam(tensor(0.2), constraints.positive)

    def initial(self):
        mean, sd = tensor([0.0, 0.5]), tensor([0.5, 0.5])
        return pyro.sample("start", dist.Normal(mean.to(self.noise), sd.to(self.noise)).to_event(1))

    def transition(self, state, control, time, step):
        position, velocity = state.unbind(-1)
        mean = self.gain * control[..., 0] - self.damping * velocity
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise))
        faster = velocity + acceleration * step
        return stack(position + 0.5 * (velocity + faster) * step, faster)

    def observe(self, state):
        pyro.sample("position", dist.Normal(state[..., 0], self.measurement_sd))

    def example_controls(self, time):
        """A slow push and pull."""
        return time.sin().unsqueeze(-1)
