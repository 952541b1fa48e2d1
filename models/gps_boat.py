"""A boat with two thrusters, a GPS receiver and a compass: the file to copy where a sensor measures the pose itself."""

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import PlanarVehicle, WrappedNormal, stack


class GpsBoat(PlanarVehicle):
    """Two thrusters side by side, nothing brakes.

    a_forward = (left + right) / mass,  a_lateral = 0,  a_yaw = arm · (right − left)      [body frame]

    The state is x, y, heading and their velocities in the world frame; `integrate` turns body-frame accelerations into
    the next one.
    """

    controls = ("left [N]", "right [N]")
    measurements = ("gps_x [m]", "gps_y [m]", "compass [rad]")
    guesses = ("noise",)
    duration = 20.0

    def __init__(self):
        super().__init__()
        self.mass = PyroParam(tensor(20.0), constraints.positive)  # kg
        self.arm = PyroParam(tensor(0.05), constraints.positive)  # rad/s² a newton
        self.noise = PyroParam(tensor([0.1, 0.1, 0.05]), constraints.positive)  # m/s², m/s², rad/s²

    def initial(self):
        sd = tensor([10.0, 10.0, 3.0, 1.0, 1.0, 0.3])  # wide: a drive may begin anywhere
        return pyro.sample("start", dist.Normal(torch.zeros_like(sd).to(self.noise), sd.to(self.noise)).to_event(1))

    def transition(self, state, control, time, step):
        left, right = control.unbind(-1)
        mean = stack((left + right) / self.mass, torch.zeros_like(left), self.arm * (right - left))
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)

    def observe(self, state):
        pyro.sample("gps", dist.Normal(state[..., :2], 0.5).to_event(1))  # 0.5 m
        pyro.sample("compass", WrappedNormal(state[..., 2:3], 0.05).to_event(1))  # 3°, from the x axis anticlockwise

    def example_controls(self, time):
        """Another pair of thrusts every three seconds."""
        choices = 10 * torch.rand(int(self.duration / 3) + 1, time.shape[1], 2, dtype=time.dtype)
        chosen = (time / 3).long().clamp(0, len(choices) - 1)
        return choices[chosen, torch.arange(time.shape[1])]


class GpsBoatTruth(GpsBoat):
    """What its owner does not know: water brakes in three ways."""

    effects = ("yaw_linear_drag=0.6", "side_slip=1.0", "quadratic_drag=0.15")
    substeps = 8
