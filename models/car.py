"""A car that is told a speed and a steering angle, with a GPS antenna and a gyroscope: list your own sensors."""

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import PlanarVehicle, stack
from steady_ppl.sensors import Position, YawRate


class Car(PlanarVehicle):
    """A kinematic bicycle: its rear axle does not slip, its front wheels point where they roll.

    a_forward = (speed − v) / settling − w · yaw_rate                     v forward, w lateral velocity
    a_lateral = −w / settling + v · yaw_rate
    a_yaw     = (v tan(steering) / wheelbase − yaw_rate) / settling

    A step takes the mean of these exponential responses over itself.
    The tracked point is the middle of the rear axle; where the antenna is from there, m ahead and to the left, is
    learned.
    """

    controls = ("speed [m/s]", "steering [rad]")
    sensors = (Position(sd=0.3, name="gps", offset="antenna"), YawRate(sd=0.02, name="gyro"))
    guesses = ("noise", "antenna")
    slips = False
    substeps = 4
    duration = 20.0
    settling = 0.1  # s

    def __init__(self):
        super().__init__()
        self.wheelbase = PyroParam(tensor(2.8), constraints.positive)  # m
        self.antenna = PyroParam(tensor([1.0, 0.0]), constraints.real)  # m
        self.noise = PyroParam(tensor([2.0, 2.0, 1.0]), constraints.positive)  # m/s², m/s², rad/s²

    def initial(self):
        sd = tensor([3.0, 3.0, 3.0, 3.0, 3.0, 0.3]).to(self.noise)
        return pyro.sample("start", dist.Normal(torch.zeros_like(sd), sd).to_event(1))

    def transition(self, state, control, time, step):
        speed, steering = control.unbind(-1)
        forward, lateral, yaw_rate = self.body_velocity(state)
        rate = (1 - (-step / self.settling).exp()) / step
        halfway = forward + 0.5 * step * rate * (speed - forward)  # the speed in the middle of the step
        turn = halfway * steering.tan() / self.wheelbase
        mean = stack(
            (speed - forward) * rate - lateral * yaw_rate,
            -lateral * rate + halfway * (yaw_rate + 0.5 * step * rate * (turn - yaw_rate)),
            (turn - yaw_rate) * rate,
        )
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)

    def example_controls(self, time):
        """Speeds and steering angles held for three seconds each."""
        held = (time / 3).long()
        values = torch.rand(2, int(held.max()) + 1, time.shape[1])
        speed, steering = (part.gather(0, held).to(time) for part in (1 + 4 * values[0], 0.8 * values[1] - 0.4))
        return torch.stack([speed, steering], -1)
