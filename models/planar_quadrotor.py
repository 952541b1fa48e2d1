"""A quadrotor in a vertical plane: y points up, gravity pulls; list your own sensors."""

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import PlanarVehicle, stack
from steady_ppl.sensors import Heading, Position, YawRate


class PlanarQuadrotor(PlanarVehicle):
    """Two rotors on a bar. The state is a planar vehicle's: x sideways, y up, the heading is the bar's tilt.

    a_forward = −drag · v − gravity · sin(tilt)              v along the bar, tilt anticlockwise from level
    a_lateral = (left + right) / mass − gravity · cos(tilt)
    a_yaw     = arm · (right − left) / inertia

    The rotors push across the bar, "lateral", and stand `arm` m from its middle, the right one ahead. They drag along
    it in proportion to the speed. Forces are those in the middle of a step. Source: Mahony, Kumar and Corke,
    Multirotor Aerial Vehicles, IEEE Robotics and Automation Magazine, 2012.
    """

    controls = ("left [N]", "right [N]")
    sensors = (Position(sd=0.01, name="marker"), Heading(sd=0.01, name="tilt"), YawRate(sd=0.02, name="gyro"))
    guesses = ("noise",)
    substeps = 2
    step = 0.05
    duration = 6.0
    gravity = 9.81  # m/s²
    arm = 0.15  # m

    def __init__(self):
        super().__init__()
        self.mass = PyroParam(tensor(0.5), constraints.positive)  # kg
        self.inertia = PyroParam(tensor(0.004), constraints.positive)  # kg m²
        self.drag = PyroParam(tensor(0.3), constraints.positive)  # 1/s
        self.noise = PyroParam(tensor([0.2, 0.2, 0.5]), constraints.positive)  # m/s², m/s², rad/s²

    def initial(self):
        sd = tensor([1.0, 1.0, 0.2, 0.3, 0.3, 0.2]).to(self.noise)
        return pyro.sample("start", dist.Normal(torch.zeros_like(sd), sd).to_event(1))

    def transition(self, state, control, time, step):
        early = self.response(state, control)
        mean = self.response(self.halfway(state, early, step), control)
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)

    def response(self, state, control):
        """Accelerations in the body frame, `(..., 3)`."""
        left, right = control.unbind(-1)
        along, _, _ = self.body_velocity(state)
        tilt = state[..., 2]
        return stack(
            -self.drag * along - self.gravity * tilt.sin(),
            (left + right) / self.mass - self.gravity * tilt.cos(),
            self.arm * (right - left) / self.inertia,
        )

    def example_controls(self, time):
        """Thrusts about that of hovering; the tilt swings by some tenths of a radian."""
        size, sign = torch.rand(2, time.shape[1]).to(time)
        difference = 0.08 * (sign - 0.5).sign() * (0.5 + size) * (3 * time).cos()
        hover = 0.25 * self.gravity * (1 + 0.2 * ((1 + 2 * size) * time).sin())
        return torch.stack([hover - difference, hover + difference], -1)
