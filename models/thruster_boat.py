"""A boat with two thrusters that carries water along: surge, sway and yaw; list your own sensors."""

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from pyro.nn import PyroParam
from torch import tensor

from steady_ppl import PlanarVehicle, stack
from steady_ppl.sensors import Heading, Position


class ThrusterBoat(PlanarVehicle):
    """A hull with added mass, its Coriolis terms, and linear and quadratic damping, in still water.

    m₁ u̇ = left + right + m₂ w r − d₁(u)                    u forward, w lateral velocity, r yaw rate
    m₂ ẇ = −m₁ u r − d₂(w)                                   dᵢ(x) = linearᵢ x + quadraticᵢ x|x|
    m₃ ṙ = arm · (right − left) + (m₁ − m₂) u w − d₃(r)
    a_forward = u̇ − w r,  a_lateral = ẇ + u r,  a_yaw = ṙ

    `mass` includes the added mass: m₁ and m₂ in kg, m₃ in kg m². The thrusters stand `arm` m from the middle line.
    Forces are those in the middle of a step. Source: Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control,
    2011, 7.3, with diagonal matrices.
    """

    controls = ("left [N]", "right [N]")
    sensors = (Position(sd=0.3, name="gps"), Heading(sd=0.03, name="compass"))
    guesses = ("noise",)
    substeps = 2
    duration = 30.0
    arm = 0.3  # m

    def __init__(self):
        super().__init__()
        self.mass = PyroParam(tensor([25.0, 30.0, 4.0]), constraints.positive)
        self.linear = PyroParam(tensor([6.0, 40.0, 4.0]), constraints.positive)  # N s/m, N s/m, N m s
        self.quadratic = PyroParam(tensor([6.0, 40.0, 4.0]), constraints.positive)  # N s²/m², N s²/m², N m s²
        self.noise = PyroParam(tensor([0.05, 0.05, 0.05]), constraints.positive)  # m/s², m/s², rad/s²

    def initial(self):
        sd = tensor([5.0, 5.0, 3.0, 0.5, 0.5, 0.2]).to(self.noise)
        return pyro.sample("start", dist.Normal(torch.zeros_like(sd), sd).to_event(1))

    def transition(self, state, control, time, step):
        early = self.response(state, control)
        mean = self.response(self.halfway(state, early, step), control)
        acceleration = pyro.sample("acceleration", dist.Normal(mean, self.noise).to_event(1))
        return self.integrate(state, acceleration, step)

    def response(self, state, control):
        """Accelerations in the body frame, `(..., 3)`."""
        left, right = control.unbind(-1)
        u, w, r = self.body_velocity(state)
        surging, swaying, _ = self.mass.unbind(-1)
        velocity = stack(u, w, r)
        force = stack(
            left + right + swaying * w * r,
            -surging * u * r,
            self.arm * (right - left) + (surging - swaying) * u * w,
        )
        damped = force - (self.linear + self.quadratic * velocity.abs()) * velocity
        return damped / self.mass + stack(-w * r, u * r, torch.zeros_like(r))

    def example_controls(self, time):
        """Another pair of thrusts every three seconds."""
        held = (time / 3).long()
        values = torch.rand(2, int(held.max()) + 1, time.shape[1])
        return torch.stack([(10 * part - 1).gather(0, held).to(time) for part in values], -1)
