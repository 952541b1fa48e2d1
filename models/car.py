"""A car commanded by a speed and a steering angle, with a GPS antenna and a gyroscope: list your own sensors."""

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
    a_lateral = −(w − rear · yaw_rate) / settling + rear · a_yaw + v · yaw_rate
    a_yaw     = (v tan(steering) / wheelbase − yaw_rate) / settling

    A step takes the mean of these exponential responses over itself.
    The rear axle is `rear` m behind the tracked point, 0 by default; a subclass sets it to a number or a `PyroParam`.
    The antenna's place, m ahead of the tracked point and to its left, is learned. Trajectories determine only the
    antenna's distance from the rear axle: learn one of the two. Source: Rajamani, Vehicle Dynamics and Control, 2012,
    2.2.
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
        self.rear = 0.0  # m
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
        faster = (speed - forward) * rate
        halfway = forward + 0.5 * step * faster  # the speed in the middle of the step
        yaw = (halfway * steering.tan() / self.wheelbase - yaw_rate) * rate
        turning = yaw_rate + 0.5 * step * yaw
        slip = lateral - self.rear * yaw_rate
        grip = self.rear * yaw - slip * rate
        mean = stack(faster - (lateral + 0.5 * step * grip) * turning, grip + halfway * turning, yaw)
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)

    def example_controls(self, time):
        """Speeds and steering angles held for three seconds each."""
        held = (time / 3).long()
        values = torch.rand(2, int(held.max()) + 1, time.shape[1])
        speed, steering = (part.gather(0, held).to(time) for part in (1 + 4 * values[0], 0.8 * values[1] - 0.4))
        return torch.stack([speed, steering], -1)
