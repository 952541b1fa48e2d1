"""A robot on two driven wheels, told the speed of each: list your own sensors."""

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import PlanarVehicle, stack
from steady_ppl.sensors import Position, WheelSpeed, YawRate


class DifferentialDrive(PlanarVehicle):
    """Two wheels on one axle reach their commanded speeds in about a tenth of a second, and do not slip.

    l = size · left_wheel,  r = size · ratio · right_wheel                speeds over ground
    a_forward = ((l + r) / 2 − v) / settling − w · yaw_rate               v forward, w lateral velocity
    a_lateral = −w / settling + v · yaw_rate
    a_yaw     = ((r − l) / track − yaw_rate) / settling

    A step takes the mean of these exponential responses over itself. The tracked point is the middle of the axle.
    `size` is the left wheel's radius over the assumed one, `ratio` the right wheel's radius over the left one's.
    Source: Borenstein and Feng, Measurement and correction of systematic odometry errors in mobile robots, 1996.
    """

    controls = ("left_wheel [m/s]", "right_wheel [m/s]")
    sensors = (
        Position(sd=0.05, name="tag"),
        YawRate(sd=0.02, name="gyro"),
        WheelSpeed(sd=0.02, name="left_encoder", left="half_track", size="size"),
        WheelSpeed(sd=0.02, name="right_encoder", left="minus_half_track", size="right_size"),
    )
    guesses = ("noise",)
    slips = False
    substeps = 2
    settling = 0.1  # s
    half_track = property(lambda self: 0.5 * self.track)
    minus_half_track = property(lambda self: -0.5 * self.track)
    right_size = property(lambda self: self.size * self.ratio)

    def __init__(self):
        super().__init__()
        self.track = PyroParam(tensor(0.4), constraints.positive)  # m
        self.size = PyroParam(tensor(1.0), constraints.positive)
        self.ratio = PyroParam(tensor(1.0), constraints.positive)
        self.noise = PyroParam(tensor([0.5, 0.5, 1.0]), constraints.positive)  # m/s², m/s², rad/s²

    def initial(self):
        sd = tensor([3.0, 3.0, 3.0, 0.5, 0.5, 0.5]).to(self.noise)
        return pyro.sample("start", dist.Normal(torch.zeros_like(sd), sd).to_event(1))

    def transition(self, state, control, time, step):
        left, right = (control * stack(self.size, self.right_size)).unbind(-1)
        forward, lateral, yaw_rate = self.body_velocity(state)
        rate = (1 - (-step / self.settling).exp()) / step
        faster = (0.5 * (left + right) - forward) * rate
        yaw = ((right - left) / self.track - yaw_rate) * rate
        sideways = (forward + 0.5 * step * faster) * (yaw_rate + 0.5 * step * yaw)
        mean = stack(faster - lateral * yaw_rate, sideways - lateral * rate, yaw)
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)

    def example_controls(self, time):
        """Wheel speeds held for three seconds each."""
        held = (time / 3).long()
        values = torch.rand(2, int(held.max()) + 1, time.shape[1])
        return torch.stack([(0.2 + 0.6 * part).gather(0, held).to(time) for part in values], -1)
