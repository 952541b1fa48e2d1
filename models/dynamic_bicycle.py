"""A car at speed: a bicycle whose tyres slip in proportion to their side force; list your own sensors."""

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import PlanarVehicle, stack
from steady_ppl.sensors import Heading, Position, YawRate


class DynamicBicycle(PlanarVehicle):
    """A single-track model with linear tyres, commanded by a speed and a steering angle.

    f_front = −front · (w + a · yaw_rate − v · steering) / s              v forward, w lateral velocity
    f_rear  = −rear · (w − b · yaw_rate) / s                              s = √(v² + slow²)
    a_forward = (speed − v) / speed_time − w · yaw_rate
    a_lateral = f_front + f_rear
    a_yaw     = (a · f_front − b · f_rear) / gyration²

    `front` and `rear` are axle cornering stiffnesses over the mass, `gyration` is √(inertia / mass), and the axles are
    a and b m from the tracked centre of mass. Near standstill the slip angles are regularised by `slow`: the
    tyres then damp sideways motion and stay finite. A step is the implicit midpoint rule, stable for stiff tyres.
    Source: Rajamani, Vehicle Dynamics and Control, 2012, 2.3.
    """

    controls = ("speed [m/s]", "steering [rad]")
    sensors = (Position(sd=0.3, name="gps"), Heading(sd=0.02, name="compass"), YawRate(sd=0.01, name="gyro"))
    guesses = ("noise",)
    substeps = 4
    duration = 20.0
    axles = (1.2, 1.6)  # m
    slow = 1.0  # m/s

    def __init__(self):
        super().__init__()
        self.front = PyroParam(tensor(50.0), constraints.positive)  # m/s² a radian
        self.rear = PyroParam(tensor(60.0), constraints.positive)  # m/s² a radian
        self.gyration = PyroParam(tensor(1.4), constraints.positive)  # m
        self.speed_time = PyroParam(tensor(1.0), constraints.positive)  # s
        self.noise = PyroParam(tensor([0.5, 0.5, 0.2]), constraints.positive)  # m/s², m/s², rad/s²

    def initial(self):
        sd = tensor([3.0, 3.0, 3.0, 2.0, 2.0, 0.2]).to(self.noise)
        return pyro.sample("start", dist.Normal(torch.zeros_like(sd), sd).to_event(1))

    def transition(self, state, control, time, step):
        speed, steering = control.unbind(-1)
        forward, lateral, yaw_rate = self.body_velocity(state)
        (ahead, behind), half, arm = self.axles, 0.5 * step, self.gyration**2
        faster = (speed - forward) / (self.speed_time + half)
        v = forward + half * faster
        slowness = (v * v + self.slow**2).rsqrt()
        front, rear = self.front * slowness, self.rear * slowness
        uneven = behind * rear - ahead * front
        # rates of (w, yaw_rate) = matrix · (w, yaw_rate) + push, taken in the middle of the step
        ww, wr, rw, rr = -front - rear, uneven - v, uneven / arm, -(ahead**2 * front + behind**2 * rear) / arm
        push = front * v * steering
        sideways = ww * lateral + wr * yaw_rate + push
        yaw = rw * lateral + rr * yaw_rate + ahead * push / arm
        scale = (1 - half * ww) * (1 - half * rr) - half * half * wr * rw
        sideways, yaw = (
            ((1 - half * rr) * sideways + half * wr * yaw) / scale,
            ((1 - half * ww) * yaw + half * rw * sideways) / scale,
        )
        turning = yaw_rate + half * yaw
        mean = stack(faster - (lateral + half * sideways) * turning, sideways + v * turning, yaw)
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)

    def example_controls(self, time):
        """Speeds and steering angles held for two seconds each."""
        held = (time / 2).long()
        values = torch.rand(2, int(held.max()) + 1, time.shape[1])
        speed, steering = (part.gather(0, held).to(time) for part in (8 + 10 * values[0], 0.1 * values[1] - 0.05))
        return torch.stack([speed, steering], -1)
