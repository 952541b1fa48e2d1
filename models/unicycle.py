"""A robot commanded by a speed and a turn rate: the file to copy for differential drives; list your own sensors."""

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import PlanarVehicle, stack
from steady_ppl.sensors import Bearings, Ranges, YawRate


class Unicycle(PlanarVehicle):
    """It reaches what it is told in about a tenth of a second, and does not slip.

    a_forward = (speed_gain · speed − v) / settling − w · yaw_rate      v forward, w lateral velocity
    a_lateral = −w / settling + v · yaw_rate
    a_yaw     = (turn_gain · turn − yaw_rate) / settling

    A step takes the mean of these exponential responses over itself.
    """

    controls = ("speed [m/s]", "turn [rad/s]")
    landmarks = ((0.0, 0.0), (5.0, 0.0), (5.0, 5.0), (0.0, 5.0))
    sensors = (Ranges(sd=0.1), Bearings(sd=0.05), YawRate(sd=0.02, name="gyro"))
    guesses = ("noise",)
    slips = False
    substeps = 2
    settling = 0.1  # s

    def __init__(self):
        super().__init__()
        self.speed_gain = PyroParam(tensor(1.0), constraints.positive)
        self.turn_gain = PyroParam(tensor(1.0), constraints.positive)
        self.noise = PyroParam(tensor([1.0, 1.0, 1.0]), constraints.positive)  # m/s², m/s², rad/s²

    def initial(self):
        mean = tensor([2.5, 2.5, 0.0, 0.0, 0.0, 0.0]).to(self.noise)
        sd = tensor([3.0, 3.0, 3.0, 0.5, 0.5, 0.5]).to(self.noise)
        return pyro.sample("start", dist.Normal(mean, sd).to_event(1))

    def transition(self, state, control, time, step):
        speed, turn = control.unbind(-1)
        forward, lateral, yaw_rate = self.body_velocity(state)
        rate = (1 - (-step / self.settling).exp()) / step
        mean = stack(
            (self.speed_gain * speed - forward) * rate - lateral * yaw_rate,
            -lateral * rate + forward * yaw_rate,
            (self.turn_gain * turn - yaw_rate) * rate,
        )
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)

    def example_controls(self, time):
        """Speeds and turn rates held for three seconds each."""
        held = (time / 3).long()
        values = torch.rand(2, int(held.max()) + 1, time.shape[1])
        speed, turn = (part.gather(0, held).to(time) for part in (values[0], 2 * values[1] - 1))
        return torch.stack([speed, turn], -1)
